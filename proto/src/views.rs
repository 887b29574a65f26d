use grasp::{DepthImage, Intrinsics, RequestError, Unit as DepthUnit};
use grasp_perception::{CameraPose, Frame};

use crate::pb::depth_view::Extrinsics;
use crate::pose::{self, PoseFields};
use crate::{labels, pb, png};

/// Largest number of views in one request.
pub const MAX_VIEWS: usize = 64;

/// Longest edge of an image, pixels.
const MAX_EDGE: u32 = 16_384;

/// Tolerance for the principal point, as a fraction of the image size. Intrinsics of another resolution are off by a
/// similar fraction on both axes; those of a cropped image usually are not.
const OFF_CENTRE: f64 = 0.1;

const CAMERA_FROM_TASK: PoseFields =
    PoseFields { position: "camera_from_task.position", orientation: "camera_from_task.orientation" };
const FRAME_FROM_CAMERA: PoseFields =
    PoseFields { position: "frame_from_camera.position", orientation: "frame_from_camera.orientation" };
/// Checks the number of views of a request.
///
/// # Errors
/// [`RequestError`] if there are none or more than [`MAX_VIEWS`].
pub fn check_views(views: usize) -> Result<(), RequestError> {
    if (1..=MAX_VIEWS).contains(&views) {
        return Ok(());
    }
    Err(RequestError::of_length("views", views, format_args!("must have from 1 to {MAX_VIEWS}")))
}

/// A request of a stream may have no views.
pub(crate) fn check_number(views: usize) -> Result<(), RequestError> {
    if views == 0 { Ok(()) } else { check_views(views) }
}

