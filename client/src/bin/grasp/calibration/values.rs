//! Reads what is said about a camera.

use anyhow::{bail, ensure};
use serde_json::Value;

use super::Said;
use super::names::Role;
use crate::camera::Camera;
use crate::distortion::{self, Distortion};
use crate::document::{number, numbers, plain};
use crate::notes::note;

/// The nearest value that `read` finds. Two at the same distance must agree.
fn nearest<T: PartialEq>(
    said: &[Said],
    read: impl Fn(&Said) -> anyhow::Result<Option<T>>,
) -> anyhow::Result<Option<T>> {
    let mut found: Option<(&Said, T)> = None;
    let mut sorted: Vec<&Said> = said.iter().collect();
    sorted.sort_by_key(|said| said.distance);
    for said in sorted {
        if found.as_ref().is_some_and(|(first, _)| first.distance < said.distance) {
            break;
        }
        let Some(value) = read(said)? else { continue };
        match &found {
            Some((first, other)) if *other != value => {
                bail!("`{}` is {}, but `{}` is {}", first.key, short(first.value), said.key, short(said.value))
            }
            Some(_) => (),
            None => found = Some((said, value)),
        }
    }
    Ok(found.map(|(_, value)| value))
}

pub(super) fn short(value: &Value) -> String {
    let text = value.to_string();
    let cut: String = text.chars().take(60).collect();
    if cut.len() < text.len() { cut + "…" } else { cut }
}

/// `rectified`: of rectified images, whose distortion is not applied.
pub(super) fn of_said(k: [f64; 9], said: &[Said], rectified: bool) -> anyhow::Result<Camera> {
    let of_edges = [edge(said, 0)?, edge(said, 1)?];
    let of_size = nearest(said, size)?;
    let size = of_size.map_or(of_edges, |size| size.map(Some));
    for (both, edge) in size.iter().zip(of_edges) {
        ensure!(edge.is_none() || edge == *both, "two sizes of the images: {of_edges:?} and {size:?}");
    }
    let depth_scale = nearest(said, unit)?;
    if depth_scale.is_none() {
        said.iter().for_each(unused);
    }
    let distortion = if rectified { None } else { lens_of(said)? };
    Ok(Camera { size, distortion, depth_scale, ..Camera::from(k) })
}

/// Notes a unit that is not used.
fn unused(said: &Said) {
    let is_usual = number(said.value).is_some_and(|number| number == 1.0 || number == 1e-3);
    let is_pair = numbers(said.value).is_some_and(|numbers| numbers.len() > 1);
    let is_unit = said.role == Role::UnitLike || said.role == Role::Size && plain(said.key) == "depthresolution";
    if is_unit && said.distance.is_multiple_of(2) && !is_usual && !is_pair {
        note(format_args!(
            "`{}` is {}, which is not used; if it is the unit of the depths, give that in metres as --depth-scale",
            said.key,
            short(said.value)
        ));
    }
}

fn edge(said: &[Said], axis: usize) -> anyhow::Result<Option<u32>> {
    nearest(said, |said| match (said.role == Role::Edge(axis), number(said.value).and_then(whole)) {
        (false, _) => Ok(None),
        // Millimetres of a chip.
        (true, pixels) if plain(said.key).starts_with("sensor") && pixels.is_none_or(|edge| edge < 100) => Ok(None),
        // ROS has 0 where the size is unknown.
        (true, None) if said.distance % 2 == 1 || number(said.value) == Some(0.0) => Ok(None),
        (true, None) => bail!("`{}` is {}, must be a number of pixels", said.key, short(said.value)),
        (true, pixels) => Ok(pixels),
    })
}

