//! Requests with depth images: a whole table, and a tracked volume at the rate of a camera.

use std::time::{Duration, Instant};

use grasp::Intrinsics;
use grasp_client::{Client, Depth, DepthView, Extrinsics, Options, Report, Workspace};
use grasp_tests::scene::{TABLE, camera_at, seen};
use nalgebra::Point3;

use crate::findings::{Findings, Table, milliseconds};
use crate::{Bench, WARM_UP};

/// Lengths of the table along x and y, metres.
const EXTENT: [f64; 2] = [0.9, 0.6];

/// Interval of the images of a camera.
const INTERVAL: Duration = Duration::from_nanos(1_000_000_000 / 30);

/// Twelve boxes of 4 × 6 × 8 cm, all over the table.
fn boxes() -> Vec<[[f64; 3]; 2]> {
    let at = |index: u32| [0.12 + 0.22 * f64::from(index % 4), 0.12 + 0.18 * f64::from(index / 4)];
    (0..12).map(at).map(|[x, y]| [[x - 0.02, y - 0.03, TABLE], [x + 0.02, y + 0.03, TABLE + 0.08]]).collect()
}

/// An image of 640 × 480 pixels from a camera over the middle of the table, which moves with `number`.
fn view(number: u32) -> DepthView {
    let middle = Point3::new(EXTENT[0] / 2.0, EXTENT[1] / 2.0, TABLE);
    let camera_from_task = camera_at(middle, 0.9, 30.0, -90.0 + 0.5 * f64::from(number % 40));
    let Intrinsics { width, height, fx, fy, cx, cy } = Intrinsics::BENCHMARK;
    let millimetres = seen(&boxes(), &Intrinsics::BENCHMARK, &camera_from_task).into_iter();
    DepthView {
        depth: Depth::Millimetres(millimetres.map(|(depth, _)| (depth * 1e3).round() as u16).collect()),
        width: width as u32,
        height: height as u32,
        k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        extrinsics: Extrinsics::CameraFromTask(camera_from_task),
        labels: None,
    }
}

impl Bench {
    /// The latency of a whole table and of a tracked volume.
    pub async fn depth(&self, findings: &mut Findings) -> anyhow::Result<()> {
        let mut table = Table::new("depth images of 640 × 480 pixels, vgn", &["p50 ms", "p99 ms"]);
        let server = self.serve("vgn", &[])?;
        let client = Client::connect(server.grpc().to_string()).await?;
        let quantiles = |mut times: Vec<Duration>| {
            times.sort();
            [0.5, 0.99].map(|share| milliseconds(Report::quantile(&times, share)))
        };

        let (views, workspace) = ([view(0)], Workspace { extent: Some(EXTENT), ..Workspace::default() });
        let (mut times, started) = (Vec::new(), Instant::now());
        while started.elapsed() < self.seconds || times.len() < 2 * WARM_UP {
            let before = Instant::now();
            client.detect_from_depth(&views, &workspace, Options::default()).await?;
            times.push(before.elapsed());
        }
        let of_table = quantiles(times.split_off(WARM_UP));
        table.row("table of 0.9 × 0.6 m", of_table);
        findings.figure("table_p50_ms", of_table[0]);

        let views: Vec<DepthView> = (0..40).map(view).collect();
        let mut tracking = client.track_moving(Workspace::default(), 10.0).await?;
        let (mut times, started) = (Vec::new(), Instant::now());
        for number in 0.. {
            if started.elapsed() > self.seconds.max(Duration::from_secs(2)) {
                break;
            }
            // An image that arrives while the last one is processed waits: its latency includes the wait.
            let due = started + INTERVAL * number;
            tokio::time::sleep_until(due.into()).await;
            tracking.add(&views[number as usize % views.len()..][..1], Options::default()).await?;
            times.push(due.elapsed());
        }
        let tracked = quantiles(times.split_off(WARM_UP));
        table.row("tracked volume, 30 images/s", tracked);
        findings.figure("track_p99_ms", tracked[1]);
        findings.table(table);
        Ok(())
    }
}
