use std::env;
use std::io::Cursor;
use std::path::PathBuf;

use clap::Args;
use grasp_client::{
    Access, Client, DepthView, DetectOptions, Error, Extrinsics, FindTable, LocalServer, Options, Workspace,
};
use nalgebra::Isometry3;

use crate::image;
use crate::scene::Scene;
use crate::show;
use crate::view::ViewArgs;

/// A depth image of household-like objects on a table, with the noise of a stereo camera:
/// `grasp-sim label --scene packed --objects test --sensor stereo --views random:1 --seed 5`, in millimetres.
const IMAGE: &[u8] = include_bytes!("demo.png");

/// The intrinsic matrix of its camera.
const K: [f64; 9] = [540.0, 0.0, 320.0, 0.0, 540.0, 240.0, 0.0, 0.0, 1.0];

/// Detects grasps in a depth image that comes with the program.
#[derive(Args)]
pub(crate) struct Demo {
    #[command(flatten)]
    view: ViewArgs,
}

impl Demo {
    /// Calls the server at `address`, or starts one for this call if none runs there.
    pub async fn run(self, address: String, access: Access, json: bool) -> anyhow::Result<()> {
        let (depth, width, height) = image::decode_png(Cursor::new(IMAGE))?;
        let extrinsics = Extrinsics::FrameFromCamera(Isometry3::identity());
        let view = DepthView { depth, width, height, k: K, extrinsics, labels: None };
        let workspace = Workspace { find_table: Some(FindTable::default()), ..Workspace::default() };
        let scene = Scene::Depth(vec![view], workspace);
        self.view.check(&scene)?;

        let (client, server) = match Client::connect_with(address, access).await {
            Ok(client) => (client, None),
            Err(Error::Connect { address, .. }) => {
                let server = LocalServer::spawn(&graspd(), ["--log", "warn"])?;
                eprintln!("grasp: no graspd at {address}; started one for this call");
                (Client::connect(server.grpc().to_string()).await?, Some(server))
            }
            Err(error) => return Err(error.into()),
        };
        let detection = scene.detect(&client, Options::default()).await?;
        show::print(&if json { show::detection_json(&detection) } else { show::detection(&detection) })?;
        let picture = self.view.write(&scene, &DetectOptions::default(), &detection)?;
        eprintln!("grasp: the picture is {}", picture.display());
        drop(client);
        if let Some(server) = server {
            // On another thread, so that this one can close the connection, for which the server waits.
            tokio::task::spawn_blocking(move || server.stop()).await??;
        }
        Ok(())
    }
}

/// The program graspd: the one beside this program, or that of the search path.
fn graspd() -> PathBuf {
    let beside = env::current_exe().ok().map(|program| program.with_file_name("graspd"));
    beside.filter(|program| program.is_file()).unwrap_or_else(|| "graspd".into())
}
