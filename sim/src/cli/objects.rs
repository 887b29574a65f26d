use std::fs;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context;
use clap::Args;
use grasp_picture::{Picture, object_color};
use grasp_sim::objects::Object;
use nalgebra::{Isometry3, Point3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::Scene;

/// Columns and rows of the picture, and the distance between objects, metres.
const COLUMNS: usize = 10;
const ROWS: usize = 6;
const PITCH: f64 = 0.16;

/// Draw the objects of scenes, or write them as files for another simulator.
#[derive(Args)]
pub struct Objects {
    /// Objects: the procedural sets `train`, `test`, `containers` or `generated`, or a folder of URDF files.
    #[arg(long, default_value = "train")]
    objects: String,

    /// Scenario of `test` and `containers`.
    #[arg(long, value_enum, default_value = "packed")]
    scene: Scene,

    /// Skip this many objects at the beginning.
    #[arg(long, default_value_t = 0)]
    skip: usize,

    /// Number of `generated` objects.
    #[arg(long, default_value_t = COLUMNS * ROWS)]
    count: usize,

    /// Only objects that are at most so high, metres, at least 0.01: with 0.032 pens, cutlery, plates and tools that lie
    /// flat.
    #[arg(long, value_name = "METRES", value_parser = height)]
    max_height: Option<f64>,

    /// Draw the first 60 objects into this file, PNG.
    #[arg(long)]
    picture: Option<PathBuf>,

    /// Write the objects as URDF and OBJ into this folder.
    #[arg(long)]
    out: Option<PathBuf>,
}

impl Objects {
    pub fn run(self) -> anyhow::Result<()> {
        let set = self.scene.objects(&self.objects)?;
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let highest = self.max_height.unwrap_or(f64::INFINITY);
        let is_low = |object: &Arc<Object>| object.visual.extents().z <= highest;
        let mut objects: Vec<_> = set.listed().iter().filter(|object| is_low(object)).cloned().collect();
        if set.listed().is_empty() {
            let generated = std::iter::repeat_with(|| set.draw(&mut rng));
            objects = generated.filter(is_low).take(self.skip + self.count).collect();
        }
        let objects = objects.get(self.skip..).unwrap_or_default();
        println!("{} objects", objects.len());
        if let Some(path) = &self.picture {
            draw(objects).save(path)?;
            println!("drawn in {}", path.display());
        }
        if let Some(folder) = &self.out {
            fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
            objects.iter().try_for_each(|object| object.save(folder))?;
            println!("written to {}", folder.display());
        }
        Ok(())
    }
}

/// A height at which some generated objects are lower.
fn height(text: &str) -> Result<f64, String> {
    let height: f64 = text.parse().map_err(|_| "must be a number".to_owned())?;
    if height >= 0.01 { Ok(height) } else { Err("must be at least 0.01 m".to_owned()) }
}

fn draw(objects: &[Arc<Object>]) -> Picture {
    let (eye, target) = (Point3::new(0.72, -1.35, 2.0), Point3::new(0.72, 0.4, 0.03));
    let mut picture = Picture::looking_at(1600, 900, 0.35, eye, target);
    picture.table(0.0);
    for (place, object) in objects.iter().take(COLUMNS * ROWS).enumerate() {
        let (column, row) = ((place % COLUMNS) as f64, (ROWS - 1 - place / COLUMNS) as f64);
        let lift = -object.visual.bounds().0.z;
        let pose = Isometry3::translation(column * PITCH, row * PITCH, lift);
        picture.mesh(&object.visual, &pose, 1.0, object_color(place * 7 + place / 12));
    }
    picture
}
