//! Candidates for the classifier of GPD, tried in simulation: images of what the hand would close on, with labels.
//!
//! GPD labels a candidate by geometry, antipodal or not; here it is what a trial in the simulator came to.

use grasp::gpd::{Cloud, Image, Params, candidates};
use grasp::{DepthImage, Intrinsics, SurfacePoint};
use grasp_data::Candidates;
use rand::seq::index;

use crate::TABLE_HEIGHT;
use crate::camera::{View, observe};
use crate::label::{Recipe, is_within_reach};
use crate::trial;

/// How close the hand may come to the table, metres: the simulator's fingers are half a millimetre broader on each side.
const CLEARANCE: f64 = 0.002;

/// GPD's parameters over the simulator's table.
#[must_use]
pub fn params() -> Params {
    Params::above(TABLE_HEIGHT + CLEARANCE)
}

/// What the views see of the objects, every pixel a point: without the table and the borders of the workspace.
#[must_use]
pub fn sights(views: &[View]) -> Vec<SurfacePoint> {
    let mut sights = Vec::new();
    for view in views {
        let image = DepthImage::new(Intrinsics::BENCHMARK, &view.depth).expect("views are of the benchmark's camera");
        sights.extend(image.points(&view.camera_from_task).filter(|point| is_within_reach(&point.position)));
    }
    sights
}

impl Recipe {
    /// Makes scene number `index`, looks at it, and tries up to [`points`](Self::points) random ones of the candidates.
    #[must_use]
    pub fn candidates(&self, index: u64) -> Candidates {
        let mut rng = self.rng(index);
        let mut world = self.scene(&mut rng);
        world.sleep();
        let cloud = Cloud::new(sights(&observe(&world, &self.views, self.noise, &mut rng)));
        let found = candidates(&cloud, &params(), &mut rng);
        let chosen = index::sample(&mut rng, found.len(), self.points.min(found.len()));
        let mut tried = Candidates::default();
        for candidate in chosen.into_iter().map(|chosen| &found[chosen]) {
            let success = trial::label(&world, &candidate.pose, 0.0).is_success();
            tried.push(index, &Image::of(&cloud, candidate), success);
        }
        tried
    }
}
