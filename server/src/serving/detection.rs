//! The results of a session for a scene, in the terms of the reply.

use std::collections::HashMap;

use grasp::{Constraints, Decoded, Dropped, Grasp, Obstacles, Volume};
use grasp_proto::{Candidate, Collision, DetectParams, pb};
use nalgebra::{Point3, Vector3};
use pb::score::Violation as Reason;

/// The grasps in a scene.
pub(crate) struct Detection {
    /// Best first, at most as many as requested.
    pub grasps: Vec<Detected>,
    /// Counts of dropped candidates by reason.
    pub dropped: Dropped,
    /// Grasps beyond the requested numbers.
    pub over_limit: usize,
    /// The volumes of the computed cubes.
    pub volumes: Vec<Volume>,
}

/// A detected grasp.
#[derive(Clone, Copy)]
pub(crate) struct Detected {
    pub grasp: Grasp,
    /// Whether the open hand collides; None if not requested.
    pub collides: Option<bool>,
    /// Label of the object between the fingers.
    pub object: Option<u16>,
    /// Largest opening without a collision, metres.
    pub open_width: Option<f64>,
}

/// The score of a candidate.
pub(crate) struct Score {
    pub quality: f32,
    pub violations: Vec<Reason>,
    pub object: Option<u16>,
    pub open_width: Option<f64>,
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
    pub fn of(decoded: Decoded, volume: Volume, params: &DetectParams) -> Self {
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
                .filter(|_| params.collision == Collision::Flag)
                .map(|obstacles| obstacles.meet(&grasp.pose)),
            open_width: obstacles.as_ref().and_then(|obstacles| obstacles.opening(&grasp.pose, grasp.width)),
            object: volume.objects().and_then(|objects| objects.object(&grasp.pose, &params.hand())),
            grasp,
        };
        let grasps = grasps.into_iter().map(detected).collect();
        // The volume is kept for the page, which shows only its surface.
        Self { grasps, dropped, over_limit, volumes: vec![volume.with_objects(None)] }
    }

    /// The grasps of all cubes of a workspace. `threshold` is the smallest quality without `force`.
    pub fn merged(cubes: Vec<Self>, params: &DetectParams, threshold: f32) -> Self {
        if cubes.len() == 1 {
            return cubes.into_iter().next().unwrap_or_else(Self::empty);
        }
        let mut merged = Self::empty();
        let mut all: Vec<(usize, Detected)> = Vec::new();
        for (cube, Self { grasps, dropped, over_limit, volumes }) in cubes.into_iter().enumerate() {
            all.extend(grasps.into_iter().map(|grasp| (cube, grasp)));
            merged.dropped += dropped;
            merged.over_limit += over_limit;
            merged.volumes.extend(volumes);
        }
        all.sort_by(|(_, a), (_, b)| b.grasp.quality.total_cmp(&a.grasp.quality));
        // Each cube without a grasp above the threshold gives its best one, with `force`.
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

    fn empty() -> Self {
        Self { grasps: Vec::new(), dropped: Dropped::default(), over_limit: 0, volumes: Vec::new() }
    }
}

impl Score {
    /// The scores of candidates with the predicted `qualities`. `threshold` is the smallest quality of a grasp.
    pub fn of(
        candidates: &[Candidate],
        qualities: Vec<f32>,
        volume: &Volume,
        params: &DetectParams,
        threshold: f32,
    ) -> Vec<Self> {
        let obstacles = obstacles(volume, params);
        let score = |(candidate, quality): (&Candidate, f32)| {
            let Candidate { pose, width } = candidate;
            let hand = params.hand();
            let is_inside = is_inside(volume, &(pose * Point3::new(0.0, 0.0, hand.depth)));
            let quality = if is_inside { quality } else { 0.0 };
            let object = volume.objects().and_then(|objects| objects.object(pose, &hand));
            let violates = |constraints: Constraints| constraints.violation(pose, &hand).is_some();
            let Constraints { workspace, region, approach, min_height } = params.constraints;
            let none = Constraints::default();
            let checks = [
                (Reason::Quality, quality < threshold),
                (Reason::Width, width.is_some_and(|width| width > 2.0 * hand.half_opening())),
                (Reason::Region, !is_inside || violates(Constraints { workspace, region, ..none })),
                (Reason::Approach, violates(Constraints { approach, ..none })),
                (Reason::Height, violates(Constraints { min_height, ..none })),
                (Reason::Object, volume.objects().is_some_and(|objects| !objects.admits(pose, &hand))),
                (Reason::Collision, obstacles.as_ref().is_some_and(|obstacles| obstacles.meet(pose))),
            ];
            let violations = checks.into_iter().filter(|(_, violated)| *violated).map(|(reason, _)| reason).collect();
            let open_width = obstacles.as_ref().and_then(|obstacles| obstacles.opening(pose, width.unwrap_or(0.0)));
            Self { quality, violations, object, open_width }
        };
        candidates.iter().zip(qualities).map(score).collect()
    }
}

/// The obstacles for the hand, unless the collision check is off.
fn obstacles(volume: &Volume, params: &DetectParams) -> Option<Obstacles> {
    (params.collision != Collision::Off).then(|| Obstacles::observed(volume, params.clearance()))
}

fn is_inside(volume: &Volume, point: &Point3<f64>) -> bool {
    let size = volume.resolution() as f64 * volume.voxel_size();
    let point = volume.pose().inverse_transform_point(point);
    point.iter().all(|c| (0.0..=size).contains(c))
}

impl From<&Score> for pb::Score {
    fn from(score: &Score) -> Self {
        Self {
            quality: score.quality,
            violations: score.violations.iter().map(|&reason| reason.into()).collect(),
            object: score.object.map(u32::from),
            open_width: score.open_width,
        }
    }
}
