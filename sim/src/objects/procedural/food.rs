//! Fruit and baking.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use super::dice::Dice;
use super::shape::{Section, Shape, arc, ball, closed_pipe, frustum, lathe, pipe, prism, uniform};

/// An egg, apple, lemon or potato, with a base flat enough to rest on.
pub(super) fn fruit(dice: &mut Dice) -> Shape {
    let r = dice.between(0.024, 0.038);
    let (x, y, z) = (dice.between(0.8, 1.3) * r, dice.between(0.85, 1.0) * r, dice.between(0.8, 1.0) * r);
    let taper = dice.between(-0.25, 0.25);
    let round = ball(x, y, z).parts.into_iter().flat_map(|part| part.vertices);
    let body = Shape::hull(round.map(|mut p| {
        let narrow = 1.0 + taper * p.x / x;
        p.y *= narrow;
        p.z = (p.z * narrow).max(-0.9 * z);
        p
    }));
    if dice.chance(0.6) { body } else { body.and(frustum(0.002, 0.003, 0.014).shifted(0.0, 0.0, z - 0.004)) }
}

/// A pear or bell pepper, standing.
pub(super) fn pear(dice: &mut Dice) -> Shape {
    let (r, neck) = (dice.between(0.028, 0.037), dice.between(0.35, 0.65));
    let h = r * dice.between(2.0, 3.0);
    let body = lathe(&[
        (r * 0.5, 0.0),
        (r * 0.9, h * 0.12),
        (r, h * 0.32),
        (r * 0.9, h * 0.5),
        (r * neck, h * 0.75),
        (r * neck * 0.85, h * 0.92),
        (r * neck * 0.4, h),
    ]);
    body.and(frustum(0.0025, 0.002, 0.015).turned_y(0.3).shifted(0.0, 0.0, h - 0.003))
}

/// A banana, cucumber or croissant, lying on its side.
pub(super) fn banana(dice: &mut Dice) -> Shape {
    let (bend, length) = (dice.between(0.4, 2.2), dice.between(0.09, 0.16));
    let (r, tip) = (dice.between(0.012, 0.019), dice.between(0.3, 0.6));
    let path = arc(0.0, 0.0, length / bend, FRAC_PI_2 - bend / 2.0, FRAC_PI_2 + bend / 2.0, 9);
    let section = |i: usize| {
        let t = (i as f64 / 4.0 - 1.0).abs();
        let radius = r * (1.0 - (1.0 - tip) * t.powi(3));
        Section::Round(radius, radius)
    };
    pipe(&path.iter().enumerate().map(|(i, &(x, z))| (x, z, section(i))).collect::<Vec<_>>()).turned_x(FRAC_PI_2)
}

/// A doughnut, bangle or sealing ring, lying.
pub(super) fn ring(dice: &mut Dice) -> Shape {
    let (radius, a) = (dice.between(0.022, 0.036), dice.between(0.006, 0.016));
    let b = a * dice.between(0.7, 1.4);
    let section = if dice.chance(0.7) { Section::Round(a, b) } else { Section::Square(a, b) };
    let turns = arc(0.0, 0.0, radius, 0.0, TAU * 15.0 / 16.0, 16);
    closed_pipe(&uniform(turns, section)).turned_x(FRAC_PI_2)
}

/// A slice of cake, cheese or melon.
pub(super) fn slice(dice: &mut Dice) -> Shape {
    let (r, angle, h) = (dice.between(0.06, 0.1), dice.between(0.5, 1.1), dice.between(0.025, 0.05));
    let mut outline = arc(0.0, 0.0, r, -angle / 2.0, angle / 2.0, 8);
    outline.push((0.0, 0.0));
    prism(&outline, h)
}

/// A carrot, ice-cream cone or mushroom: a cone under a cap.
pub(super) fn cone(dice: &mut Dice) -> Shape {
    let (r, h) = (dice.between(0.016, 0.03), dice.between(0.05, 0.12));
    let cap = r * dice.between(0.9, 1.5);
    let dome = arc(0.0, 0.0, cap, 0.0, FRAC_PI_2, 5).into_iter().map(|(x, z)| (x, h + z * 0.9));
    let outline: Vec<_> = [(r * dice.between(0.15, 0.8), 0.0), (r, h)].into_iter().chain(dome).collect();
    let cone = lathe(&outline);
    if dice.chance(0.4) { cone.laid_down() } else { cone.turned_x(PI) }
}
