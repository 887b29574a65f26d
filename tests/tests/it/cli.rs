//! The command line `grasp`.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use exr::prelude::WritableImage;
use foxglove::Decode;
use foxglove::messages::{PointCloud, SceneUpdate};
use grasp::Volume;
use grasp_client::{Client, DetectOptions, Error, Options};
use grasp_tests::scene::{CAMERA, TABLE, camera, camera_at, depth, seen};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, grasp};
use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use npyz::WriterBuilder;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;
use tokio_stream::StreamExt;

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[4, 5, 6], [11, 10, 9]])
}

pub(crate) fn write<T: npyz::AutoSerialize>(path: &Path, order: npyz::Order, values: impl IntoIterator<Item = T>) {
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

/// The volume in every file format that is supported.
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
    let checks = !["detect", "view"].contains(&args[0]) || args.contains(&"--collision");
    // The hand of the test models points into the table.
    let unchecked: &[&str] = if checks { &[] } else { &["--collision", "off"] };
    let mut command = Command::new(grasp());
    command.args(args).args(unchecked).env("GRASP_SERVER", server.grpc().to_string()).output().unwrap()
}

pub(crate) fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

#[test]
fn detect_gives_the_same_grasps_for_every_file_format() {
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
fn models_and_health_are_printed() {
    let server = Server::run(&[TestModel::new("mirror"), TestModel::new("other").version("2.1")], &[]);
    let output = run(&server, &["models"]);
    assert!(text(&output.stdout).contains("mirror") && text(&output.stdout).contains("2.1"));
    let models: Value = serde_json::from_slice(&run(&server, &["models", "--json"]).stdout).unwrap();
    assert_eq!(models[0]["name"], "mirror");
    assert_eq!(models[0]["resolution"], RESOLUTION);
    assert_eq!(models[0]["sha256"].as_str().unwrap().len(), 64);
    assert_eq!(models[0]["provenance"]["data"], "none");
    assert_eq!(models[0]["voxel_origin"], "corner");
    assert!(models[0].as_object().unwrap()["camera_azimuth"].is_null());
    let output = run(&server, &["health"]);
    assert!(output.status.success());
    assert_eq!(text(&output.stdout), "serving\n");
}

#[test]
fn errors_name_the_file_the_field_or_the_server() {
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
    assert!(error.contains("NotFound: options.model: `vgn` not found; available: mirror 1"), "{error}");
    let error = refused(&["detect", file, "--server", "127.0.0.1:1"]);
    assert!(error.contains("cannot connect to graspd at 127.0.0.1:1"), "{error}");
    let whole = folder.path().join("i64.npy");
    write(&whole, npyz::Order::C, (0..RESOLUTION.pow(3) as i64).map(|_| 1_i64));
    assert!(refused(&["detect", whole.to_str().unwrap()]).contains("use f64, f32, f16 or u8"));
    let error = refused(&["detect", file, "--voxel-size", "7.5"]);
    assert!(error.contains("volume.voxel_size is 7.5, must be 0.01875 m"), "{error}");
}

/// Flags that exclude each other, or that require another flag.
#[test]
fn invalid_combinations_of_flags_are_refused_before_files_are_read() {
    let refused = |flags: &str| {
        let output = Command::new(grasp()).arg("detect").args(flags.split(' ')).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{flags}");
        text(&output.stderr).to_owned()
    };
    assert!(refused("a.npy --camera-position 0,0,0 --intrinsics k.npy").contains("cannot be used with"));
    assert!(refused("a.npy --camera-position 0,0,0 --voxel-size 0.01").contains("cannot be used with"));
    assert!(refused("a.npy --camera-position 0,0").contains("must be 3 numbers separated by commas"));
    // Flags of the other kind of input are not ignored.
    for flags in ["--cloud-scale 0.001", "--frame-from-cloud pose.npy"] {
        assert!(refused(&format!("a.npy --intrinsics k.npy {flags}")).contains("cannot be used with"), "{flags}");
    }
    for flags in ["--depth-scale 0.001", "--frame-from-camera pose.npy", "--camera-from-task pose.npy", "--png"] {
        assert!(refused(&format!("a.npy --camera-position 0,0,0 {flags}")).contains("cannot be used with"), "{flags}");
    }
    assert!(refused("a.npy --frame-from-cloud pose.npy").contains("--camera-position <X,Y,Z>"));
    assert!(refused("a.npy --palm 0,0,0,1,1,1").contains("--gripper <OPENING,DEPTH,WIDTH,BREADTH>"));
    assert!(refused("a.npy --origin parent").contains("--parent-from-grasp <FILE|NUMBERS>"));
}

#[tokio::test]
async fn errors_of_the_client_library_name_the_field() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let client = Client::connect(server.grpc().to_string()).await.unwrap();
    let wrong =
        || Options { detect: DetectOptions { threshold: Some(7.0), ..DetectOptions::default() }, ..Options::default() };
    let unary = client.detect(&volume(), wrong()).await.unwrap_err();
    let volumes = tokio_stream::iter([(volume(), wrong())]);
    let streamed = client.detect_stream(volumes).await.unwrap().next().await.unwrap().unwrap_err();
    for error in [unary, streamed] {
        assert_eq!(error.field(), Some("options.threshold"), "{error:?}");
        assert!(matches!(error, Error::Refused { .. }) && error.to_string().contains("options.threshold is 7"));
    }
    let named =
        Options { detect: DetectOptions { model: "vgn".to_owned(), ..DetectOptions::default() }, ..Options::default() };
    assert_eq!(client.detect(&volume(), named).await.unwrap_err().field(), Some("options.model"));
}

pub(crate) fn pose(value: &Value) -> Isometry3<f64> {
    let numbers = |key: &str| -> Vec<f64> {
        value[key]
            .as_array()
            .unwrap_or_else(|| panic!("no {key} in {value}"))
            .iter()
            .filter_map(Value::as_f64)
            .collect()
    };
    let (position, rotation) = (numbers("position"), numbers("orientation_xyzw"));
    let rotation = Quaternion::new(rotation[3], rotation[0], rotation[1], rotation[2]);
    Isometry3::from_parts(
        Translation3::new(position[0], position[1], position[2]),
        UnitQuaternion::new_unchecked(rotation),
    )
}

