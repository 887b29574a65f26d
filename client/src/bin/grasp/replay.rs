//! `grasp replay`: sends recorded requests again and compares the answers.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use clap::Args;
use grasp_client::pb::recording::Answer;
use grasp_client::pb::{DetectGraspsResponse, Recording, ScoreGraspsResponse};
use grasp_client::{Client, Detection, Error, Proposal};
use prost::Message;
use serde_json::{Value, json};
use tonic::Code;

use crate::numbers::counted;
use crate::show;

/// Extension of the files of recordings.
const EXTENSION: &str = "recording";

/// Codes that say nothing about a request.
const OVERLOAD: [Code; 4] = [Code::ResourceExhausted, Code::Unavailable, Code::DeadlineExceeded, Code::Cancelled];

/// After this many requests in a row for which the server was not available, the replay ends.
const MAX_UNAVAILABLE: u64 = 3;

#[derive(Args)]
pub(crate) struct Replay {
    /// Folder of recordings (graspd's --record), or one of its files.
    recordings: PathBuf,

    /// Model for all requests, instead of the one that each names.
    #[arg(long, value_name = "NAME")]
    model: Option<String>,

    /// Largest change of a quality that does not count.
    #[arg(long, value_name = "QUALITY", default_value_t = 0.01)]
    quality: f64,

    /// Largest change of a grasp's position that does not count, metres.
    #[arg(long, value_name = "METRES", default_value_t = 0.001)]
    position: f64,

    /// Largest change of a grasp's rotation that does not count, degrees.
    #[arg(long, value_name = "DEGREES", default_value_t = 1.0)]
    angle: f64,
}

/// What became of a recording.
enum Outcome {
    Same,
    /// With what has changed.
    Changed(String),
    /// The recorded answer says nothing about the request, or the server has deleted the recording.
    Skipped,
    /// The server is overloaded or not ready.
    Unanswered(Error),
}

/// Seconds of the inference, recorded and now.
type Inference = Option<(f64, f64)>;

impl Replay {
    /// Returns whether no answer has changed.
    pub async fn run(&self, client: &Client, as_json: bool) -> anyhow::Result<bool> {
        let files = files(&self.recordings)?;
        let (mut same, mut skipped, mut unanswered, mut changes) = (0, 0, 0, Vec::new());
        let (mut before, mut now) = (Vec::new(), Vec::new());
        let mut unavailable = 0;
        for file in &files {
            let (outcome, inference) = self.repeat(client, file).await.with_context(|| file.display().to_string())?;
            if !matches!(outcome, Outcome::Unanswered(_)) {
                unavailable = 0;
            }
            if let Some((recorded, repeated)) = inference {
                before.push(recorded);
                now.push(repeated);
            }
            match outcome {
                Outcome::Same => same += 1,
                Outcome::Skipped => skipped += 1,
                Outcome::Unanswered(error) => {
                    unanswered += 1;
                    eprintln!("grasp: {}: {error}", file.display());
                    unavailable = if error.code() == Some(Code::Unavailable) { unavailable + 1 } else { 0 };
                    ensure!(
                        unavailable < MAX_UNAVAILABLE,
                        "the server was not available for {unavailable} requests in a row"
                    );
                }
                Outcome::Changed(what) => {
                    let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
                    if !as_json && !show::print(&format!("{name}: {what}"))? {
                        return Ok(false);
                    }
                    changes.push(json!({ "recording": name, "change": what }));
                }
            }
        }
        let (recordings, changed) = (files.len(), changes.len());
        let inference = median(&mut before).zip(median(&mut now));
        show::print(&if as_json {
            let seconds = inference.map(|(before, now)| json!({ "recorded": before, "now": now }));
            let summary = json!({
                "recordings": recordings,
                "same": same,
                "changed": changed,
                "skipped": skipped,
                "unanswered": unanswered,
                "inference_seconds": seconds,
                "changes": Value::Array(changes),
            });
            summary.to_string()
        } else {
            let inference = inference.map_or_else(String::new, |(before, now)| {
                format!("; median inference {:.1} ms, now {:.1} ms", 1e3 * before, 1e3 * now)
            });
            let unanswered = if unanswered > 0 { format!(", {unanswered} not answered") } else { String::new() };
            let recordings = counted(recordings, "recording");
            format!("{recordings}: {same} same, {changed} changed, {skipped} skipped{unanswered}{inference}")
        })?;
        Ok(changed == 0 && unanswered == 0)
    }

