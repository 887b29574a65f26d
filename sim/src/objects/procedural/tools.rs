//! Tools and desk items.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use super::dice::Dice;
use super::shape::{Section, Shape, arc, ball, block, closed_pipe, frustum, lathe, pipe, prism, uniform, wall};

/// A screwdriver, chisel or file.
pub(super) fn screwdriver(dice: &mut Dice) -> Shape {
    let (grip, r) = (dice.between(0.05, 0.08), dice.between(0.01, 0.016));
    let (shaft, thin) = (dice.between(0.04, 0.09), dice.between(0.003, 0.005));
    lathe(&[(r * 0.8, 0.0), (r, grip * 0.15), (r * 0.85, grip * 0.6), (r, grip * 0.85), (r * 0.6, grip)])
        .and(frustum(thin, thin, shaft).shifted(0.0, 0.0, grip))
        .and(block(thin * 2.6, thin, 0.012, 0.0005).shifted(0.0, 0.0, grip + shaft - 0.002))
        .laid_down()
}

/// A hammer or mallet.
pub(super) fn hammer(dice: &mut Dice) -> Shape {
    let (length, r) = (dice.between(0.1, 0.16), dice.between(0.007, 0.011));
    let (head, size) = (dice.between(0.05, 0.075), dice.between(0.018, 0.028));
    let handle = frustum(r * 1.2, r, length).stretched(0.8, 1.0, 1.0);
    let head = if dice.chance(0.5) {
        block(size, head, size, 0.003).shifted(0.0, 0.0, length - size * 0.6)
    } else {
        let claw = Shape::hull(
            [(0.0, size * 0.4), (head * 0.55, size * 0.05)]
                .into_iter()
                .flat_map(|(y, h)| {
                    [-1.0, 1.0].into_iter().flat_map(move |sx| [-1.0, 1.0].map(move |sz| (y, sx * size * 0.4, sz * h)))
                })
                .map(|(y, x, z)| nalgebra::Point3::new(x, y, length - z)),
        );
        frustum(size * 0.5, size * 0.55, head * 0.6).turned_x(FRAC_PI_2).shifted(0.0, 0.0, length).and(claw)
    };
    handle.and(head).laid_down()
}

/// An open-end or combination wrench, lying.
pub(super) fn wrench(dice: &mut Dice) -> Shape {
    let (length, width, t) = (dice.between(0.06, 0.11), dice.between(0.012, 0.018), dice.between(0.006, 0.011));
    let jaw = dice.between(0.013, 0.019);
    let claw = Section::Square(jaw * 0.4, t / 2.0);
    let fork = |tilt: f64| {
        let bow = pipe(&uniform(arc(0.0, 0.0, jaw, 0.28 * PI, 1.72 * PI, 8), claw));
        // Rotated from the x–z plane into the x–y plane.
        bow.turned_x(FRAC_PI_2).turned_z(tilt).shifted(jaw * 1.2, 0.0, t / 2.0)
    };
    let eye = wall(&[(jaw, jaw * 0.6, 0.0), (jaw, jaw * 0.6, t)], 10).shifted(jaw * 0.85, 0.0, 0.0);
    let tilt = dice.between(-0.3, 0.3);
    let other_end = if dice.chance(0.5) { eye } else { fork(tilt) };
    let bar = block(length, width, t * 0.8, 0.001);
    bar.and(fork(tilt).shifted(length / 2.0, 0.0, 0.0)).and(other_end.shifted(length / 2.0, 0.0, 0.0).turned_z(PI))
}

/// Pliers: two bent arms that cross at a joint.
pub(super) fn pliers(dice: &mut Dice) -> Shape {
    let (length, spread) = (dice.between(0.07, 0.11), dice.between(0.012, 0.022));
    let (jaw, t) = (dice.between(0.025, 0.045), dice.between(0.005, 0.008));
    let grip = Section::Round(0.006, t);
    let path = [(-length, spread), (-length * 0.6, spread * 1.25), (-length * 0.25, spread * 0.7), (0.0, 0.0)];
    let arm = pipe(&uniform(path.to_vec(), grip)).and(
        pipe(&[(0.0, 0.0, Section::Square(0.008, t)), (jaw, -0.003, Section::Square(0.0035, t * 0.6))])
            .shifted(0.0, 0.0, -0.003),
    );
    let flat = arm.turned_x(FRAC_PI_2);
    let other = flat.clone().turned_x(PI);
    flat.and(other).and(frustum(0.011, 0.011, t * 2.4).shifted(0.0, 0.0, -t * 1.2))
}

/// Scissors: two blades and two rings.
pub(super) fn scissors(dice: &mut Dice) -> Shape {
    let (blade, r, open) = (dice.between(0.06, 0.1), dice.between(0.014, 0.02), dice.between(0.05, 0.25));
    let half = |side: f64| {
        let edge = block(blade, 0.012, 0.003, 0.0005).shifted(blade * 0.35, 0.0, 0.0);
        let ring = closed_pipe(&uniform(arc(0.0, 0.0, r, 0.0, TAU * 0.9, 10), Section::Round(0.0035, 0.0035)));
        let ring =
            ring.turned_x(FRAC_PI_2).stretched(1.35, 1.0, 1.0).shifted(-blade * 0.15 - r * 1.3, side * r * 0.6, 0.002);
        edge.and(ring).turned_z(-side * open).shifted(0.0, 0.0, side * 0.0018)
    };
    half(1.0).and(half(-1.0))
}