#[test]
fn flags_set_the_hand_its_frame_the_pre_grasp_and_the_retreat() {
    let server = Server::run(&[TestModel::new("mirror").rotation([0.6, 0.0, 0.0, 0.8])], &[]);
    let (folder, files) = files();
    let file = files[0].to_str().unwrap();
    let best = |flags: &str| -> Value {
        let output =
            run(&server, &[&["detect", file, "--json"][..], &flags.split_whitespace().collect::<Vec<_>>()].concat());
        assert!(output.status.success(), "{flags}: {}", text(&output.stderr));
        serde_json::from_slice::<Value>(&output.stdout).unwrap()["grasps"][0].take()
    };
    let same = |a: Isometry3<f64>, b: Isometry3<f64>| (a.to_homogeneous() - b.to_homogeneous()).norm() < 1e-7;
    let own = best("");
    let back = |distance: f64| pose(&own) * Translation3::new(0.0, 0.0, -distance);
    assert!(same(pose(&own["pregrasp"]), back(0.05)) && same(pose(&own["retreat"]), back(0.1)), "{own}");

    let far = best("--pregrasp 0.12 --retreat 0.2");
    assert!(same(pose(&far["pregrasp"]), back(0.12)) && same(pose(&far["retreat"]), back(0.2)), "{far}");
    let up = best("--retreat-direction 0,-0,2");
    assert!(same(pose(&up["retreat"]), Translation3::new(0.0, 0.0, 0.1) * pose(&own)), "{up}");

    let parent_from_grasp = Isometry3::new(Vector3::new(0.0, 0.01, 0.0584), Vector3::new(0.0, 0.0, 0.785));
    let path = folder.path().join("hand.json");
    let matrix: Vec<f64> = parent_from_grasp.to_homogeneous().transpose().iter().copied().collect();
    std::fs::write(&path, serde_json::to_string(&matrix).unwrap()).unwrap();
    let parent = best(&format!("--origin parent --parent-from-grasp {}", path.display()));
    assert!(same(pose(&parent) * parent_from_grasp, pose(&own)), "{parent}");
    let output = run(&server, &["detect", file, "--parent-from-grasp", path.to_str().unwrap()]);
    assert!(text(&output.stderr).contains("--parent-from-grasp needs --origin parent"), "{}", text(&output.stderr));

    let hand = ["--gripper", "0.08,0.05,0.02,0.02", "--palm"];
    assert!(run(&server, &[&["detect", file][..], &hand, &["-0.03,-0.1,-0.1,0.03,0.1,0"]].concat()).status.success());
    let output = run(&server, &[&["detect", file][..], &hand, &["-0.03,-0.1,-0.1,0.03,0.1,0.06"]].concat());
    assert!(text(&output.stderr).contains("palm is 0.06 m, must be behind the fingertips"), "{}", text(&output.stderr));
}

#[test]
fn watch_continues_after_a_refusal_and_detects_changed_poses() {
    let server = Server::run(&[TestModel::new("mirror").resolution(40)], &[]);
    let folder = tempfile::tempdir().unwrap();
    depth_files(folder.path());
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let poses = |poses: [Isometry3<f64>; 2]| {
        let rows = |pose: &Isometry3<f64>| {
            pose.to_homogeneous().row_iter().map(|row| row.iter().copied().collect()).collect::<Vec<Vec<f64>>>()
        };
        // The rename replaces the file atomically, so that `watch` never reads an incomplete file.
        std::fs::write(path("new.json"), serde_json::json!(poses.iter().map(rows).collect::<Vec<_>>()).to_string())
            .unwrap();
        std::fs::rename(path("new.json"), path("poses.json")).unwrap();
    };
    let valid = [camera(30.0, -90.0), camera(45.0, 60.0)];
    // The cameras point away from the scene.
    poses(valid.map(|pose| Isometry3::rotation(Vector3::x() * std::f64::consts::PI) * pose));
    let mut watch = Command::new(grasp())
        .args(["watch", &path("m0.npy"), &path("m1.npy"), "--intrinsics", &path("k.npy"), "--collision", "off"])
        .args(["--camera-from-task", &path("poses.json"), "--json", "--threshold", "0.6"])
        .args(["--every", "0.02", "--count", "1"])
        .env("GRASP_SERVER", server.grpc().to_string())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut warning = String::new();
    BufReader::new(watch.stderr.as_mut().unwrap()).read_line(&mut warning).unwrap();
    assert!(warning.contains("views[0]: camera at") && warning.contains("waiting"), "{warning}");
    // The images stay the same; only the poses change.
    poses(valid);
    let output = watch.wait_with_output().unwrap();
    assert!(output.status.success());
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(!answer["grasps"].as_array().unwrap().is_empty());
}

#[test]
fn a_closed_stdout_is_not_an_error() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let (_folder, files) = files();
    let file = files[0].to_str().unwrap();
    for args in [&["models"][..], &["health", "--json"], &["detect", file], &["watch", file]] {
        let mut process = Command::new(grasp())
            .args(args)
            .env("GRASP_SERVER", server.grpc().to_string())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        drop(process.stdout.take());
        let output = process.wait_with_output().unwrap();
        assert!(output.status.success() && output.stderr.is_empty(), "{args:?}: {}", text(&output.stderr));
    }
}

#[test]
fn bench_reports_latency_throughput_and_refusals() {
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
    assert_eq!(alone["outcomes"].as_object().unwrap().len(), 1, "no request is refused: {alone}");
    let crowd = bench(&["--seconds", "0.5", "--callers", "8"]);
    assert!(crowd["outcomes"]["ResourceExhausted"]["calls"].as_u64().unwrap() > 0, "{crowd}");
    let steady = bench(&["--seconds", "0.5", "--rate", "20"]);
    assert!(steady["outcomes"]["answered"]["p50_seconds"].as_f64().unwrap() > 0.0, "{steady}");
}

