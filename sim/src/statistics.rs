//! Statistics of a data set: the distribution of its labels.

use std::collections::BTreeMap;

use grasp::{MAX_OPENING, WORKSPACE_SIZE};
use grasp_data::Dataset;
use nalgebra::Vector3;
use serde::Serialize;

use crate::TABLE_HEIGHT;
use crate::export::Line;

/// A histogram of grasps or scenes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Histogram {
    /// The quantity of the x axis, with its unit.
    pub quantity: &'static str,
    /// What is counted.
    pub counted: &'static str,
    /// Start of the first bin.
    pub start: f64,
    /// Width of a bin.
    pub step: f64,
    /// Failures and successes in each bin. The first and last bins include values outside the range.
    pub bins: Vec<Count>,
}

/// Number of trials by outcome.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Count {
    /// Trials that failed.
    pub failures: u64,
    /// Trials that lifted an object.
    pub successes: u64,
}

/// Statistics of a data set.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Statistics {
    /// Number of scenes.
    pub scenes: usize,
    /// Number of observations.
    pub volumes: usize,
    /// Mean share of an observation's voxels that are near an observed surface.
    pub observed: f64,
    /// Number of grasps.
    pub grasps: Count,
    /// Opening of the successes.
    pub widths: Histogram,
    /// Height of the grasp frame above the table.
    pub heights: Histogram,
    /// Angle between the approach and straight down.
    pub approaches: Histogram,
    /// Success rate of the scenes.
    pub shares: Histogram,
}

impl Histogram {
    fn new(quantity: &'static str, counted: &'static str, end: f64) -> Self {
        const BINS: usize = 20;
        Self { quantity, counted, start: 0.0, step: end / BINS as f64, bins: vec![Count::default(); BINS] }
    }

    fn add(&mut self, value: f64, success: bool) {
        let bin = ((value - self.start) / self.step).clamp(0.0, self.bins.len() as f64 - 1.0) as usize;
        self.bins[bin].add(success);
    }
}

impl Count {
    fn add(&mut self, success: bool) {
        if success {
            self.successes += 1;
        } else {
            self.failures += 1;
        }
    }

    /// All trials.
    #[must_use]
    pub fn all(self) -> u64 {
        self.failures + self.successes
    }

    /// Share of the successes; `None` without trials.
    #[must_use]
    pub fn share(self) -> Option<f64> {
        (self.all() > 0).then(|| self.successes as f64 / self.all() as f64)
    }
}

impl Statistics {
    /// The statistics of a data set with the benchmark's workspace.
    #[must_use]
    pub fn new(dataset: &Dataset) -> Self {
        let voxel_size = WORKSPACE_SIZE / dataset.resolution().max(1) as f64;
        let mut found = Self {
            scenes: dataset.len(),
            volumes: 0,
            observed: 0.0,
            grasps: Count::default(),
            widths: Histogram::new("width, mm", "successes", MAX_OPENING * 1e3),
            heights: Histogram::new("height above the table, mm", "grasps", 200.0),
            approaches: Histogram::new("angle of the approach from straight down, degrees", "grasps", 100.0),
            shares: Histogram::new("success rate of a scene, %", "scenes", 100.0),
        };
        for index in 0..dataset.len() {
            for look in 0..dataset.volumes(index) {
                let volume = dataset.volume(index, look);
                let seen = volume.iter().filter(|&&byte| byte > 0).count();
                found.observed += seen as f64 / volume.len().max(1) as f64;
                found.volumes += 1;
            }
            let mut scene = Count::default();
            for trial in dataset.trials(index) {
                let grasp = trial.grasp(voxel_size);
                scene.add(trial.success);
                if trial.success {
                    found.widths.add(grasp.width * 1e3, true);
                }
                found.heights.add((grasp.pose.translation.z - TABLE_HEIGHT) * 1e3, trial.success);
                let off = (grasp.pose.rotation * Vector3::z()).angle(&-Vector3::z());
                found.approaches.add(off.to_degrees(), trial.success);
            }
            found.grasps.failures += scene.failures;
            found.grasps.successes += scene.successes;
            if let Some(share) = scene.share() {
                found.shares.add(share * 100.0, true);
            }
        }
        found.observed /= found.volumes.max(1) as f64;
        found
    }
}

/// Trials by object name, without the seeds of procedural objects.
#[must_use]
pub fn by_object(lines: &[Line]) -> BTreeMap<String, Count> {
    let mut objects: BTreeMap<String, Count> = BTreeMap::new();
    for line in lines {
        for trial in &line.trials {
            let Some(object) = trial.object.and_then(|index| line.objects.get(index)) else { continue };
            let kind = match object.object.rsplit_once('_') {
                Some((kind, seed)) if seed.bytes().all(|byte| byte.is_ascii_digit()) => kind,
                _ => &object.object,
            };
            objects.entry(kind.to_owned()).or_default().add(trial.label == 1);
        }
    }
    objects
}