/// Checks the size of the images that are sent as PNG, before they are decoded: a small file can contain a large image.
fn check_png(views: &[pb::DepthView]) -> Result<(), RequestError> {
    /// 128 MiB of depths in f32: 109 images of 640 × 480 pixels.
    const MAX_PIXELS: u64 = 1 << 25;
    let pixels = |view: &pb::DepthView| {
        let labels = view.labels.as_ref().map(pb::Labels::r#type);
        let images =
            u64::from(view.unit() == pb::DepthUnit::PngMillimetres) + u64::from(labels == Some(pb::LabelType::Png));
        // The product of the edges fits, because they have 32 bits; twice as much may not.
        view.camera
            .as_ref()
            .map_or(0, |camera| images.saturating_mul(u64::from(camera.width) * u64::from(camera.height)))
    };
    let sum = views.iter().map(pixels).fold(0, u64::saturating_add);
    if sum <= MAX_PIXELS {
        return Ok(());
    }
    let needed = format_args!("must have at most {MAX_PIXELS}; send fewer or smaller images");
    Err(RequestError::invalid("views", format_args!("PNG images with {sum} pixels in all"), needed))
}

/// Decodes the depth images of a request.
///
/// # Errors
/// [`RequestError`] names the invalid field.
pub fn frames(views: &[pb::DepthView]) -> Result<Vec<Frame>, RequestError> {
    check_number(views.len())?;
    check_png(views)?;
    let indexed = views.iter().enumerate();
    indexed.map(|(index, view)| frame(view).map_err(|error| error.inside(format_args!("views[{index}]")))).collect()
}

/// Decodes a depth image.
///
/// # Errors
/// [`RequestError`] names the invalid field of the view.
pub fn frame(view: &pb::DepthView) -> Result<Frame, RequestError> {
    let image = image(view)?;
    let Intrinsics { width, height, .. } = *image.intrinsics();
    let of_image = |message| labels::of_image(message, width, height);
    let labels = view.labels.as_ref().map(of_image).transpose().map_err(|error| error.inside("labels"))?;
    let pose = match &view.extrinsics {
        Some(Extrinsics::CameraFromTask(pose)) => CameraPose::InTask(pose::decode(pose, &CAMERA_FROM_TASK)?),
        Some(Extrinsics::FrameFromCamera(pose)) => CameraPose::InFrame(pose::decode(pose, &FRAME_FROM_CAMERA)?),
        None => CameraPose::Unknown,
    };
    Ok(Frame { image, labels, pose })
}

/// The image of a view.
fn image(view: &pb::DepthView) -> Result<DepthImage<'static>, RequestError> {
    let camera = view.camera.as_ref().ok_or_else(|| RequestError::invalid("camera", "absent", "must be given"))?;
    let intrinsics = intrinsics(camera)?;
    let pixels = intrinsics.width * intrinsics.height;
    let value_size = match view.unit() {
        pb::DepthUnit::F32Metres => Some(4),
        pb::DepthUnit::U16Millimetres => Some(2),
        pb::DepthUnit::PngMillimetres => None,
        pb::DepthUnit::Unspecified => {
            let needed = "must be DEPTH_UNIT_F32_METRES (1), DEPTH_UNIT_U16_MILLIMETRES (2) or \
                          DEPTH_UNIT_PNG_MILLIMETRES (3)";
            return Err(RequestError::invalid("unit", view.unit, needed));
        }
    };
    if let Some(value_size) = value_size
        && view.data.len() != pixels * value_size
    {
        let needed = format_args!(
            "{} × {} pixels need {} ({})",
            intrinsics.width,
            intrinsics.height,
            pixels * value_size,
            view.unit().as_str_name()
        );
        return Err(RequestError::invalid("data", format_args!("{} bytes", view.data.len()), needed));
    }
    let depth: Vec<f32> = match view.unit() {
        pb::DepthUnit::U16Millimetres => {
            view.data.as_chunks().0.iter().map(|&bytes| f32::from(u16::from_le_bytes(bytes)) * 1e-3).collect()
        }
        pb::DepthUnit::PngMillimetres => {
            let values = png::deep_grey(&view.data, intrinsics.width, intrinsics.height);
            let values = values.map_err(|reason| RequestError::refused("data", reason))?;
            values.into_iter().map(|value| f32::from(value) * 1e-3).collect()
        }
        _ => view.data.as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect(),
    };
    let image = DepthImage::new(intrinsics, depth).map_err(|error| RequestError::refused("camera", error))?;
    let refuse = |reason: &str| Err(RequestError::refused("data", reason));
    match (image.unit(), view.unit()) {
        (DepthUnit::Millimetres | DepthUnit::Far, pb::DepthUnit::U16Millimetres | pb::DepthUnit::PngMillimetres) => {
            refuse(
                "the median depth is above 20,000 mm, farther than depth cameras measure: send 0 for pixels without a reading",
            )
        }
        (DepthUnit::Millimetres, _) => refuse(
            "the median depth is above 20 m, so the values look like millimetres: send u16 with \
             DEPTH_UNIT_U16_MILLIMETRES, or divide by 1000",
        ),
        (DepthUnit::Far, _) => {
            refuse("the median depth is above 20 m, farther than depth cameras measure: check the depth unit")
        }
        (DepthUnit::Thousandths, pb::DepthUnit::U16Millimetres | pb::DepthUnit::PngMillimetres) => refuse(
            "the median depth is below 20 mm, so the values look like metres: send f32 with DEPTH_UNIT_F32_METRES",
        ),
        (DepthUnit::Thousandths, _) => refuse(
            "the median depth is below 0.02 m, closer than depth cameras measure: check that the values were not divided \
             by 1000 twice",
        ),
        (DepthUnit::Metres, _) => Ok(image),
    }
}

