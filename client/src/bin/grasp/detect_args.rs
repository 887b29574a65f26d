use std::path::PathBuf;

use anyhow::ensure;
use clap::{Args, ValueEnum};
use grasp_client::{DetectOptions, pb};

use crate::numbers::Numbers;
use crate::pose;

/// What is asked of the grasps.
#[derive(Args, Clone)]
pub(crate) struct DetectArgs {
    /// Which planner answers: a network, `gpd` or `shaf`. By default the server chooses.
    #[arg(long, default_value = "", hide_default_value = true)]
    model: String,

    /// Which version of it. By default the newest.
    #[arg(long, default_value = "", hide_default_value = true)]
    version: String,

    /// Smallest quality of a grasp, above 0 and at most 1. By default the model's own.
    #[arg(long)]
    threshold: Option<f32>,

    /// When nothing reaches it, the best grasp alone, if it reaches this.
    #[arg(long)]
    force: Option<f32>,

    /// At most this many grasps, the best. 0 for all.
    #[arg(long, default_value_t = 0)]
    max_grasps: u32,

    /// Also say why the other voxels hold no grasp.
    #[arg(long)]
    explain: bool,

    /// Only grasps with their fingertips in a box: its smallest and largest coordinates, metres.
    #[arg(long, value_name = "X,Y,Z,X,Y,Z", allow_hyphen_values = true)]
    region: Option<Numbers<6>>,

    /// Only grasps that approach along a direction, at most so many degrees off.
    #[arg(long, value_name = "X,Y,Z,DEGREES", allow_hyphen_values = true)]
    approach: Option<Numbers<4>>,

    /// How low the lowest corner of the hand may be, metres along the frame's z.
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    min_height: Option<f64>,

    /// The hand: its opening, the depth, the thickness and the breadth of its fingers, metres. By default Panda's.
    #[arg(long, value_name = "OPENING,DEPTH,WIDTH,BREADTH")]
    gripper: Option<Numbers<4>>,

    /// What lies behind its fingers, a box in the grasp frame: its smallest and largest coordinates, metres. By default
    /// nothing.
    #[arg(long, value_name = "X,Y,Z,X,Y,Z", allow_hyphen_values = true, requires = "gripper")]
    palm: Option<Numbers<6>>,

    /// What becomes of grasps whose open hand would meet what was observed, or the table.
    #[arg(long, value_enum, default_value_t = Collision::Off)]
    collision: Collision,

    /// Height of the table above the volume's bottom, metres.
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    table_height: Option<f64>,

    /// Where on the hand a grasp's frame stands.
    #[arg(long, value_enum, default_value_t = Origin::FingerBase)]
    origin: Origin,

    /// Along which axis of that frame the fingers close.
    #[arg(long, value_enum, default_value_t = Closing::Y)]
    closing: Closing,

    /// T_parent_grasp, for `--origin parent`: the pose of the finger base in the link that carries the hand, one in a file
    /// as for --workspace.
    #[arg(long, value_name = "FILE", required_if_eq("origin", "parent"))]
    parent_from_grasp: Option<PathBuf>,

    /// How far back along the approach the pre-grasp is, metres. By default 0.05.
    #[arg(long, value_name = "METRES")]
    pregrasp: Option<f64>,

    /// How far the hand goes with what it holds, metres. By default 0.1.
    #[arg(long, value_name = "METRES")]
    retreat: Option<f64>,

    /// In which direction of the frame it goes. By default back along the approach.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    retreat_direction: Option<Numbers<3>>,
}

#[derive(Clone, Copy, ValueEnum)]
enum Collision {
    Off,
    /// Each grasp says whether.
    Flag,
    /// They are dropped.
    Filter,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Origin {
    /// Between the fingers, where they begin.
    FingerBase,
    /// Between the fingertips.
    Tcp,
    /// At the link that carries the hand.
    Parent,
}

#[derive(Clone, Copy, ValueEnum)]
enum Closing {
    Y,
    X,
}

impl DetectArgs {
    /// As the protocol has it.
    pub fn read(&self) -> anyhow::Result<DetectOptions> {
        ensure!(
            self.parent_from_grasp.is_none() || self.origin == Origin::Parent,
            "--parent-from-grasp needs --origin parent"
        );
        let parent_from_grasp = self.parent_from_grasp.as_deref().map(pose::one).transpose()?;
        let vector = |[x, y, z]: [f64; 3]| Some(pb::Vector3 { x, y, z });
        let corners = |Numbers([a, b, c, x, y, z])| pb::Box { min: vector([a, b, c]), max: vector([x, y, z]) };
        let Self { model, version, threshold, force, max_grasps, explain, min_height, table_height, .. } = self.clone();
        Ok(DetectOptions {
            model,
            version,
            threshold,
            force,
            max_grasps,
            explain,
            min_height,
            region: self.region.map(corners),
            approach: self
                .approach
                .map(|Numbers([x, y, z, degrees])| pb::Cone { axis: vector([x, y, z]), angle: degrees.to_radians() }),
            gripper: self.gripper.map(|Numbers([max_opening, finger_depth, finger_width, finger_breadth])| {
                pb::Gripper { max_opening, finger_depth, finger_width, finger_breadth, palm: self.palm.map(corners) }
            }),
            collision: Some(pb::CollisionCheck { mode: self.collision as i32, table_height }),
            convention: Some(pb::Convention {
                origin: self.origin as i32,
                closing_axis: self.closing as i32,
                parent_from_grasp: parent_from_grasp.as_ref().map(Into::into),
            }),
            pregrasp_distance: self.pregrasp,
            retreat: (self.retreat.is_some() || self.retreat_direction.is_some()).then(|| pb::Retreat {
                distance: self.retreat,
                direction: self.retreat_direction.and_then(|Numbers(direction)| vector(direction)),
            }),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_flags_are_the_protocols_numbers() {
        use pb::collision_check::Mode;
        use pb::convention::{ClosingAxis, Origin as Wire};
        assert_eq!(
            [Mode::Off, Mode::Flag, Mode::Filter].map(i32::from),
            [Collision::Off as i32, Collision::Flag as i32, Collision::Filter as i32]
        );
        assert_eq!(
            [Wire::FingerBase, Wire::Tcp, Wire::Parent].map(i32::from),
            [Origin::FingerBase as i32, Origin::Tcp as i32, Origin::Parent as i32]
        );
        assert_eq!([ClosingAxis::Y, ClosingAxis::X].map(i32::from), [Closing::Y as i32, Closing::X as i32]);
    }
}
