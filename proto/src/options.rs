use std::collections::BTreeSet;

use grasp::{
    ClosingAxis, Collision, Cone, Constraints, Convention, DetectParams, Hand, HandError, Origin, Priority, Region,
    RequestError, Retreat, TABLE_HEIGHT,
};
use nalgebra::{Isometry3, Unit, Vector3};

use crate::pb;
use crate::pose::{self, PoseFields};

/// Default distance from the pre-grasp to the grasp, metres, as in VGN's trials.
const PREGRASP: f64 = 0.05;

/// Default distance of the retreat, metres, as in VGN's trials.
const RETREAT: f64 = 0.1;

/// Longest name of a model and longest version, bytes.
pub const MAX_NAME: usize = 256;

/// Largest pre-grasp and retreat distance, metres.
const REACH: f64 = 10.0;

/// Largest margin and clearance, metres.
const MAX_MARGIN: f64 = 0.1;

const REGION: PoseFields =
    PoseFields { position: "options.region_pose.position", orientation: "options.region_pose.orientation" };

const PARENT: PoseFields = PoseFields {
    position: "options.convention.parent_from_grasp.position",
    orientation: "options.convention.parent_from_grasp.orientation",
};

impl TryFrom<&pb::Options> for DetectParams {
    type Error = RequestError;

    fn try_from(options: &pb::Options) -> Result<Self, RequestError> {
        for (field, name) in [("options.model", &options.model), ("options.version", &options.version)] {
            if name.len() > MAX_NAME {
                let value = format_args!("{} bytes long", name.len());
                return Err(RequestError::invalid(field, value, format_args!("must be at most {MAX_NAME} bytes")));
            }
        }
        let collision = options.collision.unwrap_or_default();
        let table = number("options.collision.table_height", collision.table_height)?.unwrap_or(TABLE_HEIGHT);
        Ok(Self {
            model: options.model.clone(),
            version: options.version.clone(),
            threshold: probability("options.threshold", options.threshold)?,
            force: probability("options.force", options.force)?,
            max_grasps: limit(options.max_grasps),
            max_grasps_per_object: limit(options.max_grasps_per_object),
            objects: objects(&options.objects)?,
            margin: length("options.margin", options.margin, MAX_MARGIN)?.unwrap_or_default(),
            priority: priority(options.priority)?,
            explain: options.explain,
            constraints: Constraints {
                workspace: None,
                region: region(options)?,
                approach: options.approach.as_ref().map(cone).transpose()?,
                min_height: number("options.min_height", options.min_height)?,
            },
            hand: options.gripper.as_ref().map(hand).transpose()?,
            collision: collision.mode.map(mode).transpose()?,
            table: Some(table).filter(|height| *height >= 0.0),
            clearance: length("options.collision.clearance", collision.clearance, MAX_MARGIN)?.unwrap_or_default(),
            hidden: collision.hidden,
            convention: options.convention.as_ref().map(convention).transpose()?.unwrap_or_default(),
            pregrasp: length("options.pregrasp_distance", options.pregrasp_distance, REACH)?.unwrap_or(PREGRASP),
            retreat: options
                .retreat
                .as_ref()
                .map(retreat)
                .transpose()?
                .unwrap_or(Retreat { distance: RETREAT, direction: None }),
        })
    }
}

fn priority(number: i32) -> Result<Priority, RequestError> {
    match pb::Priority::try_from(number) {
        Ok(pb::Priority::Normal) => Ok(Priority::Normal),
        Ok(pb::Priority::Batch) => Ok(Priority::Batch),
        Err(_) => Err(RequestError::invalid("options.priority", number, "must be PRIORITY_NORMAL or PRIORITY_BATCH")),
    }
}

fn probability(field: &'static str, value: Option<f32>) -> Result<Option<f32>, RequestError> {
    match value {
        // Written so that NaN fails.
        Some(value) if !(value > 0.0 && value <= 1.0) => {
            Err(RequestError::invalid(field, value, "must be above 0 and at most 1"))
        }
        value => Ok(value),
    }
}

fn number(field: &'static str, value: Option<f64>) -> Result<Option<f64>, RequestError> {
    match value {
        Some(value) if !value.is_finite() => {
            Err(RequestError::invalid(field, value, "must be a finite number of metres"))
        }
        value => Ok(value),
    }
}

/// A length of at most `most` metres.
fn length(field: &'static str, value: Option<f64>, most: f64) -> Result<Option<f64>, RequestError> {
    match value {
        Some(value) if !(0.0..=most).contains(&value) => {
            Err(RequestError::invalid(field, value, format_args!("must be from 0 to {most} m")))
        }
        value => Ok(value),
    }
}