#[test]
fn the_former_names_of_variables_work_with_a_warning() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let address = server.grpc().to_string();
    let models = |variables: &[(&str, &str)]| {
        let mut command = Command::new(grasp());
        command.arg("models").env_remove("GRASP_SERVER").env_remove("GRASPD_SERVER").envs(variables.iter().copied());
        command.output().unwrap()
    };
    let former = models(&[("GRASPD_SERVER", &address)]);
    assert!(former.status.success() && text(&former.stderr).contains("set GRASP_SERVER instead"), "{former:?}");
    let both = models(&[("GRASPD_SERVER", "127.0.0.1:1"), ("GRASP_SERVER", &address)]);
    assert!(both.status.success() && both.stderr.is_empty(), "{both:?}");
}

#[test]
fn help_is_in_groups_and_shells_get_completions() {
    let run = |args: &[&str]| Command::new(grasp()).args(args).output().unwrap();
    let help = run(&["detect", "-h"]);
    let headings: Vec<&str> =
        text(&help.stdout).lines().filter(|line| line.ends_with(':') && !line.starts_with(' ')).collect();
    assert_eq!(headings, ["Options:", "Input:", "Grasps:", "Output:", "Connection:"]);
    let script = run(&["completions", "bash"]);
    assert!(script.status.success() && text(&script.stdout).contains("--find-table"), "{script:?}");
}

#[tokio::test]
async fn ctrl_c_ends_a_bench_with_what_was_measured() {
    let (_folder, files) = files();
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let mut command = Command::new(grasp());
    command.args(["--server", &server.grpc().to_string(), "--json", "bench"]).arg(&files[0]).args(["--seconds", "600"]);
    let bench = command.stdout(Stdio::piped()).spawn().unwrap();
    server.wait_until("graspd_requests_total{code=\"OK\",model=\"mirror 1\"}", |count| count > 5.0).await;
    kill_process(Pid::from_child(&bench), Signal::INT).unwrap();
    let output = bench.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(report["outcomes"]["answered"]["calls"].as_u64().unwrap() > 0, "{report}");
}

/// Depth images of two cameras in each supported format: paths of the images, and flags with intrinsics and poses.
pub(crate) fn depth_files(folder: &Path) -> Vec<Vec<String>> {
    let path = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    let cameras = [camera(30.0, -90.0), camera(45.0, 60.0)];
    let shape = [CAMERA.height as u64, CAMERA.width as u64];
    for (index, pose) in cameras.iter().enumerate() {
        let metres = depth(pose);
        let millimetres: Vec<u16> = metres.iter().map(|metres| (metres * 1e3).round() as u16).collect();
        let file = |name: &str| File::create(path(&format!("{name}{index}"))).unwrap();
        let options = || npyz::WriteOptions::new().default_dtype();
        let rename = |name: &str, extension: &str| {
            std::fs::rename(path(&format!("{name}{index}")), path(&format!("{name}{index}.{extension}"))).unwrap();
        };
        let mut writer = options().shape(&shape).writer(file("m")).begin_nd().unwrap();
        writer.extend(metres).unwrap();
        writer.finish().unwrap();
        rename("m", "npy");
        let mut encoder = png::Encoder::new(file("mm"), CAMERA.width as u32, CAMERA.height as u32);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(png::BitDepth::Sixteen);
        let bytes: Vec<u8> = millimetres.iter().flat_map(|v| v.to_be_bytes()).collect();
        encoder.write_header().unwrap().write_image_data(&bytes).unwrap();
        rename("mm", "png");
        let metres = depth(pose);
        let channel = exr::prelude::SpecificChannels::build().with_channel("Z").with_pixel_fn(|at| {
            let exr::prelude::Vec2(u, v) = at;
            (metres[v * CAMERA.width + u],)
        });
        let size = (CAMERA.width, CAMERA.height);
        exr::prelude::Image::from_channels(size, channel).write().to_file(path(&format!("z{index}.exr"))).unwrap();
    }
    let k = [CAMERA.fx, 0.0, CAMERA.cx, 0.0, CAMERA.fy, CAMERA.cy, 0.0, 0.0, 1.0];
    std::fs::write(path("camera_info.json"), serde_json::json!({ "width": 160, "k": k }).to_string()).unwrap();
    let mut writer = npyz::WriteOptions::new().default_dtype().shape(&[3, 3]);
    writer = writer.order(npyz::Order::C);
    let mut writer = writer.writer(File::create(path("k.npy")).unwrap()).begin_nd().unwrap();
    writer.extend(k).unwrap();
    writer.finish().unwrap();
    let matrix = |pose: &Isometry3<f64>| -> Vec<f64> { pose.to_homogeneous().transpose().iter().copied().collect() };
    let mut writer = npyz::WriteOptions::new().default_dtype().shape(&[2, 4, 4]);
    writer = writer.order(npyz::Order::C);
    let mut writer = writer.writer(File::create(path("poses.npy")).unwrap()).begin_nd().unwrap();
    writer.extend(cameras.iter().flat_map(matrix)).unwrap();
    writer.finish().unwrap();
    let named = cameras.map(|pose| {
        let pose = pose.inverse();
        serde_json::json!({
            "position": pose.translation.vector.as_slice(), "orientation": pose.rotation.coords.as_slice(),
        })
    });
    std::fs::write(path("hand_eye.json"), serde_json::to_string(&named).unwrap()).unwrap();
    let flags = |images: [&str; 2], flags: [&str; 4]| -> Vec<String> {
        let flag = |(index, text): (usize, &&str)| if index % 2 == 1 { path(text) } else { (*text).to_owned() };
        images.map(path).into_iter().chain(flags.iter().enumerate().map(flag)).collect()
    };
    vec![
        flags(["m0.npy", "m1.npy"], ["--intrinsics", "k.npy", "--camera-from-task", "poses.npy"]),
        flags(["mm0.png", "mm1.png"], ["--intrinsics", "camera_info.json", "--frame-from-camera", "hand_eye.json"]),
        flags(["z0.exr", "z1.exr"], ["--intrinsics", "k.npy", "--camera-from-task", "poses.npy"]),
    ]
}

/// The arguments `first`, then `more`.
fn command<'a>(first: &[&'a str], more: &'a [String]) -> Vec<&'a str> {
    first.iter().copied().chain(more.iter().map(String::as_str)).collect()
}

