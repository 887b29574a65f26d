use std::fmt::Display;
use std::sync::Arc;
use std::time::Instant;

use grasp::{DetectParams, Fusion, ObjectMap, Region, RequestError, SurfacePoint, TABLE_HEIGHT};
use nalgebra::{Isometry3, Point3};

use crate::grid::FusionGrid;
use crate::layout::Part;
use crate::point_sampler::PointSampler;
use crate::{FoundTable, Frames, InputGrid, Observation, Scene, Scenes, Warning, Workspace, check_margin};

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
    corrects_depth_scale: bool,
    /// Whether views of several requests are integrated.
    is_tracked: bool,
}

/// A cube and the field that its views are fused into.
#[derive(Clone, Debug)]
struct Cube {
    grid: FusionGrid,
    fusion: Fusion,
    /// `T_task_cube`.
    task_from_cube: Isometry3<f64>,
    /// The part of the workspace whose grasps come from this cube: smallest and largest x and y in the task frame.
    /// `None` if it is the only cube.
    inner: Option<[[f64; 2]; 2]>,
}

/// Most cubes of a workspace, which bounds the memory of a request to 80 MB: those of 2 × 2 m with the default margin.
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
        let table = workspace.find_table(&mut frames, height, input.edge(workspace.size))?;
        let observation = frames.in_task(&workspace.frame_from_task)?;
        let cubes = Self::new(input, &workspace, &observation.eyes(), params.margin)?;
        Ok((cubes, observation, table))
    }

    /// The cubes that a planner requires for a workspace. `eyes` are the camera positions in the task frame, metres.
    fn new(input: &InputGrid, workspace: &Workspace, eyes: &[Point3<f64>], margin: f64) -> Result<Self, RequestError> {
        let Workspace { frame_from_task, size, extent, correct_depth_scale, .. } = *workspace;
        Self::count(input, workspace, margin)?;
        let edge = input.edge(size);
        let cube = |[x, y]: [f64; 2], inner| {
            let task_from_cube = Isometry3::translation(x, y, 0.0);
            let eyes: Vec<_> = eyes.iter().map(|eye| task_from_cube.inverse() * eye).collect();
            let grid = FusionGrid::new(input, frame_from_task * task_from_cube, edge, &eyes);
            Cube { fusion: grid.fusion(), grid, task_from_cube, inner }
        };
        let cubes = match extent {
            None => vec![cube([0.0; 2], None)],
            Some(extent) => {
                let parts = Part::cover(extent, edge, margin.max(Part::MARGIN));
                parts.iter().map(|part| cube(part.corner, Some(part.inner))).collect()
            }
        };
        let extent = extent.unwrap_or([edge; 2]);
        Ok(Self {
            cubes,
            frame_from_task,
            middle: extent.map(|length| length / 2.0),
            extent,
            corrects_depth_scale: correct_depth_scale,
            is_tracked: false,
        })
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
            let value = format_args!("given, for cubes with an edge of {edge} m");
            let needed = format_args!(
                "which must be above {} m, twice options.margin (at least {} m)",
                2.0 * margin,
                Part::MARGIN
            );
            return Err(RequestError::invalid("workspace.extent", value, needed));
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
        if let Some(half_life) = half_life {
            self.cubes = self.cubes.into_iter().map(|cube| cube.forgetting(half_life)).collect();
        }
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
        params.check_objects(observation.is_labelled())?;
        let (depth_factors, mut warnings) = self.correct_depth_scale(&mut observation, params.table)?;
        let objects = observation.objects(&self.frame_from_task, &params.objects)?;
        let points = self.integrate(&observation, &mut warnings, is_wanted)?;
        let scenes = self.scenes(points, objects.as_ref(), params)?;
        Ok(Scenes { scenes, warnings, depth_factors, ..Scenes::default() })
    }

    /// Corrects the scale of the depths if `correct_depth_scale` is set, so that the table is at the height `table`, metres.
    /// Returns the factor of each view, and warnings.
    fn correct_depth_scale(
        &self,
        observation: &mut Observation,
        table: Option<f64>,
    ) -> Result<(Vec<f64>, Vec<Warning>), RequestError> {
        match (self.corrects_depth_scale, table) {
            (false, _) => Ok(Default::default()),
            (true, Some(table)) => Ok(observation.correct_depth_scale(table, self.extent)),
            (true, None) => {
                let needed = "must be false without a table, which a negative collision.table_height means";
                Err(RequestError::invalid("workspace.correct_depth_scale", true, needed))
            }
        }
    }

    /// Integrates views, each of which must see a part of the workspace. Returns for each cube the observed points, if the
    /// planner needs them. Those of tracked cubes are not stored.
    fn integrate(
        &mut self,
        observation: &Observation,
        warnings: &mut Vec<Warning>,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<Vec<Option<Vec<SurfacePoint>>>, RequestError> {
        let samples = |cube: &Cube| cube.grid.needs_points() && !self.is_tracked;
        let mut samplers: Vec<_> = self.cubes.iter().map(|cube| samples(cube).then(PointSampler::default)).collect();
        let is_of_network = self.cubes.first().is_some_and(|cube| !cube.grid.needs_points());
        for (index, eye) in observation.eyes().iter().enumerate() {
            if is_of_network {
                warnings.extend(Warning::of_camera(index, eye, self.middle));
            }
            let (mut is_seen, mut blind, mut disagreement) = (false, None, None);
            for (cube, sampler) in self.cubes.iter_mut().zip(&mut samplers) {
                if !is_wanted() {
                    return Err(RequestError::expired());
                }
                match cube.integrate(observation, index, sampler.as_mut(), &mut disagreement) {
                    Ok(()) => is_seen = true,
                    Err(error) => blind = blind.or(Some(error)),
                }
            }
            if let Some(error) = blind.filter(|_| !is_seen) {
                return Err(error);
            }
            warnings.extend(disagreement);
        }
        let unseen: Vec<_> = self.cubes.iter().filter_map(|cube| Warning::of_coverage(&cube.fusion)).collect();
        if unseen.len() == self.cubes.len() {
            warnings.extend(unseen.first());
        }
        Ok(samplers.into_iter().map(|sampler| sampler.map(PointSampler::into_points)).collect())
    }

    /// The scenes of the cubes in which something stands on the table, and at least one.
    fn scenes(
        &self,
        points: Vec<Option<Vec<SurfacePoint>>>,
        objects: Option<&Arc<ObjectMap>>,
        params: &DetectParams,
    ) -> Result<Vec<Scene>, RequestError> {
        let scene = |(cube, points): (&Cube, Option<Vec<SurfacePoint>>)| {
            let volume = cube.grid.volume(&cube.fusion)?.with_objects(objects.cloned());
            Some(Scene { volume, points, region: cube.region(&self.frame_from_task, params.margin) })
        };
        let mut scenes: Vec<_> = self.cubes.iter().zip(points).filter_map(scene).collect();
        let is_used =
            |scene: &Scene| params.table.is_none_or(|table| scene.volume.has_surface_above(table + OBJECT_HEIGHT));
        if scenes.iter().any(is_used) {
            scenes.retain(is_used);
        } else {
            scenes.truncate(1);
        }
        if scenes.is_empty() {
            let reason = "none shows a surface in the workspace; check workspace.pose and the camera poses";
            return Err(RequestError::refused("views", reason));
        }
        Ok(scenes)
    }
}