fn corners(bounds: &pb::Box, field: &'static str) -> Result<[[f64; 3]; 2], RequestError> {
    let corner = |corner: Option<pb::Vector3>, name: &str| {
        let field = format!("{field}.{name}");
        let corner = corner.ok_or_else(|| RequestError::invalid(field.clone(), "absent", "must be given"))?;
        let [x, y, z] = [corner.x, corner.y, corner.z];
        if [x, y, z].iter().all(|c| c.is_finite()) {
            return Ok([x, y, z]);
        }
        Err(RequestError::invalid(field, format_args!("({x}, {y}, {z})"), "must be finite"))
    };
    Ok([corner(bounds.min, "min")?, corner(bounds.max, "max")?])
}

/// A largest number; 0 means no limit.
fn limit(count: u32) -> usize {
    if count == 0 { usize::MAX } else { count as usize }
}

fn objects(labels: &[u32]) -> Result<BTreeSet<u16>, RequestError> {
    let label = |(index, &label): (usize, &u32)| {
        let valid = u16::try_from(label).ok().filter(|label| *label > 0);
        valid
            .ok_or_else(|| RequestError::invalid(format!("options.objects[{index}]"), label, "must be from 1 to 65535"))
    };
    labels.iter().enumerate().map(label).collect()
}

fn region(options: &pb::Options) -> Result<Option<Region>, RequestError> {
    const FIELD: &str = "options.region";
    let Some(bounds) = &options.region else {
        let without =
            |_| RequestError::invalid("options.region_pose", "given", "must be absent without options.region");
        return options.region_pose.as_ref().map_or(Ok(None), |pose| Err(without(pose)));
    };
    let frame = options.region_pose.as_ref().map_or(Ok(Isometry3::identity()), |pose| pose::decode(pose, &REGION))?;
    let [lower, upper] = corners(bounds, FIELD)?;
    for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
        if lower[axis] > upper[axis] {
            let needed = format_args!("must be at least `min.{name}`, {}", lower[axis]);
            return Err(RequestError::invalid(format!("{FIELD}.max.{name}"), upper[axis], needed));
        }
    }
    Ok(Some(Region { frame, lower, upper }))
}

/// The direction of a vector of any length above 0.
pub(crate) fn direction(vector: Option<pb::Vector3>, field: &'static str) -> Result<Unit<Vector3<f64>>, RequestError> {
    let pb::Vector3 { x, y, z } = vector.ok_or_else(|| RequestError::invalid(field, "absent", "must be given"))?;
    let vector = Vector3::new(x, y, z);
    // Scaled by the largest component first, so that the squares do not overflow.
    let direction = Unit::try_new(vector / vector.amax().max(1e-9), 1e-9);
    let direction = direction.filter(|unit| unit.iter().all(|c| c.is_finite()) && vector.norm() > 1e-9);
    direction.ok_or_else(|| {
        RequestError::invalid(field, format_args!("({x}, {y}, {z})"), "must be finite and of a length above 0")
    })
}

fn cone(cone: &pb::Cone) -> Result<Cone, RequestError> {
    let axis = direction(cone.axis, "options.approach.axis")?;
    if !(cone.angle > 0.0 && cone.angle <= std::f64::consts::PI) {
        let needed = "must be above 0 and at most π (radians)";
        return Err(RequestError::invalid("options.approach.angle", cone.angle, needed));
    }
    Ok(Cone { axis, angle: cone.angle })
}

fn hand(gripper: &pb::Gripper) -> Result<Hand, RequestError> {
    let palm = gripper.palm.as_ref().map(|palm| corners(palm, "options.gripper.palm")).transpose()?;
    let pb::Gripper { max_opening, finger_depth, finger_width, finger_breadth, .. } = *gripper;
    let hand = Hand::new(max_opening, finger_depth, finger_width, finger_breadth, palm.unwrap_or_default());
    hand.map_err(|HandError { field, value, needed }| {
        RequestError::invalid(
            format!("options.gripper.{field}"),
            format_args!("{value} m"),
            format_args!("must be {needed}"),
        )
    })
}

fn mode(mode: i32) -> Result<Collision, RequestError> {
    use pb::collision_check::Mode;
    match Mode::try_from(mode) {
        Ok(Mode::Off) => Ok(Collision::Off),
        Ok(Mode::Flag) => Ok(Collision::Flag),
        Ok(Mode::Filter) => Ok(Collision::Filter),
        Err(_) => {
            let needed = "must be MODE_OFF (0), MODE_FLAG (1) or MODE_FILTER (2)";
            Err(RequestError::invalid("options.collision.mode", mode, needed))
        }
    }
}

