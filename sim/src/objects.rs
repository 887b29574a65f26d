//! Objects: solids of convex parts, generated from seeds or read from URDF files.

pub mod procedural;
mod urdf;

use std::path::Path;
use std::sync::Arc;

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
}

impl ObjectSet {
    /// The objects of a split.
    #[must_use]
    pub fn procedural(split: Split) -> ObjectSet {
        let seeds = procedural::seeds(split).into_iter();
        ObjectSet { objects: seeds.map(|seed| Arc::new(procedural::object(seed))).collect(), stretch: None }
    }

    /// An unlimited set for training: every draw generates an object. It shares no object with the test sets.
    #[must_use]
    pub fn generated() -> ObjectSet {
        ObjectSet { objects: Vec::new(), stretch: None }
    }

    /// Reads all `*.urdf` files of a folder, in the order of their names.
    ///
    /// # Errors
    /// If the folder cannot be read or has no URDF file, or a file is not a valid single-link object. The error names
    /// the file.
    pub fn load(dir: &Path) -> Result<ObjectSet, ObjectError> {
        let objects = urdf::load_folder(dir)?.into_iter().map(Arc::new).collect();
        Ok(ObjectSet { objects, stretch: None })
    }

    /// A set of these objects; `None` if there are none.
    #[must_use]
    pub fn of(objects: Vec<Arc<Object>>) -> Option<ObjectSet> {
        (!objects.is_empty()).then_some(ObjectSet { objects, stretch: None })
    }

    /// The same objects, each stretched when it is drawn: along its three axes by random factors between 1 / `stretch`
    /// and `stretch`, uniform in their logarithms. `None` leaves them as they are.
    #[must_use]
    pub fn stretched(self, stretch: Option<f64>) -> ObjectSet {
        ObjectSet { stretch, ..self }
    }

    /// Draws an object uniformly.
    pub fn draw(&self, rng: &mut impl Rng) -> Arc<Object> {
        let object = if self.objects.is_empty() {
            Arc::new(procedural::object(rng.random_range(procedural::GENERATED)))
        } else {
            Arc::clone(&self.objects[rng.random_range(0..self.objects.len())])
        };
        let Some(stretch) = self.stretch else { return object };
        let factors = Vector3::from_fn(|_, _| stretch.powf(rng.random_range(-1.0..=1.0)));
        Arc::new(object.stretched(&factors))
    }

    /// The objects of the set; empty for the unlimited set.
    #[must_use]
    pub fn listed(&self) -> &[Arc<Object>] {
        &self.objects
    }
}
