use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use comfy_table::{CellAlignment, Table, presets};
use grasp_data::Dataset;
use grasp_sim::export;
use grasp_sim::statistics::{Count, Histogram, Statistics, by_object};
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};

/// Prints and draws the distribution of the labels over widths, heights, approach angles and objects.
#[derive(Args)]
pub struct Stats {
    /// Data set folders, packed or processed; several are pooled.
    #[arg(required = true, num_args = 1..)]
    folders: Vec<PathBuf>,

    /// File written by `label --export`, to count trials by object.
    #[arg(long)]
    export: Option<PathBuf>,

    /// Output folder for `statistics.json`, `statistics.png` and `objects.png`.
    #[arg(long)]
    out: Option<PathBuf>,
}

impl Stats {
    pub fn run(self) -> anyhow::Result<()> {
        let statistics = Statistics::new(&Dataset::open(&self.folders)?);
        let objects = match &self.export {
            Some(path) => by_object(&export::read(path)?),
            None => BTreeMap::new(),
        };
        match print(&statistics, &objects) {
            // A closed pipe, as after `| head`, is not an error.
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => {}
            printed => printed.context("cannot print")?,
        }
        let Some(folder) = &self.out else { return Ok(()) };
        fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        let json = folder.join("statistics.json");
        let text = serde_json::to_string_pretty(&serde_json::json!({ "data": statistics, "objects": objects }))?;
        fs::write(&json, text + "\n").with_context(|| json.display().to_string())?;

        register_font("sans-serif", FontStyle::Normal, dejavu::sans::regular())
            .map_err(|_| anyhow!("the built-in font cannot be read"))?;
        draw_histograms(&folder.join("statistics.png"), &statistics)?;
        if !objects.is_empty() {
            draw_objects(&folder.join("objects.png"), &objects)?;
        }
        println!("drawn in {}", folder.display());
        Ok(())
    }
}

fn print(statistics: &Statistics, objects: &BTreeMap<String, Count>) -> io::Result<()> {
    let mut out = io::stdout().lock();
    let Statistics { scenes, volumes, observed, grasps, .. } = statistics;
    writeln!(out, "{scenes} scenes, {volumes} observations, {:.1} % of the voxels near a surface", observed * 100.0)?;
    writeln!(out, "{} grasps, {} successes ({})", grasps.all(), grasps.successes, percent(*grasps))?;
    for histogram in [&statistics.widths, &statistics.heights, &statistics.approaches, &statistics.shares] {
        let mut table = table([histogram.quantity, histogram.counted, "share", "successes"]);
        let total: u64 = histogram.bins.iter().map(|bin| bin.all()).sum();
        let only_successes = histogram.bins.iter().all(|bin| bin.failures == 0);
        // Two bins per row; the pictures show every bin.
        for (row, bins) in histogram.bins.chunks(2).enumerate() {
            let count = bins.iter().fold(Count::default(), |sum, bin| Count {
                failures: sum.failures + bin.failures,
                successes: sum.successes + bin.successes,
            });
            let from = histogram.start + 2.0 * row as f64 * histogram.step;
            let share = count.all() as f64 / total.max(1) as f64;
            table.add_row([
                format!("{from:.0}–{:.0}", from + 2.0 * histogram.step),
                count.all().to_string(),
                format!("{:.1} %", share * 100.0),
                if only_successes { String::new() } else { percent(count) },
            ]);
        }
        writeln!(out, "{table}")?;
    }
    if !objects.is_empty() {
        let mut table = table(["object", "grasps", "successes", ""]);
        for (name, count) in objects {
            table.add_row([name.clone(), count.all().to_string(), count.successes.to_string(), percent(*count)]);
        }
        writeln!(out, "{table}")?;
    }
    Ok(())
}

fn table(header: [&str; 4]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_header(header);
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

fn percent(count: Count) -> String {
    count.share().map_or_else(|| "–".to_owned(), |share| format!("{:.1} %", share * 100.0))
}

const FAILURE: RGBColor = RGBColor(190, 190, 190);
const SUCCESS: RGBColor = RGBColor(40, 140, 80);

fn draw_histograms(path: &Path, statistics: &Statistics) -> anyhow::Result<()> {
    let root = BitMapBackend::new(path, (1200, 800)).into_drawing_area();
    root.fill(&WHITE)?;
    let panels = root.split_evenly((2, 2));
    draw_histogram(&panels[0], &statistics.widths)?;
    draw_histogram(&panels[1], &statistics.heights)?;
    draw_histogram(&panels[2], &statistics.approaches)?;
    draw_histogram(&panels[3], &statistics.shares)?;
    root.present()?;
    Ok(())
}

/// Stacked bars of successes and failures.
fn draw_histogram(area: &DrawingArea<BitMapBackend, Shift>, histogram: &Histogram) -> anyhow::Result<()> {
    let Histogram { quantity, counted, start, step, bins } = histogram;
    let highest = bins.iter().map(|bin| bin.all()).max().unwrap_or(0).max(1) as f64;
    let mut chart = ChartBuilder::on(area)
        .caption(*quantity, ("sans-serif", 16))
        .margin(12)
        .x_label_area_size(30)
        .y_label_area_size(70)
        .build_cartesian_2d(*start..start + step * bins.len() as f64, 0.0..highest * 1.05)?;
    chart
        .configure_mesh()
        .disable_x_mesh()
        .x_label_formatter(&|value| format!("{value:.0}"))
        .y_label_formatter(&|value| format!("{value:.0}"))
        .y_desc(*counted)
        .light_line_style(WHITE)
        .draw()?;
    let bar = |index: usize, low: u64, high: u64, color: RGBColor| {
        let left = start + step * index as f64;
        Rectangle::new([(left + 0.05 * step, low as f64), (left + 0.95 * step, high as f64)], color.filled())
    };
    chart.draw_series(bins.iter().enumerate().flat_map(|(index, bin)| {
        [bar(index, 0, bin.successes, SUCCESS), bar(index, bin.successes, bin.all(), FAILURE)]
    }))?;
    Ok(())
}

/// One bar per object, sorted by success rate.
fn draw_objects(path: &Path, objects: &BTreeMap<String, Count>) -> anyhow::Result<()> {
    const ROW: u32 = 16;
    let mut rows: Vec<(&String, f64)> =
        objects.iter().filter_map(|(name, count)| Some((name, count.share()? * 100.0))).collect();
    rows.sort_by(|(_, a), (_, b)| a.total_cmp(b));
    let root = BitMapBackend::new(path, (900, 80 + ROW * rows.len() as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&root)
        .caption("success rate by object, %", ("sans-serif", 16))
        .margin(12)
        .x_label_area_size(30)
        .y_label_area_size(180)
        .build_cartesian_2d(0.0..100.0, 0..rows.len())?;
    let label = |row: &usize| rows.get(*row).map_or_else(String::new, |(name, _)| (*name).clone());
    chart
        .configure_mesh()
        .disable_y_mesh()
        .y_labels(rows.len())
        .y_label_formatter(&label)
        .y_label_style(("sans-serif", 11))
        .light_line_style(WHITE)
        .draw()?;
    chart.draw_series(
        rows.iter()
            .enumerate()
            .map(|(row, (_, share))| Rectangle::new([(0.0, row), (*share, row + 1)], SUCCESS.filled())),
    )?;
    root.present()?;
    Ok(())
}
