//! The classifier of grasp candidates, from the data of `grasp-sim` to its use in the benchmark.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::atomic::AtomicBool;

use grasp::gpd::{Candidate, Cloud, Image};
use grasp::{DecodeParams, Grasp, Patch, SurfacePoint, Volume};
use grasp_data::{Candidates, Provenance, Setup, Trial, packed};
use grasp_models::gpd::gpd;
use grasp_models::onnx::ModelProto;
use grasp_models::{Classifier, ClassifierKind, Metadata, Options};
use grasp_sim::benchmark::Benchmark;
use grasp_sim::camera::{DepthNoise, Views};
use grasp_sim::label::SceneConfig;
use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::planner::PlannerSpec;
use grasp_sim::scene::SceneKind;
use grasp_sim::score::Summary;
use grasp_train::{CandidateDataset, ClassifierSettings, ClassifierTrainer, Examples};
use nalgebra::{Isometry3, Point3, Vector3};
use tch::Device;

use crate::support;

/// Adds a candidate with a wall between the fingers. It succeeds if the wall is parallel to the approach, and fails if
/// it is perpendicular.
fn push(number: u64, candidates: &mut Candidates) {
    let success = number.is_multiple_of(3);
    let offset = (number % 7) as f64 * 0.003 - 0.009;
    let points = (-15..=15).flat_map(|i| (0..=15).map(move |j| (f64::from(i) * 1e-3, f64::from(j) * 1e-3)));
    let points = points.map(|(x, along)| match success {
        true => SurfacePoint { position: Point3::new(x, offset, 0.03 + along), normal: Vector3::y() },
        false => SurfacePoint { position: Point3::new(x, along, 0.04 + offset), normal: Vector3::z() },
    });
    let candidate = Candidate { pose: Isometry3::identity(), width: 0.02, point: Point3::origin() };
    candidates.push(number / 4, &Image::SHAPE, Image::new(&Cloud::new(points), &candidate).pixels(), success);
}

fn candidate_file(folder: &Path, count: u64) -> PathBuf {
    let path = folder.join("walls.npz");
    let mut walls = Candidates::default();
    (0..count).for_each(|number| push(number, &mut walls));
    walls.write(&path).unwrap();
    path
}

fn classify(folder: &Path, arguments: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_grasp-train"));
    command.current_dir(folder).arg("classify").args(arguments.split_whitespace()).output().unwrap()
}

#[test]
fn a_small_data_set_is_memorized() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = CandidateDataset::read(&[candidate_file(folder.path(), 48)], &Image::SHAPE).unwrap();
    assert_eq!((dataset.len(), dataset.successes()), (48, 16));
    let settings = ClassifierSettings {
        epochs: 16,
        batch: 16,
        learning_rate: 2e-3,
        weight_decay: 0.0,
        validation: 0.25,
        seed: 1,
        balance: true,
        bf16: false,
    };
    let mut trainer = ClassifierTrainer::new(gpd(1), &dataset, settings, Device::Cpu).unwrap();
    let (training, held_out) = trainer.candidates();
    assert!(training + held_out == 48 && held_out > 0 && held_out % 4 == 0, "validation has whole scenes");
    let first = trainer.epoch(|| ()).unwrap();
    let last = (0..15).map(|_| trainer.epoch(|| ()).unwrap()).last().unwrap();
    assert!(last.loss < 0.1 && last.loss < first.loss / 4.0, "from {} to {}", first.loss, last.loss);
    assert_eq!((last.accuracy, last.precision, last.recall), (1.0, 1.0, 1.0));
    assert!(trainer.validate().unwrap().unwrap().accuracy > 0.9, "the validation scenes have the same walls");
}

