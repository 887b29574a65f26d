//! The results of a session for a scene, in the terms of the reply.

use std::collections::HashMap;

use grasp::{Candidate, Collision, Constraints, Decoded, DetectParams, Dropped, Grasp, Obstacles, Volume};
use grasp_perception::{Scene, Warning, table_warning};
use nalgebra::{Point3, Vector3};

/// The grasps in a scene.
#[derive(Debug, Default)]
pub struct Detection {
    /// Best first, at most as many as requested.
    pub grasps: Vec<Detected>,
    /// Counts of dropped candidates by reason.
    pub dropped: Dropped,
    /// Grasps beyond the requested numbers.
    pub over_limit: usize,
    /// The volumes of the computed cubes.
    pub volumes: Vec<Volume>,
    /// The warning about the table, unless it is as expected in one of the volumes.
    pub table: Option<Warning>,
}

/// A detected grasp.
#[derive(Clone, Copy, Debug)]
pub struct Detected {
    /// The grasp, in the frame of the volume's pose.
    pub grasp: Grasp,
    /// Whether the open hand collides; None if not requested.
    pub collides: Option<bool>,
    /// Label of the object between the fingers.
    pub object: Option<u16>,
    /// Largest opening without a collision, metres.
    pub open_width: Option<f64>,
}

/// The scores of candidates in a scene.
#[derive(Debug)]
pub struct Scores {
    /// One for each candidate.
    pub scores: Vec<Score>,
    /// The warning about the table.
    pub table: Option<Warning>,
}

/// The score of a candidate.
#[derive(Clone, Debug)]
pub struct Score {
    /// Predicted quality; 0 outside of the volume.
    pub quality: f32,
    /// What the candidate violates.
    pub violations: Vec<Violation>,
    /// Label of the object between the fingers.
    pub object: Option<u16>,
    /// Largest opening without a collision, metres.
    pub open_width: Option<f64>,
}

/// What a candidate violates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Violation {
    /// The quality is below the threshold.
    Quality,
    /// The hand does not open that wide.
    Width,
    /// Outside of the volume, the workspace or the region.
    Region,
    /// The approach direction is outside of the cone.
    Approach,
    /// The hand is too low.
    Height,
    /// Not on an object that is wanted.
    Object,
    /// The open hand collides.
    Collision,
}

/// Distance within which a better grasp of another cube suppresses a grasp, metres: half of the window of VGN's
/// non-maximum suppression.
const SUPPRESSION: f64 = 0.015;

/// The positions of the grasps of a merged detection and their cubes, by cells with an edge of [`SUPPRESSION`].
#[derive(Default)]
struct Kept(HashMap<[i64; 3], Vec<(Vector3<f64>, usize)>>);

impl Kept {
    fn cell(at: &Vector3<f64>) -> [i64; 3] {
        // Saturates far outside of every workspace.
        at.map(|c| (c / SUPPRESSION).floor() as i64).into()
    }

    fn add(&mut self, at: Vector3<f64>, cube: usize) {
        self.0.entry(Self::cell(&at)).or_default().push((at, cube));
    }

    /// Whether a grasp of another cube is near a position.
    fn is_near(&self, at: &Vector3<f64>, cube: usize) -> bool {
        let [x, y, z] = Self::cell(at);
        let around = |c: i64| c.saturating_sub(1)..=c.saturating_add(1);
        let mut cells = around(x).flat_map(|x| around(y).flat_map(move |y| around(z).map(move |z| [x, y, z])));
        cells.any(|cell| {
            let grasps = self.0.get(&cell);
            grasps.into_iter().flatten().any(|(other, of)| *of != cube && (other - at).norm() < SUPPRESSION)
        })
    }
}

impl Detection {
    /// The requested number of grasps, with what was requested about each.
    pub(crate) fn new(decoded: Decoded, volume: Volume, params: &DetectParams) -> Self {
        let Decoded { grasps, dropped } = decoded;
        let found = grasps.len();
        let mut grasps = match volume.objects() {
            Some(objects) => objects.limited(grasps, &params.hand(), params.max_grasps_per_object),
            None => grasps,
        };
        grasps.truncate(params.max_grasps);
        let over_limit = found - grasps.len();
        let obstacles = if grasps.is_empty() { None } else { obstacles(&volume, params) };
        let detected = |grasp: Grasp| Detected {
            collides: obstacles
                .as_ref()
                .filter(|_| params.collision == Some(Collision::Flag))
                .map(|obstacles| obstacles.collides(&grasp.pose)),
            open_width: obstacles.as_ref().and_then(|obstacles| obstacles.opening(&grasp.pose, grasp.width)),
            object: volume.objects().and_then(|objects| objects.object(&grasp.pose, &params.hand())),
            grasp,
        };
        let grasps = grasps.into_iter().map(detected).collect();
        let table = params.table.and_then(|expected| Warning::of_table(&volume, expected));
        // The volume is kept for the page, which shows only its surface.
        Self { grasps, dropped, over_limit, volumes: vec![volume.alone()], table }
    }

