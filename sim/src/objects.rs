//! The things to grasp: solids of convex parts, made from seeds or read from URDF files.

pub mod procedural;
mod urdf;

use std::path::Path;
use std::sync::Arc;

use crate::mesh::Mesh;
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

/// A set of objects for scenes to draw from; never empty.
#[derive(Clone, Debug)]
pub struct ObjectSet {
    objects: Vec<Arc<Object>>,
}

impl ObjectSet {
    /// The objects of a split, the same on every call.
    pub fn procedural(split: Split) -> ObjectSet {
        let seeds = procedural::seeds(split).into_iter();
        ObjectSet { objects: seeds.map(|seed| Arc::new(procedural::object(seed))).collect() }
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

    /// The number of objects.
    pub fn len(&self) -> usize {
        self.objects.len()
    }

    /// Whether there are none; a set built by this module always has some.
    pub fn is_empty(&self) -> bool {
        self.objects.is_empty()
    }

    /// The object at `index`, if there are so many.
    pub fn get(&self, index: usize) -> Option<&Arc<Object>> {
        self.objects.get(index)
    }

    /// All objects in order.
    pub fn iter(&self) -> std::slice::Iter<'_, Arc<Object>> {
        self.objects.iter()
    }
}
