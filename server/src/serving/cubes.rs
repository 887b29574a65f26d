use std::sync::Arc;
use std::time::Instant;

use grasp::{Fusion, ObjectMap, Region, SurfacePoint, Tile, WORKSPACE_SIZE, Warning};
use grasp_planner::{Scene, Source};
use grasp_proto::{DetectParams, FieldError, Workspace, pb};
use nalgebra::{Isometry3, Point3};

use super::job::EngineError;
use super::observation::{Observation, Observed, at};
use super::refusal::Refusal;
use super::scene::{FusionGrid, PointSampler, empty, sees_nothing};

/// The cubes that cover a workspace: one, or several overlapping ones for a workspace with an extent.
pub(crate) struct Cubes {
    cubes: Vec<Cube>,
    /// `T_frame_task`.
    frame_from_task: Isometry3<f64>,
    /// `T_task_middle`: the cube in the middle of the workspace.
    task_from_middle: Isometry3<f64>,
    /// Lengths of the workspace along x and y, metres.
    extent: [f64; 2],
    /// Whether to correct the scale of the depths.
    corrects_depth_scale: bool,
    /// Whether views of several requests are integrated.
    is_tracked: bool,
}

/// A cube and the field that its views are fused into.
struct Cube {
    grid: FusionGrid,
    fusion: Fusion,
    /// `T_task_cube`.
    task_from_cube: Isometry3<f64>,
    /// The part of the workspace whose grasps come from this cube: smallest and largest x and y in the task frame.
    /// `None` if it is the only cube.
    inner: Option<[[f64; 2]; 2]>,
}

/// The scene in one cube, with the parameters for it.
pub(crate) struct CubeScene {
    pub scene: Scene,
    pub params: DetectParams,
}

/// The scenes of a request with views, and what their fusion showed.
pub(crate) type Fused = (Vec<CubeScene>, Observed);

/// For each cube the observed points, if the planner needs them.
type CubePoints = Vec<Option<Vec<SurfacePoint>>>;

impl Cubes {
    /// The cubes that a planner requires for a workspace. `cameras` are in the task frame, metres.
    pub fn of(
        source: &Source,
        workspace: &Workspace,
        cameras: &[Point3<f64>],
        margin: f64,
    ) -> Result<Self, FieldError> {
        let Workspace { frame_from_task, size, extent, correct_depth_scale, .. } = *workspace;
        let edge = edge(source, size);
        Self::count(source, workspace, margin)?;
        let cube = |[x, y]: [f64; 2], inner| {
            let task_from_cube = Isometry3::translation(x, y, 0.0);
            let cameras: Vec<_> = cameras.iter().map(|camera| task_from_cube.inverse() * camera).collect();
            let grid = FusionGrid::of(source, &(frame_from_task * task_from_cube), size, &cameras)?;
            Ok::<_, FieldError>(Cube { fusion: grid.fusion(), grid, task_from_cube, inner })
        };
        let cubes = match extent {
            None => vec![cube([0.0; 2], None)?],
            Some(extent) => {
                let tiles = Tile::cover(extent, edge, margin.max(Tile::MARGIN));
                tiles.iter().map(|tile| cube(tile.corner, Some(tile.inner))).collect::<Result<_, _>>()?
            }
        };
        let [x, y] = extent.map_or([0.0; 2], |extent| extent.map(|length| (length - edge) / 2.0));
        Ok(Self {
            cubes,
            frame_from_task,
            task_from_middle: Isometry3::translation(x, y, 0.0),
            extent: extent.unwrap_or([edge; 2]),
            corrects_depth_scale: correct_depth_scale,
            is_tracked: false,
        })
    }

