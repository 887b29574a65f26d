//! Training data of GPD's classifier: images of candidates with labels. The label is the outcome of a trial in
//! simulation. GPD's authors label by geometry (antipodal or not).

use grasp::gpd::{Cloud, Image, candidates};
use grasp::{Hand, WORKSPACE_SIZE};
use grasp_data::Candidates;
use grasp_planner::{HandFit, object_points};
use rand::seq::index;

use crate::TABLE_HEIGHT;
use crate::camera::{observe, points};
use crate::label::SceneConfig;
use crate::trial;

impl SceneConfig {
    /// Generates and observes scene number `index`, and tries up to [`points`](Self::points) random candidates of GPD.
    #[must_use]
    pub fn candidates(&self, index: u64) -> Candidates {
        let mut rng = self.rng(index);
        let mut world = self.scene(&mut rng);
        world.sleep();
        let points = points(&observe(&world, &self.views, self.noise, &mut rng));
        let cloud = Cloud::new(object_points(&points, WORKSPACE_SIZE, TABLE_HEIGHT));
        let found = candidates(&cloud, &HandFit::params(Hand::GPD, TABLE_HEIGHT), &mut rng);
        let chosen = index::sample(&mut rng, found.len(), self.points.min(found.len()));
        let mut tried = Candidates::default();
        for candidate in chosen.into_iter().map(|chosen| &found[chosen]) {
            let success = trial::label(&world, &candidate.pose, 0.0).is_success();
            tried.push(index, &Image::SHAPE, Image::new(&cloud, candidate).pixels(), success);
        }
        tried
    }
}