#[test]
fn depth_images_are_read_in_every_format() {
    let server = Server::run(&[TestModel::new("mirror").resolution(40)], &[]);
    let folder = tempfile::tempdir().unwrap();
    let mut found = Vec::new();
    for flags in depth_files(folder.path()) {
        let output = run(&server, &command(&["detect", "--threshold", "0.6", "--json", "--frame-id", "base"], &flags));
        assert!(output.status.success(), "{flags:?}: {}", text(&output.stderr));
        let reply: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(reply["frame_id"], "base");
        assert!(reply["latency_seconds"]["fusion"].as_f64().unwrap() > 0.0);
        found.push(reply["grasps"].as_array().unwrap().len());
    }
    assert!(found[0] > 5 && found[0].abs_diff(found[1]) <= found[0] / 4, "{found:?}");
    assert_eq!(found[0], found[2], "of the same metres");

    let [in_metres, in_millimetres, _] = &depth_files(folder.path())[..] else { panic!("three formats") };
    let as_png = run(&server, &command(&["detect", "--threshold", "0.6", "--json", "--png"], in_millimetres));
    let reply: Value = serde_json::from_slice(&as_png.stdout).unwrap_or_else(|_| panic!("{as_png:?}"));
    assert_eq!(reply["grasps"].as_array().unwrap().len(), found[1]);
    let output = run(&server, &command(&["detect", "--png"], in_metres));
    assert!(text(&output.stderr).contains("--png needs depths in millimetres"), "{output:?}");
    let colour = folder.path().join("colour.exr");
    exr::prelude::write_rgb_file(&colour, CAMERA.width, CAMERA.height, |_, _| (0.5_f32, 0.4_f32, 0.3_f32)).unwrap();
    let output = run(&server, &["detect", colour.to_str().unwrap(), "--intrinsics", &in_metres[3], "--find-table"]);
    let error = text(&output.stderr);
    assert!(error.contains("colour.exr") && error.contains("channels in the file: B, G, R"), "{error}");

    let flags = &depth_files(folder.path())[0];
    let output = run(&server, &["detect", &flags[0], "--intrinsics", &flags[3]]);
    assert!(text(&output.stderr).contains("depth images need --camera-from-task or --frame-from-camera"));
    let output = run(&server, &command(&["detect"], &[&flags[..1], &flags[2..]].concat()));
    assert!(text(&output.stderr).contains("2 poses in the file for 1 image;"), "{}", text(&output.stderr));
}

