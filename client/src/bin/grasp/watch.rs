//! `grasp watch`: detects grasps again whenever an input file changes.

use std::fs;
use std::io;
use std::time::Duration;

use clap::Args;
use grasp_client::{Client, DetectOptions, Detection};

use crate::detect_args::DetectArgs;
use crate::live::{Address, DEFAULT_ADDRESS, Live};
use crate::messages::messages;
use crate::scene::{Scene, SceneArgs};
use crate::{options, positive, show};

#[derive(Args)]
pub(crate) struct Watch {
    #[command(flatten)]
    scene: SceneArgs,

    #[command(flatten)]
    detect: DetectArgs,

    /// Interval at which the files are checked for changes, seconds.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.1, value_parser = positive)]
    every: f64,

    /// Exit after this many detections. Default: no limit.
    #[arg(long, value_name = "N")]
    count: Option<u64>,

    /// Also show each detection in Foxglove: the points, the surface, the workspace and the grasps. Foxglove connects
    /// to this address (Open connection, Foxglove WebSocket, ws://localhost:8765). Default: 127.0.0.1:8765.
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = DEFAULT_ADDRESS)]
    live: Option<Address>,
}

impl Watch {
    pub fn scene(&self) -> &SceneArgs {
        &self.scene
    }

    /// Ctrl-C ends a live view and closes its connections; without one it ends the process.
    pub async fn run(&self, connect: impl AsyncFnOnce() -> anyhow::Result<Client>, json: bool) -> anyhow::Result<()> {
        let detect = self.detect.read()?;
        let Some(address) = &self.live else { return self.watch(&connect().await?, detect, json, None).await };
        let live = Live::start(address).await?;
        let client = connect().await?;
        eprintln!("grasp: live view: open the connection {} in Foxglove", live.url(address));
        let watched = tokio::select! {
            watched = self.watch(&client, detect, json, Some(&live)) => watched,
            Ok(()) = tokio::signal::ctrl_c() => Ok(()),
        };
        live.stop().await;
        watched
    }

    async fn watch(
        &self,
        client: &Client,
        detect: DetectOptions,
        json: bool,
        live: Option<&Live>,
    ) -> anyhow::Result<()> {
        let Self { scene: args, every, count, .. } = self;
        let stamps = || args.files().map(|path| fs::metadata(path)?.modified()).collect::<io::Result<Vec<_>>>();
        let (mut seen, mut answers) = (None, 0);
        // A missing file is not an error: it may be written later.
        if let Some(missing) = args.files().find(|path| !path.exists()) {
            eprintln!("grasp: {} not found; waiting for it", missing.display());
        }
        while count.is_none_or(|count| answers < count) {
            let now = stamps().ok();
            if now.is_some() && now != seen {
                match self.answer(client, &detect).await {
                    Ok((scene, detection)) => {
                        let text = if json { show::detection_json(&detection) } else { show::detection(&detection) };
                        if !show::print(&text)? {
                            break;
                        }
                        answers += 1;
                        let published =
                            live.map(|live| live.publish(messages(&scene, &detect, &detection)?)).transpose();
                        if let Err(error) = published {
                            eprintln!("grasp: live view: {error:#}");
                        }
                    }
                    // The error may be gone at the next change: an incomplete file, or a server that restarts.
                    Err(error) => {
                        eprintln!("grasp: {error:#}; waiting for a file to change");
                        if let Some(live) = live {
                            live.publish_error(&format!("{error:#}"));
                        }
                    }
                }
                seen = now;
            }
            tokio::time::sleep(Duration::from_secs_f64(*every)).await;
        }
        Ok(())
    }

    async fn answer(&self, client: &Client, detect: &DetectOptions) -> anyhow::Result<(Scene, Detection)> {
        let scene = self.scene.read()?;
        scene.check_objects(&detect.objects)?;
        let detection = scene.detect(client, options(&self.scene, detect.clone())).await?;
        Ok((scene, detection))
    }
}
