//! Household-like objects, each generated from a seed.
//!
//! A kind (bottle, mug, pliers) defines random proportions. The size is drawn from the range of real objects, and the
//! density gives the mass.

mod containers;
mod dice;
mod food;
mod packaging;
mod shape;
mod tableware;
mod tools;
mod toys;

use std::ops::Range;

use super::{Object, Split};
pub(super) use containers::containers;
use dice::Dice;
use grasp_picture::Mesh;
use shape::Shape;

/// Friction of all objects, that of the public object sets for grasping.
const FRICTION: f64 = 1.0;
/// Ranges of the maximum length of the shortest, middle and longest side, metres. Real objects are large for a gripper
/// that opens 80 mm: of 88 household objects half are wider than that in two directions.
const SIDES: [(f64, f64); 3] = [(0.055, 0.077), (0.05, 0.17), (0.12, 0.28)];
/// Smallest length of the longest side, metres.
const SMALLEST: f64 = 0.045;
/// Payload of an arm with such a gripper, kg.
const HEAVIEST: f64 = 1.5;

/// Seeds of generated objects, which are in no split.
pub(super) const GENERATED: Range<u64> = 1 << 32..1 << 63;

/// A kind of object.
struct Kind {
    name: &'static str,
    make: fn(&mut Dice) -> Shape,
    /// Smallest and greatest density, kg/m³; low for hollow objects.
    density: (f64, f64),
    /// Whether objects of this kind stand upright.
    upright: bool,
}

const fn kind(name: &'static str, make: fn(&mut Dice) -> Shape, low: f64, high: f64, upright: bool) -> Kind {
    Kind { name, make, density: (low, high), upright }
}

/// All kinds. The remainder of the seed selects one, so that consecutive seeds give different kinds.
const KINDS: &[Kind] = &[
    kind("carton", packaging::carton, 150.0, 700.0, true),
    kind("screwdriver", tools::screwdriver, 900.0, 1800.0, false),
    kind("bottle", packaging::bottle, 200.0, 1000.0, true),
    kind("composite", toys::composite, 300.0, 1200.0, false),
    kind("mug", tableware::mug, 1200.0, 2200.0, true),
    kind("fruit", food::fruit, 500.0, 1000.0, false),
    kind("can", packaging::can, 300.0, 1100.0, true),
    kind("hammer", tools::hammer, 900.0, 2500.0, false),
    kind("bowl", tableware::bowl, 900.0, 2200.0, false),
    kind("wooden_block", toys::wooden_block, 450.0, 800.0, false),
    kind("shampoo", packaging::shampoo, 200.0, 1000.0, true),
    kind("banana", food::banana, 500.0, 950.0, false),
    kind("animal", toys::animal, 300.0, 1100.0, false),
    kind("wrench", tools::wrench, 1500.0, 4000.0, false),
    kind("cup", tableware::cup, 500.0, 2200.0, true),
    kind("slab", tools::slab, 500.0, 1500.0, false),
    kind("jar", packaging::jar, 400.0, 1300.0, true),
    kind("ring", food::ring, 300.0, 1100.0, false),
    kind("car", toys::car, 300.0, 1200.0, false),
    kind("pliers", tools::pliers, 1500.0, 3500.0, false),
    kind("milk_carton", packaging::milk_carton, 150.0, 1000.0, true),
    kind("dish", tableware::dish, 900.0, 2200.0, false),
    kind("profile", toys::profile, 400.0, 1500.0, false),
    kind("flashlight", tools::flashlight, 600.0, 1500.0, false),
    kind("teapot", tableware::teapot, 400.0, 1200.0, true),
    kind("stone", toys::stone, 400.0, 1800.0, false),
    kind("spray", packaging::spray, 200.0, 900.0, true),
    kind("scissors", tools::scissors, 1200.0, 3000.0, false),
    kind("turned", tableware::turned, 400.0, 1200.0, true),
    kind("pear", food::pear, 500.0, 1000.0, false),
    kind("brick", toys::brick, 300.0, 900.0, false),
    kind("bulb", tools::bulb, 150.0, 500.0, false),
    kind("canister", packaging::canister, 200.0, 1000.0, true),
    kind("spoon", tableware::spoon, 700.0, 2500.0, false),
    kind("figure", toys::figure, 400.0, 1100.0, false),
    kind("tray", packaging::tray, 400.0, 1100.0, false),
    kind("drill", tools::drill, 500.0, 1300.0, false),
    kind("roll", packaging::roll, 200.0, 800.0, true),
    kind("goblet", tableware::goblet, 900.0, 2300.0, true),
    kind("gear", toys::gear, 500.0, 2500.0, false),
    kind("tube", packaging::tube, 300.0, 1000.0, false),
    kind("mouse", tools::mouse, 300.0, 1100.0, false),
    kind("plane", toys::plane, 300.0, 1000.0, false),
    kind("pouch", packaging::pouch, 150.0, 700.0, true),
    kind("padlock", tools::padlock, 1200.0, 3500.0, false),
    kind("arch", toys::arch, 450.0, 900.0, false),
    kind("receiver", toys::receiver, 300.0, 900.0, false),
    kind("cone", food::cone, 300.0, 900.0, false),
    kind("slice", food::slice, 400.0, 1000.0, false),
    kind("brush", tableware::brush, 400.0, 1300.0, false),
    kind("bolt", tools::bolt, 700.0, 4000.0, false),
    kind("pen", tools::pen, 600.0, 2000.0, false),
    kind("spool", toys::spool, 300.0, 1000.0, false),
];

