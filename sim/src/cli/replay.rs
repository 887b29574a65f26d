use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, anyhow};
use clap::{Args, ValueEnum};
use grasp::MAX_OPENING;
use grasp_picture::{Picture, quality_color, save_sheet};
use grasp_sim::TABLE_HEIGHT;
use grasp_sim::export::{self, Export, Line};
use grasp_sim::objects::{Object, ObjectSet};
use grasp_sim::physics::World;
use grasp_sim::trial::{execute, label};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use rayon::prelude::*;

use super::show;

type Objects<'a> = HashMap<&'a str, &'a Arc<Object>>;

/// Reads a file of `label --export`, or of another simulator with the same keys, rebuilds its scenes and tries its
/// grasps.
#[derive(Args)]
pub struct Replay {
    /// The exported scenes.
    trials: PathBuf,

    /// Folder with the URDF files of the objects.
    #[arg(long)]
    objects: PathBuf,

    /// Effect of a contact on the approach. allow: the hand closes there, as in evaluation; the result is `executed`.
    /// forbid: the grasp fails, as in labels; the result is `label`.
    #[arg(long, value_enum, default_value = "allow")]
    contact: Contact,

    /// Output file for the scenes with the results.
    #[arg(long)]
    out: Option<PathBuf>,

    /// Picture of the first grasps whose result differs: the hand is green if the grasp succeeds here, and red if it
    /// succeeded only in the file.
    #[arg(long)]
    differences: Option<PathBuf>,

    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Pictures on the sheet of differences, and per row.
const DIFFERENCES: usize = 6;
const DIFFERENCES_IN_A_ROW: usize = 3;

/// The result of a scene: the counts of successes, successes that succeeded again, failures, and failures that failed
/// again; and the grasps whose result differs, with whether they succeed here.
type Compared = ([u64; 4], Vec<(Isometry3<f64>, bool)>);

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Contact {
    Allow,
    Forbid,
}

impl Replay {
    pub fn run(self) -> anyhow::Result<()> {
        let objects = ObjectSet::load(&self.objects)?;
        let objects: Objects = objects.listed().iter().map(|object| (object.name.as_str(), object)).collect();
        let mut scenes = export::read(&self.trials)?;
        let compared: Vec<Compared> =
            scenes.par_iter_mut().map(|scene| self.replay(scene, &objects)).collect::<anyhow::Result<_>>()?;
        if let Some(path) = &self.out {
            let mut file = Export::open(path, 0)?;
            scenes.iter().try_for_each(|scene| file.append(scene))?;
        }
        let [successes, kept_successes, failures, kept_failures] =
            compared.iter().fold([0; 4], |sum, (counts, _)| std::array::from_fn(|i| sum[i] + counts[i]));
        if self.json {
            let report = serde_json::json!({
                "scenes": scenes.len(),
                "successes": successes,
                "successes_kept": kept_successes,
                "failures": failures,
                "failures_kept": kept_failures,
            });
            println!("{report}");
        } else {
            println!(
                "{} scenes: {kept_successes} of {successes} successes and {kept_failures} of {failures} failures are the \
                 same",
                scenes.len()
            );
        }
        if let Some(path) = &self.differences {
            let differing = scenes.iter().zip(&compared).filter(|(_, (_, grasps))| !grasps.is_empty());
            let differences = differing.flat_map(|(scene, (_, grasps))| {
                let world = self.world(scene, &objects);
                grasps
                    .iter()
                    .map(move |grasp| world.as_ref().map(|world| draw(world, grasp)).map_err(|e| anyhow!("{e:#}")))
            });
            let pictures: Vec<Picture> = differences.take(DIFFERENCES).collect::<anyhow::Result<_>>()?;
            save_sheet(path, &pictures.iter().collect::<Vec<_>>(), DIFFERENCES_IN_A_ROW)?;
            if pictures.is_empty() {
                eprintln!("{}: not written, because no result differs", path.display());
            }
        }
        Ok(())
    }

    /// The scene, at rest.
    fn world(&self, scene: &Line, objects: &Objects) -> anyhow::Result<World> {
        let mut world = World::new();
        for placed in &scene.objects {
            let object = objects.get(placed.object.as_str()).with_context(|| {
                format!(
                    "scene {}: object {} has no URDF file in {}; pass the folder with the scene's objects as --objects",
                    scene.scene,
                    placed.object,
                    self.objects.display()
                )
            })?;
            world.add(object, placed.scale, &isometry(&placed.pose));
        }
        // The engine detects contacts in a step.
        world.step();
        world.sleep();
        Ok(world)
    }

    /// Tries a scene's grasps and stores the results in it.
    fn replay(&self, scene: &mut Line, objects: &Objects) -> anyhow::Result<Compared> {
        let world = self.world(scene, objects)?;
        let (mut counts, mut differences) = ([0; 4], Vec::new());
        for trial in &mut scene.trials {
            let pose = isometry(&trial.pose);
            let before = match self.contact {
                Contact::Allow => trial.executed.unwrap_or(trial.label),
                Contact::Forbid => trial.label,
            };
            let held = match self.contact {
                Contact::Allow => execute(&mut world.clone(), &pose).0.is_success(),
                Contact::Forbid => label(&world, &pose, 0.0).is_success(),
            };
            match self.contact {
                Contact::Allow => trial.executed = Some(u8::from(held)),
                Contact::Forbid => trial.label = u8::from(held),
            }
            let first = if before == 1 { 0 } else { 2 };
            counts[first] += 1;
            counts[first + 1] += u64::from(held == (before == 1));
            if held != (before == 1) {
                differences.push((pose, held));
            }
        }
        Ok((counts, differences))
    }
}

fn draw(world: &World, (pose, held): &(Isometry3<f64>, bool)) -> Picture {
    let mut picture = Picture::of_workspace(480, 360, TABLE_HEIGHT);
    show(&mut picture, world).hand(pose, MAX_OPENING, quality_color(if *held { 1.0 } else { 0.0 }));
    picture
}

fn isometry(&[x, y, z, qx, qy, qz, qw]: &[f64; 7]) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(Quaternion::new(qw, qx, qy, qz)))
}
