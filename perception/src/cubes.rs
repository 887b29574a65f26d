use std::borrow::Cow;
use std::collections::BTreeSet;
use std::fmt::Display;
use std::sync::Arc;
use std::time::Instant;

use grasp::{DepthImage, DetectParams, Fusion, Region, RequestError, SurfacePoint, TABLE_HEIGHT};
use nalgebra::{Isometry3, Point3};

use crate::grid::FusionGrid;
use crate::layout::{OBJECT_MARGIN, Part};
use crate::point_sampler::PointSampler;
use crate::workspace::Cover;
use crate::{DepthScale, FoundTable, Frames, InputGrid, Observation, Scene, Scenes, Warning, Workspace, check_margin};

/// The scenes of a request with views: places the workspace, and fuses the views into its cubes. Stops when `is_wanted`
/// returns false.
///
/// # Errors
/// [`RequestError`] names the invalid field, or says that the result is no longer wanted.
pub fn perceive(
    frames: Frames,
    workspace: Workspace,
    input: &InputGrid,
    params: &DetectParams,
    is_wanted: &dyn Fn() -> bool,
) -> Result<Scenes, RequestError> {
    let started = Instant::now();
    let (mut cubes, observation, table) = Cubes::placed(workspace, frames, input, params)?;
    let scenes = cubes.fuse(observation, params, is_wanted)?;
    Ok(Scenes { table, fusion: Some(started.elapsed()), ..scenes })
}

/// The cubes that cover a workspace: one, or several overlapping ones for a workspace with an extent.
#[derive(Clone, Debug)]
pub(crate) struct Cubes {
    cubes: Vec<Cube>,
    /// `T_frame_task`.
    frame_from_task: Isometry3<f64>,
    /// The middle of the bottom of the workspace, metres.
    middle: [f64; 2],
    /// Lengths of the workspace along x and y, metres.
    extent: [f64; 2],
    /// Whether to correct the scale of the depths.
    depth_scale: DepthScale,
    /// Whether views of several requests are integrated.
    is_tracked: bool,
    /// The half-life of the measurements of tracked cubes, views.
    half_life: Option<f64>,
    /// The labels of the objects that were found on the table.
    found: Option<BTreeSet<u16>>,
    /// The warning about objects on the table that no cube holds.
    left_out: Option<Warning>,
}

/// A cube, and the field that the views of a stream are fused into.
#[derive(Clone, Debug)]
struct Cube {
    grid: FusionGrid,
    fusion: Option<Fusion>,
    /// `T_task_cube`.
    task_from_cube: Isometry3<f64>,
    /// The part of the workspace whose grasps come from this cube: smallest and largest x and y in the task frame.
    /// `None` if it is the only cube.
    inner: Option<[[f64; 2]; 2]>,
}

/// Most cubes of a workspace, which bounds the memory of a request to 400 MB: those of 2 × 2 m with the default margin.
const MAX_CUBES: usize = 100;

/// Smallest height of an object above the table, metres. Lower surfaces are noise, or too low for a hand.
const OBJECT_HEIGHT: f64 = 0.01;

impl Cubes {
    /// The cubes of a workspace, what the cameras saw in its task frame, and the table if it determined the pose.
    pub fn placed(
        mut workspace: Workspace,
        mut frames: Frames,
        input: &InputGrid,
        params: &DetectParams,
    ) -> Result<(Self, Observation, Option<FoundTable>), RequestError> {
        let height = params.table.unwrap_or(TABLE_HEIGHT);
        let edge = input.edge(workspace.size);
        Self::count(input, &workspace, params.margin)?;
        let Some((mut table, standing)) = workspace.find(&mut frames, height, edge)? else {
            let observation = frames.in_task(&workspace.frame_from_task)?;
            let cubes = Self::new(input, &workspace, None, &observation.eyes(), params.margin);
            return Ok((cubes, observation, None));
        };
        let cover = workspace.cover(&mut table, &standing.objects, edge, params.margin);
        let observation = frames.in_task(&workspace.frame_from_task)?;
        let cubes = Self::new(input, &workspace, cover.as_ref(), &observation.eyes(), params.margin);
        let left_out = cover.filter(|cover| cover.left_out > 0).map(|Cover { left_out, corners, .. }| {
            Warning::ObjectsLeftOut { left_out, objects: table.objects, cubes: corners.len() }
        });
        // If nothing was found, everything may be grasped: objects may be too low to be found.
        let found = standing.labels.filter(|_| !standing.objects.is_empty());
        Ok((Self { found, left_out, ..cubes }, observation, Some(table)))
    }

