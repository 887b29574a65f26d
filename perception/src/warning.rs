use grasp::{DepthImage, Fusion, Volume};
use nalgebra::{Isometry3, Point3, Vector3};
use thiserror::Error;

use crate::{Table, measured_shift};

/// A sign that the geometry of an observation is wrong, or that a network was not trained for it. Grasps are detected
/// all the same.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum Warning {
    /// No level plane of a table's size was observed.
    #[error(
        "no table observed: the largest level plane covers {:.0} cm², a table at z = {expected:.3} m was expected; check \
         that the table is inside the cube and is not masked out, the camera pose, and workspace.pose; if there is no \
         table, set collision.table_height to a negative value",
        area * 1e4
    )]
    NoTable {
        /// Observed part of the largest level plane, m².
        area: f64,
        /// Height at which a table was expected, metres above the bottom of the volume.
        expected: f64,
    },
    /// The table is not level.
    #[error(
        "the table is tilted by {:.1}° in the volume; check the camera pose and its direction, the intrinsics, and \
         whether the image is rotated",
        tilt.to_degrees()
    )]
    TableTilted {
        /// Angle between the table and the bottom of the volume, radians.
        tilt: f64,
    },
    /// The table is level, but not at the expected height.
    #[error(
        "the table is at z = {height:.3} m in the volume, expected at {expected:.3} m; check the height of \
         workspace.pose and the camera pose, or set collision.table_height; if the scale of the depths is in doubt, set \
         workspace.correct_depth_scale"
    )]
    TableHeight {
        /// Height of the table, metres above the bottom of the volume.
        height: f64,
        /// Expected height, metres.
        expected: f64,
    },
    /// The cameras measured only a small part of the volume.
    #[error(
        "the cameras measured only {:.0} % of the volume; check that the whole workspace is in the image and has depth",
        share * 100.0
    )]
    MostlyUnseen {
        /// Measured share of the voxels.
        share: f64,
    },
    /// A view shows surfaces in space that earlier views saw as free.
    #[error(
        "views[{view}] contradicts the views before it: {:.0} % of its surface lies in space that they saw as free; check \
         its pose, and whether the scene has changed",
        share * 100.0
    )]
    ViewsDisagree {
        /// Index of the view.
        view: usize,
        /// Contradicted share of its points.
        share: f64,
    },
    /// The distance of a camera is outside the range of the training data.
    #[error(
        "the camera of views[{view}] is {distance:.2} m from the middle of the workspace; the network was trained with cameras at \
         {} to {} m",
        TRAINED_DISTANCE[0],
        TRAINED_DISTANCE[1]
    )]
    CameraDistance {
        /// Index of the view.
        view: usize,
        /// Distance of the camera from the middle of the workspace, metres.
        distance: f64,
    },
    /// The direction of a camera is outside the range of the training data.
    #[error(
        "the camera of views[{view}] is {:.0}° from the vertical; the network was trained with cameras at {:.0} to {:.0}°",
        angle.to_degrees(),
        TRAINED_ANGLE[0],
        TRAINED_ANGLE[1]
    )]
    CameraAngle {
        /// Index of the view.
        view: usize,
        /// Angle between the vertical and the direction to the camera, radians.
        angle: f64,
    },
    /// The scale of the depths of a view cannot be corrected.
    #[error(
        "views[{view}] shows no table within 10 % of its distance, so its depths were not corrected; check the camera \
         pose, workspace.pose and collision.table_height"
    )]
    DepthScale {
        /// Index of the view.
        view: usize,
    },
    /// The scale of the depths of a view was corrected although the request did not ask for it.
    #[error(
        "the depths of views[{view}] were multiplied by {factor:.4}, because its table is at z = {height:.3} m, expected at \
         {expected:.3} m; if a pose is wrong instead, grasps are beside the objects: check the camera pose, workspace.pose \
         and collision.table_height, or set workspace.correct_depth_scale to false"
    )]
    DepthsCorrected {
        /// Index of the view.
        view: usize,
        /// The factor.
        factor: f64,
        /// Height at which the table was measured, metres.
        height: f64,
        /// Its expected height, metres.
        expected: f64,
    },
    /// There are more objects on the table than the cubes may cover.
    #[error(
        "{left_out} of the {objects} objects on the table are not in the workspace, which has {cubes} cubes; for a \
         larger one set workspace.extent"
    )]
    ObjectsLeftOut {
        /// Number of objects outside of the workspace.
        left_out: usize,
        /// Number of objects on the table.
        objects: usize,
        /// Number of cubes.
        cubes: usize,
    },
}

