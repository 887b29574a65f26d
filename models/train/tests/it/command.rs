//! The program `grasp-train`.

use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use grasp::VoxelOrigin;
use grasp_models::onnx::ModelProto;
use grasp_models::{Architecture, Calibration, Metadata, Orientation, Store};
use grasp_train::{Checkpoint, EpochRecord};

use crate::support;

const N: usize = 16;

/// A folder with `start.onnx`, a network for small volumes, and `data`.
fn prepare() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let scenes: Vec<_> = (0..12).map(|seed| support::scene(seed, N)).collect();
    support::write(&folder.path().join("data"), &scenes);
    Architecture::Vgn.build(N, 0).unwrap().write(&folder.path().join("start.onnx")).unwrap();
    folder
}

fn command(folder: &Path, arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_grasp-train"));
    command.current_dir(folder).args(arguments.split_whitespace());
    command
}

fn train(folder: &Path, arguments: &str) -> Output {
    let fixed = "train --from start.onnx --data data --batch 4 --threads 1 --augment rotate,mirror,shift";
    command(folder, &format!("{fixed} {arguments}")).output().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_run_writes_a_model_that_can_be_served() {
    let folder = prepare();
    let arguments = "--out models/pile.onnx --epochs 2 --val 0.3 --voxel-origin center --model-version 2.0 --seed 3";
    let output = train(folder.path(), arguments);
    assert!(output.status.success(), "{}", stderr(&output));
    let models = folder.path().join("models");
    let store = Store::open(&models).unwrap();
    let metadata = &store.get("pile", Some("2.0")).unwrap().metadata;
    assert_eq!((metadata.resolution, metadata.voxel_origin), (N, VoxelOrigin::Center));
    let expected = [
        ("architecture", "vgn"),
        ("data", "data"),
        ("scenes", "12"),
        ("grasps", "24"),
        ("seed", "3"),
        ("epochs", "2"),
        ("from", "start.onnx"),
    ];
    for (key, value) in expected {
        assert_eq!(metadata.provenance.get(key).map(String::as_str), Some(value), "{key}");
    }
    let log = fs::read_to_string(models.join("pile.jsonl")).unwrap();
    assert_eq!(log, String::from_utf8(output.stdout).unwrap(), "the log equals the output");
    let records: Vec<EpochRecord> = log.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(records.iter().map(|record| record.epoch).collect::<Vec<_>>(), [1, 2]);
    assert!(records.iter().all(|record| record.validation.is_some() && record.volumes_per_second > 0.0));
    assert_eq!(&fs::read(models.join("pile.png")).unwrap()[1..4], b"PNG");
}

#[test]
fn fine_tuning_uses_the_defaults_of_the_initial_network() {
    let folder = prepare();
    let start = Architecture::TransformerSmall.build(N, 0).unwrap();
    start.write(&folder.path().join("small.onnx")).unwrap();
    for (from, batch, learning_rate) in [("start", 32, 3e-4), ("small", 64, 1e-4)] {
        let arguments = format!("train --from {from}.onnx --data data --threads 1 --epochs 1 --out out.onnx");
        let output = command(folder.path(), &arguments).output().unwrap();
        assert!(output.status.success(), "{}", stderr(&output));
        let path = folder.path().join("out.onnx");
        let metadata = Metadata::from_model(&ModelProto::read(&path).unwrap(), &path).unwrap();
        let settings: serde_json::Value = serde_json::from_str(&metadata.provenance["settings"]).unwrap();
        assert_eq!((&settings["batch"], &settings["learning_rate"]), (&batch.into(), &learning_rate.into()), "{from}");
        assert_eq!(settings["quality"], "label", "{from}");
    }
}

#[test]
fn a_run_can_be_resumed() {
    let folder = prepare();
    assert!(train(folder.path(), "--out whole.onnx --epochs 3 --name x").status.success());
    assert!(train(folder.path(), "--out parts.onnx --epochs 1 --name x --save-every 1000").status.success());
    let output = train(folder.path(), "--out parts.onnx --epochs 3 --name x --resume");
    assert!(output.status.success(), "{}", stderr(&output));
    let weights = |name: &str| ModelProto::read(&folder.path().join(name)).unwrap().graph.unwrap().initializer;
    assert_eq!(weights("whole.onnx"), weights("parts.onnx"));
    let lines = |name: &str| fs::read_to_string(folder.path().join(name)).unwrap().lines().count();
    assert_eq!((lines("whole.jsonl"), lines("parts.jsonl")), (3, 3));
    let other = train(folder.path(), "--out parts.onnx --epochs 4 --name x --resume --quality share");
    let stderr = stderr(&other);
    assert!(!other.status.success() && stderr.contains("give the same options"), "{stderr}");
    assert!(stderr.contains(r#""quality":"label""#) && stderr.contains(r#""quality":"share""#), "{stderr}");
}

#[test]
fn a_teacher_is_recorded_and_another_voxel_origin_is_an_error() {
    let folder = prepare();
    let output = train(folder.path(), "--out out.onnx --epochs 1 --teacher start.onnx --teacher-weight 2");
    assert!(output.status.success(), "{}", stderr(&output));
    let path = folder.path().join("out.onnx");
    let metadata = Metadata::from_model(&ModelProto::read(&path).unwrap(), &path).unwrap();
    assert_eq!(metadata.provenance["teacher"], "vgn 1 at 2");
    let output = train(folder.path(), "--out out.onnx --epochs 1 --teacher start.onnx --voxel-origin center");
    assert!(!output.status.success() && stderr(&output).contains("give --voxel-origin"), "{}", stderr(&output));
}

#[test]
fn a_run_ends_after_the_patience_of_the_evaluation() {
    let folder = prepare();
    // Each evaluation is worse: 0.9, 0.8, 0.7…
    let script =
        r#"n=$(cat n 2>/dev/null || echo 9); echo $((n - 1)) > n; test -s {} && echo "{\"gsr\":0.$n,\"dr\":0.$n}""#;
    let arguments =
        "train --from start.onnx --data data --threads 1 --epochs 9 --keep best --patience 2 --out out.onnx";
    let output = command(folder.path(), arguments).args(["--evaluate", script]).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let lines = String::from_utf8(output.stdout).unwrap();
    let records: Vec<EpochRecord> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let rates: Vec<f64> = records.iter().map(|record| record.benchmark.unwrap().gsr).collect();
    assert_eq!(rates, [0.9, 0.8, 0.7], "two consecutive results were not better");
    let path = folder.path().join("out.onnx");
    let metadata = Metadata::from_model(&ModelProto::read(&path).unwrap(), &path).unwrap();
    assert_eq!(metadata.provenance["epochs"], "1");
    assert_eq!(metadata.provenance["evaluation"], "GSR 0.900, DR 0.900");
    // A resumed run that has ended does nothing.
    let again = command(folder.path(), &format!("{arguments} --resume")).args(["--evaluate", script]).output().unwrap();
    assert!(again.status.success() && again.stdout.is_empty());
    let without = command(folder.path(), &format!("{arguments} --resume")).output().unwrap();
    assert!(!without.status.success() && stderr(&without).contains("that of --evaluate"), "{}", stderr(&without));
}

#[test]
fn an_epoch_whose_evaluation_fails_is_not_lost() {
    let folder = prepare();
    let arguments = "train --from start.onnx --data data --threads 1 --epochs 2 --out out.onnx";
    let failed = command(folder.path(), arguments).args(["--evaluate", "test ! -e {}"]).output().unwrap();
    assert!(!failed.status.success() && stderr(&failed).contains("failed"), "{}", stderr(&failed));
    let checkpoint = Checkpoint::read(&folder.path().join("out.state")).unwrap();
    assert_eq!((checkpoint.epoch, checkpoint.batch), (1, 0));
    let script = r#"test -e {} && echo '{"gsr":0.5,"dr":0.5}'"#;
    let rest = command(folder.path(), &format!("{arguments} --resume")).args(["--evaluate", script]).output().unwrap();
    assert!(rest.status.success(), "{}", stderr(&rest));
    let lines = String::from_utf8(rest.stdout).unwrap();
    let records = lines.lines().map(|line| serde_json::from_str::<EpochRecord>(line).unwrap());
    let evaluated: Vec<_> = records.map(|record| (record.epoch, record.benchmark.is_some())).collect();
    assert_eq!(evaluated, [(1, true), (2, true)], "the first epoch is evaluated again");
    let best = format!("{arguments} --resume --keep best");
    let refused = command(folder.path(), &best).args(["--evaluate", script]).output().unwrap();
    assert!(stderr(&refused).contains("the file has the last weights, not the best"), "{}", stderr(&refused));
}

#[test]
fn ctrl_c_writes_a_checkpoint() {
    let folder = prepare();
    let arguments =
        "train --from start.onnx --data data --batch 1 --threads 1 --epochs 100000 --save-every 0.5 --out out.onnx";
    let mut run = command(folder.path(), arguments).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let start = Instant::now();
    while !folder.path().join("out.state").exists() {
        assert!(start.elapsed() < Duration::from_secs(60), "no checkpoint after half a second");
        sleep(Duration::from_millis(20));
    }
    assert!(Command::new("kill").args(["-INT", &run.id().to_string()]).status().unwrap().success());
    assert_eq!(run.wait().unwrap().code(), Some(0));
    let checkpoint = Checkpoint::read(&folder.path().join("out.state")).unwrap();
    assert!(checkpoint.steps > 0 && checkpoint.epoch < 100_000);
    let path = folder.path().join("out.onnx");
    let metadata = Metadata::from_model(&ModelProto::read(&path).unwrap(), &path).unwrap();
    assert_eq!(metadata.provenance["steps"], checkpoint.steps.to_string(), "both are of the same step");
}

#[test]
fn a_network_is_written_with_random_weights() {
    let folder = tempfile::tempdir().unwrap();
    let output = command(folder.path(), "init --network vgn --seed 4 --out vgn.onnx").output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let written = ModelProto::read(&folder.path().join("vgn.onnx")).unwrap();
    assert_eq!(written, Architecture::Vgn.build(40, 4).unwrap());
}

#[test]
fn an_fp16_export_halves_the_file_and_computes_the_same() {
    let folder = prepare();
    let arguments = "export --from start.onnx --precision fp16 --out half.onnx --data data --volumes 5";
    let output = command(folder.path(), arguments).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let number = |pointer: &str| report.pointer(pointer).and_then(serde_json::Value::as_f64).unwrap();
    assert!(number("/out_bytes") < 0.55 * number("/from_bytes"), "{report}");
    assert_eq!(number("/compared/volumes"), 5.0);
    for output in ["quality", "rotation", "width_voxels"] {
        let (largest, mean) =
            (number(&format!("/compared/{output}/largest")), number(&format!("/compared/{output}/mean")));
        assert!(largest > 0.0 && largest < 5e-3 && mean < largest, "{output}: {report}");
    }
    // An fp16 file can be trained and exported to fp32.
    for arguments in [
        "train --from half.onnx --data data --threads 1 --epochs 1 --out trained.onnx",
        "export --from half.onnx --precision fp32 --out full.onnx",
    ] {
        let output = command(folder.path(), arguments).output().unwrap();
        assert!(output.status.success(), "{arguments}: {}", stderr(&output));
    }
    let size = |name: &str| fs::metadata(folder.path().join(name)).unwrap().len();
    // The weights are the same; the metadata have an additional entry.
    assert!(size("full.onnx").abs_diff(size("start.onnx")) < 100 && size("trained.onnx") > size("half.onnx"));
}

#[test]
fn an_int8_export_is_a_third_of_the_file_and_computes_nearly_the_same() {
    let folder = prepare();
    let arguments = "export --from start.onnx --precision int8 --out int8.onnx --data data --calibrate 4";
    let output = command(folder.path(), arguments).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let number = |pointer: &str| report.pointer(pointer).and_then(serde_json::Value::as_f64).unwrap();
    assert!(number("/out_bytes") < 0.35 * number("/from_bytes"), "{report}");
    for output in ["quality", "rotation", "width_voxels"] {
        let (largest, mean) =
            (number(&format!("/compared/{output}/largest")), number(&format!("/compared/{output}/mean")));
        assert!(largest > 0.0 && largest < 0.1 && mean < 0.02, "{output}: {report}");
    }
    // An int8 network cannot be trained.
    let arguments = "train --from int8.onnx --data data --epochs 1 --out trained.onnx";
    let output = command(folder.path(), arguments).output().unwrap();
    assert!(stderr(&output).contains("the operator `QuantizeLinear` cannot be trained"), "{}", stderr(&output));
}

#[test]
fn rotation_averaging_is_exported_in_every_precision() {
    let folder = prepare();
    let axes = Architecture::Vgn.build_with(N, Orientation::Axes, 0).unwrap();
    axes.write(&folder.path().join("axes.onnx")).unwrap();
    fs::create_dir(folder.path().join("zoo")).unwrap();
    for precision in ["fp32", "fp16", "int8"] {
        let arguments = format!(
            "export --from axes.onnx --precision {precision} --average-rotations --data data --out zoo/{precision}.onnx"
        );
        let output = command(folder.path(), &arguments).output().unwrap();
        assert!(output.status.success(), "{}", stderr(&output));
        let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        let largest = report.pointer("/compared/quality/largest").and_then(serde_json::Value::as_f64).unwrap();
        assert!(largest > 1e-5, "the average differs from its parts: {report}");
    }
    let store = Store::open(&folder.path().join("zoo")).unwrap();
    let metadata = &store.get("fp16", None).unwrap().metadata;
    assert_eq!(metadata.provenance["precision"], "fp16");
    assert_eq!(metadata.provenance["averaged_over_rotations"], "4");

    let output = command(folder.path(), "export --from start.onnx --precision fp32 --average-rotations --out x.onnx")
        .output()
        .unwrap();
    assert!(
        stderr(&output).contains("start.onnx") && stderr(&output).contains("--orientation axes"),
        "{}",
        stderr(&output)
    );
}

#[test]
fn an_exported_classifier_keeps_its_calibration() {
    let folder = tempfile::tempdir().unwrap();
    assert!(command(folder.path(), "init --network gpd --out random.onnx").status().unwrap().success());
    let read = |name: &str| ModelProto::read(&folder.path().join(name)).unwrap();
    let calibration = Calibration { slope: 0.5, offset: -0.25 };
    let mut model = read("random.onnx");
    calibration.write_to(&mut model);
    model.write(&folder.path().join("calibrated.onnx")).unwrap();
    let output =
        command(folder.path(), "export --from calibrated.onnx --precision fp16 --out half.onnx").output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert_eq!(Calibration::from_model(&read("half.onnx")), Ok(calibration));
}

#[test]
fn errors_name_the_flag_or_the_file() {
    let folder = prepare();
    for (arguments, expected) in [
        ("train --network vng --data data --out x.onnx", "network `vng` not found"),
        ("train --network vgn --data data --out x.onnx", "--data has volumes of 16³ voxels, but the network needs 40³"),
        ("train --network vgn --data data --ema 1 --out x.onnx", "--ema is 1"),
        ("train --network vgn --data data --weight-decay=-1 --out x.onnx", "--weight-decay is -1"),
        ("train --network vgn --data data --lr 0 --out x.onnx", "--lr is 0"),
        ("train --network vgn --data data --minutes 0 --out x.onnx", "--minutes is 0"),
        ("train --network vgn --data data --rotation-weight=-1 --out x.onnx", "--rotation-weight is -1"),
        ("train --network vgn --data data --occupancy=-1 --out x.onnx", "--occupancy is -1"),
        (
            "train --from start.onnx --data data --occupancy 1 --out x.onnx",
            "--occupancy needs scenes with their occupancy",
        ),
        ("train --from start.onnx --data data --follow --out x.onnx", "--follow needs packed data sets"),
        ("train --network vgn --data data --follow --cosine --out x.onnx", "--cosine with --follow needs --minutes"),
        ("train --network vgn --data data --max-shift 1 --out x.onnx", "--max-shift needs --augment shift"),
        ("train --network vgn --data data --val 0 --keep best --out x.onnx", "--patience and --keep best need results"),
        ("classify --network gpd --data data --out x.onnx --val 1", "--val is 1"),
        ("classify --network gpd --data data --out x.onnx --lr 0", "--lr is 0"),
        (
            "train --network vgn --data data --evaluate true --out x.onnx",
            "must contain {} in place of the model's file",
        ),
        ("train --from start.onnx --data data --accumulate 0 --out x.onnx", "no training scenes"),
        ("train --network vgn --data nowhere --out x.onnx", "nowhere: No such file"),
        ("train --network vgn --data data --out x.onnx --val 1", "--val is 1"),
        ("train --from start.onnx --data data --out x.onnx --resume", "x.state: No such file"),
        ("train --data data --out x.onnx", "--network"),
        ("train --from start.onnx --data data --out x.onnx --device cuda:99", "--device is cuda:99"),
        ("train --from start.onnx --data data --out x.onnx --device gpu", "cuda:N"),
        ("export --from start.onnx --precision int8 --out x.onnx", "add --data"),
    ] {
        let output = command(folder.path(), arguments).output().unwrap();
        assert!(!output.status.success());
        assert!(stderr(&output).contains(expected), "{arguments}: {}", stderr(&output));
    }
}

#[test]
fn the_latency_of_the_eager_mode_is_measured() {
    let folder = tempfile::tempdir().unwrap();
    assert!(command(folder.path(), "init --network vgn --out vgn.onnx").status().unwrap().success());
    let output = command(folder.path(), "time --model vgn.onnx --calls 2").output().unwrap();
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(report["p50_ms"].as_f64().unwrap() > 0.0 && report["published_p50_ms"].as_f64().unwrap() > 0.0, "{report}");
    assert_eq!(report["calls"], 2);
}
