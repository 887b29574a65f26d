//! One caller with many scenes: a stream, compared with concurrent calls.

use std::sync::Arc;
use std::time::Instant;

use anyhow::ensure;
use grasp_client::{Arrivals, Client, Options, Until};
use tokio::sync::mpsc;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;

use crate::findings::{Findings, Table};
use crate::{Bench, run_load};

/// Scenes of the caller.
const SCENES: usize = 400;

impl Bench {
    /// The throughput of a stream, compared with as many concurrent calls as keep the sessions busy.
    pub async fn streams(&self, findings: &mut Findings) -> anyhow::Result<()> {
        let server = self.serve("vgn", &[])?;
        let client = Client::connect(server.grpc().to_string()).await?;
        let title = format!("vgn, one caller, {SCENES} scenes");
        let mut table = Table::new(&title, &["answers/s"]);
        let (mut calls, mut stream) = (0.0_f64, 0.0_f64);
        // In turns, so that a slow minute affects both.
        for _ in 0..3 {
            let callers = Arrivals::Callers(2 * self.threads);
            let report = run_load(&client, &self.scene, callers, Until::Calls(SCENES), Options::default()).await;
            ensure!(report.refusals() == 0, "graspd refused {} calls", report.refusals());
            calls = calls.max(report.throughput());
            stream = stream.max(self.stream(&client).await?);
        }
        table.row("concurrent calls", [calls]);
        table.row("one stream", [stream]);
        findings.figure("stream_ratio", stream / calls);
        findings.table(table);
        Ok(())
    }

    /// Answers per second of a stream.
    async fn stream(&self, client: &Client) -> anyhow::Result<f64> {
        let (send, scenes) = mpsc::channel(1);
        let scene = Arc::clone(&self.scene);
        let sender = tokio::spawn(async move {
            for _ in 0..SCENES {
                if send.send(((*scene).clone(), Options::default())).await.is_err() {
                    break;
                }
            }
        });
        let started = Instant::now();
        let mut replies = client.detect_stream(ReceiverStream::new(scenes)).await?;
        while let Some(reply) = replies.next().await {
            reply?;
        }
        let seconds = started.elapsed().as_secs_f64();
        sender.await?;
        Ok(SCENES as f64 / seconds)
    }
}