/// A flashlight or microphone, lying.
pub(super) fn flashlight(dice: &mut Dice) -> Shape {
    let (r, length) = (dice.between(0.011, 0.017), dice.between(0.06, 0.11));
    let head = r * dice.between(1.2, 1.8);
    let cone = dice.between(0.01, 0.025);
    lathe(&[(r * 0.9, 0.0), (r, 0.003), (r, length), (head, length + cone), (head, length + cone + 0.015)]).laid_down()
}

/// A light bulb, lying.
pub(super) fn bulb(dice: &mut Dice) -> Shape {
    let (r, socket) = (dice.between(0.024, 0.034), dice.between(0.011, 0.014));
    let long = dice.between(1.0, 1.4);
    let dome = arc(0.0, 0.0, r, -0.7, FRAC_PI_2, 6)
        .into_iter()
        .map(|(x, z)| (x.max(0.0), 0.028 + (z + r * 0.65) * long + 0.012));
    let outline = [(socket * 0.5, 0.0), (socket, 0.004), (socket, 0.026)].into_iter().chain(dome);
    lathe(&outline.collect::<Vec<_>>()).laid_down()
}

/// A cordless drill or glue gun, upright on its battery.
pub(super) fn drill(dice: &mut Dice) -> Shape {
    let (grip, body) = (dice.between(0.06, 0.08), dice.between(0.07, 0.1));
    let foot = block(dice.between(0.045, 0.065), 0.035, 0.018, 0.003);
    let handle = block(0.026, 0.022, grip, 0.005).turned_y(0.12).shifted(-0.006, 0.0, 0.012);
    let barrel = lathe(&[(0.018, 0.0), (0.021, 0.006), (0.021, body * 0.7), (0.013, body), (0.009, body + 0.018)]);
    let bit = frustum(0.003, 0.003, dice.between(0.02, 0.04)).shifted(0.0, 0.0, body + 0.016);
    Shape::all([foot, handle, barrel.and(bit).laid_down().shifted(-body * 0.35, 0.0, grip + 0.025)])
}

/// A remote control, phone, book or card: a thin block, lying.
pub(super) fn slab(dice: &mut Dice) -> Shape {
    let (x, y, z) = (dice.between(0.06, 0.15), dice.between(0.03, 0.08), dice.between(0.008, 0.025));
    let slab = block(x, y, z, dice.between(0.0005, 0.004));
    if dice.chance(0.6) {
        return slab;
    }
    let keys = dice.count(2, 5);
    let key = |i: usize| frustum(0.005, 0.004, 0.003).shifted(x * (0.1 + 0.12 * i as f64 - 0.4), 0.0, z);
    slab.and(Shape::all((0..keys).map(key)))
}

/// A computer mouse, soap or stone: half an ellipsoid.
pub(super) fn mouse(dice: &mut Dice) -> Shape {
    let (x, y, z) = (dice.between(0.035, 0.055), dice.between(0.022, 0.034), dice.between(0.025, 0.045));
    let low = dice.between(0.0, 0.4) * z;
    let dome = ball(x, y, z).parts.into_iter().flat_map(|part| part.vertices);
    Shape::hull(dome.map(|mut p| {
        p.z = p.z.max(-low);
        p
    }))
}

/// A padlock: a body and a shackle.
pub(super) fn padlock(dice: &mut Dice) -> Shape {
    let (x, y, z) = (dice.between(0.035, 0.055), dice.between(0.015, 0.026), dice.between(0.03, 0.045));
    let r = x * dice.between(0.28, 0.38);
    let rise = dice.between(0.004, 0.02);
    let mut path = vec![(r, z - 0.005)];
    path.extend(arc(0.0, z + rise, r, 0.0, PI, 8));
    path.push((-r, z - 0.005));
    block(x, y, z, 0.003).and(pipe(&uniform(path, Section::Round(0.0045, 0.0045))))
}

/// A bolt with its head, standing on it, or a knob.
pub(super) fn bolt(dice: &mut Dice) -> Shape {
    let (head, height) = (dice.between(0.014, 0.026), dice.between(0.01, 0.018));
    let (r, length) = (head * dice.between(0.4, 0.6), dice.between(0.03, 0.08));
    let corners = if dice.chance(0.6) { 6 } else { 16 };
    let outline: Vec<_> = (0..corners)
        .map(|i| (TAU * f64::from(i) / f64::from(corners)).sin_cos())
        .map(|(s, c)| (head * c, head * s))
        .collect();
    let bolt = prism(&outline, height).and(frustum(r, r, length).shifted(0.0, 0.0, height));
    if dice.chance(0.5) {
        bolt
    } else {
        bolt.and(wall(&[(head, r, 0.0), (head, r, height)], 6).shifted(0.0, 0.0, height + length * 0.6))
    }
}

/// A pen, marker, battery or lipstick.
pub(super) fn pen(dice: &mut Dice) -> Shape {
    let (r, length) = (dice.between(0.006, 0.013), dice.between(0.05, 0.14));
    let tip = r * dice.between(0.3, 1.0);
    lathe(&[(r * 0.9, 0.0), (r, 0.002), (r, length), (tip, length + r)]).laid_down()
}
