use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use comfy_table::{CellAlignment, Table, presets};
use grasp::FINGER_DEPTH;
use grasp_client::{Client, DepthView, DetectOptions, Detection, LocalServer, Options, Workspace};
use grasp_picture::{Picture, quality_color};
use grasp_sim::TABLE_HEIGHT;
use grasp_sim::benchmark::Benchmark;
use grasp_sim::physics::World;
use grasp_sim::planner::depth_view;
use grasp_sim::trial::{Outcome, execute};
use nalgebra::{UnitQuaternion, Vector3};

use super::{SceneArgs, show};

/// Rows of the table of grasps.
const SHOWN: usize = 8;

/// Start graspd, send it the depth images of a simulated scene and execute the best grasp in simulation.
#[derive(Args)]
pub struct Demo {
    /// Path of the graspd binary.
    #[arg(long)]
    graspd: PathBuf,

    /// Folder of the server's models.
    #[arg(long)]
    models: PathBuf,

    #[command(flatten)]
    scene: SceneArgs,

    /// Output file of the picture, PNG.
    #[arg(long, default_value = "demo.png")]
    picture: PathBuf,
}

impl Demo {
    pub fn run(self) -> anyhow::Result<()> {
        let benchmark = Benchmark {
            kind: self.scene.kind(),
            objects: self.scene.objects("test")?,
            count: 5,
            views: self.scene.views()?,
            noise: self.scene.noise(),
            rounds: 1,
            seed: self.scene.seed,
        };
        let (world, mut rng) = benchmark.scene(0);
        let observation = benchmark
            .observe(&world, &mut rng)
            .context("the cameras see no object in this scene; try another --seed")?;
        println!("a {} scene of {} objects, seed {}", self.scene.scene.name(), world.objects().len(), self.scene.seed);
        println!("seen in {} depth image(s) of 640×480 pixels", observation.views.len());

        let arguments = ["--log".as_ref(), "warn".as_ref(), "--models".as_ref(), self.models.as_os_str()];
        let server = LocalServer::spawn(&self.graspd, arguments)?;
        println!("graspd listens on {}", server.grpc());
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let detection = runtime.block_on(async {
            let client = Client::connect(server.grpc().to_string()).await?;
            // A low threshold, so that the picture also shows grasps that would not be executed.
            let detect = DetectOptions { threshold: Some(0.5), ..DetectOptions::default() };
            let options = Options { detect, ..Options::default() };
            let views: Vec<DepthView> = observation.views.iter().map(depth_view).collect();
            client.detect_from_depth(&views, &Workspace::default(), options).await
        })?;
        // Closes the client's connection, because the server waits for open connections when it shuts down.
        drop(runtime);
        print_detection(&detection);

        match detection.grasps.first().map(|best| execute(&mut world.clone(), &best.pose).0) {
            Some(Outcome::Lifted { object, width }) => {
                let name = world.objects().iter().find(|body| body.id == object).map(|body| body.object.name.as_str());
                println!("the best one, executed: lifted {} ({:.0} mm wide)", name.unwrap_or("it"), width * 1e3);
            }
            Some(failure) => println!("the best one, executed: {}", failure.name().replace('_', " ")),
            None => println!("no grasp to execute ({:?}); try another --seed", detection.dropped),
        }

        draw(&world, &detection).save(&self.picture)?;
        println!("drawn in {}", self.picture.display());

        let status = server.stop()?;
        anyhow::ensure!(status.success(), "graspd did not stop cleanly: {status}");
        println!("graspd stopped cleanly");
        Ok(())
    }
}

fn print_detection(detection: &Detection) {
    let mut table = Table::new();
    table.load_style(presets::UTF8_HORIZONTAL_ONLY);
    table.set_header(["quality", "x mm", "y mm", "z mm", "approach", "width mm"]);
    for column in table.column_iter_mut() {
        column.set_cell_alignment(CellAlignment::Right);
    }
    for grasp in detection.grasps.iter().take(SHOWN) {
        let p = grasp.pose.translation.vector * 1e3;
        let off_vertical = angle_off_vertical(&grasp.pose.rotation).to_degrees();
        table.add_row([
            format!("{:.3}", grasp.quality),
            format!("{:.1}", p.x),
            format!("{:.1}", p.y),
            format!("{:.1}", p.z),
            format!("{off_vertical:.0}° off vertical"),
            format!("{:.1}", grasp.width * 1e3),
        ]);
    }
    println!("{} grasps from {} version {}:", detection.grasps.len(), detection.model, detection.version);
    println!("{table}");
    let ms = |seconds: f64| format!("{:.2} ms", seconds * 1e3);
    let latency = &detection.latency;
    println!(
        "latency: queue {}, pre-processing {}, fusion {}, inference {}, evaluation {}, post-processing {}, total {}",
        ms(latency.queue),
        ms(latency.preprocessing),
        ms(latency.fusion),
        ms(latency.inference),
        ms(latency.evaluation),
        ms(latency.postprocessing),
        ms(latency.total)
    );
}

fn angle_off_vertical(rotation: &UnitQuaternion<f64>) -> f64 {
    (rotation * Vector3::z()).angle(&-Vector3::z())
}

/// The scene with all grasps coloured by quality; the executed grasp is a solid hand.
fn draw(world: &World, detection: &Detection) -> Picture {
    let mut picture = Picture::of_workspace(1200, 900, TABLE_HEIGHT);
    show(&mut picture, world);
    for (index, grasp) in detection.grasps.iter().enumerate() {
        let color = quality_color(f64::from(grasp.quality));
        if index == 0 {
            picture.hand(&grasp.pose, grasp.width, color);
        } else {
            picture.gripper(&grasp.pose, grasp.width, FINGER_DEPTH, color);
        }
    }
    picture
}
