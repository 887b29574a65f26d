use anyhow::Context;
use grasp::{DecodeParams, Grasp, Intrinsics};
use grasp_client::{Client, Depth, DepthView, DetectOptions, Extrinsics, Options, Workspace};
use tokio::runtime::Runtime;

use super::Observation;
use crate::camera::View;

/// A running graspd, which receives the depth images.
pub struct Server {
    runtime: Runtime,
    client: Client,
    params: DecodeParams,
}

impl Server {
    /// Connects to the server at this address.
    ///
    /// # Errors
    /// If the server cannot be reached.
    pub fn connect(address: &str, params: &DecodeParams) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let client = runtime.block_on(Client::connect(address)).with_context(|| format!("planner `grpc:{address}`"))?;
        Ok(Self { runtime, client, params: *params })
    }

    pub(super) fn plan(&self, observation: &Observation) -> anyhow::Result<Vec<Grasp>> {
        let DecodeParams { threshold, force, .. } = self.params;
        let detect = DetectOptions { threshold: Some(threshold), force, ..DetectOptions::default() };
        let options = Options { detect, ..Options::default() };
        let views: Vec<DepthView> = observation.views.iter().map(depth_view).collect();
        // The benchmark itself corrects the depths, if asked to.
        let workspace = Workspace { correct_depth_scale: Some(false), ..Workspace::default() };
        let detection = self.runtime.block_on(self.client.detect_from_depth(&views, &workspace, options))?;
        Ok(detection.grasps.iter().map(Into::into).collect())
    }
}

/// A view of the benchmark's camera as input of a server.
#[must_use]
pub fn depth_view(view: &View) -> DepthView {
    let Intrinsics { width, height, fx, fy, cx, cy } = Intrinsics::BENCHMARK;
    DepthView {
        depth: Depth::Metres(view.depth.clone()),
        // 640 × 480, so that the casts are lossless.
        width: width as u32,
        height: height as u32,
        k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        extrinsics: Extrinsics::CameraFromTask(view.camera_from_task),
        labels: None,
    }
}
