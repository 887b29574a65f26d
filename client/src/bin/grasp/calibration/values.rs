//! Reads what is said about a camera.

use anyhow::{bail, ensure};
use serde_json::Value;

use super::Said;
use super::names::Role;
use crate::camera::Camera;
use crate::distortion::{self, Distortion};
use crate::document::{number, numbers, plain};

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

pub(super) fn of_said(k: [f64; 9], said: &[Said]) -> anyhow::Result<Camera> {
    let of_edges = [edge(said, 0)?, edge(said, 1)?];
    let of_size = nearest(said, size)?;
    let size = of_size.map_or(of_edges, |size| size.map(Some));
    for (both, edge) in size.iter().zip(of_edges) {
        ensure!(edge.is_none() || edge == *both, "two sizes of the images: {of_edges:?} and {size:?}");
    }
    let depth_scale = nearest(said, unit)?;
    Ok(Camera { k, size, distortion: lens_of(said)?, depth_scale })
}

fn edge(said: &[Said], axis: usize) -> anyhow::Result<Option<u32>> {
    nearest(said, |said| match (said.role == Role::Edge(axis), number(said.value).and_then(whole)) {
        (false, _) => Ok(None),
        // ROS has 0 where the size is unknown.
        (true, None) if said.distance % 2 == 1 || number(said.value) == Some(0.0) => Ok(None),
        (true, None) => bail!("`{}` is {}, must be a number of pixels", said.key, short(said.value)),
        (true, pixels) => Ok(pixels),
    })
}

fn size(said: &Said) -> anyhow::Result<Option<[u32; 2]>> {
    if said.role != Role::Size {
        return Ok(None);
    }
    let of_text = |text: &str| text.split(['x', 'X', '×', ',', ' ']).map(|edge| edge.trim().parse().ok()).collect();
    let edges: Option<Vec<f64>> = said.value.as_str().map_or_else(|| numbers(said.value), of_text);
    match edges.as_deref().map(|edges| edges.iter().map(|&edge| whole(edge)).collect::<Option<Vec<_>>>()) {
        Some(Some(edges)) if edges.len() == 2 => Ok(Some([edges[0], edges[1]])),
        // The edge of a workspace, or what another object says of itself.
        _ if plain(said.key) == "size" || said.distance % 2 == 1 => Ok(None),
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
                "`{}` is {}, must be the numbers of the distortion; remove it if the image is rectified",
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
        "mm" | "millimetre" | "millimetres" | "millimeter" | "millimeters" => Some(1e-3),
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
        None => bail!("`{}` is {}, must be above 0: the unit of the depths, metres", said.key, short(said.value)),
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