    /// The number of cubes that a planner requires for a workspace.
    pub fn count(source: &Source, workspace: &Workspace, margin: f64) -> Result<usize, FieldError> {
        let Workspace { frame_from_task, size, extent, .. } = *workspace;
        // Checks the size of the request.
        FusionGrid::of(source, &frame_from_task, size, &[])?;
        let edge = edge(source, size);
        let Some(extent) = extent else { return check_margin(margin, edge).map(|()| 1) };
        let margin = margin.max(Tile::MARGIN);
        if edge <= 2.0 * margin {
            let value = format_args!("given, for cubes with an edge of {edge} m");
            let needed =
                format_args!("needs more than {} m, twice options.margin (at least {} m)", 2.0 * margin, Tile::MARGIN);
            return Err(FieldError::new("workspace.extent", value, needed));
        }
        let count = Tile::count(extent, edge, margin);
        if count > MAX_CUBES as f64 {
            let value = format_args!("{} × {} m, which needs {count} cubes", extent[0], extent[1]);
            let needed = format_args!("must need at most {MAX_CUBES}; reduce it or options.margin");
            return Err(FieldError::new("workspace.extent", value, needed));
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
            for cube in &mut self.cubes {
                cube.fusion = cube.fusion.clone().forgetting(half_life);
            }
        }
        self
    }

    /// `T_frame_task`.
    pub fn frame_from_task(&self) -> &Isometry3<f64> {
        &self.frame_from_task
    }

    /// Checks that a planner can use these cubes.
    pub fn check(&self, source: &Source) -> Result<(), FieldError> {
        self.cubes.iter().try_for_each(|cube| cube.grid.check(source))
    }