/// Point clouds of the same cameras: in the frames of the cameras, and in the task frame.
fn points(task_from_camera: &Isometry3<f64>) -> Vec<Point3<f64>> {
    let point = |(index, depth): (usize, f32)| {
        let (u, v) = ((index % CAMERA.width) as f64, (index / CAMERA.width) as f64);
        Point3::new((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0) * f64::from(depth)
    };
    depth(&task_from_camera.inverse()).into_iter().enumerate().map(point).collect()
}

pub(crate) fn cloud_files(folder: &Path) -> [Vec<String>; 2] {
    let path = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    let cameras = [camera(30.0, -90.0), camera(45.0, 60.0)].map(|pose| pose.inverse());
    let [mut own, mut placed] = [["--camera-position", "0,0,0"].map(str::to_owned).to_vec(), Vec::new()];
    for (index, task_from_camera) in cameras.iter().enumerate() {
        let points = points(task_from_camera);
        let shape = [points.len() as u64, 3];
        own.push(path(&format!("own{index}.npy")));
        let mut writer = npyz::WriteOptions::new().default_dtype().shape(&shape);
        writer = writer.order(npyz::Order::C);
        let mut writer = writer.writer(File::create(&own[2 + index]).unwrap()).begin_nd().unwrap();
        writer
            .extend(points.iter().flat_map(|point| point.coords.iter().map(|&c| c as f32).collect::<Vec<_>>()))
            .unwrap();
        writer.finish().unwrap();

        // The memory order in which NumPy saves `np.stack([x, y, z]).T`.
        let name = path(&format!("placed{index}.npz"));
        let mut archive = npyz::npz::NpzWriter::create(&name).unwrap();
        for (array, shape) in [("colors", [1, 3]), ("points", shape)] {
            let writer = archive.array(array, Default::default()).unwrap().default_dtype();
            let mut writer = writer.order(npyz::Order::Fortran).shape(&shape).begin_nd().unwrap();
            let coordinate = |axis: usize| points.iter().map(move |point| (task_from_camera * point)[axis]);
            writer.extend((0..3).flat_map(coordinate).take(3 * shape[0] as usize)).unwrap();
            writer.finish().unwrap();
        }
        let eye = task_from_camera.translation;
        placed.extend([name, "--camera-position".to_owned(), format!("{},{},{}", eye.x, eye.y, eye.z)]);
    }
    let matrices = cameras.map(|pose| pose.to_homogeneous().transpose().as_slice().to_vec());
    std::fs::write(path("poses.json"), serde_json::to_string(&matrices).unwrap()).unwrap();
    own.extend(["--frame-from-cloud".to_owned(), path("poses.json")]);
    [own, placed]
}

#[test]
fn point_clouds_are_read_in_every_format() {
    let server = Server::run(&[TestModel::new("mirror").resolution(40)], &[]);
    let folder = tempfile::tempdir().unwrap();
    let clouds = cloud_files(folder.path());
    let found = clouds.each_ref().map(|flags| {
        let output = run(&server, &command(&["detect", "--threshold", "0.6", "--json", "--frame-id", "base"], flags));
        assert!(output.status.success(), "{flags:?}: {}", text(&output.stderr));
        let reply: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(reply["frame_id"], "base");
        assert!(reply["latency_seconds"]["fusion"].as_f64().unwrap() > 0.0);
        reply["grasps"].as_array().unwrap().len()
    });
    // Points on the border between two pixels may be assigned to either.
    assert!(found[0] > 5 && found[0].abs_diff(found[1]) <= 1 + found[0] / 4, "{found:?}");

    let [own, _] = &clouds;
    let table = run(&server, &["table", &own[2], "--camera-position", "0,0,0", "--json"]);
    let table: Value = serde_json::from_slice(&table.stdout).unwrap_or_else(|_| panic!("{table:?}"));
    let placed = &["detect", &own[2], "--camera-position", "0,0,0", "--find-table", "--threshold", "0.6", "--json"];
    let placed: Value = serde_json::from_slice(&run(&server, placed).stdout).unwrap();
    assert_eq!(placed["table"]["workspace"]["position"], table["workspace"]["position"]);
    let distance = camera(30.0, -90.0).inverse().translation.z - TABLE;
    assert!((table["distance"].as_f64().unwrap() - distance).abs() < 0.004, "{table}, not {distance}");

    let refused = |args: &[&str]| {
        let output = run(&server, args);
        assert_eq!(output.status.code(), Some(1), "{args:?}");
        text(&output.stderr).to_owned()
    };
    let (cloud, poses) = (own[2].as_str(), own[5].as_str());
    let origin = ["--camera-position", "0,0,0"];
    let error = refused(&["detect", cloud]);
    assert!(error.contains("a volume must be N×N×N; for a point cloud add --camera-position"), "{error}");
    let error = refused(&[&["detect", cloud][..], &origin, &["--frame-from-cloud", poses]].concat());
    assert!(error.contains("2 poses in the file for 1 point cloud;"), "{error}");
    let error = refused(&[&["detect", cloud][..], &origin, &origin].concat());
    assert!(error.contains("is given 2 times for 1 point cloud;"), "{error}");
    let error = refused(&[&["detect", cloud][..], &["--camera-position", "0.1,0.1,0.1"]].concat());
    assert!(error.contains("views[0]") && error.contains("check camera_position"), "{error}");
    let (_folder, volumes) = files();
    let error = refused(&[&["detect", volumes[0].to_str().unwrap()][..], &origin].concat());
    assert!(error.contains("a point cloud must be N×3"), "{error}");
}

#[test]
fn point_clouds_of_pcl_and_of_meshes_are_read() {
    let server = Server::run(&[TestModel::new("mirror").resolution(40)], &[]);
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let points: Vec<[f32; 3]> = points(&camera(30.0, -90.0).inverse())
        .iter()
        .map(|point| [point.x as f32, point.y as f32, point.z as f32])
        .collect();
    let count = points.len();
    let lines: String = points.iter().map(|[x, y, z]| format!("7 {x} {y} {z}\n")).collect();
    let header = "# .PCD v0.7\nVERSION 0.7\nFIELDS label x y z\nSIZE 4 4 4 4\nTYPE U F F F\nCOUNT 1 1 1 1\n";
    let size = format!("WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA ascii\n");
    std::fs::write(path("cloud.pcd"), format!("{header}{size}{lines}")).unwrap();
    let header = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {count}\nproperty float x\nproperty float y\n\
         property float z\nproperty uchar red\nend_header\n"
    );
    let vertices = points.iter().flat_map(|point| point.iter().flat_map(|c| c.to_le_bytes()).chain([9]));
    std::fs::write(path("cloud.ply"), header.into_bytes().into_iter().chain(vertices).collect::<Vec<_>>()).unwrap();
    let mut writer = npyz::WriteOptions::new().default_dtype().shape(&[count as u64, 3]);
    writer = writer.order(npyz::Order::C);
    let mut writer = writer.writer(File::create(path("cloud.npy")).unwrap()).begin_nd().unwrap();
    writer.extend(points.iter().flatten().copied()).unwrap();
    writer.finish().unwrap();

    let pose = camera(30.0, -90.0).inverse();
    let [x, y, z] = pose.translation.vector.into();
    let [qx, qy, qz, qw] = pose.rotation.coords.into();
    let pose = format!("{x},{y},{z},{qx},{qy},{qz},{qw}");
    let found = ["cloud.npy", "cloud.pcd", "cloud.ply"].map(|name| {
        let args = ["--camera-position", "0,0,0", "--frame-from-cloud", &pose, "--threshold", "0.6", "--json"];
        let output = run(&server, &[&["detect", &path(name)][..], &args].concat());
        let reply: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
        reply["grasps"].clone()
    });
    assert!(found[0].as_array().is_some_and(|grasps| !grasps.is_empty()));
    assert!(found[1] == found[0] && found[2] == found[0]);

    // A file of the wrong kind is named as such.
    let refused = |args: &[&str]| text(&run(&server, &[&["detect"][..], args].concat()).stderr).to_owned();
    assert!(refused(&[&path("cloud.ply")]).contains("this is a point cloud; give --camera-position"));
    let error = refused(&[&path("cloud.pcd"), "--intrinsics", "540,540,320,240", "--find-table"]);
    assert!(error.contains("give --camera-position instead of --intrinsics"), "{error}");
    std::fs::write(path("image"), b"\x89PNG\r\n\x1a\n").unwrap();
    assert!(refused(&[&path("image")]).contains("this is an image; for a depth image give --intrinsics"));
    std::fs::write(path("text"), "hello").unwrap();
    assert!(refused(&[&path("text")]).contains("not a file of a known format"));
}