    /// The cubes that a planner requires for a workspace, or those that `cover` the objects on a table. `eyes` are the camera
    /// positions in the task frame, metres.
    fn new(input: &InputGrid, workspace: &Workspace, cover: Option<&Cover>, eyes: &[Point3<f64>], margin: f64) -> Self {
        let Workspace { frame_from_task, size, extent, depth_scale, .. } = *workspace;
        let edge = input.edge(size);
        // Where the cube was placed by the caller, the volume is what the networks were trained with.
        let is_padded = workspace.find_table || extent.is_some();
        let cube = |[x, y]: [f64; 2], inner| {
            let task_from_cube = Isometry3::translation(x, y, 0.0);
            let eyes: Vec<_> = eyes.iter().map(|eye| task_from_cube.inverse() * eye).collect();
            let grid = FusionGrid::new(input, frame_from_task * task_from_cube, edge, &eyes, is_padded);
            Cube { fusion: None, grid, task_from_cube, inner }
        };
        let margin_of_objects = margin.max(OBJECT_MARGIN);
        let inner = |corner: &[f64; 2]| [margin_of_objects, edge - margin_of_objects].map(|c| corner.map(|x| x + c));
        let cubes = match (extent, cover.map(|cover| cover.corners.as_slice())) {
            (None, Some(corners @ [_, _, ..])) => {
                corners.iter().map(|corner| cube(*corner, Some(inner(corner)))).collect()
            }
            (None, _) => vec![cube([0.0; 2], None)],
            (Some(extent), _) => {
                let parts = Part::cover(extent, edge, margin.max(Part::MARGIN));
                parts.iter().map(|part| cube(part.corner, Some(part.inner))).collect()
            }
        };
        let extent = extent.or(cover.map(|cover| cover.extent)).unwrap_or([edge; 2]);
        Self {
            cubes,
            frame_from_task,
            middle: extent.map(|length| length / 2.0),
            extent,
            depth_scale,
            is_tracked: false,
            half_life: None,
            found: None,
            left_out: None,
        }
    }

    /// The number of cubes that a planner requires for a workspace. It is an error if the planner cannot use their size, or if
    /// there are too many.
    pub fn count(input: &InputGrid, workspace: &Workspace, margin: f64) -> Result<usize, RequestError> {
        let Workspace { size, extent, .. } = *workspace;
        input.check_size(size)?;
        let edge = input.edge(size);
        let Some(extent) = extent else { return check_margin(margin, edge).map(|()| 1) };
        let margin = margin.max(Part::MARGIN);
        if edge <= 2.0 * margin {
            let reason = format_args!(
                "cubes with an edge of {edge} m leave no room between margins of {margin} m on each side: set a smaller \
                 options.margin (at least {} m with an extent), or a larger workspace.size",
                Part::MARGIN
            );
            return Err(RequestError::refused("workspace.extent", reason));
        }
        let count = Part::count(extent, edge, margin);
        if count > MAX_CUBES as f64 {
            let value = format_args!("{} × {} m, which needs {count} cubes", extent[0], extent[1]);
            let needed = format_args!("must need at most {MAX_CUBES}; reduce it or options.margin");
            return Err(RequestError::invalid("workspace.extent", value, needed));
        }
        Ok(count as usize)
    }

    /// Number of cubes.
    pub fn len(&self) -> usize {
        self.cubes.len()
    }

    /// The cubes for views of several requests, whose fields forget with this half-life, views. Without it all views have
    /// the same weight.
    pub fn tracked(mut self, half_life: Option<f64>) -> Self {
        self.is_tracked = true;
        self.half_life = half_life;
        self
    }

    /// `T_frame_task`.
    pub fn frame_from_task(&self) -> &Isometry3<f64> {
        &self.frame_from_task
    }

    /// Checks that a planner can read the grids of these cubes.
    pub fn check(&self, input: &InputGrid) -> Result<(), RequestError> {
        if self.cubes.iter().all(|cube| cube.grid.fits(input)) {
            return Ok(());
        }
        let needed = "which requires a different grid than the stream's volume; send a workspace to start a new one";
        Err(RequestError::invalid("options.model", format_args!("`{}`", input.model), needed))
    }