fn convention(convention: &pb::Convention) -> Result<Convention, RequestError> {
    use pb::convention::{ClosingAxis as Axis, Origin as From};
    let parent = convention.parent_from_grasp.as_ref();
    const ORIGIN: &str = "options.convention.origin";
    let origin = match (From::try_from(convention.origin), parent) {
        (Ok(From::FingerBase), None) => Origin::FingerBase,
        (Ok(From::Tcp), None) => Origin::Fingertips,
        (Ok(From::Parent), Some(pose)) => Origin::Parent(pose::decode(pose, &PARENT)?),
        (Ok(From::Parent), None) => {
            let needed = "must be given for ORIGIN_PARENT";
            return Err(RequestError::invalid("options.convention.parent_from_grasp", "absent", needed));
        }
        (Ok(origin), Some(_)) => {
            let needed = "must be ORIGIN_PARENT if parent_from_grasp is given";
            return Err(RequestError::invalid(ORIGIN, origin.as_str_name(), needed));
        }
        (Err(_), _) => {
            let needed = "must be ORIGIN_FINGER_BASE (0), ORIGIN_TCP (1) or ORIGIN_PARENT (2)";
            return Err(RequestError::invalid(ORIGIN, convention.origin, needed));
        }
    };
    let closing = match Axis::try_from(convention.closing_axis) {
        Ok(Axis::Y) => ClosingAxis::Y,
        Ok(Axis::X) => ClosingAxis::X,
        Err(_) => {
            let needed = "must be CLOSING_AXIS_Y (0) or CLOSING_AXIS_X (1)";
            return Err(RequestError::invalid("options.convention.closing_axis", convention.closing_axis, needed));
        }
    };
    Ok(Convention { origin, closing })
}

fn retreat(retreat: &pb::Retreat) -> Result<Retreat, RequestError> {
    let distance = length("options.retreat.distance", retreat.distance, REACH)?;
    let towards = retreat.direction.map(|vector| direction(Some(vector), "options.retreat.direction")).transpose()?;
    Ok(Retreat { distance: distance.unwrap_or(RETREAT), direction: towards })
}

#[cfg(test)]
mod tests {
    use grasp::DecodeParams;
    use nalgebra::Translation3;

    use super::*;

    fn refused(options: pb::Options) -> String {
        DetectParams::try_from(&options).unwrap_err().to_string()
    }

    #[test]
    fn the_defaults_are_those_of_the_papers() {
        let params = DetectParams::try_from(&pb::Options::default()).unwrap();
        let own = DecodeParams { threshold: 0.8, force: Some(0.5), ..DecodeParams::default() };
        assert_eq!(params.decode_params(own, None), own);
        let grasp = Isometry3::new(Vector3::new(0.1, 0.2, 0.3), Vector3::new(3.0, 0.0, 0.0));
        let [pose, pregrasp, retreat] = params.poses(&grasp);
        assert_eq!(pose, grasp);
        let z = |pose: Isometry3<f64>| (grasp.inverse() * pose).translation.vector.z;
        assert!((z(pregrasp) + 0.05).abs() < 1e-12 && (z(retreat) + 0.1).abs() < 1e-12);
        assert_eq!((params.collision, params.table, params.max_grasps), (None, Some(0.05), usize::MAX));
    }

    #[test]
    fn retreat_direction_and_parent_frame_are_applied() {
        let up = pb::Vector3 { x: 0.0, y: 0.0, z: 2.0 };
        let parent = (&Isometry3::translation(0.0, 0.0, 0.0584)).into();
        let options = pb::Options {
            retreat: Some(pb::Retreat { distance: Some(0.2), direction: Some(up) }),
            convention: Some(pb::Convention { origin: 2, closing_axis: 0, parent_from_grasp: Some(parent) }),
            ..Default::default()
        };
        let grasp = Isometry3::new(Vector3::new(0.1, 0.2, 0.3), Vector3::new(3.0, 0.0, 0.0));
        let [pose, _, retreat] = DetectParams::try_from(&options).unwrap().poses(&grasp);
        assert!((retreat.translation.vector - pose.translation.vector - Vector3::new(0.0, 0.0, 0.2)).norm() < 1e-12);
        assert!(
            (pose * Translation3::new(0.0, 0.0, 0.0584)).translation.vector.metric_distance(&grasp.translation.vector)
                < 1e-12
        );
    }

