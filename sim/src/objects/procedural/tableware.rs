//! Crockery and kitchen utensils, hollow where real ones are.

use std::f64::consts::{FRAC_PI_2, PI};

use super::dice::Dice;
use super::shape::{Section, Shape, arc, ball, block, frustum, lathe, pipe, uniform, wall};

/// A mug with a handle.
pub(super) fn mug(dice: &mut Dice) -> Shape {
    let (r, h) = (dice.between(0.028, 0.04), dice.between(0.06, 0.1));
    let base = r * dice.between(0.75, 1.0);
    let height = dice.between(0.28, 0.4) * h;
    vessel(base, r, h, dice.between(0.003, 0.006), 14).and(handle(
        r * 0.97,
        h * 0.5,
        dice.between(0.018, 0.028),
        height,
    ))
}

/// A cup, glass, pot or bucket without handle.
pub(super) fn cup(dice: &mut Dice) -> Shape {
    let (r, h) = (dice.between(0.025, 0.045), dice.between(0.045, 0.12));
    vessel(r * dice.between(0.6, 1.0), r, h, dice.between(0.002, 0.006), 16)
}

/// A bowl.
pub(super) fn bowl(dice: &mut Dice) -> Shape {
    let (r, h, t) = (dice.between(0.04, 0.06), dice.between(0.03, 0.05), dice.between(0.004, 0.006));
    let foot = r * dice.between(0.4, 0.6);
    let middle = r * 0.86;
    let rings = [(foot, foot - t, 0.0), (middle, middle - t, h * 0.42), (r, r - t, h)];
    wall(&rings, 14).and(frustum(foot - t * 0.3, foot + t, t))
}

/// A plate, saucer, tart form or pan.
pub(super) fn dish(dice: &mut Dice) -> Shape {
    let (r, h, t) = (dice.between(0.04, 0.065), dice.between(0.012, 0.025), dice.between(0.003, 0.005));
    let base = r * dice.between(0.6, 0.9);
    let dish = wall(&[(base, base - 2.0 * t, 0.0), (r, r - t, h)], 18).and(frustum(base - t, base - t, t));
    if dice.chance(0.6) {
        return dish;
    }
    dish.and(block(dice.between(0.05, 0.09), 0.013, 0.006, 0.002).shifted(r + 0.02, 0.0, h - 0.007))
}

/// A glass on a stem.
pub(super) fn goblet(dice: &mut Dice) -> Shape {
    let (foot, stem) = (dice.between(0.024, 0.034), dice.between(0.03, 0.06));
    let (r, h) = (dice.between(0.024, 0.034), dice.between(0.035, 0.06));
    let base = lathe(&[(foot, 0.0), (foot, 0.003), (0.006, 0.01), (0.004, 0.01 + stem), (r * 0.5, 0.018 + stem)]);
    let rings = [(r * 0.5, r * 0.5 - 0.003, 0.0), (r, r - 0.003, h * 0.4), (r * 0.85, r * 0.85 - 0.003, h)];
    base.and(wall(&rings, 12).shifted(0.0, 0.0, 0.018 + stem))
}

/// A teapot or kettle.
pub(super) fn teapot(dice: &mut Dice) -> Shape {
    let (r, h) = (dice.between(0.032, 0.042), dice.between(0.05, 0.07));
    let body = lathe(&[(r * 0.7, 0.0), (r, h * 0.35), (r, h * 0.6), (r * 0.6, h), (r * 0.25, h + 0.006)]);
    let knob = ball(0.007, 0.007, 0.007).shifted(0.0, 0.0, h + 0.011);
    let spout = frustum(0.012, 0.006, r * 1.1).turned_y(-0.85).shifted(-r * 0.7, 0.0, h * 0.4);
    Shape::all([body, knob, spout, handle(r * 0.9, h * 0.5, dice.between(0.018, 0.025), h * 0.32)])
}

/// A spoon, ladle or scoop, lying.
pub(super) fn spoon(dice: &mut Dice) -> Shape {
    let (length, r) = (dice.between(0.08, 0.14), dice.between(0.016, 0.026));
    let bar = Section::Square(dice.between(0.0025, 0.004), dice.between(0.005, 0.009));
    let bend = dice.between(0.004, 0.02);
    let stem = pipe(&uniform(vec![(r * 0.8, 0.008), (length * 0.4, 0.008 + bend), (length, 0.008 + bend * 0.8)], bar));
    let rings = [(r * 0.5, r * 0.5 - 0.002, 0.0), (r, r - 0.0025, r * 0.5)];
    let scoop = wall(&rings, 12).and(frustum(r * 0.5, r * 0.5, 0.0025));
    stem.and(scoop.stretched(1.25, 0.9, 1.0))
}

/// A salt cellar, pepper mill, vase or chess piece: a solid of revolution.
pub(super) fn turned(dice: &mut Dice) -> Shape {
    let r = dice.between(0.02, 0.036);
    let mut outline = vec![(r, 0.0)];
    let mut z = 0.0;
    for _ in 0..dice.count(4, 8) {
        z += dice.between(0.006, 0.026);
        outline.push((r * dice.between(0.35, 1.0), z));
    }
    if dice.chance(0.4) {
        outline.push((0.0, z + dice.between(0.005, 0.02)));
    }
    lathe(&outline)
}

/// A fork-like rake, spatula or brush, lying: a handle and a wide head.
pub(super) fn brush(dice: &mut Dice) -> Shape {
    let (length, width) = (dice.between(0.08, 0.13), dice.between(0.025, 0.06));
    let grip = frustum(0.007, dice.between(0.007, 0.012), length).stretched(0.8, 1.0, 1.0).laid_down();
    let head = block(dice.between(0.03, 0.06), width, 0.01, 0.002).shifted(-0.015, 0.0, -0.005);
    let bristles = block(0.03, width * 0.9, dice.between(0.01, 0.03), 0.001);
    let tool = grip.and(head);
    if dice.chance(0.3) { tool } else { tool.and(bristles.shifted(-0.015, 0.0, 0.004)).turned_x(PI) }
}

/// A hollow round vessel with a floor.
fn vessel(bottom: f64, top: f64, height: f64, thickness: f64, segments: usize) -> Shape {
    let rings = [(bottom, bottom - thickness, 0.0), (top, top - thickness, height)];
    wall(&rings, segments).and(frustum(bottom - thickness * 0.5, bottom - thickness * 0.5, thickness))
}

/// The handle of a cup at x = `from`, around the height `z`.
pub(super) fn handle(from: f64, z: f64, reach: f64, height: f64) -> Shape {
    let mut path = arc(0.0, 0.0, 1.0, FRAC_PI_2, -FRAC_PI_2, 7);
    path.iter_mut().for_each(|p| *p = (from - 0.002 + p.0 * reach, z + p.1 * height));
    pipe(&uniform(path, Section::Round(0.0045, 0.006)))
}
