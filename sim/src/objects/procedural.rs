//! Household-like objects made from seeds.

use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{Object, Split};
use crate::mesh::Mesh;

/// The seeds of a split.
pub(super) fn seeds(split: Split) -> Vec<u64> {
    match split {
        Split::Train => (0..303).collect(),
        Split::PileTest => (1_000_000..1_000_040).collect(),
        Split::PackedTest => (2_000_000..2_000_016).collect(),
    }
}

/// The object of a seed.
pub fn object(seed: u64) -> Object {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (w, d, h) = (rng.random_range(0.02..0.07), rng.random_range(0.02..0.07), rng.random_range(0.05..0.15));
    let part = if seed % 2 == 0 {
        Mesh::cuboid(Vector3::new(w, d, h))
    } else {
        Mesh::cylinder(w / 2.0, h, 24)
    };
    Object {
        name: format!("block_{seed}"),
        mass: part.volume() * 500.0,
        visual: part.clone(),
        parts: vec![part],
        friction: 1.0,
    }
}
