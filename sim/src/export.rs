//! Scenes and trials as JSON lines, so that another simulator can replay them.
//!
//! Each line is a scene. `scene` is its number. Each of its `objects` has `object` (the name), `scale` and `pose`. Each
//! of its `trials` has `pose`, `label`, `width`, `object` (index of the object whose surface the point was sampled
//! from), `yaws` (the outcome at each yaw) and `yaw` (the index of the yaw of `pose`). Yaw k is k · 36° about the
//! grasp's z. A pose is `[x, y, z, qx, qy, qz, qw]` in the task frame, metres.
//!
//! `share` is the success rate of the repetitions of `pose`, in [0, 1]. `clearance` is the smallest distance between
//! the objects and the open hand from pre-grasp to grasp, metres, at most 0.02. `executed` is written by `grasp-sim
//! replay` or another simulator: 1 if the grasp, executed as in evaluation (on contact the hand closes), lifted an
//! object, else 0. For `label` a contact on the approach is a failure. Older files lack these three.

use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use crate::label::{LabelledScene, YAWS};

/// A scene with its trials.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// Scene number.
    pub scene: u64,
    /// Objects of the scene.
    pub objects: Vec<Object>,
    /// Grasp points.
    pub trials: Vec<Trial>,
}

/// An object of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Object {
    /// Name in its set or folder. `grasp-sim objects` writes the procedural sets as files.
    pub object: String,
    /// Scale of its mesh.
    pub scale: f64,
    /// `T_task_object`.
    pub pose: [f64; 7],
}

/// A grasp point.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// `T_task_grasp` at the labelled yaw.
    pub pose: [f64; 7],
    /// 1 for a success, else 0.
    pub label: u8,
    /// Opening after the lift, metres; the maximum opening for a failure.
    pub width: f64,
    /// Index of the object whose surface the point was sampled from.
    pub object: Option<usize>,
    /// Index of the yaw of `pose`.
    pub yaw: usize,
    /// Outcome of each yaw: 1 if it lifted an object.
    pub yaws: [u8; YAWS],
    /// Success rate of the repetitions of `pose`. If a file lacks it, [`read`] sets it to `label`.
    #[serde(default = "missing_share")]
    pub share: f32,
    /// Smallest distance between the objects and the open hand from pre-grasp to grasp, metres; 0 if unknown.
    #[serde(default)]
    pub clearance: f32,
    /// 1 if `pose`, executed as in evaluation, lifted an object; `None` if it was not executed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub executed: Option<u8>,
}

/// Marks a missing `share`: JSON has no NaN.
fn missing_share() -> f32 {
    f32::NAN
}

impl Line {
    /// The line of a scene.
    #[must_use]
    pub fn new(number: u64, scene: &LabelledScene) -> Self {
        let objects = scene.objects.iter();
        let points = scene.points.iter();
        Self {
            scene: number,
            objects: objects
                .map(|placed| Object { object: placed.name.clone(), scale: placed.scale, pose: numbers(&placed.pose) })
                .collect(),
            trials: points
                .map(|point| Trial {
                    pose: numbers(&point.grasp.pose),
                    label: u8::from(point.success()),
                    width: point.grasp.width,
                    object: point.object,
                    yaw: point.yaw,
                    yaws: point.lifted.map(u8::from),
                    share: point.share,
                    clearance: point.clearance,
                    executed: None,
                })
                .collect(),
        }
    }
}

fn numbers(pose: &Isometry3<f64>) -> [f64; 7] {
    let (p, q) = (pose.translation.vector, pose.rotation.coords);
    [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
}

/// Appends scenes to a file.
pub struct Export {
    path: PathBuf,
    file: File,
}

impl Export {
    /// Creates a file, or opens that of an earlier run and removes its scenes from number `next` on.
    ///
    /// # Errors
    /// When the file cannot be read or written.
    pub fn open(path: &Path, next: u64) -> anyhow::Result<Self> {
        let file = open(path, next).with_context(|| path.display().to_string())?;
        Ok(Self { path: path.to_owned(), file })
    }

    /// Number of the last scene of a file; `None` if it has no scene or does not exist.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn last(path: &Path) -> anyhow::Result<Option<u64>> {
        match File::open(path).and_then(|file| complete(&file, u64::MAX)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            found => found.map(|(_, last)| last).with_context(|| path.display().to_string()),
        }
    }

    /// Appends a scene.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn append(&mut self, line: &Line) -> anyhow::Result<()> {
        let text = serde_json::to_string(line)? + "\n";
        self.file.write_all(text.as_bytes()).with_context(|| self.path.display().to_string())
    }
}

fn open(path: &Path, next: u64) -> io::Result<File> {
    let mut file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path)?;
    let (kept, _) = complete(&file, next)?;
    file.set_len(kept)?;
    file.seek(SeekFrom::End(0))?;
    Ok(file)
}

/// Length of the complete lines of the scenes before number `next`, and the number of the last of them.
fn complete(file: &File, next: u64) -> io::Result<(u64, Option<u64>)> {
    #[derive(Deserialize)]
    struct Number {
        scene: u64,
    }
    let mut reader = BufReader::new(file);
    let (mut length, mut last, mut line) = (0, None, String::new());
    while reader.read_line(&mut line)? > 0 {
        let number = serde_json::from_str::<Number>(&line).ok().filter(|_| line.ends_with('\n'));
        let Some(Number { scene }) = number.filter(|number| number.scene < next) else { break };
        last = Some(scene);
        length += line.len() as u64;
        line.clear();
    }
    Ok((length, last))
}

/// Reads the scenes of a file.
///
/// # Errors
/// Names the file and the line that cannot be read.
pub fn read(path: &Path) -> anyhow::Result<Vec<Line>> {
    let file = File::open(path).with_context(|| path.display().to_string())?;
    let lines = BufReader::new(file).lines().enumerate();
    lines
        .map(|(index, line)| {
            let context = || format!("{}, line {}", path.display(), index + 1);
            let mut line: Line = serde_json::from_str(&line.with_context(context)?).with_context(context)?;
            for trial in line.trials.iter_mut().filter(|trial| trial.share.is_nan()) {
                trial.share = f32::from(trial.label);
            }
            Ok(line)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_without_share_and_clearance_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scenes.jsonl");
        let trial = |label: u8, more: &str| {
            format!(
                r#"{{"pose":[0,0,0,0,0,0,1],"label":{label},"width":0.04,"object":0,"yaw":0,"yaws":[{label},0,0,0,0,0]{more}}}"#
            )
        };
        let known = trial(1, r#","share":0.75,"clearance":0.0125,"executed":0"#);
        let trials = [trial(1, ""), trial(0, ""), known.clone()].join(",");
        std::fs::write(&path, format!(r#"{{"scene":7,"objects":[],"trials":[{trials}]}}"#) + "\n").unwrap();
        let line = read(&path).unwrap().remove(0);
        let found: Vec<_> = line.trials.iter().map(|trial| (trial.share, trial.clearance, trial.executed)).collect();
        assert_eq!(found, [(1.0, 0.0, None), (0.0, 0.0, None), (0.75, 0.0125, Some(0))]);

        // Written again, the lines have the same keys.
        let written = |index: usize| serde_json::to_string(&line.trials[index]).unwrap();
        assert!(written(2).ends_with(r#""share":0.75,"clearance":0.0125,"executed":0}"#), "{}", written(2));
        assert!(!written(0).contains("executed"), "{}", written(0));
    }
}