/// The object of a seed.
///
/// Its origin is the centre of its bounding box. The z axis points up in its most stable pose.
pub fn object(seed: u64) -> Object {
    let kind = kind_of(seed);
    let mut dice = Dice::new(seed);
    let shape = (kind.make)(&mut dice);
    let parts = fitted(shape, &mut dice).parts;
    // A quarter of the objects is filled or massive.
    let filling = if dice.chance(0.25) { dice.between(1.5, 5.0) } else { 1.0 };
    let density = dice.between(kind.density.0, kind.density.1) * filling;
    let mass = (density * parts.iter().map(Mesh::volume).sum::<f64>()).min(HEAVIEST);
    let name = format!("{}_{seed}", kind.name);
    // The visual mesh equals the collision shape.
    Object { name, visual: Mesh::union(&parts), parts, mass, friction: FRICTION }
}

/// The seeds of a split.
pub(super) fn seeds(split: Split) -> Vec<u64> {
    match split {
        Split::Train => (0..303).collect(),
        Split::PileTest => (1_000_000..1_000_040).collect(),
        Split::PackedTest => (2_000_000..).filter(|&seed| is_upright(seed)).take(16).collect(),
    }
}

fn kind_of(seed: u64) -> &'static Kind {
    &KINDS[(seed % KINDS.len() as u64) as usize]
}

/// Whether an object suits packed scenes: its kind stands upright, and it is 5–21 cm high.
fn is_upright(seed: u64) -> bool {
    kind_of(seed).upright && (0.05..0.21).contains(&object(seed).visual.extents().z)
}

