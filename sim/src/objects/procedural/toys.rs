//! Toys, building blocks and abstract shapes.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use nalgebra::Point3;

use super::dice::Dice;
use super::shape::{Section, Shape, arc, ball, block, frustum, lathe, pipe, prism, uniform};

/// A toy brick with studs.
pub(super) fn brick(dice: &mut Dice) -> Shape {
    let (columns, rows, pitch) = (dice.count(1, 4), dice.count(1, 2), dice.between(0.02, 0.03));
    let h = pitch * dice.between(0.4, 1.2);
    let centre = |i: usize, n: usize| (i as f64 - (n - 1) as f64 / 2.0) * pitch;
    let stud = |i: usize| {
        let stud = frustum(pitch * 0.3, pitch * 0.3, pitch * 0.22);
        stud.shifted(centre(i % columns, columns), centre(i / columns, rows), h)
    };
    let body = block(columns as f64 * pitch, rows as f64 * pitch, h, 0.0005);
    body.and(Shape::all((0..columns * rows).map(stud)))
}

/// A wooden block: cube, plank, wedge, roof or half disc.
pub(super) fn wooden_block(dice: &mut Dice) -> Shape {
    let (x, y, z) = (dice.between(0.03, 0.1), dice.between(0.025, 0.06), dice.between(0.025, 0.06));
    let outline = match dice.count(0, 3) {
        0 => return block(x, y, z, dice.between(0.0005, 0.006)),
        1 => vec![(-x / 2.0, 0.0), (x / 2.0, 0.0), (x / 2.0, 0.004), (-x / 2.0, z)],
        2 => vec![(-x / 2.0, 0.0), (x / 2.0, 0.0), (0.0, z)],
        _ => arc(0.0, 0.0, x.min(0.08) / 2.0, 0.0, PI, 12),
    };
    prism(&outline, y).turned_x(FRAC_PI_2)
}

/// An arch or bridge.
pub(super) fn arch(dice: &mut Dice) -> Shape {
    let (r, t, depth) = (dice.between(0.018, 0.03), dice.between(0.008, 0.015), dice.between(0.015, 0.035));
    let rise = dice.between(0.005, 0.03);
    let bow = uniform(arc(0.0, rise, r, 0.0, PI, 9), Section::Square(t / 2.0, depth));
    let pillar = |side: f64| block(t, 2.0 * depth, rise + 0.001, 0.0005).shifted(side * r, 0.0, 0.0);
    pipe(&bow).and(pillar(1.0)).and(pillar(-1.0))
}

/// A beam with an L, T, U, Z or cross section, standing.
pub(super) fn profile(dice: &mut Dice) -> Shape {
    let (w, d, h) = (dice.between(0.03, 0.065), dice.between(0.03, 0.065), dice.between(0.03, 0.14));
    let t = dice.between(0.006, 0.016);
    let web = |x: f64| block(t, d, h, 0.0005).shifted(x, 0.0, 0.0);
    let flange = |y: f64| block(w, t, h, 0.0005).shifted(0.0, y, 0.0);
    let (side, end) = ((w - t) / 2.0, (d - t) / 2.0);
    match dice.count(0, 4) {
        0 => web(-side).and(flange(-end)),
        1 => web(0.0).and(flange(end)),
        2 => Shape::all([web(-side), web(side), flange(-end)]),
        3 => Shape::all([web(0.0), flange(end).shifted(side, 0.0, 0.0), flange(-end).shifted(-side, 0.0, 0.0)]),
        _ => web(0.0).and(flange(0.0)),
    }
}

/// A car or lorry.
pub(super) fn car(dice: &mut Dice) -> Shape {
    let (x, y, z) = (dice.between(0.07, 0.12), dice.between(0.03, 0.045), dice.between(0.014, 0.025));
    let wheel = dice.between(0.009, 0.014);
    let (cabin, shift) = (dice.between(0.35, 0.6) * x, dice.between(-0.2, 0.2) * x);
    let roof = dice.between(0.012, 0.03);
    let trapeze = [(-cabin / 2.0, 0.0), (cabin / 2.0, 0.0), (cabin * 0.3, roof), (-cabin * 0.4, roof)];
    let cabin = prism(&trapeze, y * 0.85).turned_x(FRAC_PI_2).shifted(shift, y * 0.425, wheel + z);
    let wheels = (0..4).map(|i| {
        let (along, side) = (if i % 2 == 0 { -0.3 } else { 0.3 }, if i < 2 { -1.0 } else { 1.0 });
        let width = 0.009;
        frustum(wheel, wheel, width).turned_x(FRAC_PI_2).shifted(along * x, side * y / 2.0 + width / 2.0, wheel)
    });
    let wheels = Shape::all(wheels);
    block(x, y, z, 0.003).shifted(0.0, 0.0, wheel).and(cabin).and(wheels)
}