/// Range of the distances of the cameras from the middle of the workspace in training, metres.
pub const TRAINED_DISTANCE: [f64; 2] = [0.48, 0.72];

/// Range of the angles of the cameras from the vertical in training, degrees.
pub const TRAINED_ANGLE: [f64; 2] = [20.0, 75.0];

/// Height of the point at which the cameras looked in training, metres above the bottom of the workspace.
pub const TARGET_HEIGHT: f64 = 0.08;

impl Warning {
    /// How far beyond the range of the training a camera is accepted, metres and degrees.
    const DISTANCE_MARGIN: f64 = 0.05;
    const ANGLE_MARGIN: f64 = 5.0;
    /// Largest contradicted share of a view.
    const CONTRADICTED: f64 = 0.1;
    /// Smallest measured share of a volume.
    const MEASURED: f64 = 0.3;
    /// Smallest observed area of a table, m². It is larger than the tops of most objects, and smaller than what is seen
    /// of the table in the benchmark's scenes.
    const SMALLEST_TABLE: f64 = 0.02;
    /// Largest tilt of a table, radians: 3°. Well-calibrated cameras have errors of 1°.
    const TILT: f64 = 3.0 * std::f64::consts::PI / 180.0;
    /// Largest distance of a table from the expected height, metres.
    const HEIGHT: f64 = 0.01;

    /// Checks the position of a camera against the training data. `middle` is that of the bottom of the workspace. Both
    /// in the task frame, metres.
    #[must_use]
    pub fn of_camera(view: usize, eye: &Point3<f64>, middle: [f64; 2]) -> Option<Warning> {
        let from_middle = eye.coords - Vector3::new(middle[0], middle[1], TARGET_HEIGHT);
        let (distance, angle) = (from_middle.norm(), from_middle.angle(&Vector3::z()));
        let is_within =
            |value: f64, [low, high]: [f64; 2], margin: f64| (low - margin..=high + margin).contains(&value);
        if !is_within(distance, TRAINED_DISTANCE, Self::DISTANCE_MARGIN) {
            Some(Self::CameraDistance { view, distance })
        } else {
            (!is_within(angle.to_degrees(), TRAINED_ANGLE, Self::ANGLE_MARGIN))
                .then_some(Self::CameraAngle { view, angle })
        }
    }

    /// The warning about corrected depths of a view from `eye`, if the correction moved the table by more than 1 cm.
    #[must_use]
    pub fn of_depth_factor(view: usize, factor: f64, eye: &Point3<f64>, expected: f64) -> Option<Warning> {
        let shift = measured_shift(factor, eye, expected);
        let height = expected + shift;
        (shift.abs() > Self::HEIGHT).then_some(Self::DepthsCorrected { view, factor, height, expected })
    }

    /// Compares a view with those that were fused before it.
    #[must_use]
    pub fn of_view(
        view: usize,
        fused: &Fusion,
        image: &DepthImage,
        camera_from_task: &Isometry3<f64>,
    ) -> Option<Warning> {
        let share = fused.contradicted(image, camera_from_task)?;
        (share > Self::CONTRADICTED).then_some(Self::ViewsDisagree { view, share })
    }

    /// Checks how much of a volume was measured. The volume is the middle of a field with `padding` voxels on each
    /// side.
    #[must_use]
    pub fn of_coverage(fused: &Fusion, padding: usize) -> Option<Warning> {
        let share = fused.measured(padding);
        (share < Self::MEASURED).then_some(Self::MostlyUnseen { share })
    }

    /// Looks for a table at the height `expected`, metres above the bottom of the volume.
    #[must_use]
    pub fn of_table(volume: &Volume, expected: f64) -> Option<Warning> {
        match Table::find(volume, expected) {
            Some(table) if table.area >= Self::SMALLEST_TABLE => {
                let Table { tilt, height, .. } = table;
                let is_off = (height - expected).abs() > Self::HEIGHT;
                if tilt > Self::TILT {
                    Some(Self::TableTilted { tilt })
                } else {
                    is_off.then_some(Self::TableHeight { height, expected })
                }
            }
            table => Some(Self::NoTable { area: table.map_or(0.0, |table| table.area), expected }),
        }
    }
}

/// The warning about the table of the scenes of a request, given that of each, unless it is as expected in one of them.
#[must_use]
pub fn table_warning(of_scenes: impl IntoIterator<Item = Option<Warning>>) -> Option<Warning> {
    let mut warnings = of_scenes.into_iter();
    let first = warnings.next()??;
    warnings.all(|warning| warning.is_some()).then_some(first)
}
