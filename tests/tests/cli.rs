//! The command line `grasp`.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use grasp::Volume;
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, grasp};
use nalgebra::Isometry3;
use npyz::WriterBuilder;
use serde_json::Value;
use tempfile::TempDir;

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[4, 5, 6], [11, 10, 9]])
}

fn write<T: npyz::AutoSerialize>(path: &Path, order: npyz::Order, values: impl IntoIterator<Item = T>) {
    let mut writer = npyz::WriteOptions::new()
        .default_dtype()
        .order(order)
        .shape(&[1, RESOLUTION as u64, RESOLUTION as u64, RESOLUTION as u64])
        .writer(File::create(path).unwrap())
        .begin_nd()
        .unwrap();
    writer.extend(values).unwrap();
    writer.finish().unwrap();
}

/// The volume in every form that is read.
fn files() -> (TempDir, Vec<PathBuf>) {
    let folder = tempfile::tempdir().unwrap();
    let path = |name| folder.path().join(name);
    let volume = volume();
    let values = || volume.values().iter();
    let n = RESOLUTION;
    write(&path("f32.npy"), npyz::Order::C, values().copied());
    write(&path("f64.npy"), npyz::Order::C, values().map(|&v| f64::from(v)));
    write(&path("u8.npy"), npyz::Order::C, values().map(|&v| (v * 255.0).round() as u8));
    let transposed = (0..n.pow(3)).map(|i| volume.values()[(i % n * n + i / n % n) * n + i / (n * n)]);
    write(&path("fortran.npy"), npyz::Order::Fortran, transposed);
    let mut archive = npyz::npz::NpzWriter::create(path("scene.npz")).unwrap();
    for (name, length) in [("other", 3), ("grid", n as u64)] {
        let array = archive.array(name, Default::default()).unwrap();
        let mut writer = array.default_dtype().shape(&[length, length, length]).begin_nd().unwrap();
        writer.extend(values().take(length.pow(3) as usize).copied()).unwrap();
        writer.finish().unwrap();
    }
    drop(archive);
    let files = ["f32.npy", "f64.npy", "u8.npy", "fortran.npy", "scene.npz"].map(path).to_vec();
    (folder, files)
}

fn run(server: &Server, args: &[&str]) -> Output {
    Command::new(grasp()).args(args).env("GRASPD_SERVER", server.grpc().to_string()).output().unwrap()
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

#[test]
fn detect_reads_every_form_and_prints_the_same() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let (_folder, files) = files();
    for file in files {
        let output = run(&server, &["detect", file.to_str().unwrap(), "--json", "--explain"]);
        assert!(output.status.success(), "{}: {}", file.display(), text(&output.stderr));
        let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
        let grasps = answer["grasps"].as_array().unwrap();
        assert_eq!(grasps.len(), 2, "{}", file.display());
        let mut voxels: Vec<_> = grasps.iter().map(|grasp| grasp["position"].as_array().unwrap()).collect();
        voxels.sort_by(|a, b| a[0].as_f64().unwrap().total_cmp(&b[0].as_f64().unwrap()));
        for (position, voxel) in voxels.iter().zip([[4.0, 5.0, 6.0], [11.0, 10.0, 9.0]]) {
            for (metres, index) in position.iter().zip(voxel) {
                assert!((metres.as_f64().unwrap() - index * 0.3 / RESOLUTION as f64).abs() < 1e-9);
            }
        }
        assert_eq!(answer["model"], "mirror");
        assert!(answer["latency_seconds"]["total"].as_f64().unwrap() > 0.0);
        assert!(answer["dropped"]["below_threshold"].as_u64().unwrap() > 0);
    }
}

#[test]
fn detect_prints_a_table_with_the_latency_of_each_stage() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let (_folder, files) = files();
    let output = run(&server, &["detect", files[0].to_str().unwrap()]);
    let table = text(&output.stdout);
    for word in ["quality", "width m", "mirror 1", "queue", "preprocessing", "inference", "postprocessing", "total"] {
        assert!(table.contains(word), "no `{word}` in:\n{table}");
    }
}

#[test]
fn models_and_health_say_what_there_is() {
    let server = Server::run(&[TestModel::new("mirror"), TestModel::new("other").version("2.1")], &[]);
    let output = run(&server, &["models"]);
    assert!(text(&output.stdout).contains("mirror") && text(&output.stdout).contains("2.1"));
    let models: Value = serde_json::from_slice(&run(&server, &["models", "--json"]).stdout).unwrap();
    assert_eq!(models[0]["name"], "mirror");
    assert_eq!(models[0]["resolution"], RESOLUTION);
    assert_eq!(models[0]["sha256"].as_str().unwrap().len(), 64);
    assert_eq!(models[0]["provenance"]["data"], "none");
    let output = run(&server, &["health"]);
    assert!(output.status.success());
    assert_eq!(text(&output.stdout), "serving\n");
}

#[test]
fn mistakes_are_explained() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let (folder, files) = files();
    let refused = |args: &[&str]| {
        let output = run(&server, args);
        assert_eq!(output.status.code(), Some(1));
        assert!(output.stdout.is_empty());
        text(&output.stderr).to_owned()
    };
    let file = files[0].to_str().unwrap();
    assert!(refused(&["detect", "nowhere.npy"]).contains("nowhere.npy: No such file"));
    let error = refused(&["detect", file, "--model", "vgn"]);
    assert!(error.contains("NotFound: options.model is `vgn`, there is no such; there are mirror 1"), "{error}");
    let error = refused(&["detect", file, "--server", "127.0.0.1:1"]);
    assert!(error.contains("cannot reach graspd at 127.0.0.1:1"), "{error}");
    let whole = folder.path().join("i64.npy");
    write(&whole, npyz::Order::C, (0..RESOLUTION.pow(3) as i64).map(|_| 1_i64));
    assert!(refused(&["detect", whole.to_str().unwrap()]).contains("f64, f32, f16 or u8 is needed"));
    let error = refused(&["detect", file, "--voxel-size", "7.5"]);
    assert!(error.contains("volume.voxel_size is 7.5, the model mirror 1 takes 0.01875 m"), "{error}");
}

#[test]
fn a_benchmark_says_how_long_answers_took_and_what_was_refused() {
    let (_folder, files) = files();
    let server = Server::run(&[TestModel::new("slow").convolutions(20)], &["--queue", "1"]);
    let bench = |flags: &[&str]| -> Value {
        let output = Command::new(grasp())
            .args(["--server", &server.grpc().to_string(), "--json", "bench"])
            .arg(&files[0])
            .args(flags)
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let alone = bench(&["--seconds", "0.5"]);
    assert!(alone["outcomes"]["answered"]["calls"].as_u64().unwrap() > 0, "{alone}");
    assert!(alone["answers_per_second"].as_f64().unwrap() > 0.0);
    assert_eq!(alone["outcomes"].as_object().unwrap().len(), 1, "nobody is refused: {alone}");
    let crowd = bench(&["--seconds", "0.5", "--callers", "8"]);
    assert!(crowd["outcomes"]["ResourceExhausted"]["calls"].as_u64().unwrap() > 0, "{crowd}");
    let steady = bench(&["--seconds", "0.5", "--rate", "20"]);
    assert!(steady["outcomes"]["answered"]["p50_seconds"].as_f64().unwrap() > 0.0, "{steady}");
}
