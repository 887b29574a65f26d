use std::ops::RangeInclusive;

use grasp::RequestError;
use grasp_perception::Cloud;
use nalgebra::{Isometry3, Point3};

use crate::pose::{self, PoseFields};
use crate::views::check_number;
use crate::{labels, pb};

/// Median distance of the points of a cloud from its camera beyond which they are probably not in metres: far beyond
/// the range of depth cameras.
const FARTHEST: f64 = 20.0;

/// Distances of millimetres that are read as metres.
const MILLIMETRES: RangeInclusive<f64> = 100.0..=10_000.0;

const FRAME_FROM_CLOUD: PoseFields =
    PoseFields { position: "frame_from_cloud.position", orientation: "frame_from_cloud.orientation" };

/// Decodes the point clouds of a request, in the caller's frame.
///
/// # Errors
/// [`RequestError`] names the invalid field.
pub fn clouds(views: &[pb::CloudView]) -> Result<Vec<Cloud>, RequestError> {
    check_number(views.len())?;
    let indexed = views.iter().enumerate();
    indexed.map(|(index, view)| cloud(view).map_err(|error| error.inside(format_args!("views[{index}]")))).collect()
}

/// Decodes a point cloud, in the caller's frame.
///
/// # Errors
/// [`RequestError`] names the invalid field of the view.
pub fn cloud(view: &pb::CloudView) -> Result<Cloud, RequestError> {
    const POINT: usize = 12;
    if view.points.is_empty() || !view.points.len().is_multiple_of(POINT) {
        let value = format_args!("{} bytes", view.points.len());
        return Err(RequestError::invalid(
            "points",
            value,
            "must be a multiple of 12 above 0: x, y, z of each point, f32",
        ));
    }
    let frame_from_cloud = view.frame_from_cloud.as_ref();
    let frame_from_cloud =
        frame_from_cloud.map_or(Ok(Isometry3::identity()), |p| pose::decode(p, &FRAME_FROM_CLOUD))?;
    let eye =
        view.camera_position.ok_or_else(|| RequestError::invalid("camera_position", "absent", "must be given"))?;
    let pb::Vector3 { x, y, z } = eye;
    if ![x, y, z].iter().all(|c| c.is_finite()) {
        return Err(RequestError::invalid("camera_position", format_args!("({x}, {y}, {z})"), "must be finite"));
    }
    let scale = view.scale.unwrap_or(1.0);
    if !(scale.is_finite() && scale > 0.0) {
        return Err(RequestError::invalid("scale", scale, "must be above 0: 0.001 for points in millimetres"));
    }
    let point = |bytes: &[u8; POINT]| {
        let [x, y, z] =
            [0, 4, 8].map(|at| f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]));
        let finite = x.is_finite() && y.is_finite() && z.is_finite();
        finite.then(|| frame_from_cloud * (Point3::new(x, y, z).cast::<f64>() * scale))
    };
    let all = view.points.as_chunks().0;
    let points: Vec<_> = all.iter().filter_map(point).collect();
    let of_points = |message| labels::of_points(message, all.len());
    let labels = view.labels.as_ref().map(of_points).transpose().map_err(|error| error.inside("labels"))?;
    let labels = labels.map(|labels| {
        let finite = all.iter().zip(labels).filter(|(bytes, _)| point(bytes).is_some());
        finite.map(|(_, label)| label).collect()
    });
    if points.is_empty() {
        let reason = format_args!("none of the {} points is finite; at least one must be", all.len());
        return Err(RequestError::refused("points", reason));
    }
    let eye = frame_from_cloud * Point3::new(x, y, z);
    let distance = median(points.iter().map(|point| (point - eye).norm()));
    if distance > FARTHEST {
        let advice = if MILLIMETRES.contains(&distance) && scale == 1.0 && Point3::new(x, y, z).coords.norm() < FARTHEST
        {
            "so the points look like millimetres: set `CloudView.scale` to 0.001"
        } else {
            "farther than depth cameras measure: check the depth unit and `camera_position`, which is in metres"
        };
        let reason = format_args!("the median distance from the camera is {distance:.0} m, {advice}");
        return Err(RequestError::refused("points", reason));
    }
    Ok(Cloud { points, eye, labels })
}

/// The median of a sample of the distances; 0 if there are none.
fn median(distances: impl Iterator<Item = f64>) -> f64 {
    /// Step between sampled points. More samples would not change the result.
    const EVERY: usize = 61;
    let mut sample: Vec<f64> = distances.step_by(EVERY).collect();
    let middle = sample.len() / 2;
    if sample.is_empty() { 0.0 } else { *sample.select_nth_unstable_by(middle, f64::total_cmp).1 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_transformed_into_the_task_frame() {
        let points: [f32; 6] = [0.1, 0.2, 0.3, f32::NAN, 0.0, 0.0];
        let view = pb::CloudView {
            points: points.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into(),
            frame_from_cloud: Some((&Isometry3::translation(1.0, 0.0, 0.0)).into()),
            camera_position: Some(pb::Vector3::default()),
            labels: None,
            scale: None,
        };
        let points = cloud(&view).unwrap().in_task(&Isometry3::translation(0.5, 0.0, 0.0));
        let [point] = points.points[..] else { panic!("the NaN point is ignored") };
        assert!((point - Point3::new(0.6, 0.2, 0.3)).norm() < 1e-6);
        assert!((points.eye - Point3::new(0.5, 0.0, 0.0)).norm() < 1e-12);
        let refused = |view: pb::CloudView| cloud(&view).unwrap_err().to_string();
        assert!(
            refused(pb::CloudView { points: vec![0; 13].into(), ..view.clone() }).starts_with("points is 13 bytes")
        );
        assert!(refused(pb::CloudView { camera_position: None, ..view }).starts_with("camera_position is absent"));
    }

    #[test]
    fn points_that_are_not_finite_are_left_out_with_their_labels() {
        let labels = |data: Vec<u8>| Some(pb::Labels { data: data.into(), r#type: pb::LabelType::U8.into() });
        let points = [[0.0, 0.0, 0.5], [f32::NAN, 0.0, 0.5], [0.1, 0.0, 0.5]];
        let cloud = pb::CloudView {
            points: points.iter().flatten().flat_map(|c| c.to_le_bytes()).collect::<Vec<u8>>().into(),
            frame_from_cloud: None,
            camera_position: Some(pb::Vector3::default()),
            labels: labels(vec![4, 5, 6]),
            scale: None,
        };
        let converted = super::cloud(&cloud).unwrap();
        assert_eq!((converted.points.len(), converted.labels), (2, Some(vec![4, 6])));
        let millimetres = points.iter().flatten().flat_map(|c| (c * 1000.0).to_le_bytes());
        let cloud = pb::CloudView { points: millimetres.collect::<Vec<u8>>().into(), ..cloud };
        let wrong = |scale| clouds(&[pb::CloudView { scale, ..cloud.clone() }]).unwrap_err().to_string();
        assert!(
            wrong(None).contains("views[0].points: the median distance from the camera is 500 m, so the points look")
        );
        for scale in [0.0, -1.0, f64::NAN] {
            assert!(wrong(Some(scale)).starts_with("views[0].scale is "));
        }
        let [scaled] = clouds(&[pb::CloudView { scale: Some(1e-3), ..cloud }]).unwrap().try_into().unwrap();
        assert!(scaled.points.iter().zip(&converted.points).all(|(a, b)| (a - b).norm() < 1e-6));
    }
}