/// Validates the intrinsic matrix.
fn intrinsics(camera: &pb::Camera) -> Result<Intrinsics, RequestError> {
    const FORM: &str = "must be nine numbers, row by row: fx 0 cx, 0 fy cy, 0 0 1";
    for (field, edge) in [("camera.width", camera.width), ("camera.height", camera.height)] {
        if !(1..=MAX_EDGE).contains(&edge) {
            return Err(RequestError::invalid(field, edge, format_args!("must be from 1 to {MAX_EDGE} pixels")));
        }
    }
    let k: &[f64] = &camera.k;
    let &[fx, skew, cx, zero, fy, cy, left, right, one] = k else {
        return Err(RequestError::invalid("camera.k", format_args!("{} numbers", k.len()), FORM));
    };
    let wrong = |needed: &str| Err(RequestError::invalid("camera.k", format_args!("{k:?}"), needed));
    if !k.iter().all(|value| value.is_finite()) {
        return wrong("must be finite");
    }
    if [skew, cx, cy] == [0.0; 3] && (left != 0.0 || right != 0.0) {
        return wrong("must have its principal point in the last column: send the matrix row by row, not transposed");
    }
    if [zero, left, right] != [0.0; 3] || (one - 1.0).abs() > 1e-6 {
        return wrong(FORM);
    }
    if skew.abs() > 1e-3 * fx.abs() {
        return wrong("must have no skew (second number): rectify the image");
    }
    if !(fx > 0.0 && fy > 0.0) {
        return wrong("must have focal lengths above 0 (first and fifth number)");
    }
    let [u, v] = [cx / f64::from(camera.width) - 0.5, cy / f64::from(camera.height) - 0.5];
    if u.abs().min(v.abs()) > OFF_CENTRE && (u - v).abs() <= OFF_CENTRE {
        // The factor that moves the principal point to the centre.
        let factor = 1.0 / (1.0 + u + v);
        let [fx, cx, fy, cy] = [fx, cx, fy, cy].map(|value| (value * factor * 10.0).round() / 10.0);
        let resized = if (0.1..=10.0).contains(&factor) {
            format!(", about [{fx}, 0, {cx}, 0, {fy}, {cy}, 0, 0, 1] if it was resized by {factor:.2}")
        } else {
            String::new()
        };
        let needed = format_args!(
            "must be of an image of {} × {} pixels, but its principal point (third and sixth number) is far from the \
             centre: send the intrinsics of this resolution{resized}; if the image was cropped, send the whole image",
            camera.width, camera.height
        );
        return Err(RequestError::invalid("camera.k", format_args!("{k:?}"), needed));
    }
    // No overflow: both are at most MAX_EDGE.
    Ok(Intrinsics { width: camera.width as usize, height: camera.height as usize, fx, fy, cx, cy })
}

#[cfg(test)]
mod tests {
    use grasp_perception::Workspace;
    use nalgebra::Isometry3;

    use super::*;

    /// A wall at a distance of 0.5 m.
    fn view() -> pb::DepthView {
        pb::DepthView {
            data: [500_u16; 12].iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into(),
            unit: pb::DepthUnit::U16Millimetres.into(),
            camera: Some(pb::Camera { width: 4, height: 3, k: vec![5.0, 0.0, 2.0, 0.0, 5.0, 1.5, 0.0, 0.0, 1.0] }),
            extrinsics: Some(Extrinsics::CameraFromTask((&Isometry3::translation(0.0, 0.0, 0.4)).into())),
            labels: None,
        }
    }

    fn refused(change: impl Fn(&mut pb::DepthView)) -> String {
        let mut view = view();
        change(&mut view);
        let error = frames(&[self::view(), view]).unwrap_err();
        assert!(error.message.starts_with(error.field()), "{error:?}");
        error.to_string()
    }

    #[test]
    fn a_png_gives_the_same_view() {
        let png = pb::DepthView {
            data: png::grey_png(&[500; 12], 4).into(),
            unit: pb::DepthUnit::PngMillimetres.into(),
            ..view()
        };
        assert_eq!(frame(&png), frame(&view()));
        let other = png::grey_png(&[500; 12], 3);
        let unit = pb::DepthUnit::PngMillimetres.into();
        assert_eq!(
            refused(|view| *view = pb::DepthView { data: other.clone().into(), unit, ..view.clone() }),
            "views[1].data: the PNG has 3 × 4 pixels, the camera has 4 × 3"
        );
        assert!(refused(|view| view.unit = unit).starts_with("views[1].data: not a valid PNG file"));
    }