    /// Integrates the views of a request, and returns the scenes for the planner. `found` is the table that determined the
    /// workspace. Stops when `is_wanted` returns false.
    pub fn fuse(
        &mut self,
        mut observation: Observation,
        found: Option<pb::FoundTable>,
        params: &DetectParams,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<Fused, Refusal> {
        let started = Instant::now();
        params.check_objects(observation.is_labelled())?;
        let (depth_factors, mut warnings) = self.correct_depth_scale(&mut observation, params.table)?;
        // Before the views are added, because a tracked volume keeps them.
        let objects = observation.objects(&self.frame_from_task, &params.objects)?;
        let points = self.integrate(&observation, &mut warnings, is_wanted)?;
        let scenes = self.scenes(points, objects.as_ref(), params)?;
        Ok((
            scenes,
            Observed { fusion: Some(started.elapsed()), warnings, table: found, depth_factors, ..Observed::default() },
        ))
    }

    /// Corrects the scale of the depths if `correct_depth_scale` is set, so that the table is at the height `table`, metres.
    /// Returns the factor of each view, and warnings.
    fn correct_depth_scale(
        &self,
        observation: &mut Observation,
        table: Option<f64>,
    ) -> Result<(Vec<f64>, Vec<Warning>), FieldError> {
        match (self.corrects_depth_scale, table) {
            (false, _) => Ok(Default::default()),
            (true, Some(table)) => Ok(observation.correct_depth_scale(table, self.extent)),
            (true, None) => {
                let needed = "must be false without a table, which a negative collision.table_height means";
                Err(FieldError::new("workspace.correct_depth_scale", true, needed))
            }
        }
    }

    /// Integrates views, each of which must see a part of the workspace. Returns the observed points of untracked cubes:
    /// those of earlier requests are not stored.
    fn integrate(
        &mut self,
        observation: &Observation,
        warnings: &mut Vec<Warning>,
        is_wanted: &dyn Fn() -> bool,
    ) -> Result<CubePoints, Refusal> {
        let samples = |cube: &Cube| cube.grid.needs_points() && !self.is_tracked;
        let mut samplers: Vec<_> = self.cubes.iter().map(|cube| samples(cube).then(PointSampler::default)).collect();
        for (index, camera) in observation.cameras().iter().enumerate() {
            if let Some(grid) = self.cubes.first().map(|cube| &cube.grid).filter(|grid| !grid.needs_points()) {
                warnings.extend(Warning::of_camera(index, &(at(camera) * self.task_from_middle), grid.size()));
            }
            let (mut is_seen, mut refusal, mut disagreement) = (false, None, None);
            for (cube, sampler) in self.cubes.iter_mut().zip(&mut samplers) {
                if !is_wanted() {
                    return Err(EngineError::Expired.into());
                }
                match cube.integrate(observation, index, sampler.as_mut(), &mut disagreement) {
                    Ok(()) => is_seen = true,
                    Err(error) => refusal = refusal.or(Some(error)),
                }
            }
            if let Some(refusal) = refusal.filter(|_| !is_seen) {
                return Err(refusal.into());
            }
            warnings.extend(disagreement);
        }
        let unseen: Vec<_> = self.cubes.iter().filter_map(|cube| Warning::of_coverage(&cube.fusion)).collect();
        if unseen.len() == self.cubes.len() {
            warnings.extend(unseen.first());
        }
        Ok(samplers.into_iter().map(|sampler| sampler.map(PointSampler::into_points)).collect())
    }

    /// The scenes for the planner: those of the cubes in which something stands on the table, and at least one.
    fn scenes(
        &self,
        points: CubePoints,
        objects: Option<&Arc<ObjectMap>>,
        params: &DetectParams,
    ) -> Result<Vec<CubeScene>, FieldError> {
        let scene = |(cube, points): (&Cube, Option<Vec<SurfacePoint>>)| {
            let volume = cube.grid.volume(&cube.fusion)?.with_objects(objects.cloned());
            let mut params = params.clone();
            params.constraints.workspace = cube.region(&self.frame_from_task, params.margin);
            Some(CubeScene { scene: Scene { volume, points }, params })
        };
        let mut scenes: Vec<_> = self.cubes.iter().zip(points).filter_map(scene).collect();
        let is_used = |scene: &CubeScene| {
            params.table.is_none_or(|table| scene.scene.volume.has_surface_above(table + OBJECT_HEIGHT))
        };
        if scenes.iter().any(is_used) {
            scenes.retain(is_used);
        } else {
            scenes.truncate(1);
        }
        if scenes.is_empty() { Err(empty()) } else { Ok(scenes) }
    }
}

/// Most cubes of a workspace, which bounds the memory of a request to 80 MB: those of 2 × 2 m with the default margin.
const MAX_CUBES: usize = 100;

/// Smallest height of an object above the table, metres. Lower surfaces are noise, or too low for a hand.
const OBJECT_HEIGHT: f64 = 0.01;

impl Cube {
    /// Integrates view `index`. `disagreement` becomes the warning if it contradicts the views before it.
    fn integrate(
        &mut self,
        observation: &Observation,
        index: usize,
        sampler: Option<&mut PointSampler>,
        disagreement: &mut Option<Warning>,
    ) -> Result<(), FieldError> {
        let (view, camera_from_cube) = observation.image(index, &self.task_from_cube, self.grid.size())?;
        let image = grasp::DepthImage::new(view.intrinsics, &view.depth);
        let image = image.map_err(|error| FieldError::refused(format!("views[{index}]"), error))?;
        let camera_from_grid = self.grid.camera_from_grid(&camera_from_cube);
        if disagreement.is_none() {
            *disagreement = Warning::of_view(index, &self.fusion, &image, &camera_from_grid);
        }
        if self.fusion.integrate(&image, &camera_from_grid) == 0 {
            let reason = self.fusion.blind(&image, &camera_from_grid);
            let camera = (self.task_from_cube * camera_from_cube.inverse()).translation;
            return Err(sees_nothing(index, &camera.vector.into(), reason));
        }
        if let Some(sampler) = sampler {
            let inside = |point: &SurfacePoint| point.position.iter().all(|c| (0.0..=self.grid.size()).contains(c));
            image.points(&camera_from_cube).filter(inside).for_each(|point| sampler.add(point));
        }
        Ok(())
    }

    /// The region of the cube's grasps, if it is not the whole field. The fingertips keep `margin` from the sides.
    fn region(&self, frame_from_task: &Isometry3<f64>, margin: f64) -> Option<Region> {
        let size = self.grid.size();
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

/// Checks that a margin leaves space for grasps in a cube with this edge, metres.
pub(crate) fn check_margin(margin: f64, edge: f64) -> Result<(), FieldError> {
    if 2.0 * margin < edge {
        return Ok(());
    }
    Err(FieldError::new(
        "options.margin",
        margin,
        format_args!("must be below {} m, half of the cube's edge", edge / 2.0),
    ))
}

/// Edge of a cube, metres: that of the request, or the planner's.
pub(crate) fn edge(source: &Source, size: Option<f64>) -> f64 {
    let trained = |network: &grasp_models::Metadata| network.resolution as f64 * network.voxel_size;
    let own = source.network().map_or(WORKSPACE_SIZE, |network| trained(&network.metadata));
    size.unwrap_or(own)
}