/// An animal on four legs.
pub(super) fn animal(dice: &mut Dice) -> Shape {
    let (x, y, z) = (dice.between(0.025, 0.04), dice.between(0.012, 0.02), dice.between(0.013, 0.022));
    let (leg, thick) = (dice.between(0.012, 0.035), dice.between(0.005, 0.008));
    let legs = (0..4).map(|i| {
        let (along, side) = (if i % 2 == 0 { -0.6 } else { 0.6 }, if i < 2 { -0.55 } else { 0.55 });
        frustum(thick, thick, leg + z * 0.4).shifted(along * x, side * y, 0.0)
    });
    let legs = Shape::all(legs);
    let head = dice.between(0.011, 0.017);
    let (up, ahead) = (dice.between(0.2, 1.8) * z, x * 1.05);
    let neck = pipe(&uniform(vec![(x * 0.5, leg + z), (ahead, leg + z + up)], Section::Round(head * 0.6, head * 0.6)));
    let face = ball(head * 1.3, head * 0.9, head).shifted(ahead + head * 0.4, 0.0, leg + z + up);
    let ear = |side: f64| block(0.004, 0.006, head, 0.001).shifted(ahead, side * head * 0.6, leg + z + up + head * 0.6);
    let tail = frustum(0.003, 0.002, x * 0.7).turned_y(-0.9).shifted(-x * 0.9, 0.0, leg + z);
    let body = ball(x, y, z).shifted(0.0, 0.0, leg + z);
    Shape::all([body, legs, neck, face, ear(1.0), ear(-1.0), tail])
}

/// A toy figure, standing.
pub(super) fn figure(dice: &mut Dice) -> Shape {
    let (leg, torso) = (dice.between(0.022, 0.04), dice.between(0.028, 0.04));
    let (width, depth) = (dice.between(0.026, 0.038), dice.between(0.018, 0.026));
    let legs = |side: f64| block(width * 0.42, depth, leg, 0.001).shifted(side * width * 0.25, 0.0, 0.0);
    let trunk = [(-width / 2.0, 0.0), (width / 2.0, 0.0), (width * 0.38, torso), (-width * 0.38, torso)];
    let trunk = prism(&trunk, depth).turned_x(FRAC_PI_2).shifted(0.0, depth / 2.0, leg);
    let swing = dice.between(-1.2, 1.2);
    let arm = |side: f64, swing: f64| {
        let arm = block(0.009, 0.01, torso * 0.95, 0.002).shifted(0.0, 0.0, -torso * 0.9).turned_x(swing);
        arm.shifted(side * (width * 0.42 + 0.006), 0.0, leg + torso * 0.95)
    };
    let head = if dice.chance(0.5) {
        lathe(&[(0.009, 0.0), (0.012, 0.003), (0.012, 0.018), (0.007, 0.022)])
    } else {
        ball(0.012, 0.012, 0.014).shifted(0.0, 0.0, 0.013)
    };
    Shape::all([legs(-1.0), legs(1.0), trunk, arm(-1.0, swing), arm(1.0, -swing), head.shifted(0.0, 0.0, leg + torso)])
}

/// An aeroplane.
pub(super) fn plane(dice: &mut Dice) -> Shape {
    let (length, r) = (dice.between(0.08, 0.13), dice.between(0.011, 0.018));
    let (span, chord) = (dice.between(0.6, 1.0) * length, dice.between(0.2, 0.3) * length);
    let hull =
        lathe(&[(r * 0.3, 0.0), (r * 0.9, length * 0.55), (r, length * 0.75), (r * 0.6, length * 0.95), (0.0, length)])
            .laid_down();
    let wing = |sweep: f64, span: f64, chord: f64| {
        let half = |side: f64| {
            prism(
                &[(0.0, 0.0), (chord, 0.0), (chord * 0.6 - sweep, side * span / 2.0), (-sweep, side * span / 2.0)],
                0.004,
            )
        };
        half(1.0).and(half(-1.0))
    };
    let sweep = dice.between(0.0, 0.02);
    let tail = wing(0.008, span * 0.4, chord * 0.6).turned_x(FRAC_PI_2);
    let fin = Shape { parts: tail.parts.into_iter().take(2).collect() };
    let rudder = wing(0.008, span * 0.4, chord * 0.6);
    hull.and(wing(sweep, span, chord).shifted(length * 0.5, 0.0, -0.002)).and(rudder).and(fin.shifted(0.0, 0.002, 0.0))
}

