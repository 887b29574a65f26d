use std::fmt::Write;
use std::time::Duration;

use indicatif::{HumanDuration, ProgressBar, ProgressState, ProgressStyle};

/// The progress bar of this many scenes.
///
/// # Errors
/// Only if the template of the bar is invalid.
pub fn of_scenes(scenes: u64) -> anyhow::Result<ProgressBar> {
    // Neither the rate nor the remaining time is known before the first scene.
    let speed = |state: &ProgressState, text: &mut dyn Write| {
        if state.per_sec() > 0.0 {
            let left = Duration::from_secs(state.eta().as_secs());
            // Writing to a string cannot fail.
            let _ = write!(text, ", {:.1}/s, {} left", state.per_sec(), HumanDuration(left));
        }
    };
    let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} scenes{speed}")?.with_key("speed", speed);
    Ok(ProgressBar::new(scenes).with_style(style))
}
