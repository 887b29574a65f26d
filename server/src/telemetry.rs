use std::io::{IsTerminal, stderr};

use tracing_subscriber::EnvFilter;

use crate::config::{Config, LogFormat};

/// Sends the log to stderr; stdout is for the process that started this one.
pub(crate) fn init(config: &Config) {
    let log = tracing_subscriber::fmt()
        .with_env_filter(EnvFilter::new(&config.log))
        .with_writer(stderr)
        .with_ansi(stderr().is_terminal())
        // It would tell stderr that stderr cannot be written, and panic over that: a full disk is no reason to stop.
        .log_internal_errors(false);
    match config.log_format {
        LogFormat::Text => log.init(),
        LogFormat::Json => log.json().init(),
    }
}