#[test]
fn a_trained_classifier_plans_in_the_benchmark() {
    let folder = tempfile::tempdir().unwrap();
    let config = SceneConfig {
        kind: SceneKind::Packed,
        objects: ObjectSet::procedural(Split::Train),
        points: 10,
        views: Views::Side { azimuth: 0.0 },
        observations: 1,
        noise: DepthNoise::BENCHMARK,
        seed: 1,
    };
    let mut candidates = Candidates::default();
    (0..6).for_each(|number| candidates.append(config.candidates(number)));
    candidates.write(&folder.path().join("packed.npz")).unwrap();

    let arguments = "--data packed.npz --out models/gpd.onnx --epochs 2 --val 0.3 --batch 16 --model-version 2";
    let output = classify(folder.path(), arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let lines = String::from_utf8(output.stdout).unwrap();
    let records: Vec<serde_json::Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(records.len(), 2);
    for name in ["loss", "accuracy", "precision", "recall"] {
        assert!(records[1]["validation"][name].is_number() && records[1]["training"][name].is_number(), "{name}");
    }
    let path = folder.path().join("models/gpd.onnx");
    let properties = ModelProto::read(&path).unwrap().metadata_props;
    for (key, value) in [("name", "gpd"), ("version", "2"), ("provenance.data", "packed")] {
        let key = format!("graspd.{key}");
        assert!(properties.iter().any(|p| p.key() == key && p.value() == value), "{key}: {properties:?}");
    }

    let benchmark = Benchmark {
        kind: SceneKind::Packed,
        objects: ObjectSet::procedural(Split::PackedTest),
        count: 3,
        views: config.views,
        noise: DepthNoise::BENCHMARK,
        rounds: 2,
        seed: 1,
    };
    let planner = format!("gpd:{}", path.display()).parse::<PlannerSpec>().unwrap();
    let rounds = benchmark
        .run(&planner, &DecodeParams::benchmark(), &Options::default(), &AtomicBool::new(false), |_| ())
        .unwrap();
    let summary = Summary::new(&rounds);
    assert!(summary.rounds == 2 && summary.objects >= 2, "{summary:?}");
    assert!(summary.attempts > 0 || summary.nothing_proposed == 2, "{summary:?}");
}

/// A data set of volumes that are full or empty between the fingers. Grasps in full volumes succeed.
fn proposals(folder: &Path) -> PathBuf {
    let path = folder.join("proposals");
    let provenance = Provenance { network: Some("vgn-packed".to_owned()), ..support::provenance() };
    let mut writer = packed::Writer::open(&path, &Setup::benchmark(provenance)).unwrap();
    for number in 0..24_u8 {
        let success = number.is_multiple_of(2);
        let volume = filled(if success { 0.7 } else { 0.2 } + 0.005 * f32::from(number));
        let trial = |i: u8| Trial::new(&grasp(f64::from(i)), success, volume.voxel_size());
        writer.append(u64::from(number), &[volume.values().to_vec()], &[0, 1, 2, 3].map(trial), None).unwrap();
    }
    path
}

/// A volume with one value.
fn filled(value: f32) -> Volume {
    Volume::new(40, 0.0075, Isometry3::identity(), vec![value; 64_000]).unwrap()
}

fn grasp(shift: f64) -> Grasp {
    Grasp { pose: Isometry3::translation(0.15 + 0.002 * shift, 0.15, 0.12), width: 0.04, quality: 1.0 }
}

#[test]
fn an_evaluator_separates_full_from_empty_volumes() {
    let folder = tempfile::tempdir().unwrap();
    proposals(folder.path());
    let arguments = "--network evaluator --proposals-of vgn-packed --data proposals --out evaluator.onnx --epochs 20 \
                     --batch 16";
    let output = classify(folder.path(), arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let path = folder.path().join("evaluator.onnx");
    let metadata = Metadata::from_model(&ModelProto::read(&path).unwrap(), &path).unwrap();
    assert_eq!((&*metadata.name, metadata.network.as_deref()), ("evaluator", Some("vgn-packed")));
    let mut evaluator = Classifier::load(&path, ClassifierKind::Evaluator, &Options::default()).unwrap();
    let volumes = [filled(0.75), filled(0.25)];
    let scores = evaluator.score(2, |index, patch| Patch::write(&volumes[index], &grasp(0.5).pose, patch)).unwrap();
    assert!(scores[0] > 0.0 && scores[1] < 0.0, "{scores:?}");

    let arguments = "--network evaluator --proposals-of vgn-packed --data proposals --from evaluator.onnx --out \
                     further.onnx --epochs 1 --lr 1e-9";
    let output = classify(folder.path(), arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let further = ModelProto::read(&folder.path().join("further.onnx")).unwrap();
    let from = further.metadata_props.iter().find(|property| property.key() == "graspd.provenance.from").unwrap();
    assert_eq!(from.value(), "evaluator");
    let mut further =
        Classifier::load(&folder.path().join("further.onnx"), ClassifierKind::Evaluator, &Options::default()).unwrap();
    let again = further.score(2, |index, patch| Patch::write(&volumes[index], &grasp(0.5).pose, patch)).unwrap();
    assert!(scores.iter().zip(&again).all(|(a, b)| (a - b).abs() < 1e-3), "{scores:?}, {again:?}");

    let arguments = "--network coarse-evaluator --teacher evaluator.onnx --data proposals --out both.onnx --epochs 20 \
                     --batch 16 --lr 2e-3";
    let output = classify(folder.path(), arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let path = folder.path().join("both.onnx");
    let both = ModelProto::read(&path).unwrap();
    let metadata = Metadata::from_model(&both, &path).unwrap();
    assert_eq!((&*metadata.name, &*metadata.provenance["coarse.teacher"]), ("evaluator", "evaluator"));
    let mut unchanged = Classifier::load(&path, ClassifierKind::Evaluator, &Options::default()).unwrap();
    let same = unchanged.score(2, |index, patch| Patch::write(&volumes[index], &grasp(0.5).pose, patch)).unwrap();
    assert_eq!(same, scores);
    let mut coarse = Classifier::load(&path, ClassifierKind::CoarseEvaluator, &Options::default()).unwrap();
    let of_coarse =
        coarse.score(2, |index, patch| Patch::write_coarse(&volumes[index], &grasp(0.5).pose, patch)).unwrap();
    assert!(of_coarse[0] > 0.0 && of_coarse[1] < 0.0, "{of_coarse:?}");
    let alone = folder.path().join("evaluator.onnx");
    let error = Classifier::load(&alone, ClassifierKind::CoarseEvaluator, &Options::default()).err().unwrap();
    assert!(error.to_string().contains("grasp-train classify --network coarse-evaluator"), "{error}");

    candidate_file(folder.path(), 8);
    for (arguments, expected) in [
        ("--network coarse-evaluator --data proposals --out x.onnx", "--teacher"),
        ("--data walls.npz --teacher evaluator.onnx --out x.onnx", "--teacher is of coarse evaluators, and gpd"),
        ("--data walls.npz --from evaluator.onnx --out x.onnx", "the graph is not that of gpd"),
        ("--network evaluator --data proposals --out x.onnx", "--proposals-of"),
        ("--network evaluator --proposals-of vgn --data walls.npz --out x.onnx", "walls.npz: "),
        ("--data proposals --out x.onnx", "proposals: "),
        ("--data walls.npz --out x.onnx --device cuda:99", "--device is cuda:99"),
        ("--data walls.npz --out x.onnx --lr 1e30 --batch 2", "the loss is not finite after epoch 1"),
    ] {
        let output = classify(folder.path(), arguments);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && stderr.contains(expected), "{arguments}: {stderr}");
    }
}

#[test]
fn the_same_seed_gives_the_same_classifier() {
    let folder = tempfile::tempdir().unwrap();
    candidate_file(folder.path(), 24);
    let train = |name: &str, seed: u64| {
        let arguments = format!("--data walls.npz --out {name}.onnx --epochs 1 --threads 1 --seed {seed}");
        assert!(classify(folder.path(), &arguments).status.success());
        ModelProto::read(&folder.path().join(format!("{name}.onnx"))).unwrap().graph.unwrap().initializer
    };
    let first = train("a", 1);
    assert_eq!(first, train("b", 1));
    assert_ne!(first, train("c", 2));
}

#[test]
fn errors_name_the_flag_or_the_file() {
    let folder = tempfile::tempdir().unwrap();
    candidate_file(folder.path(), 8);
    fs::write(folder.path().join("text.npz"), "not a zip").unwrap();
    for (arguments, expected) in [
        ("--data text.npz --out x.onnx", "text.npz: "),
        ("--data nowhere.npz --out x.onnx", "nowhere.npz: No such file"),
        ("--data walls.npz --out x.onnx --val 1", "--val is 1"),
        ("--data walls.npz --out x.onnx --batch 0", "--batch"),
        ("--out x.onnx", "--data"),
    ] {
        let output = classify(folder.path(), arguments);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && stderr.contains(expected), "{arguments}: {stderr}");
    }
    assert!(!folder.path().join("x.onnx").exists());
}