    #[test]
    fn png_images_of_a_request_are_limited_together() {
        let image = |edge: u32| pb::DepthView {
            unit: pb::DepthUnit::PngMillimetres.into(),
            camera: Some(pb::Camera { width: edge, height: edge, k: Vec::new() }),
            ..view()
        };
        assert!(check_png(&[image(4096), image(4096)]).is_ok());
        let r#type = pb::LabelType::Png.into();
        let labelled = pb::DepthView { labels: Some(pb::Labels { r#type, ..Default::default() }), ..image(4096) };
        assert_eq!(
            check_png(&[image(4096), labelled]).unwrap_err().to_string(),
            "views is PNG images with 50331648 pixels in all, must have at most 33554432; send fewer or smaller images"
        );
        let raw = pb::DepthView { unit: pb::DepthUnit::U16Millimetres.into(), ..image(u32::MAX) };
        assert!(check_png(&[raw]).is_ok(), "its size is that of the message");
        assert!(check_png(&[image(u32::MAX), image(u32::MAX)]).is_err());
    }

    #[test]
    fn a_depth_in_8_bits_is_refused() {
        let mut file = Vec::new();
        let mut encoder = ::png::Encoder::new(&mut file, 4, 3);
        encoder.set_color(::png::ColorType::Grayscale);
        encoder.write_header().unwrap().write_image_data(&[200; 12]).unwrap();
        let unit = pb::DepthUnit::PngMillimetres.into();
        assert_eq!(
            refused(|view| *view = pb::DepthView { data: file.clone().into(), unit, ..view.clone() }),
            "views[1].data: the PNG has the type Grayscale of 8 bits, must be grey of 16 bits"
        );
    }

    #[test]
    fn labels_belong_to_pixels_and_points() {
        let labels = |data: Vec<u8>| Some(pb::Labels { data: data.into(), r#type: pb::LabelType::U8.into() });
        let labelled = pb::DepthView { labels: labels((0..12).collect()), ..view() };
        let converted = frame(&labelled).unwrap();
        assert_eq!(converted.labels, Some((0..12).collect()));
        assert_eq!(
            refused(|view| view.labels = labels(vec![1; 11])),
            "views[1].labels.data: 11 bytes; 4 × 3 pixels need 12 (LABEL_TYPE_U8)"
        );
    }

    #[test]
    fn an_extent_is_checked() {
        let workspace = |x, y| {
            let extent = Some(pb::Extent { x, y });
            Workspace::try_from(pb::Workspace { extent, ..Default::default() }).map(|workspace| workspace.extent)
        };
        assert_eq!(workspace(0.9, 0.6), Ok(Some([0.9, 0.6])));
        assert_eq!(
            workspace(0.9, 2.5).unwrap_err().to_string(),
            "workspace.extent.y is 2.5, must be above 0 and at most 2 m"
        );
        assert_eq!(workspace(f64::NAN, 0.5).unwrap_err().field(), "workspace.extent.x");
    }

    #[test]
    fn both_units_and_both_directions_give_the_same_view() {
        let frame_from_task = Isometry3::translation(1.0, 2.0, 3.0);
        let in_task = |view: &pb::DepthView| frame(view).unwrap().in_task(&frame_from_task).unwrap();
        let expected = in_task(&view());
        assert_eq!(expected.image.depth(), [0.5; 12]);
        let intrinsics = Intrinsics { width: 4, height: 3, fx: 5.0, fy: 5.0, cx: 2.0, cy: 1.5 };
        assert_eq!(expected.intrinsics(), intrinsics);

        let metres: Vec<u8> = [0.5_f32; 12].iter().flat_map(|v| v.to_le_bytes()).collect();
        let frame_from_camera = frame_from_task * expected.camera_from_task.inverse();
        let other = in_task(&pb::DepthView {
            data: metres.into(),
            unit: pb::DepthUnit::F32Metres.into(),
            extrinsics: Some(Extrinsics::FrameFromCamera((&frame_from_camera).into())),
            ..view()
        });
        assert_eq!(other.image, expected.image);
        assert!((other.camera_from_task.to_homogeneous() - expected.camera_from_task.to_homogeneous()).norm() < 1e-9);
    }

    #[test]
    fn each_invalid_field_is_named() {
        let camera = |k: &[f64]| Some(pb::Camera { width: 4, height: 3, k: k.to_vec() });
        assert_eq!(refused(|v| v.camera = None), "views[1].camera is absent, must be given");
        assert_eq!(
            refused(|v| v.camera = camera(&[5.0; 4])),
            "views[1].camera.k is 4 numbers, must be nine numbers, row by row: fx 0 cx, 0 fy cy, 0 0 1"
        );
        let transposed = [5.0, 0.0, 0.0, 0.0, 5.0, 0.0, 2.0, 1.5, 1.0];
        assert!(refused(|v| v.camera = camera(&transposed)).ends_with("not transposed"));
        let skewed = [5.0, 0.3, 2.0, 0.0, 5.0, 1.5, 0.0, 0.0, 1.0];
        assert!(refused(|v| v.camera = camera(&skewed)).ends_with("rectify the image"));
        assert!(refused(|v| v.camera = camera(&[0.0; 9])).contains("must be nine numbers"));
        assert!(refused(|v| v.camera = camera(&[f64::NAN; 9])).ends_with("must be finite"));
        for scale in [2.0, 0.75, 0.5] {
            let k = [5.0 * scale, 0.0, 2.0 * scale, 0.0, 5.0 * scale, 1.5 * scale, 0.0, 0.0, 1.0];
            let of_this = format!(
                "send the intrinsics of this resolution, about [5, 0, 2, 0, 5, 1.5, 0, 0, 1] if it was resized by {:.2};",
                1.0 / scale
            );
            assert!(refused(|v| v.camera = camera(&k)).contains(&of_this));
        }
        let negative = [-5.0, 0.0, 2.0, 0.0, 5.0, 1.5, 0.0, 0.0, 1.0];
        assert!(refused(|v| v.camera = camera(&negative)).contains("focal lengths above 0"));
        assert_eq!(
            refused(|v| v.camera.as_mut().unwrap().width = 0),
            "views[1].camera.width is 0, must be from 1 to 16384 pixels"
        );
        assert_eq!(
            refused(|v| v.data = vec![0; 23].into()),
            "views[1].data is 23 bytes, 4 × 3 pixels need 24 (DEPTH_UNIT_U16_MILLIMETRES)"
        );
        assert_eq!(
            refused(|v| v.unit = 0),
            "views[1].unit is 0, must be DEPTH_UNIT_F32_METRES (1), DEPTH_UNIT_U16_MILLIMETRES (2) or DEPTH_UNIT_PNG_MILLIMETRES (3)"
        );
        let no_pose = frame(&pb::DepthView { extrinsics: None, ..view() }).unwrap().in_task(&Isometry3::identity());
        assert!(no_pose.unwrap_err().message.starts_with("extrinsics is absent, camera_from_task"));
        let nowhere = pb::Pose { position: None, orientation: None };
        assert_eq!(
            refused(|v| v.extrinsics = Some(Extrinsics::FrameFromCamera(nowhere))),
            "views[1].frame_from_camera.position is absent, must be given"
        );
    }

    #[test]
    fn a_cropped_image_is_accepted() {
        let camera = pb::Camera { width: 4, height: 3, k: vec![5.0, 0.0, -1.0, 0.0, 5.0, 1.2, 0.0, 0.0, 1.0] };
        let view = pb::DepthView { camera: Some(camera), ..view() };
        assert_eq!(frame(&view).unwrap().image.intrinsics().cx, -1.0);
    }

    #[test]
    fn a_wrong_depth_unit_is_an_error() {
        let f32s = |value: f32| [value; 12].iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let metres = |value: f32| refused(|v| (v.data, v.unit) = (f32s(value).into(), pb::DepthUnit::F32Metres.into()));
        assert!(metres(500.0).contains("look like millimetres"), "{}", metres(500.0));
        assert!(metres(60.0).contains("check the depth unit") && metres(6e5).contains("check the depth unit"));
        assert!(metres(0.0005).contains("not divided by 1000 twice"));
        let millimetres =
            refused(|v| v.data = [1_u16; 12].iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into());
        assert!(millimetres.contains("look like metres"), "{millimetres}");
    }

    #[test]
    fn the_workspace_size_is_checked() {
        let workspace = |size| Workspace::try_from(pb::Workspace { size, ..Default::default() });
        assert_eq!(workspace(0.0).unwrap().size, None);
        assert_eq!(workspace(0.3).unwrap().size, Some(0.3));
        for size in [-0.3, f64::NAN, 300.0] {
            assert!(
                workspace(size).unwrap_err().message.starts_with(&format!("workspace.size is {size}, must be above 0"))
            );
        }
        assert!(check_views(1).is_ok() && check_views(64).is_ok());
        assert_eq!(check_views(0).unwrap_err().message, "views has 0 entries, must have from 1 to 64");
    }
}