fn size(said: &Said) -> anyhow::Result<Option<[u32; 2]>> {
    if said.role != Role::Size && said.role != Role::Shape {
        return Ok(None);
    }
    let of_text = |text: &str| text.split(['x', 'X', '×', ',', ' ']).map(|edge| edge.trim().parse().ok()).collect();
    let edges: Option<Vec<f64>> = said.value.as_str().map_or_else(|| numbers(said.value), of_text);
    let edges = edges.as_deref().map(|edges| edges.iter().map(|&edge| whole(edge)).collect::<Option<Vec<_>>>());
    match (said.role, edges.flatten().as_deref()) {
        (Role::Size, Some(&[width, height])) => Ok(Some([width, height])),
        (Role::Shape, Some(&[height, width] | &[height, width, _])) => Ok(Some([width, height])),
        // The edge of a workspace, the shape of a thing, a unit, or what another object says of itself.
        _ if ["size", "shape", "res", "depthresolution"].contains(&&*plain(said.key)) || said.distance % 2 == 1 => {
            Ok(None)
        }
        _ => bail!("`{}` is {}, must be the width and the height in pixels", said.key, short(said.value)),
    }
}

fn whole(number: f64) -> Option<u32> {
    (number >= 1.0 && number <= f64::from(u32::MAX) && number.fract() == 0.0).then_some(number as u32)
}

fn lens_of(said: &[Said]) -> anyhow::Result<Option<Distortion>> {
    let list = nearest(said, |said| {
        let is_none =
            said.value == false || said.value.as_str().is_some_and(|text| ["", "none"].contains(&&*plain(text)));
        match (said.role == Role::Coefficients, numbers(said.value)) {
            (false, _) => Ok(None),
            (true, None) if is_none => Ok(Some(Vec::new())),
            (true, None) => bail!(
                "`{}` is {}, must be the numbers of the distortion; if the images are rectified, add --rectified",
                said.key,
                short(said.value)
            ),
            (true, numbers) => Ok(numbers),
        }
    })?;
    let mut named = [None; 8];
    for (index, coefficient) in named.iter_mut().enumerate() {
        *coefficient = nearest(said, |said| match (said.role == Role::Coefficient(index), number(said.value)) {
            (false, _) => Ok(None),
            (true, None) => bail!("`{}` is {}, must be a number of the distortion", said.key, short(said.value)),
            (true, number) => Ok(number),
        })?;
    }
    for (role, places) in [(Role::Radial, &[0, 1, 4][..]), (Role::Tangential, &[2, 3])] {
        let Some(numbers) = nearest(said, |said| if said.role == role { part(said, places.len()) } else { Ok(None) })?
        else {
            continue;
        };
        for (&place, number) in places.iter().zip(numbers) {
            let is_same = named[place].is_none_or(|other| other == number);
            ensure!(is_same, "the distortion is in the file twice, with different numbers");
            named[place] = Some(number);
        }
    }
    said.iter().try_for_each(doubtful)?;
    let of_role = |role: Role| nearest(said, |said| Ok(model(said).filter(|_| said.role == role)));
    let model = match of_role(Role::DistortionModel)? {
        None => of_role(Role::Fisheye)?.or(of_role(Role::CameraModel)?),
        model => model,
    };
    let model = model.as_deref();
    let of_list = Distortion::new(model, list.as_deref().unwrap_or_default())?;
    if named.iter().all(Option::is_none) {
        return Ok(of_list);
    }
    let [_, _, p1, p2, _, k4, ..] = named;
    let has_tangential = p1.is_some() || p2.is_some();
    let all = named.map(Option::unwrap_or_default);
    ensure!(
        model.is_some() || has_tangential || k4.unwrap_or_default() == 0.0,
        "the distortion has k4 and no p1: name its `distortion_model`, equidistant (fisheye) or rational_polynomial"
    );
    let [k1, k2, _, _, k3, k4, ..] = all;
    let of_names = if model.is_some_and(distortion::is_fisheye) {
        Distortion::new(model, &[k1, k2, k3, k4])?
    } else {
        Distortion::new(model, &all)?
    };
    ensure!(list.is_none() || of_list == of_names, "the distortion is in the file twice, with different numbers");
    Ok(of_names)
}

