//! SHAF, the highest-point heuristic that GIGA's paper uses as a baseline, in two forms.

use grasp::gpd::ranked;
use grasp::{DecodeParams, Decoded, Grasp};
use grasp_perception::Scene;
use nalgebra::Isometry3;

use crate::hand_fit::HandFit;
use crate::{NetworkPlanner, PlanError, PlanParams, Planner};

/// SHAF on the candidates of GPD: the highest comes first.
pub struct Shaf;

impl Shaf {
    /// The default parameters. The quality is a rank and not a probability, so the threshold keeps all grasps.
    #[must_use]
    pub fn decode_params() -> DecodeParams {
        DecodeParams { threshold: 1e-6, ..DecodeParams::default() }
    }
}

impl Planner for Shaf {
    fn plan(&mut self, scene: &Scene, params: &PlanParams, is_wanted: &dyn Fn() -> bool) -> Result<Decoded, PlanError> {
        let mut fit = HandFit::new(scene, params, is_wanted)?;
        let grasps = ranked(std::mem::take(&mut fit.candidates));
        Ok(fit.select(grasps, scene, &params.decode))
    }
}

/// SHAF on the grasps of a network with a quality above 0.5: the highest comes first.
pub struct HighestProposal(pub NetworkPlanner);

impl Planner for HighestProposal {
    fn plan(&mut self, scene: &Scene, params: &PlanParams, is_wanted: &dyn Fn() -> bool) -> Result<Decoded, PlanError> {
        let decode = DecodeParams { threshold: 0.5, force: None, ..params.decode };
        let mut decoded = self.0.plan(scene, &PlanParams { decode, ..*params }, is_wanted)?;
        highest_first(&mut decoded.grasps, &scene.volume.pose().inverse());
        Ok(decoded)
    }
}

/// Sorts by the height of the grasp's position in the task frame. `task_from_frame` maps points of the frame of the
/// grasps into it. The sort is stable, so at equal height the better grasp comes first.
fn highest_first(grasps: &mut [Grasp], task_from_frame: &Isometry3<f64>) {
    let height = |grasp: &Grasp| (task_from_frame * grasp.pose).translation.z;
    grasps.sort_by(|a, b| height(b).total_cmp(&height(a)));
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::UnitQuaternion;

    use super::*;

    #[test]
    fn the_highest_proposal_comes_first_whatever_its_quality() {
        let at = |z, quality| Grasp { pose: Isometry3::translation(0.1, 0.1, z), width: 0.05, quality };
        let mut grasps = [at(0.1, 0.99), at(0.2, 0.6), at(0.15, 0.9), at(0.2, 0.55)];
        highest_first(&mut grasps, &Isometry3::identity());
        assert_eq!(grasps.map(|grasp| grasp.quality), [0.6, 0.55, 0.9, 0.99]);
        // In the frame of a camera that looks down, the highest grasp has the smallest z.
        let upside_down = Isometry3::from_parts(Default::default(), UnitQuaternion::from_euler_angles(PI, 0.0, 0.0));
        highest_first(&mut grasps, &upside_down);
        assert_eq!(grasps.map(|grasp| grasp.quality), [0.99, 0.9, 0.6, 0.55]);
    }
}
