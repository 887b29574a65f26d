//! Learning curves of a run as a picture.

use std::ops::Range;
use std::path::Path;
use std::sync::OnceLock;

use anyhow::anyhow;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};

use crate::epoch_record::{EpochRecord, Validation};

const SIZE: (u32, u32) = (1500, 420);

/// A curve: its name and its value for an epoch.
type Curve<'a> = (&'a str, Box<dyn Fn(&EpochRecord) -> Option<f64>>);

/// Draws losses and validation scores over the epochs.
///
/// # Errors
/// When the file cannot be written.
pub fn draw(path: &Path, records: &[EpochRecord]) -> anyhow::Result<()> {
    static FONT: OnceLock<bool> = OnceLock::new();
    if !FONT.get_or_init(|| register_font("sans-serif", FontStyle::Normal, dejavu::sans::regular()).is_ok()) {
        return Err(anyhow!("the built-in font cannot be read"));
    }
    let root = BitMapBackend::new(path, SIZE).into_drawing_area();
    root.fill(&WHITE)?;
    let (left, others) = root.split_horizontally(SIZE.0 / 3);
    let (middle, right) = others.split_horizontally(SIZE.0 / 3);
    let held_out =
        |value: fn(&Validation) -> Option<f64>| move |record: &EpochRecord| record.validation.as_ref().and_then(value);
    let losses: [Curve; 2] =
        [("training", Box::new(|record| Some(record.loss))), ("validation", Box::new(held_out(|v| Some(v.loss))))];
    let highest =
        records.iter().flat_map(|r| [Some(r.loss), r.validation.map(|v| v.loss)]).flatten().fold(0.0, f64::max);
    panel(&left, "mean loss of labelled voxels", 0.0..highest * 1.05, &losses, records)?;
    let scores: [Curve; 3] = [
        ("accuracy", Box::new(held_out(|v| Some(v.accuracy)))),
        ("precision", Box::new(held_out(|v| v.precision))),
        ("recall", Box::new(held_out(|v| v.recall))),
    ];
    panel(&middle, "validation, quality above 0.5", 0.0..1.0, &scores, records)?;
    let angles: [Curve; 1] = [("mean angle", Box::new(held_out(|v| v.angle)))];
    let highest = records.iter().filter_map(|record| record.validation?.angle).fold(0.0, f64::max).max(1.0);
    panel(&right, "validation, rotation of successes, degrees", 0.0..highest * 1.05, &angles, records)?;
    root.present()?;
    Ok(())
}

fn panel(
    area: &DrawingArea<BitMapBackend, Shift>,
    title: &str,
    range: Range<f64>,
    curves: &[Curve],
    records: &[EpochRecord],
) -> anyhow::Result<()> {
    let last = records.last().map_or(1, |record| record.epoch).max(2);
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 16))
        .margin(10)
        .x_label_area_size(30)
        .y_label_area_size(45)
        .build_cartesian_2d(1..last, range)?;
    chart.configure_mesh().x_desc("epoch").light_line_style(WHITE).draw()?;
    for (index, (name, value)) in curves.iter().enumerate() {
        let color = Palette99::pick(index).stroke_width(2);
        let points = records.iter().filter_map(|record| value(record).map(|value| (record.epoch, value)));
        chart
            .draw_series(LineSeries::new(points, color))?
            .label(*name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 15, y)], color));
    }
    chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(BLACK.mix(0.3)).draw()?;
    Ok(())
}