/// Centres a shape on its bounding box and scales it to the maximum lengths drawn for its sides.
fn fitted(shape: Shape, dice: &mut Dice) -> Shape {
    let (low, high) = shape.bounds();
    let centre = nalgebra::center(&low, &high);
    let mut sides: [f64; 3] = (high - low).into();
    sides.sort_by(f64::total_cmp);

    let fits = SIDES.iter().zip(sides).map(|(&(least, most), side)| dice.between(least, most) / side);
    let scale = fits.fold(f64::INFINITY, f64::min).max(SMALLEST / sides[2]);
    shape.shifted(-centre.x, -centre.y, -centre.z).stretched(scale, scale, scale)
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;
    use crate::objects::ObjectSet;

    fn all() -> Vec<Object> {
        [Split::Train, Split::PileTest, Split::PackedTest].into_iter().flat_map(seeds).map(object).collect()
    }

    #[test]
    fn sets_have_their_sizes_and_share_no_object() {
        let sizes =
            [Split::Train, Split::PileTest, Split::PackedTest].map(|split| ObjectSet::procedural(split).listed().len());
        assert_eq!(sizes, [303, 40, 16]);
        let names: HashSet<String> = all().into_iter().map(|object| object.name).collect();
        assert_eq!(names.len(), 303 + 40 + 16);
        let seeds = [Split::Train, Split::PileTest, Split::PackedTest].into_iter().flat_map(seeds);
        assert!(seeds.into_iter().all(|seed| !GENERATED.contains(&seed)));
    }

    #[test]
    fn an_object_depends_only_on_its_seed() {
        let shapes: Vec<_> = (0..200).map(object).collect();
        assert_eq!(shapes, (0..200).map(object).collect::<Vec<_>>());
        let kinds = KINDS.len();
        assert!(shapes.iter().zip(&shapes[kinds..]).all(|(a, b)| a.visual != b.visual));
    }

    #[test]
    fn parts_are_convex_solids() {
        for object in all() {
            assert!((1..=32).contains(&object.parts.len()), "{}: {} parts", object.name, object.parts.len());
            for part in &object.parts {
                assert!(part.volume() > 1e-9, "{}: a part of {} m³", object.name, part.volume());
                assert!((4..=64).contains(&part.vertices.len()), "{}: {} vertices", object.name, part.vertices.len());
                for &triangle in &part.triangles {
                    let normal = part.area_normal(triangle);
                    if normal.norm() < 1e-9 {
                        continue;
                    }
                    let corner = part.corners(triangle)[0];
                    let out = part.vertices.iter().map(|p| normal.normalize().dot(&(p - corner))).fold(0.0, f64::max);
                    assert!(out < 1e-5, "{}: a vertex lies {out} m outside a face", object.name);
                }
            }
        }
    }

    #[test]
    fn objects_are_centred_and_can_be_grasped_and_lifted() {
        for object in all() {
            let (low, high) = object.visual.bounds();
            assert!((low + high.coords).coords.norm() < 1e-6, "{}: off centre", object.name);
            let size = high - low;
            assert!(size.min() > 0.003 && (0.044..0.29).contains(&size.max()), "{}: {size:?}", object.name);
            assert!((0.002..=HEAVIEST).contains(&object.mass), "{}: {} kg", object.name, object.mass);
        }
        let graspable = |object: &&Object| object.visual.extents().min() < 0.075;
        let all = all();
        assert!(all.iter().filter(graspable).count() * 100 > all.len() * 95);
    }

    #[test]
    fn packed_objects_stand() {
        for object in seeds(Split::PackedTest).into_iter().map(object) {
            assert!(stands(&object, 0.005), "{} would fall over", object.name);
        }
    }

    /// Whether the centre of mass is above the base, at least `margin` metres inside its rim.
    fn stands(object: &Object, margin: f64) -> bool {
        let volume: f64 = object.parts.iter().map(Mesh::volume).sum();
        let moment: nalgebra::Vector3<f64> =
            object.parts.iter().map(|part| part.centroid().coords * part.volume()).sum();
        let centre = moment / volume;
        let floor = object.visual.bounds().0.z + 5e-4;
        let base: Vec<_> = object.visual.vertices.iter().filter(|p| p.z < floor).collect();
        (0..32).map(|i| (f64::from(i) * std::f64::consts::TAU / 32.0).sin_cos()).all(|(y, x)| {
            let reach = |p: nalgebra::Vector3<f64>| p.x * x + p.y * y;
            base.iter().any(|p| reach(p.coords) > reach(centre) + margin)
        })
    }
}
