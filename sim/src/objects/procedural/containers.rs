//! Cartons, cans, bottles and tubs at the sizes of real ones: a test set that measures how much room the fingers need.

use super::dice::Dice;
use super::shape::{Shape, block, frustum, lathe};
use super::tableware::handle;
use super::{FRICTION, HEAVIEST, Object};
use grasp_picture::Mesh;

/// Containers of each kind.
const OF_EACH: u64 = 18;
/// Their seeds, which are in no other set.
const SEEDS: u64 = 3_000_000;
/// Smallest and greatest length of the narrower horizontal side, metres.
const WIDTHS: (f64, f64) = (0.03, 0.078);

/// A kind of container: makes one of a width.
type Kind = (&'static str, fn(f64, &mut Dice) -> Shape);

const KINDS: [Kind; 4] = [("carton", carton), ("can", can), ("bottle", bottle), ("tub", tub)];

/// All containers. The widths of each kind are evenly spread. In scenes that add objects at `scale`, they have their
/// real sizes.
pub(in crate::objects) fn containers(scale: f64) -> Vec<Object> {
    (0..OF_EACH * KINDS.len() as u64).map(|number| container(number, scale)).collect()
}

fn container(number: u64, scale: f64) -> Object {
    let (step, (kind, make)) = (number / KINDS.len() as u64, KINDS[(number % KINDS.len() as u64) as usize]);
    let width = WIDTHS.0 + (WIDTHS.1 - WIDTHS.0) * step as f64 / (OF_EACH - 1) as f64;
    let mut dice = Dice::new(SEEDS + number);
    let shape = make(width, &mut dice);
    let mass = shape.parts.iter().map(Mesh::volume).sum::<f64>() * dice.between(200.0, 1000.0);
    let (low, high) = shape.bounds();
    let centre = nalgebra::center(&low, &high);
    let shape = shape.shifted(-centre.x, -centre.y, -centre.z).stretched(1.0 / scale, 1.0 / scale, 1.0 / scale);
    Object {
        name: format!("{kind}_{:.0}mm", width * 1e3),
        visual: Mesh::union(&shape.parts),
        parts: shape.parts,
        mass: mass.min(HEAVIEST),
        friction: FRICTION,
    }
}

/// A box, half of them with a tuck flap that stands up.
fn carton(width: f64, dice: &mut Dice) -> Shape {
    let (depth, height) = (width * dice.between(1.0, 2.2), dice.between(0.06, 0.22));
    let carton = block(depth.min(0.14), width, height, 0.001);
    if dice.chance(0.5) {
        return carton;
    }
    let flap = block(depth.min(0.14) * 0.96, 0.002, dice.between(0.01, 0.03), 0.0005);
    carton.and(flap.shifted(0.0, width / 2.0 - 0.002, height))
}

/// A can with a rim, or with a snap-on lid that is wider than the body.
fn can(width: f64, dice: &mut Dice) -> Shape {
    let (r, h) = (width / 2.0, dice.between(0.06, 0.17));
    if dice.chance(0.5) {
        let rim = dice.between(0.85, 0.97) * r;
        return lathe(&[(rim, 0.0), (r, 0.006), (r, h - 0.008), (rim, h)]);
    }
    let body = r - 0.0015;
    lathe(&[(body, 0.0), (body, h)]).and(frustum(r, r, dice.between(0.006, 0.012)).shifted(0.0, 0.0, h))
}

/// A bottle with a neck and a cap, a quarter of them with a handle.
fn bottle(width: f64, dice: &mut Dice) -> Shape {
    let (r, body) = (width / 2.0, dice.between(0.07, 0.15));
    let shoulder = body + dice.between(0.5, 1.2) * r;
    let neck = dice.between(0.009, 0.016).min(0.8 * r);
    let cap = neck * dice.between(1.05, 1.35);
    let top = shoulder + dice.between(0.012, 0.035);
    let end = top + dice.between(0.012, 0.025);
    let bottle = lathe(&[
        (r * 0.95, 0.0),
        (r, 0.004),
        (r, body),
        (r * 0.85, body + (shoulder - body) * 0.45),
        (neck, shoulder),
        (neck, top),
        (cap, top + 0.001),
        (cap * 0.95, end),
    ]);
    if dice.chance(0.75) {
        return bottle;
    }
    bottle.and(handle(r, body * 0.55, dice.between(0.025, 0.035), body * 0.35))
}

/// A tub that is wider at the top, with a lid.
fn tub(width: f64, dice: &mut Dice) -> Shape {
    let (r, h) = (width / 2.0, dice.between(0.06, 0.11));
    let base = r * dice.between(0.75, 0.95);
    frustum(base, r - 0.002, h).and(frustum(r, r, dice.between(0.006, 0.012)).shifted(0.0, 0.0, h))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn containers_have_real_sizes_in_their_scenes() {
        const SCALE: f64 = 0.8;
        let containers = containers(SCALE);
        assert_eq!(containers.len(), 72);
        for container in &containers {
            let size = container.visual.extents() * SCALE;
            let width = size.x.min(size.y);
            assert!(
                (WIDTHS.0 - 1e-3..=WIDTHS.1 + 1e-3).contains(&width) && (0.06..=0.25).contains(&size.z),
                "{}: {size:?}",
                container.name
            );
        }
        let wide = containers.iter().filter(|container| container.visual.extents().y * SCALE > 0.064).count();
        assert!((18..36).contains(&wide), "{wide} of 72 leave less than 8 mm beside each finger");
    }
}