#[test]
fn grasps_are_exported_as_csv_moveit_and_isaac_files() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let (folder, files) = files();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let formats = ["--csv", "--moveit", "--isaac"].map(|flag| (flag, path(flag)));
    let mut args = vec!["detect", files[0].to_str().unwrap(), "--frame-id", "base", "--collision", "flag"];
    args.extend(formats.iter().flat_map(|(flag, path)| [*flag, path]));
    assert!(run(&server, &args).status.success());
    let [csv, moveit, isaac] = formats.map(|(_, path)| std::fs::read_to_string(path).unwrap());
    let lines: Vec<&str> = csv.lines().collect();
    assert_eq!(lines.len(), 3);
    assert!(lines[0].starts_with("quality,width,x,y,z,qx,qy,qz,qw,"), "{csv}");
    assert!(lines[0].ends_with(",collides,retreat_x,retreat_y,retreat_z,object,open_width"), "{csv}");
    assert!(lines[1..].iter().all(|line| line.split(',').count() == lines[0].split(',').count()));
    assert!(moveit.contains("- id: grasp_1\n") && moveit.contains(r#""frame_id":"base""#), "{moveit}");
    assert!(isaac.starts_with("format: isaac_grasp\n") && isaac.contains("  grasp_1:\n"), "{isaac}");
}

#[test]
fn view_writes_pictures_and_recordings() {
    let server = Server::run(&[TestModel::new("mirror").resolution(40)], &[]);
    let folder = tempfile::tempdir().unwrap();
    let images = depth_files(folder.path()).remove(0);
    let [clouds, _] = cloud_files(folder.path());
    let view = |name: &str, flags: &[String]| {
        let path = folder.path().join(name);
        let output = run(&server, &command(&["view", "--threshold", "0.6", "--out", path.to_str().unwrap()], flags));
        assert!(output.status.success(), "{}", text(&output.stderr));
        std::fs::read(path).unwrap()
    };
    for flags in [&images, &clouds] {
        let png = view("grasps.png", flags);
        let mut reader = png::Decoder::new(std::io::Cursor::new(png)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        let count = |is: fn([i16; 3]) -> bool| {
            pixels.as_chunks().0.iter().filter(|pixel: &&[u8; 3]| is(pixel.map(i16::from))).count()
        };
        // Grippers are yellow or green, the surface is grey; only the x axis is red and only the z axis is blue.
        assert!(count(|[red, green, blue]| green - blue > 60 && green + 60 > red) > 500);
        assert!(count(|[red, green, blue]| red - green > 80 && red - blue > 80) > 100);
        assert!(count(|[red, green, blue]| blue - red > 80 && blue - green > 60) > 100);
    }

    let recording = view("grasps.mcap", &images);
    let messages: Vec<_> = mcap::MessageStream::new(&recording).unwrap().map(Result::unwrap).collect();
    let topics: Vec<_> = messages.iter().map(|message| message.channel.topic.as_str()).collect();
    assert_eq!(topics, ["/cloud", "/surface", "/workspace", "/grasps", "/hands"]);
    let schemas = messages.iter().map(|message| message.channel.schema.as_ref().unwrap().name.clone());
    let [cloud, scene] = ["foxglove.PointCloud", "foxglove.SceneUpdate"];
    assert_eq!(schemas.collect::<Vec<_>>(), [cloud, cloud, scene, scene, cloud]);
    let clouds = [0, 1, 4].map(|index: usize| PointCloud::decode(&*messages[index].data).unwrap());
    assert!(clouds.iter().all(|cloud| cloud.data.len() > 1000 * cloud.point_stride as usize));
    let scene = SceneUpdate::decode(&*messages[3].data).unwrap();
    assert!(scene.entities.len() > 5);
    assert_eq!(scene.entities[0].lines[0].points.len(), 8);
}

#[test]
fn watch_detects_again_when_the_file_changes() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let (_folder, files) = files();
    let watched = files[0].to_str().unwrap();
    let mut watch = Command::new(grasp())
        .args(["watch", watched, "--json", "--every", "0.02", "--count", "2"])
        .env("GRASP_SERVER", server.grpc().to_string())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    // Repeated writes, because `watch` may not have read the file yet.
    while watch.try_wait().unwrap().is_none() {
        write(&files[0], npyz::Order::C, volume().values().iter().copied());
        std::thread::sleep(std::time::Duration::from_millis(100));
    }
    let output = watch.wait_with_output().unwrap();
    assert!(output.status.success());
    let answers = serde_json::Deserializer::from_slice(&output.stdout).into_iter::<Value>();
    assert_eq!(answers.map(|answer| answer.unwrap()["grasps"].as_array().unwrap().len()).collect::<Vec<_>>(), [2, 2]);
}

#[tokio::test]
async fn one_depth_image_and_its_intrinsics_suffice() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let camera = camera(35.0, -90.0);
    // In tenths of a millimetre.
    let tenths: Vec<u16> = depth(&camera).iter().map(|metres| (metres * 1e4).round() as u16).collect();
    let image = png::Encoder::new(File::create(path("depth.png")).unwrap(), CAMERA.width as u32, CAMERA.height as u32);
    let mut image = png_header(image, png::ColorType::Grayscale, png::BitDepth::Sixteen);
    image.write_image_data(&tenths.iter().flat_map(|depth| depth.to_be_bytes()).collect::<Vec<_>>()).unwrap();
    drop(image);
    let color = png::Encoder::new(File::create(path("color.png")).unwrap(), CAMERA.width as u32, CAMERA.height as u32);
    let mut color = png_header(color, png::ColorType::Rgb, png::BitDepth::Eight);
    color.write_image_data(&vec![30; 3 * CAMERA.width * CAMERA.height]).unwrap();
    drop(color);
    let k = format!("{},{},{},{}", CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy);
    let given = [&*path("depth.png"), "--intrinsics", &k, "--depth-scale", "0.0001"].map(str::to_owned);
    let with = |command: &str, rest: &[&str]| {
        let args = [command].into_iter().chain(given.iter().map(String::as_str)).chain(rest.iter().copied());
        run(&server, &args.collect::<Vec<_>>())
    };

    let found = with("table", &["--out", &path("corner.json"), "--picture", &path("table.png"), "--json"]);
    let table: Value = serde_json::from_slice(&found.stdout).unwrap_or_else(|_| panic!("{found:?}"));
    assert!((table["angle"].as_f64().unwrap().to_degrees() - 35.0).abs() < 1.0, "{table}");
    assert!(std::fs::read(path("table.png")).unwrap().starts_with(b"\x89PNG"));

    let found = with("detect", &["--workspace", &path("corner.json"), "--threshold", "0.6", "--json"]);
    let of_file: Value = serde_json::from_slice(&found.stdout).unwrap_or_else(|_| panic!("{found:?}"));
    let found = with("detect", &["--find-table", "--threshold", "0.6", "--json"]);
    let of_server: Value = serde_json::from_slice(&found.stdout).unwrap_or_else(|_| panic!("{found:?}"));
    assert_eq!(of_server["table"]["workspace"]["position"], table["workspace"]["position"]);
    let qualities = |found: &Value| -> Vec<Value> {
        found["grasps"].as_array().unwrap().iter().map(|grasp| grasp["quality"].clone()).collect()
    };
    assert!(!qualities(&of_file).is_empty() && !qualities(&of_server).is_empty());
    assert_eq!((&of_server["table"]["objects"], &table["objects"]), (&Value::from(1), &Value::from(1)));
    assert!(of_server["grasps"].as_array().unwrap().iter().all(|grasp| grasp["object"] == 1), "{of_server}");

    let color = path("color.png");
    let drawn = with("view", &["--find-table", "--threshold", "0.6", "--color", &color, "--out", &path("over.png")]);
    assert!(drawn.status.success(), "{drawn:?}");
    let mut picture = png::Decoder::new(BufReader::new(File::open(path("over.png")).unwrap())).read_info().unwrap();
    let mut pixels = vec![0; picture.output_buffer_size().unwrap()];
    picture.next_frame(&mut pixels).unwrap();
    let background = pixels.as_chunks::<3>().0.iter().filter(|pixel| **pixel == [30; 3]).count();
    assert!((1000..CAMERA.width * CAMERA.height - 100).contains(&background), "{background} pixels of the image");

    let without = with("detect", &[]);
    assert!(String::from_utf8_lossy(&without.stderr).contains("`grasp table` finds"), "{without:?}");
}