/// The radial or the tangential part of a distortion, with at least two numbers.
fn part(said: &Said, most: usize) -> anyhow::Result<Option<Vec<f64>>> {
    match numbers(said.value) {
        Some(numbers) if (2..=most).contains(&numbers.len()) => Ok(Some(numbers)),
        Some(numbers) if numbers.iter().all(|&number| number == 0.0) => Ok(None),
        _ => {
            let parts = if most == 3 { "k1, k2 and k3" } else { "p1 and p2" };
            bail!("`{}` is {}, must be {parts} of the distortion", said.key, short(said.value))
        }
    }
}

/// Refuses what may be a distortion under another name.
fn doubtful(said: &Said) -> anyhow::Result<()> {
    let found = all_numbers(said.value);
    // A single number may be a distance.
    let may_be = found.len() > 1 || plain(said.key).contains("distort");
    ensure!(
        said.role != Role::Doubtful || !may_be || found.iter().all(|&number| number == 0.0),
        "`{}` is {}, which may be the distortion of the lens: name it `distortion_coefficients`, and its model \
         `distortion_model`; if the images are rectified, add --rectified",
        said.key,
        short(said.value)
    );
    Ok(())
}

/// The numbers in arrays and objects of any depth.
fn all_numbers(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(values) => values.iter().flat_map(all_numbers).collect(),
        Value::Object(map) => map.values().flat_map(all_numbers).collect(),
        value => number(value).into_iter().collect(),
    }
}

/// The model of a lens, which librealsense also gives as the number of an enum.
fn model(said: &Said) -> Option<String> {
    const REALSENSE: [&str; 6] =
        ["none", "modified_brown_conrady", "inverse_brown_conrady", "ftheta", "brown_conrady", "kannala_brandt4"];
    match (said.role, said.value) {
        (Role::Fisheye, value) => {
            let is_set = *value == true || number(value) == Some(1.0) || value.as_str() == Some("true");
            is_set.then(|| "equidistant".to_owned())
        }
        (_, Value::String(text)) => Some(text.rsplit('.').next().unwrap_or_default().to_owned()),
        (_, value) => REALSENSE.get(value.as_u64()? as usize).map(|name| (*name).to_owned()),
    }
}

fn unit(said: &Said) -> anyhow::Result<Option<f64>> {
    let of_text = |text: &str| match plain(text).as_str() {
        "m" | "metre" | "metres" | "meter" | "meters" => Some(1.0),
        "cm" | "centimetre" | "centimetres" | "centimeter" | "centimeters" => Some(1e-2),
        "mm" | "millimetre" | "millimetres" | "millimeter" | "millimeters" => Some(1e-3),
        "um" | "micrometre" | "micrometres" | "micrometer" | "micrometers" => Some(1e-6),
        _ => None,
    };
    let metres = match (said.role, number(said.value)) {
        (Role::Unit, Some(scale)) if plain(said.key) == "scale" && (0.02..50.0).contains(&scale) => {
            // Scales an image or a scene.
            return Ok(None);
        }
        (Role::Unit, Some(scale)) => Some(metres(scale)),
        (Role::UnitsPerMetre, Some(factor)) if factor >= 1.0 => Some(factor.recip()),
        (Role::UnitsPerMetre, Some(factor)) => Some(metres(factor)),
        (Role::Unit | Role::UnitsPerMetre, None) => said.value.as_str().and_then(of_text),
        _ => return Ok(None),
    };
    match metres.filter(|metres| *metres > 0.0 && metres.is_finite()) {
        None if said.distance % 2 == 1 => Ok(None),
        None => bail!(
            "`{}` is {}, must be the unit of the depths: a number of metres above 0, or m, cm, mm or um",
            said.key,
            short(said.value)
        ),
        metres => Ok(metres),
    }
}

/// The unit of a depth scale, metres: BOP gives it in millimetres, others in metres, or as units per metre.
fn metres(depth_scale: f64) -> f64 {
    if depth_scale >= 50.0 {
        depth_scale.recip()
    } else if depth_scale > 0.02 {
        depth_scale * 1e-3
    } else {
        depth_scale
    }
}
