//! Packaging: boxes, cans, bottles.

use super::dice::Dice;
use super::shape::{Section, Shape, arc, ball, block, frustum, lathe, pipe, prism, uniform, wall};

/// A box of cereal, tea, pills …
pub(super) fn carton(dice: &mut Dice) -> Shape {
    let (x, y, z) = (dice.between(0.04, 0.1), dice.between(0.02, 0.07), dice.between(0.06, 0.18));
    block(x, y, z, 0.001)
}

/// A box for milk or juice with a roof.
pub(super) fn milk_carton(dice: &mut Dice) -> Shape {
    let (x, y) = (dice.between(0.05, 0.07), dice.between(0.045, 0.07));
    let (body, roof) = (dice.between(0.07, 0.14), dice.between(0.02, 0.035));
    let gable = prism(&[(-y / 2.0, 0.0), (y / 2.0, 0.0), (0.003, roof), (-0.003, roof)], x);
    let crest = block(x, 0.004, roof + 0.012, 0.0005);
    let carton = block(x, y, body, 0.001)
        .and(gable.turned_x(std::f64::consts::FRAC_PI_2).turned_z(std::f64::consts::FRAC_PI_2).shifted(
            -x / 2.0,
            0.0,
            body,
        ))
        .and(crest.shifted(0.0, 0.0, body));
    if dice.chance(0.5) {
        carton
    } else {
        carton.and(frustum(0.012, 0.012, 0.012).turned_x(0.9).shifted(0.0, -y / 4.0, body + roof / 3.0))
    }
}

/// A can, low (tuna) or high (drink).
pub(super) fn can(dice: &mut Dice) -> Shape {
    let (r, h) = (dice.between(0.024, 0.042), dice.between(0.035, 0.15));
    let rim = dice.between(0.82, 1.0) * r;
    lathe(&[(rim, 0.0), (r, 0.006), (r, h - 0.008), (rim, h)])
}

/// A jar with a lid.
pub(super) fn jar(dice: &mut Dice) -> Shape {
    let (r, h) = (dice.between(0.025, 0.042), dice.between(0.04, 0.11));
    let (lid, lid_h) = (r * dice.between(0.75, 1.05), dice.between(0.012, 0.02));
    let neck = lid.min(r) * 0.93;
    lathe(&[(r * 0.94, 0.0), (r, 0.004), (r, h - 0.008), (neck, h), (neck, h + 0.004)])
        .and(frustum(lid, lid, lid_h).shifted(0.0, 0.0, h + 0.004))
}

/// A bottle: body, shoulder, neck and cap.
pub(super) fn bottle(dice: &mut Dice) -> Shape {
    lathe(&bottle_outline(dice))
}

/// A bottle with an oval section, for shampoo or detergent.
pub(super) fn shampoo(dice: &mut Dice) -> Shape {
    let flat = dice.between(0.5, 0.8);
    lathe(&bottle_outline(dice)).stretched(1.2, flat, dice.between(0.8, 1.1))
}

/// A bottle whose body is a rounded box.
pub(super) fn canister(dice: &mut Dice) -> Shape {
    let (x, y, z) = (dice.between(0.05, 0.09), dice.between(0.03, 0.06), dice.between(0.07, 0.13));
    let neck = dice.between(0.009, 0.4 * y);
    let side = if dice.chance(0.5) { 0.0 } else { x / 2.0 - neck * 1.3 };
    let body = block(x, y, z, dice.between(0.08, 0.22) * y);
    let cap = frustum(neck, neck * dice.between(0.8, 1.0), dice.between(0.015, 0.03));
    let canister = body.and(cap.shifted(side, 0.0, z - 0.002));
    if dice.chance(0.6) || side == 0.0 {
        return canister;
    }
    let grip = Section::Round(0.006, 0.007);
    let handle = uniform(arc(-x * 0.15, z - 0.004, x * 0.27, 0.0, std::f64::consts::PI, 6), grip);
    canister.and(pipe(&handle))
}

/// A bottle with a trigger to spray.
pub(super) fn spray(dice: &mut Dice) -> Shape {
    let (r, h, neck) = (dice.between(0.03, 0.042), dice.between(0.08, 0.12), dice.between(0.01, 0.014));
    let top = h + dice.between(0.03, 0.045);
    let bottle = lathe(&[(r, 0.0), (r, h * 0.7), (r * 0.75, h * 0.9), (neck, h), (neck, top)]);
    let head = block(0.06, 0.02, 0.022, 0.003).shifted(0.012, 0.0, top);
    let trigger = block(0.007, 0.012, 0.035, 0.002).turned_y(-0.35).shifted(0.036, 0.0, top - 0.03);
    bottle.and(head).and(trigger).stretched(1.0, dice.between(0.65, 1.0), 1.0)
}

