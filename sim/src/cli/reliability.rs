use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, ensure};
use clap::Args;
use grasp_sim::reliability::{Attempt, Bin, Reliability};
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};
use serde::Deserialize;

/// Compare the predicted quality of executed grasps with their success rate: a diagram and the expected calibration
/// error.
#[derive(Args)]
pub struct ReliabilityArgs {
    /// NAME=FILE: a label for the diagram, and a file of `bench --attempts` or `sim/pybullet/clear.py --attempts`.
    #[arg(required = true, num_args = 1.., value_parser = parse_named)]
    attempts: Vec<(String, PathBuf)>,

    /// Output file of the diagram, PNG.
    #[arg(long)]
    out: Option<PathBuf>,

    /// Print JSON: all bins of the diagram.
    #[arg(long)]
    json: bool,
}

fn parse_named(text: &str) -> Result<(String, PathBuf), String> {
    let (name, path) = text.split_once('=').ok_or("must be NAME=FILE")?;
    Ok((name.to_owned(), path.into()))
}

impl ReliabilityArgs {
    pub fn run(self) -> anyhow::Result<()> {
        let mut found = Vec::new();
        for (name, path) in &self.attempts {
            let reliability = Reliability::new(&read(path)?);
            if self.json {
                println!("{}", serde_json::json!({ "name": name, "reliability": reliability }));
            } else {
                let Bin { attempts, lifted, quality } = reliability.whole;
                println!(
                    "{name}: {attempts} attempts, {:.1} % lifted, {:.1} % predicted; expected calibration error {:.3}",
                    lifted as f64 / attempts.max(1) as f64 * 100.0,
                    quality * 100.0,
                    reliability.error
                );
            }
            found.push((name.as_str(), reliability));
        }
        match &self.out {
            Some(path) => draw(path, &found).with_context(|| path.display().to_string()),
            None => Ok(()),
        }
    }
}

/// A line of a file of attempts.
#[derive(Deserialize)]
struct Line {
    planner: Option<String>,
    #[serde(flatten)]
    attempt: Attempt,
}

pub(super) fn read(path: &Path) -> anyhow::Result<Vec<Attempt>> {
    let text = fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let lines: Vec<Line> = text
        .lines()
        .enumerate()
        .map(|(index, line)| {
            serde_json::from_str(line).with_context(|| format!("{}, line {}", path.display(), index + 1))
        })
        .collect::<anyhow::Result<_>>()?;
    let planners: BTreeSet<&str> = lines.iter().filter_map(|line| line.planner.as_deref()).collect();
    ensure!(
        planners.len() <= 1,
        "{} has attempts of several planners ({}); write one file per planner",
        path.display(),
        planners.iter().copied().collect::<Vec<_>>().join(", ")
    );
    let attempts: Vec<Attempt> = lines.into_iter().map(|line| line.attempt).collect();
    ensure!(!attempts.is_empty(), "{} is empty; it must contain at least one attempt", path.display());
    Ok(attempts)
}

const COLORS: [RGBColor; 4] =
    [RGBColor(40, 110, 180), RGBColor(210, 110, 30), RGBColor(40, 140, 80), RGBColor(150, 60, 150)];

/// Draws the diagram. The axis starts at the first bin with an attempt.
fn draw(path: &Path, found: &[(&str, Reliability)]) -> anyhow::Result<()> {
    register_font("sans-serif", FontStyle::Normal, dejavu::sans::regular())
        .map_err(|_| anyhow!("the built-in font cannot be read"))?;
    let first = found.iter().filter_map(|(_, found)| found.bins.iter().position(|bin| bin.attempts > 0)).min();
    let lowest = first.unwrap_or(0) as f64 / found.first().map_or(1, |(_, found)| found.bins.len()) as f64;
    let root = BitMapBackend::new(path, (640, 560)).into_drawing_area();
    root.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&root)
        .margin(14)
        .x_label_area_size(42)
        .y_label_area_size(58)
        .build_cartesian_2d(lowest..1.0, 0.0..1.0)?;
    chart
        .configure_mesh()
        .x_desc("quality")
        .y_desc("success rate")
        .x_label_formatter(&|value| format!("{value:.2}"))
        .y_label_formatter(&|value| format!("{value:.1}"))
        .label_style(("sans-serif", 14))
        .light_line_style(WHITE)
        .draw()?;
    chart.draw_series(LineSeries::new([(lowest, lowest), (1.0, 1.0)], BLACK.mix(0.4)))?;
    for ((name, reliability), color) in found.iter().zip(COLORS.iter().cycle()) {
        let points: Vec<(f64, f64, [f64; 2])> = reliability
            .bins
            .iter()
            .filter_map(|bin| bin.share().map(|(share, interval)| (bin.quality, share, interval)))
            .collect();
        let label = format!("{name}: error {:.1} %, n {}", 100.0 * reliability.error, reliability.whole.attempts);
        chart
            .draw_series(LineSeries::new(
                points.iter().map(|&(quality, share, _)| (quality, share)),
                color.stroke_width(2),
            ))?
            .label(label)
            .legend(|(x, y)| PathElement::new([(x, y), (x + 20, y)], color.stroke_width(2)));
        chart
            .draw_series(points.iter().map(|&(quality, share, _)| Circle::new((quality, share), 4, color.filled())))?;
        chart.draw_series(
            points.iter().map(|&(quality, _, [low, high])| PathElement::new([(quality, low), (quality, high)], color)),
        )?;
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperLeft)
        .label_font(("sans-serif", 14))
        .background_style(WHITE)
        .border_style(BLACK.mix(0.3))
        .draw()?;
    root.present()?;
    Ok(())
}