impl Cube {
    fn forgetting(self, half_life: f64) -> Self {
        Self { fusion: self.fusion.forgetting(half_life), ..self }
    }

    /// Integrates view `index`. `disagreement` becomes the warning if it contradicts the views before it.
    fn integrate(
        &mut self,
        observation: &Observation,
        index: usize,
        sampler: Option<&mut PointSampler>,
        disagreement: &mut Option<Warning>,
    ) -> Result<(), RequestError> {
        let (image, camera_from_cube) = observation.image(index, &self.task_from_cube, self.grid.size)?;
        let camera_from_grid = self.grid.camera_from_grid(&camera_from_cube);
        if disagreement.is_none() {
            *disagreement = Warning::of_view(index, &self.fusion, &image, &camera_from_grid);
        }
        if self.fusion.integrate(&image, &camera_from_grid) == 0 {
            let reason = self.fusion.no_measurement(&image, &camera_from_grid);
            let eye = self.task_from_cube * Point3::from(camera_from_cube.inverse().translation.vector);
            return Err(sees_nothing(index, &eye, reason));
        }
        if let Some(sampler) = sampler {
            let inside = |point: &SurfacePoint| point.position.iter().all(|c| (0.0..=self.grid.size).contains(c));
            image.points(&camera_from_cube).filter(inside).for_each(|point| sampler.add(point));
        }
        Ok(())
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
    let position = format!("({:.3}, {:.3}, {:.3})", eye.x, eye.y, eye.z);
    let reason = format!("camera at {position} in the task frame sees none of the workspace; {reason}");
    RequestError::refused(format!("views[{index}]"), reason)
}