/// A tube of toothpaste or cream that stands on its cap.
pub(super) fn tube(dice: &mut Dice) -> Shape {
    let (r, h, cap) = (dice.between(0.014, 0.024), dice.between(0.07, 0.14), dice.between(0.012, 0.025));
    let cap_r = r * dice.between(0.7, 1.0);
    let round = (0..20).map(|i| std::f64::consts::TAU * f64::from(i) / 20.0);
    let round = round.map(|a| nalgebra::Point3::new(r * a.cos(), r * a.sin(), cap));
    let seam =
        [-1.0, 1.0].into_iter().flat_map(|x| [-0.001, 0.001].map(|y| nalgebra::Point3::new(x * r * 1.35, y, cap + h)));
    Shape::hull(round.chain(seam)).and(frustum(cap_r, cap_r, cap))
}

/// A pouch or bag: a cushion that bulges.
pub(super) fn pouch(dice: &mut Dice) -> Shape {
    let (x, y, z) = (dice.between(0.04, 0.08), dice.between(0.025, 0.045), dice.between(0.06, 0.12));
    let bulge = prism(&[(-x / 2.0, -y / 2.0), (x / 2.0, -y / 2.0), (x / 2.0, y / 2.0), (-x / 2.0, y / 2.0)], z * 0.15);
    let base = bulge.parts.iter().flat_map(|part| part.vertices.clone());
    let belly = ball(x * 0.53, y * 0.62, z * 0.3).shifted(0.0, 0.0, z * 0.42);
    let seam = block(x, 0.002, 0.004, 0.0005).shifted(0.0, 0.0, z - 0.004);
    let points = base.chain([belly, seam].into_iter().flat_map(|s| s.parts.into_iter().flat_map(|part| part.vertices)));
    let points: Vec<_> = points.filter(|p| p.z >= 0.0).collect();
    Shape::hull(points)
}

/// An open box with thin walls.
pub(super) fn tray(dice: &mut Dice) -> Shape {
    let (x, y, z) = (dice.between(0.05, 0.1), dice.between(0.045, 0.075), dice.between(0.02, 0.06));
    let t = dice.between(0.003, 0.006);
    let long = |side: f64| block(x, t, z, 0.0005).shifted(0.0, side * (y - t) / 2.0, 0.0);
    let short = |side: f64| block(t, y - 2.0 * t, z, 0.0005).shifted(side * (x - t) / 2.0, 0.0, 0.0);
    Shape::all([block(x - 0.001, y - 0.001, t, 0.0005), long(-1.0), long(1.0), short(-1.0), short(1.0)])
}

/// A roll: kitchen paper, adhesive tape.
pub(super) fn roll(dice: &mut Dice) -> Shape {
    let (outer, h) = (dice.between(0.025, 0.05), dice.between(0.012, 0.1));
    let inner = outer * dice.between(0.35, 0.8);
    wall(&[(outer, inner, 0.0), (outer, inner, h)], 18)
}

/// Radii and heights of a bottle from the base to the cap.
fn bottle_outline(dice: &mut Dice) -> Vec<(f64, f64)> {
    let r = dice.between(0.024, 0.036);
    let body = dice.between(0.06, 0.12);
    let waist = if dice.chance(0.3) { dice.between(0.8, 0.95) } else { 1.0 };
    let shoulder = body + dice.between(0.008, 0.04);
    let neck = r * dice.between(0.3, 0.55);
    let cap = neck * dice.between(1.05, 1.4);
    let cap_from = shoulder + dice.between(0.004, 0.03);
    let cap_to = cap_from + dice.between(0.012, 0.03);
    let mut outline = vec![(r * 0.93, 0.0), (r, 0.004)];
    if waist < 1.0 {
        outline.extend([(r, body * 0.3), (r * waist, body * 0.45), (r * waist, body * 0.65), (r, body * 0.8)]);
    }
    outline.extend([(r, body), (r * 0.85, body + (shoulder - body) * 0.45), (neck, shoulder), (neck, cap_from)]);
    outline.extend([(cap, cap_from + 0.001), (cap * 0.92, cap_to)]);
    outline
}