    #[test]
    fn options_about_objects_need_labels() {
        let params = |options: &pb::Options| DetectParams::try_from(options).unwrap();
        let of_objects = params(&pb::Options { objects: vec![7, 3], ..Default::default() });
        assert_eq!(of_objects.objects, [3, 7].into());
        let refused = of_objects.check_objects(false, true).unwrap_err();
        assert_eq!(refused.to_string(), "options.objects: object 3 needs views with labels");
        assert!(of_objects.check_objects(true, false).is_ok());
        let limited = params(&pb::Options { max_grasps_per_object: 2, ..Default::default() });
        assert_eq!(limited.check_objects(false, false).unwrap_err().field(), "options.max_grasps_per_object");
        assert!(params(&pb::Options::default()).check_without_views().is_ok());
    }

    #[test]
    fn a_region_can_have_any_direction() {
        let vector = |x, y, z| Some(pb::Vector3 { x, y, z });
        let pose = Isometry3::new(Vector3::new(0.1, 0.0, 0.0), Vector3::new(0.0, 0.0, 0.5));
        let region = Some(pb::Box { min: vector(0.0, 0.0, 0.0), max: vector(0.1, 0.1, 0.1) });
        let options = pb::Options { region, region_pose: Some((&pose).into()), ..Default::default() };
        let region = DetectParams::try_from(&options).unwrap().constraints.region.unwrap();
        assert!((region.frame.to_homogeneous() - pose.to_homogeneous()).norm() < 1e-12);
    }

    #[test]
    fn each_invalid_option_is_named() {
        let vector = |x, y, z| Some(pb::Vector3 { x, y, z });
        let options = |change: fn(&mut pb::Options)| {
            let mut options = pb::Options::default();
            change(&mut options);
            refused(options)
        };
        assert_eq!(
            options(|o| o.threshold = Some(f32::NAN)),
            "options.threshold is NaN, must be above 0 and at most 1"
        );
        assert_eq!(
            options(|o| o.pregrasp_distance = Some(-0.1)),
            "options.pregrasp_distance is -0.1, must be from 0 to 10 m"
        );
        assert_eq!(
            options(|o| o.gripper = Some(pb::Gripper { max_opening: 85.0, ..Default::default() })),
            "options.gripper.max_opening is 85 m, must be above 0 and at most 0.5"
        );
        let region = Some(pb::Box { min: vector(0.0, 0.0, 0.2), max: vector(0.1, 0.1, 0.1) });
        assert_eq!(
            refused(pb::Options { region, ..Default::default() }),
            "options.region.max.z is 0.1, must be at least `min.z`, 0.2"
        );
        assert_eq!(options(|o| o.margin = Some(0.2)), "options.margin is 0.2, must be from 0 to 0.1 m");
        assert_eq!(options(|o| o.objects = vec![3, 0]), "options.objects[1] is 0, must be from 1 to 65535");
        let clearance = Some(pb::CollisionCheck { clearance: Some(f64::NAN), ..Default::default() });
        assert_eq!(
            refused(pb::Options { collision: clearance, ..Default::default() }),
            "options.collision.clearance is NaN, must be from 0 to 0.1 m"
        );
        assert_eq!(
            options(|o| o.region_pose = Some((&Isometry3::identity()).into())),
            "options.region_pose is given, must be absent without options.region"
        );
        let approach = Some(pb::Cone { axis: vector(0.0, 0.0, 0.0), angle: 0.5 });
        assert_eq!(
            refused(pb::Options { approach, ..Default::default() }),
            "options.approach.axis is (0, 0, 0), must be finite and of a length above 0"
        );
        let approach = Some(pb::Cone { axis: vector(0.0, 0.0, -1.0), angle: 30.0 });
        assert_eq!(
            refused(pb::Options { approach, ..Default::default() }),
            "options.approach.angle is 30, must be above 0 and at most π (radians)"
        );
        let convention = Some(pb::Convention { origin: 2, ..Default::default() });
        assert_eq!(
            refused(pb::Options { convention, ..Default::default() }),
            "options.convention.parent_from_grasp is absent, must be given for ORIGIN_PARENT"
        );
        let collision = Some(pb::CollisionCheck { mode: Some(7), ..Default::default() });
        assert_eq!(
            refused(pb::Options { collision, ..Default::default() }),
            "options.collision.mode is 7, must be MODE_OFF (0), MODE_FLAG (1) or MODE_FILTER (2)"
        );
    }
}