/// A PNG with 16 bits per pixel.
fn write_png(path: &str, values: impl Iterator<Item = u16>) {
    let encoder = png::Encoder::new(File::create(path).unwrap(), CAMERA.width as u32, CAMERA.height as u32);
    let mut image = png_header(encoder, png::ColorType::Grayscale, png::BitDepth::Sixteen);
    image.write_image_data(&values.flat_map(u16::to_be_bytes).collect::<Vec<_>>()).unwrap();
}

#[test]
fn files_of_other_tools_are_read_and_contradictions_refused() {
    let server = Server::run(&[TestModel::new("mirror").resolution(40)], &[]);
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let camera = camera(35.0, -90.0);
    let metres = depth(&camera);
    write_png(&path("mm.png"), metres.iter().map(|metres| (metres * 1e3).round() as u16));
    write_png(&path("half_mm.png"), metres.iter().map(|metres| 2 * (metres * 1e3).round() as u16));
    let (fx, cx, cy) = (CAMERA.fx, CAMERA.cx, CAMERA.cy);
    let k = format!("{fx},{fx},{cx},{cy}");
    let file = |name: &str, content: String| {
        std::fs::write(path(name), content).unwrap();
        path(name)
    };
    let rows = camera.inverse().to_homogeneous();
    let pose = file(
        "pose.txt",
        rows.row_iter().map(|row| row.iter().map(|c| format!("{c} ")).collect::<String>() + "\n").collect(),
    );
    let Translation3 { vector: at } = camera.inverse().translation;
    let turn = camera.inverse().rotation;
    let stamped = file(
        "stamped.yaml",
        format!(
            "header: {{frame_id: base}}\nchild_frame_id: camera\ntransform:\n  translation: {{x: {}, y: {}, z: {}}}\n  rotation: {{x: {}, y: {}, z: {}, w: {}}}\n",
            at.x, at.y, at.z, turn.i, turn.j, turn.k, turn.w
        ),
    );
    let detect = |image: &str, intrinsics: &str, pose: &str, more: &[&str]| {
        let image = path(image);
        let args =
            ["detect", &image, "--intrinsics", intrinsics, "--frame-from-camera", pose, "--threshold", "0.6", "--json"];
        run(&server, &[&args, more].concat())
    };
    let qualities = |output: Output| -> Vec<Value> {
        let reply: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
        reply["grasps"].as_array().unwrap().iter().map(|grasp| grasp["quality"].clone()).collect()
    };
    let expected = qualities(detect("mm.png", &k, &stamped, &[]));
    assert!(!expected.is_empty());

    let scaled =
        file("scaled.json", format!(r#"{{"fx": {fx}, "fy": {fx}, "cx": {cx}, "cy": {cy}, "depth_scale": 0.0005}}"#));
    assert_eq!(qualities(detect("half_mm.png", &scaled, &pose, &[])), expected);
    let opencv = file(
        "opencv.yaml",
        format!(
            "%YAML:1.0\n---\nimage_width: 160\nimage_height: 120\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ {fx}, 0., {cx}, 0., {fx}, {cy}, 0., 0., 1. ]\n"
        ),
    );
    assert_eq!(qualities(detect("mm.png", &opencv, &pose, &[])), expected);

    let shape = [CAMERA.height as u64, CAMERA.width as u64];
    let whole = npyz::WriteOptions::new().default_dtype().shape(&shape);
    let mut whole = whole.writer(File::create(path("i32.npy")).unwrap()).begin_nd().unwrap();
    whole.extend(metres.iter().map(|metres| (metres * 1e3).round() as i32)).unwrap();
    whole.finish().unwrap();
    assert_eq!(qualities(detect("i32.npy", &k, &pose, &[])), expected);

    let refused = |output: Output, expected: &str| {
        let error = text(&output.stderr);
        assert!(!output.status.success() && error.contains(expected), "{expected}: {error}");
    };
    let other =
        file("other.json", format!(r#"{{"width": 320, "height": 240, "K": [{fx}, 0, {cx}, 0, {fx}, {cy}, 0, 0, 1]}}"#));
    refused(
        detect("mm.png", &other, &pose, &[]),
        "of images of 320 × 240 pixels, the image has 160 × 120; if the image was scaled",
    );
    refused(
        detect("half_mm.png", &scaled, &pose, &["--depth-scale", "0.001"]),
        "--depth-scale is 0.001 m, but the file",
    );
    refused(detect("mm.png", &k, &pose, &["--depth-scale", "1000"]), "did you mean 0.001?");
    std::fs::write(path("depth.jpg"), b"\xff\xd8\xff\xe0\0\x10JFIF").unwrap();
    refused(detect("depth.jpg", &k, &pose, &[]), "depth.jpg: a JPEG file");
    let fisheye = file(
        "fisheye.json",
        format!(
            r#"{{"K": [{fx}, 0, {cx}, 0, {fx}, {cy}, 0, 0, 1], "D": [0.1, 0.1], "distortion_model": "double_sphere"}}"#
        ),
    );
    refused(detect("mm.png", &fisheye, &pose, &[]), "double_sphere");

    let lens = file(
        "lens.json",
        format!(
            r#"{{"K": [{fx}, 0, {cx}, 0, {fx}, {cy}, 0, 0, 1], "D": [0.1, 0, 0, 0, 0], "mm_per_unit": 0.5,
                 "P": [{fx}, 0, {cx}, 0, 0, {fx}, {cy}, 0, 0, 0, 1, 0]}}"#
        ),
    );
    let noted = detect("mm.png", &lens, &pose, &[]);
    for note in [
        "lens.json: images of this camera are rectified with plumb_bob (0.1, 0, 0, 0, 0)",
        "add --rectified",
        "lens.json: `mm_per_unit` is 0.5, which is not used",
    ] {
        assert!(text(&noted.stderr).contains(note), "{note}: {noted:?}");
    }
    assert_eq!(qualities(detect("mm.png", &lens, &pose, &["--rectified"])), expected);
    refused(detect("mm.png", "300,300,160", &pose, &[]), "it has 3 numbers; must be a file, the numbers FX,FY,CX,CY");
    refused(detect("mm.png", &k, "0,0", &[]), "it has 2 numbers; must be a file, or the numbers X,Y,Z or");
    refused(detect("mm.png", &k, "0,-250,620", &[]), "of its pose, or of the workspace, looks like millimetres");
    refused(detect("mm.png", &k, &pose, &["--depth-scale", "-1"]), "must be above 0");
    refused(detect("mm.png", "-135,135,80,60", &pose, &[]), "views[0].camera.k is");
    refused(detect("mm.png", &k, &pose, &["--labels", &path("depth.jpg")]), "changes the values; save PNG or .npy");
    write_png(&path("mask.png"), metres.iter().map(|_| 255));
    let mask = path("mask.png");
    let labels = "--objects 1,2: not in --labels; labels there: 255";
    refused(detect("mm.png", &k, &pose, &["--labels", &mask, "--objects", "1,2"]), labels);
    let whole = npyz::WriteOptions::new().default_dtype().shape(&shape);
    let mut whole = whole.writer(File::create(path("f32.npy")).unwrap()).begin_nd().unwrap();
    whole.extend(metres.iter().map(|metres| metres * 1e3)).unwrap();
    whole.finish().unwrap();
    refused(detect("f32.npy", &k, &pose, &[]), "look like millimetres: ");
    refused(detect("f32.npy", &k, &pose, &[]), "(here: --depth-scale 0.001)");
    let given = detect("f32.npy", &k, &pose, &["--depth-scale", "0.1"]);
    refused(given, "farther than depth cameras measure: check the depth unit (here: --depth-scale is 0.1)");
}

#[tokio::test]
async fn objects_are_chosen_by_their_labels_and_own_grasps_are_scored() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let boxes = [0.15, 0.45].map(|x| [[x - 0.02, 0.11, TABLE], [x + 0.02, 0.19, 0.15]]);
    let pixels = seen(&boxes, &CAMERA, &camera_at(Point3::new(0.3, 0.15, 0.08), 0.7, 35.0, -90.0));
    let write = |name: &str, bits: png::BitDepth, bytes: Vec<u8>| {
        let file = File::create(path(name)).unwrap();
        let encoder = png::Encoder::new(file, CAMERA.width as u32, CAMERA.height as u32);
        png_header(encoder, png::ColorType::Grayscale, bits).write_image_data(&bytes).unwrap();
    };
    let millimetres = pixels.iter().flat_map(|(depth, _)| ((depth * 1e3).round() as u16).to_be_bytes());
    write("depth.png", png::BitDepth::Sixteen, millimetres.collect());
    write("mask.png", png::BitDepth::Eight, pixels.iter().map(|&(_, label)| label as u8).collect());
    let k = format!("{},{},{},{}", CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy);
    let given =
        [&*path("depth.png"), "--intrinsics", &k, "--find-table", "--labels", &path("mask.png")].map(str::to_owned);
    let with = |command: &str, rest: &[&str]| {
        let args = [command].into_iter().chain(given.iter().map(String::as_str)).chain(rest.iter().copied());
        let output = run(&server, &args.collect::<Vec<_>>());
        assert!(output.status.success(), "{output:?}");
        serde_json::from_slice::<Value>(&output.stdout).unwrap()
    };
    let large = ["--size", "0.7,0.4", "--model", "shaf", "--json"];
    let all = with("detect", &large);
    let objects = |found: &Value| -> Vec<u64> {
        found["grasps"].as_array().unwrap().iter().filter_map(|grasp| grasp["object"].as_u64()).collect()
    };
    assert!(objects(&all).contains(&1) && objects(&all).contains(&2), "{all}");
    let second = with("detect", &[&large[..], &["--objects", "2", "--max-grasps-per-object", "3"]].concat());
    assert_eq!(objects(&second), [2; 3]);

    let poses =
        all["grasps"].as_array().unwrap().iter().map(
            |grasp| serde_json::json!({ "position": grasp["position"], "orientation": grasp["orientation_xyzw"] }),
        );
    let poses: Vec<Value> = poses.take(2).collect();
    std::fs::write(path("mine.json"), Value::from(poses).to_string()).unwrap();
    let mine = path("mine.json");
    let scores = with("score", &["--grasps", &mine, "--collision", "flag", "--threshold", "0.6", "--json"]);
    let scores = scores["scores"].as_array().unwrap();
    assert_eq!(scores.len(), 2);
    assert!(scores.iter().all(|score| score["quality"].as_f64().unwrap() >= 0.0), "{scores:?}");
    let table = [&given[..], &["--grasps".to_owned(), mine]].concat();
    let printed = run(&server, &command(&["score"], &table));
    for expected in ["violations", "m from the camera"] {
        assert!(text(&printed.stdout).contains(expected), "{expected}: {printed:?}");
    }
}

fn png_header(
    mut encoder: png::Encoder<'static, File>,
    color: png::ColorType,
    bits: png::BitDepth,
) -> png::Writer<File> {
    encoder.set_color(color);
    encoder.set_depth(bits);
    encoder.write_header().unwrap()
}
