use anyhow::ensure;
use clap::{Args, ValueEnum};
use grasp_client::{DetectOptions, pb};

use crate::numbers::Numbers;
use crate::pose::Poses;

/// Options of the detection.
#[derive(Args, Clone)]
#[command(next_help_heading = "Grasps")]
pub(crate) struct DetectArgs {
    /// Model, one of `grasp models`. Default: the server's default model.
    #[arg(long, default_value = "", hide_default_value = true)]
    model: String,

    /// Version of the model (not of this program). Default: the newest.
    #[arg(long, default_value = "", hide_default_value = true)]
    version: String,

    /// Smallest quality of a grasp, greater than 0 and at most 1. Default: the model's threshold.
    #[arg(long)]
    threshold: Option<f32>,

    /// If no grasp reaches the threshold, return the best grasp if its quality is at least this.
    #[arg(long)]
    force: Option<f32>,

    /// Return at most this many grasps, best first. 0: no limit.
    #[arg(long, default_value_t = 0)]
    max_grasps: u32,

    /// Return only grasps on the objects with these labels (see --labels); the others remain obstacles.
    #[arg(long, value_name = "LABEL,…", value_delimiter = ',')]
    objects: Vec<u32>,

    /// Return at most this many grasps on one object, with --labels. 0: no limit.
    #[arg(long, value_name = "N", default_value_t = 0)]
    max_grasps_per_object: u32,

    /// Smallest distance of the fingertips from the sides of the workspace's cube, metres: an object that a side cuts
    /// looks like a thinner one. Default: 0.
    #[arg(long, value_name = "METRES")]
    margin: Option<f64>,

    /// Batch priority, for offline processing: requests with normal priority are processed first.
    #[arg(long)]
    batch: bool,

    /// Also report how many voxels were dropped, by reason.
    #[arg(long)]
    explain: bool,

    /// Only grasps whose point between the fingertips lies in this box: its minimum and maximum corner in the frame of
    /// the grasps, metres.
    #[arg(long, value_name = "X,Y,Z,X,Y,Z", allow_hyphen_values = true)]
    region: Option<Numbers<6>>,

    /// Pose of the frame of --region in the frame of the grasps, for a box of any orientation. Formats as for
    /// --workspace.
    #[arg(long, value_name = "FILE|NUMBERS", requires = "region", allow_hyphen_values = true)]
    region_pose: Option<Poses>,

    /// Only grasps whose approach direction is within this angle of a direction in the frame of the grasps.
    #[arg(long, value_name = "X,Y,Z,DEGREES", allow_hyphen_values = true)]
    approach: Option<Numbers<4>>,

    /// Smallest z of any corner of the open hand in the frame of the grasps, metres.
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    min_height: Option<f64>,

    /// Gripper: maximum opening; depth, thickness and breadth of the fingers, metres. Default: Panda hand.
    #[arg(long, value_name = "OPENING,DEPTH,WIDTH,BREADTH")]
    gripper: Option<Numbers<4>>,

    /// Bounding box of the palm in the grasp frame: minimum and maximum corner, metres. Default: no palm.
    #[arg(long, value_name = "X,Y,Z,X,Y,Z", allow_hyphen_values = true, requires = "gripper")]
    palm: Option<Numbers<6>>,

    /// Check of the open hand for collisions with the observed surface and the table. Default: filter for depth images
    /// and point clouds, off for a volume.
    #[arg(long, value_enum)]
    collision: Option<Collision>,

    /// Smallest distance between the hand and the obstacles in the collision check, metres. Default: 0.
    #[arg(long, value_name = "METRES")]
    clearance: Option<f64>,

    /// In the collision check, also treat as an obstacle what lies behind a surface in a view and was measured by no
    /// view.
    #[arg(long)]
    hidden: bool,

    /// Height of the table above the bottom of the workspace, metres; negative: no table. Default: 0.05.
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    table_height: Option<f64>,

    /// Origin of the grasp frame.
    #[arg(long, value_enum, default_value_t = Origin::FingerBase)]
    origin: Origin,

    /// Axis of the grasp frame along which the fingers close.
    #[arg(long, value_enum, default_value_t = Closing::Y)]
    closing: Closing,

    /// T_parent_grasp for `--origin parent`: pose of the finger base in the parent link. Formats as for --workspace.
    #[arg(long, value_name = "FILE|NUMBERS", required_if_eq("origin", "parent"), allow_hyphen_values = true)]
    parent_from_grasp: Option<Poses>,

    /// Distance of the pre-grasp from the grasp, back along the approach, metres. Default: 0.05.
    #[arg(long, value_name = "METRES")]
    pregrasp: Option<f64>,

    /// Distance of the retreat, metres. Default: 0.1.
    #[arg(long, value_name = "METRES")]
    retreat: Option<f64>,

    /// Direction of the retreat in the frame of the grasps. Default: back along the approach.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    retreat_direction: Option<Numbers<3>>,
}

#[derive(Clone, Copy, ValueEnum)]
enum Collision {
    /// No check.
    Off,
    /// Mark grasps that collide.
    Flag,
    /// Drop grasps that collide.
    Filter,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Origin {
    /// Midpoint between the finger bases.
    FingerBase,
    /// Midpoint between the fingertips.
    Tcp,
    /// The robot link that carries the hand.
    Parent,
}

#[derive(Clone, Copy, ValueEnum)]
enum Closing {
    Y,
    X,
}

impl DetectArgs {
    /// The options as a protocol message.
    pub fn read(&self) -> anyhow::Result<DetectOptions> {
        ensure!(
            self.parent_from_grasp.is_none() || self.origin == Origin::Parent,
            "--parent-from-grasp needs --origin parent"
        );
        ensure!(
            !matches!(self.collision, Some(Collision::Off)) || self.clearance.is_none() && !self.hidden,
            "--clearance and --hidden exclude --collision off"
        );
        let parent_from_grasp = self.parent_from_grasp.as_ref().map(Poses::one).transpose()?;
        let vector = |[x, y, z]: [f64; 3]| Some(pb::Vector3 { x, y, z });
        let corners = |Numbers([a, b, c, x, y, z])| pb::Box { min: vector([a, b, c]), max: vector([x, y, z]) };
        let region_pose = self.region_pose.as_ref().map(Poses::one).transpose()?;
        let Self { model, version, threshold, force, max_grasps, explain, min_height, .. } = self.clone();
        let Self { objects, max_grasps_per_object, margin, table_height, clearance, hidden, .. } = self.clone();
        Ok(DetectOptions {
            model,
            version,
            threshold,
            force,
            max_grasps,
            explain,
            min_height,
            objects,
            max_grasps_per_object,
            margin,
            priority: if self.batch { pb::Priority::Batch } else { pb::Priority::Normal }.into(),
            region: self.region.map(corners),
            region_pose: region_pose.as_ref().map(Into::into),
            approach: self
                .approach
                .map(|Numbers([x, y, z, degrees])| pb::Cone { axis: vector([x, y, z]), angle: degrees.to_radians() }),
            gripper: self.gripper.map(|Numbers([max_opening, finger_depth, finger_width, finger_breadth])| {
                pb::Gripper { max_opening, finger_depth, finger_width, finger_breadth, palm: self.palm.map(corners) }
            }),
            collision: Some(pb::CollisionCheck {
                mode: self.collision.map(|mode| mode as i32),
                table_height,
                clearance,
                hidden,
            }),
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
    fn the_values_of_the_flags_equal_the_protocols_enums() {
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
