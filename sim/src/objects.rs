//! Objects: solids of convex parts, generated from seeds or read from URDF files.

pub mod procedural;
mod urdf;

use std::path::Path;
use std::sync::Arc;

use grasp::MAX_OPENING;
use nalgebra::Vector3;
use rand::{Rng, RngExt};

use grasp_picture::Mesh;
pub use urdf::ObjectError;

/// A rigid object. The z axis of its frame points up in its most stable pose on a table.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// Name for reports: kind and seed, or the file name of the URDF.
    pub name: String,
    /// The collision shape: convex, closed meshes in the object's frame. They may overlap.
    pub parts: Vec<Mesh>,
    /// Surface for rendering, in the object's frame.
    pub visual: Mesh,
    /// Mass, kg.
    pub mass: f64,
    /// Coulomb friction coefficient against the gripper's fingers.
    pub friction: f64,
}

impl Object {
    /// The object stretched along its axes; its density stays the same.
    #[must_use]
    fn stretched(&self, factors: &Vector3<f64>) -> Object {
        let stretch = |mesh: &Mesh| mesh.mapped(|vertex| vertex.coords.component_mul(factors).into());
        Object {
            name: self.name.clone(),
            parts: self.parts.iter().map(stretch).collect(),
            visual: stretch(&self.visual),
            mass: self.mass * factors.product(),
            friction: self.friction,
        }
    }

    /// Writes URDF and OBJ files into a folder, in the format that [`ObjectSet::load`] reads.
    ///
    /// # Errors
    /// [`ObjectError::Write`] names the file.
    pub fn save(&self, dir: &Path) -> Result<(), ObjectError> {
        urdf::save(self, dir)
    }
}

/// A set of procedural objects. The sets share no seed, hence no object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// 303 objects of every kind, for training.
    Train,
    /// 40 objects of every kind, for benchmarks with piles.
    PileTest,
    /// 16 objects that stand upright, for packed benchmarks.
    PackedTest,
}

/// The set from which scenes draw their objects.
#[derive(Clone, Debug)]
pub struct ObjectSet {
    /// The objects; empty for the unlimited set of generated objects.
    objects: Vec<Arc<Object>>,
    /// Greatest factor by which a drawn object is stretched along each axis.
    stretch: Option<f64>,
    clearance: Option<Clearance>,
}

/// The free space beside drawn objects between the open fingers.
#[derive(Clone, Copy, Debug)]
struct Clearance {
    /// Greatest distance between a finger and a centred object, metres.
    most: f64,
    /// Scale at which the scene adds objects, on average.
    scale: f64,
}

impl Clearance {
    /// Greatest horizontal extent and height of a resized object in its scene, metres.
    const LARGEST: Vector3<f64> = Vector3::new(0.16, 0.16, 0.25);

    /// Factors along the axes, after which the object has a clearance drawn uniformly from 0 to `most`. A side that
    /// would exceed [`LARGEST`](Self::LARGEST) gets that length.
    fn factors(self, extents: Vector3<f64>, rng: &mut impl Rng) -> Vector3<f64> {
        let width = MAX_OPENING - 2.0 * rng.random_range(0.0..=self.most);
        let factor = width / (self.scale * extents.x.min(extents.y));
        extents.zip_map(&Self::LARGEST, |extent, largest| factor.min(largest / (self.scale * extent)))
    }
}

impl ObjectSet {
    /// The objects of a split.
    #[must_use]
    pub fn procedural(split: Split) -> ObjectSet {
        let seeds = procedural::seeds(split).into_iter();
        ObjectSet { objects: seeds.map(|seed| Arc::new(procedural::object(seed))).collect(), ..Self::generated() }
    }

    /// An unlimited set for training: every draw generates an object. It shares no object with the test sets.
    #[must_use]
    pub fn generated() -> ObjectSet {
        ObjectSet { objects: Vec::new(), stretch: None, clearance: None }
    }

    /// 72 cartons, cans, bottles and tubs, a test set: they have the sizes of real ones, 30 to 78 mm in their narrower
    /// horizontal side, in scenes that add objects at `scale` on average.
    #[must_use]
    pub fn containers(scale: f64) -> ObjectSet {
        let objects = procedural::containers(scale).into_iter().map(Arc::new).collect();
        ObjectSet { objects, ..Self::generated() }
    }

    /// Reads all `*.urdf` files of a folder, in the order of their names.
    ///
    /// # Errors
    /// If the folder cannot be read or has no URDF file, or a file is not a valid single-link object. The error names
    /// the file.
    pub fn load(dir: &Path) -> Result<ObjectSet, ObjectError> {
        let objects = urdf::load_folder(dir)?.into_iter().map(Arc::new).collect();
        Ok(ObjectSet { objects, ..Self::generated() })
    }

    /// A set of these objects; `None` if there are none.
    #[must_use]
    pub fn new(objects: Vec<Arc<Object>>) -> Option<ObjectSet> {
        (!objects.is_empty()).then_some(ObjectSet { objects, ..Self::generated() })
    }

    /// The same objects, each stretched when it is drawn: along its three axes by random factors between 1 / `stretch`
    /// and `stretch`, uniform in their logarithms. `None` leaves them as they are.
    #[must_use]
    pub fn stretched(self, stretch: Option<f64>) -> ObjectSet {
        ObjectSet { stretch, ..self }
    }

    /// The same objects, each resized when it is drawn, so that the distance between it and each finger of the open
    /// hand is uniform from 0 to `most` metres, where its narrower horizontal side is between the fingers. `scale` is the
    /// average scale at which the scene adds objects. `None` leaves them as they are.
    #[must_use]
    pub fn with_clearance(self, most: Option<f64>, scale: f64) -> ObjectSet {
        ObjectSet { clearance: most.map(|most| Clearance { most, scale }), ..self }
    }

    /// Draws an object uniformly.
    pub fn draw(&self, rng: &mut impl Rng) -> Arc<Object> {
        let object = if self.objects.is_empty() {
            Arc::new(procedural::object(rng.random_range(procedural::GENERATED)))
        } else {
            Arc::clone(&self.objects[rng.random_range(0..self.objects.len())])
        };
        let object = match self.stretch {
            None => object,
            Some(stretch) => {
                Arc::new(object.stretched(&Vector3::from_fn(|_, _| stretch.powf(rng.random_range(-1.0..=1.0)))))
            }
        };
        let Some(clearance) = self.clearance else { return object };
        Arc::new(object.stretched(&clearance.factors(object.visual.extents(), rng)))
    }

    /// The objects of the set; empty for the unlimited set.
    #[must_use]
    pub fn listed(&self) -> &[Arc<Object>] {
        &self.objects
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn clearance_is_uniform_between_the_open_fingers() {
        let (most, scale) = (0.025, 0.8);
        let objects = ObjectSet::procedural(Split::PackedTest).stretched(Some(1.35)).with_clearance(Some(most), scale);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut thirds = [0; 3];
        for _ in 0..300 {
            let extents = objects.draw(&mut rng).visual.extents() * scale;
            let clearance = (MAX_OPENING - extents.x.min(extents.y)) / 2.0;
            assert!((-1e-9..=most + 1e-9).contains(&clearance), "{clearance} m beside an object of {extents:?}");
            assert!(extents.max() <= 0.25 + 1e-9, "{extents:?}");
            thirds[((clearance / most * 3.0) as usize).min(2)] += 1;
        }
        assert!(thirds.iter().all(|&count| (70..130).contains(&count)), "{thirds:?}");
    }
}