    /// Sends the request of a file again.
    async fn repeat(&self, client: &Client, file: &Path) -> anyhow::Result<(Outcome, Inference)> {
        let bytes = match fs::read(file) {
            // A server that records deletes the oldest.
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok((Outcome::Skipped, None)),
            bytes => bytes?,
        };
        ensure!(!bytes.is_empty(), "the file is empty");
        let recording = Recording::decode(&*bytes).context("it is not a recording")?;
        let (Some(request), Some(answer)) = (recording.request, recording.answer) else {
            bail!("it has no request or no answer; it was recorded by a newer graspd");
        };
        if let Answer::Error(error) = &answer
            && OVERLOAD.contains(&Code::from_i32(error.code))
        {
            return Ok((Outcome::Skipped, None));
        }
        let repeated = match client.replay(request, self.model.as_deref()).await {
            Ok(repeated) => Ok(repeated),
            Err(error) if error.code().is_some_and(|code| OVERLOAD.contains(&code)) => {
                return Ok((Outcome::Unanswered(error), None));
            }
            Err(error) => Err(error),
        };
        Ok(match (answer, repeated) {
            (Answer::Grasps(before), Ok(Answer::Grasps(now))) => {
                let inference = inference(before.latency.as_ref(), now.latency.as_ref());
                (self.compare(before, now)?, inference)
            }
            (Answer::Scores(before), Ok(Answer::Scores(now))) => {
                let inference = inference(before.latency.as_ref(), now.latency.as_ref());
                (self.compare_scores(&before, &now), inference)
            }
            (Answer::Error(before), Err(now)) if now.code() == Some(Code::from_i32(before.code)) => {
                (Outcome::Same, None)
            }
            (Answer::Error(before), Err(now)) => {
                (Outcome::Changed(format!("refused: {}; now: {now}", before.message)), None)
            }
            (Answer::Error(before), Ok(_)) => {
                (Outcome::Changed(format!("was refused ({}), is answered now", before.message)), None)
            }
            (_, Err(now)) => (Outcome::Changed(format!("was answered, is refused now: {now}")), None),
            _ => bail!("the answer does not belong to its request"),
        })
    }

    fn compare(&self, before: DetectGraspsResponse, now: DetectGraspsResponse) -> anyhow::Result<Outcome> {
        let models = [&before, &now].map(|response| format!("{} {}", response.model, response.version));
        let (before, now): (Detection, Detection) = (before.try_into()?, now.try_into()?);
        let kept = before.grasps.iter().filter(|grasp| now.grasps.iter().any(|other| self.is_same(grasp, other)));
        let (kept, all) = (kept.count(), before.grasps.len());
        if kept == all && now.grasps.len() == all {
            return Ok(Outcome::Same);
        }
        let mut text = format!("{kept} of {all} grasps are the same, {} now", now.grasps.len());
        if let (Some(best), Some(other)) = (before.grasps.first(), now.grasps.first()) {
            let (position, angle) = differences(best, other);
            text += &format!(
                "; the best: quality {:.2}, now {:.2}, {:.1} mm and {:.0}° away",
                best.quality,
                other.quality,
                1e3 * position,
                angle
            );
        }
        let [before, now] = models;
        if before != now {
            text += &format!("; {before}, now {now}");
        }
        Ok(Outcome::Changed(text))
    }

    fn compare_scores(&self, before: &ScoreGraspsResponse, now: &ScoreGraspsResponse) -> Outcome {
        let pairs = || before.scores.iter().zip(&now.scores);
        let change = |(before, now): (&grasp_client::Score, &grasp_client::Score)| {
            f64::from((before.quality - now.quality).abs())
        };
        let largest = pairs().map(change).fold(0.0, f64::max);
        let violations = pairs().filter(|(before, now)| before.violations != now.violations).count();
        if before.scores.len() == now.scores.len() && largest <= self.quality && violations == 0 {
            return Outcome::Same;
        }
        let (before, now) = (before.scores.len(), now.scores.len());
        Outcome::Changed(format!(
            "{before} scores, {now} now; the largest change of a quality is {largest:.2}, {violations} violate other \
             options"
        ))
    }

    fn is_same(&self, a: &Proposal, b: &Proposal) -> bool {
        let (position, angle) = differences(a, b);
        position <= self.position && angle <= self.angle && f64::from((a.quality - b.quality).abs()) <= self.quality
    }
}

/// Distance, metres, and angle, degrees, between two grasps.
fn differences(a: &Proposal, b: &Proposal) -> (f64, f64) {
    let position = (a.pose.translation.vector - b.pose.translation.vector).norm();
    (position, a.pose.rotation.angle_to(&b.pose.rotation).to_degrees())
}

fn inference(before: Option<&grasp_client::Latency>, now: Option<&grasp_client::Latency>) -> Inference {
    Some((before?.inference, now?.inference))
}

fn median(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// The files of a folder, the oldest first, or the file.
fn files(path: &Path) -> anyhow::Result<Vec<PathBuf>> {
    ensure!(path.exists(), "{}: no such file or folder", path.display());
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let entries = fs::read_dir(path).with_context(|| path.display().to_string())?;
    let mut files = entries.map(|entry| Ok(entry?.path())).collect::<anyhow::Result<Vec<_>>>()?;
    files.retain(|file| file.extension().is_some_and(|extension| extension == EXTENSION));
    files.sort();
    if files.is_empty() {
        bail!("{} has no .{EXTENSION} files; run graspd with --record", path.display());
    }
    Ok(files)
}