/// A spinning top, dumbbell, spool or skittle: a solid of revolution.
pub(super) fn spool(dice: &mut Dice) -> Shape {
    let (r, h) = (dice.between(0.02, 0.035), dice.between(0.04, 0.1));
    let (core, flange) = (r * dice.between(0.35, 0.7), dice.between(0.12, 0.3) * h);
    lathe(&[(r, 0.0), (r, flange), (core, flange + 0.003), (core, h - flange - 0.003), (r, h - flange), (r, h)])
}

/// A gear or star: a hub with teeth.
pub(super) fn gear(dice: &mut Dice) -> Shape {
    let (r, h, teeth) = (dice.between(0.018, 0.027), dice.between(0.01, 0.04), dice.count(5, 10));
    let (reach, width) = (r * dice.between(1.25, 1.5), TAU * r / teeth as f64 * 0.28);
    let tip = width * dice.between(0.1, 0.8);
    let tooth = prism(&[(r * 0.8, -width), (reach, -tip), (reach, tip), (r * 0.8, width)], h);
    let teeth = (0..teeth).map(|i| tooth.clone().turned_z(TAU * i as f64 / teeth as f64));
    frustum(r, r, h).and(Shape::all(teeth))
}

/// A game controller, phone receiver or handle: a bar with two grips.
pub(super) fn receiver(dice: &mut Dice) -> Shape {
    let (half, r) = (dice.between(0.035, 0.06), dice.between(0.009, 0.014));
    let drop = dice.between(0.01, 0.03);
    let bar = pipe(&uniform(arc(0.0, -half * 1.5, half * 1.8, PI * 0.32, PI * 0.68, 6), Section::Round(r * 0.8, r)));
    let grip = |side: f64| frustum(r * 1.5, r * 1.2, drop + r).shifted(side * half * 0.96, 0.0, -drop - r * 0.4);
    bar.and(grip(1.0)).and(grip(-1.0))
}

/// An irregular convex stone or crystal.
pub(super) fn stone(dice: &mut Dice) -> Shape {
    let (x, y, z) = (dice.between(0.02, 0.05), dice.between(0.02, 0.035), dice.between(0.02, 0.035));
    let points = dice.count(9, 24);
    let floor = -dice.between(0.5, 0.9) * z;
    let stone = (0..points).map(|_| {
        let (angle, height) = (dice.between(0.0, TAU), dice.between(-1.0, 1.0));
        let flat = (1.0 - height * height).sqrt();
        Point3::new(x * flat * angle.cos(), y * flat * angle.sin(), (z * height).max(floor))
    });
    Shape::hull(stone.collect::<Vec<_>>())
}

/// A random union of a few simple solids.
pub(super) fn composite(dice: &mut Dice) -> Shape {
    let mut shape = Shape::default();
    for i in 0..dice.count(2, 5) {
        let (a, b, c) = (dice.between(0.01, 0.03), dice.between(0.01, 0.03), dice.between(0.02, 0.08));
        let solid = match dice.count(0, 3) {
            0 => block(2.0 * a, 2.0 * b, c, 0.001),
            1 => frustum(a, b, c),
            2 => ball(a, b, c / 2.0).shifted(0.0, 0.0, c / 2.0),
            _ => prism(&[(-a, -b), (a, -b), (0.0, b)], c),
        };
        let solid = if i > 0 && dice.chance(0.5) { solid.laid_down().shifted(-c / 2.0, 0.0, a) } else { solid };
        let spread = if i == 0 { 0.0 } else { 0.02 };
        let mut offset = || spread * dice.between(-1.0, 1.0);
        shape = shape.and(solid.shifted(offset(), offset(), offset() + spread));
    }
    shape
}