    /// The grasps of all cubes of a workspace. `threshold` is the smallest quality without `force`.
    #[must_use]
    pub fn merged(mut cubes: Vec<Self>, params: &DetectParams, threshold: f32) -> Self {
        if cubes.len() == 1 {
            return cubes.pop().unwrap_or_default();
        }
        let mut merged = Self { table: table_warning(cubes.iter().map(|cube| cube.table)), ..Self::default() };
        let mut all: Vec<(usize, Detected)> = Vec::new();
        for (cube, Self { grasps, dropped, over_limit, volumes, .. }) in cubes.into_iter().enumerate() {
            all.extend(grasps.into_iter().map(|grasp| (cube, grasp)));
            merged.dropped += dropped;
            merged.over_limit += over_limit;
            merged.volumes.extend(volumes);
        }
        all.sort_by(|(_, a), (_, b)| b.grasp.quality.total_cmp(&a.grasp.quality));
        // With `force`, each cube without a grasp above the threshold returns its best one. One of these is kept, if
        // there is no other grasp.
        let is_forced = |(_, detected): &(usize, Detected)| detected.grasp.quality < threshold;
        let forced = all.iter().position(is_forced).map_or(0, |first| all.len() - first.max(1));
        all.truncate(all.len() - forced);
        merged.dropped.suppressed += forced;
        let mut kept = Kept::default();
        let mut of_objects = HashMap::<_, usize>::new();
        for (cube, detected) in all {
            let at = detected.grasp.pose.translation.vector;
            let of_object = of_objects.entry(detected.object).or_default();
            if kept.is_near(&at, cube) {
                merged.dropped.suppressed += 1;
            } else if merged.grasps.len() == params.max_grasps || *of_object >= params.max_grasps_per_object {
                merged.over_limit += 1;
            } else {
                *of_object += 1;
                kept.add(at, cube);
                merged.grasps.push(detected);
            }
        }
        merged
    }
}

impl Scores {
    /// The scores of candidates with the predicted `qualities`. `threshold` is the smallest quality of a grasp.
    pub(crate) fn new(
        candidates: &[Candidate],
        qualities: Vec<f32>,
        scene: &Scene,
        params: &DetectParams,
        threshold: f32,
    ) -> Self {
        let Scene { volume, region: workspace, .. } = scene;
        let obstacles = obstacles(volume, params);
        let score = |(candidate, quality): (&Candidate, f32)| {
            let Candidate { pose, width } = candidate;
            let hand = params.hand();
            let is_inside = is_inside(volume, &(pose * Point3::new(0.0, 0.0, hand.depth)));
            let quality = if is_inside { quality } else { 0.0 };
            let object = volume.objects().and_then(|objects| objects.object(pose, &hand));
            let violates = |constraints: Constraints| constraints.violation(pose, &hand).is_some();
            let Constraints { region, approach, min_height, .. } = params.constraints;
            let none = Constraints::default();
            let checks = [
                (Violation::Quality, quality < threshold),
                (Violation::Width, width.is_some_and(|width| width > 2.0 * hand.half_opening())),
                (Violation::Region, !is_inside || violates(Constraints { workspace: *workspace, region, ..none })),
                (Violation::Approach, violates(Constraints { approach, ..none })),
                (Violation::Height, violates(Constraints { min_height, ..none })),
                (Violation::Object, volume.objects().is_some_and(|objects| !objects.accepts(pose, &hand))),
                (Violation::Collision, obstacles.as_ref().is_some_and(|obstacles| obstacles.collides(pose))),
            ];
            let violations = checks.into_iter().filter(|(_, violated)| *violated).map(|(reason, _)| reason).collect();
            let open_width = obstacles.as_ref().and_then(|obstacles| obstacles.opening(pose, width.unwrap_or(0.0)));
            Score { quality, violations, object, open_width }
        };
        let scores = candidates.iter().zip(qualities).map(score).collect();
        Self { scores, table: params.table.and_then(|expected| Warning::of_table(volume, expected)) }
    }
}

/// The obstacles for the hand, unless the collision check is off.
fn obstacles(volume: &Volume, params: &DetectParams) -> Option<Obstacles> {
    params.checks_collisions().then(|| Obstacles::observed(volume, params.clearance()))
}

fn is_inside(volume: &Volume, point: &Point3<f64>) -> bool {
    let size = volume.resolution() as f64 * volume.voxel_size();
    let point = volume.pose().inverse_transform_point(point);
    point.iter().all(|c| (0.0..=size).contains(c))
}
