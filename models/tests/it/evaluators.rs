//! Scores of the shipped evaluators: compared with those stored in `tests/snapshots/`, and between backends. After an
//! evaluator is replaced, set `UPDATE_SNAPSHOTS=1` once and commit the new file. `ORT_DYLIB_PATH` must name ONNX
//! Runtime's library.

use std::env;
use std::f64::consts::PI;
use std::fmt::Write;
use std::fs;
use std::path::Path;

use grasp::{Patch, Volume};
use grasp_models::{Classifier, ClassifierKind, Options, Precision, Provider};
use nalgebra::{Isometry3, Translation3, UnitQuaternion};

use crate::scenes;

/// Largest difference of a score from its snapshot. Two libraries or processors sum in a different order.
const TOLERANCE: f32 = 2e-3;

/// Largest difference between the probabilities of two backends in bf16.
const BF16: f32 = 0.05;

/// Grasps from above and from the side at several places.
fn poses() -> Vec<Isometry3<f64>> {
    let places = [[0.15, 0.15, 0.17], [0.15, 0.12, 0.14], [0.1, 0.12, 0.12]];
    let tilts = [0.0, 0.6];
    let yaws = [0.0, 0.9];
    let pose = |[x, y, z]: [f64; 3], tilt: f64, yaw: f64| {
        let rotation = UnitQuaternion::from_euler_angles(PI - tilt, 0.0, yaw);
        Isometry3::from_parts(Translation3::new(x, y, z), rotation)
    };
    let turns = || tilts.into_iter().flat_map(move |tilt| yaws.map(|yaw| (tilt, yaw)));
    places.into_iter().flat_map(|place| turns().map(move |(tilt, yaw)| pose(place, tilt, yaw))).collect()
}

fn scores(evaluator: &mut Classifier, volume: &Volume) -> Vec<f32> {
    let poses = poses();
    evaluator.score(poses.len(), |index, patch| Patch::write(volume, &poses[index], patch)).unwrap()
}

#[test]
fn scores_of_the_shipped_evaluators_match_their_snapshots() {
    for path in scenes::shipped("evaluators") {
        let mut evaluator = Classifier::load(&path, ClassifierKind::Evaluator, &Options::default()).unwrap();
        let mut text = String::new();
        for (scene, volume) in scenes::all() {
            let scores: Vec<String> =
                scores(&mut evaluator, &volume).iter().map(|score| format!("{score:.4}")).collect();
            writeln!(text, "{scene}: {}", scores.join(" ")).unwrap();
        }
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        let stored = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/snapshots/{name}.txt"));
        if env::var_os("UPDATE_SNAPSHOTS").is_some() {
            fs::write(&stored, &text).unwrap();
        }
        let expected = fs::read_to_string(&stored).unwrap_or_else(|error| panic!("{}: {error}", stored.display()));
        assert_eq!(text.lines().count(), expected.lines().count(), "{name}");
        for (got, expected) in text.lines().zip(expected.lines()) {
            let ((scene, got), (label, values)) = (parse(got), parse(expected));
            let is_close = |(a, b): (&f32, &f32)| (a - b).abs() <= TOLERANCE * b.abs().max(1.0);
            let is_same = scene == label && got.len() == values.len() && got.iter().zip(&values).all(is_close);
            assert!(is_same, "{name}, {scene}: {got:?}\nnot {expected}");
        }
    }
}

fn parse(line: &str) -> (&str, Vec<f32>) {
    let (label, values) = line.split_once(": ").unwrap();
    (label, values.split(' ').map(|value| value.parse().unwrap()).collect())
}

#[test]
fn coarse_evaluators_agree_with_their_evaluators() {
    let probability = |score: f32| 1.0 / (1.0 + (-score).exp());
    for path in scenes::shipped("evaluators") {
        let [mut fine, mut coarse] = [ClassifierKind::Evaluator, ClassifierKind::CoarseEvaluator]
            .map(|kind| Classifier::load(&path, kind, &Options::default()).unwrap());
        let poses = poses();
        let mut differences = Vec::new();
        for (_, volume) in scenes::all() {
            let write = |index: usize, patch: &mut [f32]| Patch::write_coarse(&volume, &poses[index], patch);
            let of_coarse = coarse.score(poses.len(), write).unwrap();
            let both = scores(&mut fine, &volume).into_iter().zip(of_coarse);
            differences.extend(both.map(|(fine, coarse)| (probability(fine) - probability(coarse)).abs()));
        }
        let mean = differences.iter().sum::<f32>() / differences.len() as f32;
        assert!(mean < 0.1, "{}: the probabilities differ by {mean} on average", path.display());
    }
}

#[test]
fn every_available_backend_scores_as_the_reference() {
    let probability = |score: f32| 1.0 / (1.0 + (-score).exp());
    for path in scenes::shipped("evaluators") {
        let mut reference = Classifier::load(&path, ClassifierKind::Evaluator, &Options::default()).unwrap();
        for (provider, precision, limit) in
            [(Provider::OpenVino, Precision::Fp32, 1e-3), (Provider::OpenVino, Precision::Bf16, BF16)]
        {
            let options = Options { provider: Some(provider), precision: Some(precision), ..Options::auto(2) };
            let mut evaluator = match Classifier::load(&path, ClassifierKind::Evaluator, &options) {
                Ok(evaluator) => evaluator,
                Err(error) if error.to_string().contains("available: ") => {
                    println!("{provider} {precision}: not available");
                    continue;
                }
                Err(error) => panic!("{error}"),
            };
            assert_eq!((evaluator.backend().provider, evaluator.backend().precision), (provider, precision));
            for (scene, volume) in scenes::all() {
                let expected = scores(&mut reference, &volume);
                for (got, expected) in scores(&mut evaluator, &volume).into_iter().zip(expected) {
                    let difference = (probability(got) - probability(expected)).abs();
                    assert!(difference <= limit, "{provider} {precision}, {scene}: {got} instead of {expected}");
                }
            }
        }
    }
}
