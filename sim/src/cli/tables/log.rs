//! The file of measurements, JSON lines. An interrupted command continues from it.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use grasp_sim::score::{Spread, Summary};
use grasp_sim::tables::Condition;
use serde::{Deserialize, Serialize};

/// The result of one run.
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct Measurement {
    /// Hash of everything that the result depends on.
    pub(super) key: String,
    #[serde(flatten)]
    pub(super) condition: Condition,
    pub(super) seed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) summary: Option<Summary>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) milliseconds: Option<Spread>,
}

/// The measurements by key, and their file.
pub(super) struct Log {
    path: PathBuf,
    file: File,
    pub(super) measurements: BTreeMap<String, Measurement>,
}

impl Log {
    pub(super) fn open(path: &Path) -> anyhow::Result<Self> {
        let context = || path.display().to_string();
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).with_context(context)?;
        }
        let mut measurements = BTreeMap::new();
        if path.exists() {
            for line in BufReader::new(File::open(path).with_context(context)?).lines() {
                // Ignores an incomplete line of a killed command; its run is repeated.
                if let Ok(line) = serde_json::from_str::<Measurement>(&line.with_context(context)?) {
                    measurements.insert(line.key.clone(), line);
                }
            }
        }
        let file = OpenOptions::new().append(true).create(true).open(path).with_context(context)?;
        Ok(Self { path: path.to_owned(), file, measurements })
    }

    pub(super) fn append(&mut self, measurement: Measurement) -> anyhow::Result<()> {
        // The first newline ends an incomplete line.
        let line = format!("\n{}\n", serde_json::to_string(&measurement)?);
        self.file.write_all(line.as_bytes()).with_context(|| self.path.display().to_string())?;
        self.measurements.insert(measurement.key.clone(), measurement);
        Ok(())
    }

    /// Sorts the measurements by the keys of `tasks` and stores the conditions of `tasks` with them. Removes the
    /// others, except those that `is_kept` returns true for.
    pub(super) fn keep<'a>(
        &mut self,
        tasks: impl Iterator<Item = (&'a str, &'a Condition)>,
        is_kept: impl Fn(&Measurement) -> bool,
    ) -> anyhow::Result<()> {
        let context = || self.path.display().to_string();
        let tasks: Vec<(&str, &Condition)> = tasks.collect();
        let is_task = |line: &Measurement| tasks.iter().any(|(key, _)| *key == line.key);
        let others = self.measurements.values().filter(|line| is_kept(line) && !is_task(line)).cloned();
        let of_tasks = tasks.iter().filter_map(|&(key, condition)| {
            let measurement = self.measurements.get(key)?.clone();
            Some(Measurement { condition: condition.clone(), ..measurement })
        });
        let lines = of_tasks.chain(others);
        let text = lines.map(|line| Ok(serde_json::to_string(&line)? + "\n")).collect::<anyhow::Result<String>>()?;
        let partial = self.path.with_extension("jsonl.partial");
        fs::write(&partial, text).with_context(context)?;
        fs::rename(&partial, &self.path).with_context(context)
    }
}