    /// Integrates the views of a request, and returns the scenes for the planner. Stops when `is_wanted` returns false. After
    /// an error the fields may hold some of the views.
    pub fn fuse(
        &mut self,
        mut observation: Observation,
        params: &DetectParams,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<Scenes, RequestError> {
        let are_found = self.found.is_some();
        params.check_objects(observation.is_labelled() && !are_found, are_found)?;
        let (depth_factors, mut warnings) = self.correct_depth_scale(&mut observation, params.table)?;
        warnings.extend(self.left_out);
        let wanted = self.found.as_ref().or(Some(&params.objects).filter(|wanted| !wanted.is_empty()));
        let objects = observation.objects(&self.frame_from_task, wanted).map(Arc::new);
        // Of small objects that were found, other pixels in the same cells may be more.
        let missing = objects.as_ref().filter(|_| !are_found).and_then(|objects| objects.missing());
        if let Some(label) = missing {
            let reason = format_args!("no pixel or point with a depth has the label {label}");
            return Err(RequestError::refused("options.objects", reason));
        }
        let scenes = self.integrate(&observation, params.margin, &mut warnings, is_wanted)?;
        let of_objects = |scene: Scene| Scene { volume: scene.volume.with_objects(objects.clone()), ..scene };
        let scenes = with_objects(scenes, params.table).into_iter().map(of_objects).collect();
        Ok(Scenes { scenes, warnings, depth_factors, ..Scenes::default() })
    }

    /// Corrects the scale of the depths, so that the table is at the height `table`, metres. Returns the factor of each
    /// view, and warnings.
    fn correct_depth_scale(
        &self,
        observation: &mut Observation,
        table: Option<f64>,
    ) -> Result<(Vec<f64>, Vec<Warning>), RequestError> {
        match (self.depth_scale, table) {
            (DepthScale::Keep, _) | (DepthScale::Auto, None) => Ok(Default::default()),
            (DepthScale::Auto, Some(table)) => Ok(observation.correct_plausible_depth_scale(table, self.extent)),
            (DepthScale::Correct, Some(table)) => Ok(observation.correct_depth_scale(table, self.extent)),
            (DepthScale::Correct, None) => {
                let needed = "must be false without a table, which a negative collision.table_height means";
                Err(RequestError::invalid("workspace.correct_depth_scale", true, needed))
            }
        }
    }

    /// Integrates views, each of which must see a part of the workspace. Returns the scenes of the cubes in which a surface was
    /// observed. Those of tracked cubes have no points.
    fn integrate(
        &mut self,
        observation: &Observation,
        margin: f64,
        warnings: &mut Vec<Warning>,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<Vec<Scene>, RequestError> {
        let eyes = observation.eyes();
        let mut blind: Vec<Result<(), Option<RequestError>>> = vec![Err(None); eyes.len()];
        let mut disagreements = vec![None; eyes.len()];
        let (mut scenes, mut unseen) = (Vec::new(), Vec::new());
        for cube in &mut self.cubes {
            let mut fusion = cube.fusion.take().unwrap_or_else(|| {
                let fusion = cube.grid.fusion();
                match self.half_life {
                    None => fusion,
                    Some(half_life) => fusion.forgetting(half_life),
                }
            });
            let mut sampler = (cube.grid.needs_points() && !self.is_tracked).then(PointSampler::default);
            let mut views = Vec::new();
            for index in 0..eyes.len() {
                if !is_wanted() {
                    return Err(RequestError::expired());
                }
                let seen = cube.integrate(&mut fusion, observation, index, sampler.as_mut(), &mut disagreements[index]);
                match (seen, &mut blind[index]) {
                    (Ok(view), seen) => {
                        views.push(view);
                        *seen = Ok(());
                    }
                    (Err(error), Err(first)) => *first = first.take().or(Some(error)),
                    (Err(_), Ok(())) => {}
                }
            }
            if self.is_tracked {
                // The views of earlier requests are not known, so there are no details.
                views.clear();
            }
            unseen.extend(Warning::of_coverage(&fusion, cube.grid.padding));
            scenes.extend(cube.grid.volume(&fusion, &views).map(|volume| Scene {
                volume,
                points: sampler.map(PointSampler::into_points),
                region: cube.region(&self.frame_from_task, margin),
            }));
            if self.is_tracked {
                cube.fusion = Some(fusion);
            }
        }
        let is_of_network = self.cubes.first().is_some_and(|cube| !cube.grid.needs_points());
        for (index, ((eye, blind), disagreement)) in eyes.iter().zip(blind).zip(disagreements).enumerate() {
            if let Err(Some(error)) = blind {
                return Err(error);
            }
            if is_of_network {
                warnings.extend(Warning::of_camera(index, eye, self.middle));
            }
            warnings.extend(disagreement);
        }
        if unseen.len() == self.cubes.len() {
            warnings.extend(unseen.first());
        }
        if scenes.is_empty() {
            let reason =
                "none shows a surface in the workspace; check workspace.pose, the camera poses and the depth unit";
            return Err(RequestError::refused("views", reason));
        }
        Ok(scenes)
    }
}

/// The scenes in which something stands on the table, at the height `table`, and at least one.
fn with_objects(mut scenes: Vec<Scene>, table: Option<f64>) -> Vec<Scene> {
    let is_used = |scene: &Scene| table.is_none_or(|table| scene.volume.has_surface_above(table + OBJECT_HEIGHT));
    if scenes.iter().any(is_used) {
        scenes.retain(is_used);
    } else {
        scenes.truncate(1);
    }
    scenes
}

impl Cube {
    /// Integrates view `index`, and returns its image and the pose of the camera (`T_camera_field`). `disagreement` becomes
    /// the warning if it contradicts the views before it.
    fn integrate<'a>(
        &self,
        fusion: &mut Fusion,
        observation: &'a Observation,
        index: usize,
        sampler: Option<&mut PointSampler>,
        disagreement: &mut Option<Warning>,
    ) -> Result<(Cow<'a, DepthImage<'static>>, Isometry3<f64>), RequestError> {
        let (image, camera_from_cube) = observation.image(index, &self.task_from_cube, self.grid.size)?;
        let camera_from_grid = self.grid.camera_from_grid(&camera_from_cube);
        if disagreement.is_none() {
            *disagreement = Warning::of_view(index, fusion, &image, &camera_from_grid);
        }
        if fusion.integrate(&image, &camera_from_grid) == 0 {
            let reason = fusion.no_measurement(&image, &camera_from_grid);
            let eye = self.task_from_cube * Point3::from(camera_from_cube.inverse().translation.vector);
            return Err(sees_nothing(index, &eye, reason));
        }
        if let Some(sampler) = sampler {
            let inside = |point: &SurfacePoint| point.position.iter().all(|c| (0.0..=self.grid.size).contains(c));
            image.points(&camera_from_cube).filter(inside).for_each(|point| sampler.add(point));
        }
        Ok((image, camera_from_grid))
    }

    /// The region of the cube's grasps, if it is not the whole field. The fingertips keep `margin` from the sides.
    fn region(&self, frame_from_task: &Isometry3<f64>, margin: f64) -> Option<Region> {
        let size = self.grid.size;
        let [lower, upper] = match self.inner {
            Some(inner) => inner,
            // A grid that is rotated in its cube extends beyond it.
            None if margin > 0.0 || self.grid.is_rotated() => [[margin; 2], [size - margin; 2]],
            None => return None,
        };
        let frame = *frame_from_task;
        Some(Region { frame, lower: [lower[0], lower[1], 0.0], upper: [upper[0], upper[1], size] })
    }
}

/// The error for a view that sees none of the workspace. It contains the camera's position, which shows wrong poses.
pub(crate) fn sees_nothing(index: usize, eye: &Point3<f64>, reason: impl Display) -> RequestError {
    /// Farther from the workspace than any depth camera, metres.
    const FAR: f64 = 20.0;
    let position = format!("({:.3}, {:.3}, {:.3})", eye.x, eye.y, eye.z);
    let distance = eye.coords.norm();
    let reason = if distance > FAR {
        let unit = if distance > 5.0 * FAR { "looks like millimetres" } else { "may have another unit" };
        format!(
            "that is {distance:.0} m away: the position of its pose, or of the workspace, {unit}, must be in metres"
        )
    } else {
        reason.to_string()
    };
    let reason = format!("camera at {position} in the task frame sees none of the workspace; {reason}");
    RequestError::refused(format!("views[{index}]"), reason)
}
