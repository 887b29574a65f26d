//! The things to grasp: solids of convex parts, made from seeds or read from URDF files.

pub mod procedural;
mod urdf;

use std::path::Path;
use std::sync::Arc;

use rand::{Rng, RngExt};

use grasp_picture::Mesh;
pub use urdf::ObjectError;

/// A rigid object. Its frame has z up in the pose in which it best stands on a table.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// A name for reports: the kind and the seed, or the URDF's file name.
    pub name: String,
    /// The collision shape: convex, closed meshes in the object's frame. They may overlap.
    pub parts: Vec<Mesh>,
    /// The surface a camera sees, in the object's frame.
    pub visual: Mesh,
    /// Mass, kg.
    pub mass: f64,
    /// Coulomb friction coefficient against the gripper's fingers.
    pub friction: f64,
}

impl Object {
    /// Writes it into a folder as URDF and OBJ, as [`ObjectSet::load`] reads them.
    ///
    /// # Errors
    /// [`ObjectError::Write`] names the file.
    pub fn save(&self, dir: &Path) -> Result<(), ObjectError> {
        urdf::save(self, dir)
    }
}

/// Which procedural objects: the sets share no seed, hence no object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// 303 objects of every kind, to learn from.
    Train,
    /// 40 objects of every kind, to be tested in piles.
    PileTest,
    /// 16 objects that stand upright, to be tested packed.
    PackedTest,
}

/// What scenes draw their objects from; never empty.
#[derive(Clone, Debug)]
pub struct ObjectSet {
    /// Those to draw from; none for objects without end.
    objects: Vec<Arc<Object>>,
}

impl ObjectSet {
    /// The objects of a split, the same on every call.
    #[must_use]
    pub fn procedural(split: Split) -> ObjectSet {
        let seeds = procedural::seeds(split).into_iter();
        ObjectSet { objects: seeds.map(|seed| Arc::new(procedural::object(seed))).collect() }
    }

    /// A new object at every draw, to learn from: none of any test set, hardly ever one twice.
    #[must_use]
    pub fn generated() -> ObjectSet {
        ObjectSet { objects: Vec::new() }
    }

    /// Reads every `*.urdf` of a folder, in the order of their names.
    ///
    /// # Errors
    /// A folder that cannot be read or holds no URDF, and any file that is not a well-formed
    /// single-link object; the error names the file.
    pub fn load(dir: &Path) -> Result<ObjectSet, ObjectError> {
        let objects = urdf::load_folder(dir)?.into_iter().map(Arc::new).collect();
        Ok(ObjectSet { objects })
    }

    /// These objects; `None` of none.
    #[must_use]
    pub fn of(objects: Vec<Arc<Object>>) -> Option<ObjectSet> {
        (!objects.is_empty()).then_some(ObjectSet { objects })
    }

    /// Any of them, each as likely.
    pub fn draw(&self, rng: &mut impl Rng) -> Arc<Object> {
        if self.objects.is_empty() {
            return Arc::new(procedural::object(rng.random_range(procedural::GENERATED)));
        }
        Arc::clone(&self.objects[rng.random_range(0..self.objects.len())])
    }

    /// Those there are; none of a set without end.
    #[must_use]
    pub fn listed(&self) -> &[Arc<Object>] {
        &self.objects
    }
}
