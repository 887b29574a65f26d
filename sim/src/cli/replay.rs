use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context;
use clap::{Args, ValueEnum};
use grasp_sim::export::{self, Export, Line};
use grasp_sim::objects::ObjectSet;
use grasp_sim::physics::World;
use grasp_sim::trial::{execute, label};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use rayon::prelude::*;

/// Reads what `label --export` wrote, or another simulator with the same keys, lays its scenes, and tries its grasps.
#[derive(Args)]
pub struct Replay {
    /// The exported scenes.
    trials: PathBuf,

    /// Folder of the URDF files that the scenes name.
    #[arg(long)]
    objects: PathBuf,

    /// What a contact on the way does: the hand closes there, as in evaluation, and the result is `executed`; or the grasp
    /// fails, as in labels, and the result is `label`.
    #[arg(long, value_enum, default_value = "allow")]
    contact: Contact,

    /// File for the scenes with the results.
    #[arg(long)]
    out: Option<PathBuf>,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Contact {
    Allow,
    Forbid,
}

impl Replay {
    pub fn run(self) -> anyhow::Result<()> {
        let objects = ObjectSet::load(&self.objects)?;
        let objects: HashMap<_, _> = objects.listed().iter().map(|object| (object.name.as_str(), object)).collect();
        let mut scenes = export::read(&self.trials)?;
        let kept: Vec<[u64; 4]> =
            scenes.par_iter_mut().map(|scene| self.replay(scene, &objects)).collect::<anyhow::Result<_>>()?;
        if let Some(path) = &self.out {
            let mut file = Export::open(path, 0)?;
            scenes.iter().try_for_each(|scene| file.append(scene))?;
        }
        let [successes, kept_successes, failures, kept_failures] =
            kept.iter().fold([0; 4], |sum, scene| std::array::from_fn(|i| sum[i] + scene[i]));
        let report = serde_json::json!({
            "scenes": scenes.len(),
            "successes": successes,
            "successes_kept": kept_successes,
            "failures": failures,
            "failures_kept": kept_failures,
        });
        println!("{report}");
        Ok(())
    }

    /// Tries a scene's grasps, writes the results into it, and counts its successes, those of them that are successes
    /// again, its failures, and those of them that are failures again.
    fn replay(
        &self,
        scene: &mut Line,
        objects: &HashMap<&str, &Arc<grasp_sim::objects::Object>>,
    ) -> anyhow::Result<[u64; 4]> {
        let mut world = World::new();
        for placed in &scene.objects {
            let object = objects.get(placed.object.as_str()).with_context(|| {
                format!(
                    "scene {} has the object {}: {} has no such URDF",
                    scene.scene,
                    placed.object,
                    self.objects.display()
                )
            })?;
            world.add(object, placed.scale, &isometry(&placed.pose));
        }
        // The engine finds in a step what touches what.
        world.step();
        world.sleep();
        let mut counts = [0; 4];
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
        }
        Ok(counts)
    }
}

fn isometry(&[x, y, z, qx, qy, qz, qw]: &[f64; 7]) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(Quaternion::new(qw, qx, qy, qz)))
}
