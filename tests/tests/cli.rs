//! The command line `grasp`.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use grasp::Volume;
use grasp_tests::scene::{CAMERA, camera, depth};
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

/// What the CLI reads of a depth camera, in every form: the images' names, and the flags that say how they were taken.
fn depth_files(folder: &Path) -> Vec<Vec<String>> {
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
    ]
}

/// With words between the file and the flags.
fn command<'a>(first: &[&'a str], more: &'a [String]) -> Vec<&'a str> {
    first.iter().copied().chain(more.iter().map(String::as_str)).collect()
}

#[test]
fn depth_images_are_read_in_every_form() {
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

    let flags = &depth_files(folder.path())[0];
    let output = run(&server, &["detect", &flags[0], "--intrinsics", &flags[3]]);
    assert!(text(&output.stderr).contains("depth images need --camera-from-task or --frame-from-camera"));
    let output = run(&server, &command(&["detect"], &[&flags[..1], &flags[2..]].concat()));
    assert!(text(&output.stderr).contains("holds 2 poses for 1 images"), "{}", text(&output.stderr));
}

#[test]
fn grasps_are_written_as_others_read_them() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let (folder, files) = files();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let forms = ["--csv", "--moveit", "--isaac"].map(|flag| (flag, path(flag)));
    let mut args = vec!["detect", files[0].to_str().unwrap(), "--frame-id", "base", "--collision", "flag"];
    args.extend(forms.iter().flat_map(|(flag, path)| [*flag, path]));
    assert!(run(&server, &args).status.success());
    let [csv, moveit, isaac] = forms.map(|(_, path)| std::fs::read_to_string(path).unwrap());
    let lines: Vec<&str> = csv.lines().collect();
    assert_eq!(lines.len(), 3);
    assert!(lines[0].starts_with("quality,width,x,y,z,qx,qy,qz,qw,"), "{csv}");
    assert!(lines[1..].iter().all(|line| line.split(',').count() == lines[0].split(',').count()));
    assert!(moveit.contains("- id: grasp_1\n") && moveit.contains(r#""frame_id":"base""#), "{moveit}");
    assert!(isaac.starts_with("format: isaac_grasp\n") && isaac.contains("  grasp_1:\n"), "{isaac}");
}

#[test]
fn what_was_seen_is_drawn_and_recorded() {
    let server = Server::run(&[TestModel::new("mirror").resolution(40)], &[]);
    let folder = tempfile::tempdir().unwrap();
    let flags = depth_files(folder.path()).remove(0);
    let view = |name: &str| {
        let path = folder.path().join(name);
        let output = run(&server, &command(&["view", "--threshold", "0.6", "--out", path.to_str().unwrap()], &flags));
        assert!(output.status.success(), "{}", text(&output.stderr));
        std::fs::read(path).unwrap()
    };
    let png = view("grasps.png");
    let mut reader = png::Decoder::new(std::io::Cursor::new(png)).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    // Coloured grippers before a grey surface.
    let is_coloured = |pixel: &[u8]| pixel.iter().max().zip(pixel.iter().min()).is_some_and(|(a, b)| a - b > 60);
    assert!(pixels.chunks_exact(3).filter(|pixel| is_coloured(pixel)).count() > 500);

    let recording = view("grasps.mcap");
    let messages: Vec<_> = mcap::MessageStream::new(&recording).unwrap().map(Result::unwrap).collect();
    let topics: Vec<_> = messages.iter().map(|message| message.channel.topic.as_str()).collect();
    assert_eq!(topics, ["/surface", "/grasps"]);
    let schemas = messages.iter().map(|message| message.channel.schema.as_ref().unwrap().name.clone());
    assert_eq!(schemas.collect::<Vec<_>>(), ["foxglove.PointCloud", "foxglove.SceneUpdate"]);
    let scene: Value = serde_json::from_slice(&messages[1].data).unwrap();
    assert!(scene["entities"].as_array().unwrap().len() > 5);
    assert_eq!(scene["entities"][0]["lines"][0]["points"].as_array().unwrap().len(), 8);
}

#[test]
fn a_file_is_watched() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let (_folder, files) = files();
    let watched = files[0].to_str().unwrap();
    let mut watch = Command::new(grasp())
        .args(["watch", watched, "--json", "--every", "0.02", "--count", "2"])
        .env("GRASPD_SERVER", server.grpc().to_string())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    // Again and again, for it may not have looked yet.
    while watch.try_wait().unwrap().is_none() {
        write(&files[0], npyz::Order::C, volume().values().iter().copied());
        std::thread::sleep(std::time::Duration::from_millis(100));
    }
    let output = watch.wait_with_output().unwrap();
    assert!(output.status.success());
    let answers = serde_json::Deserializer::from_slice(&output.stdout).into_iter::<Value>();
    assert_eq!(answers.map(|answer| answer.unwrap()["grasps"].as_array().unwrap().len()).collect::<Vec<_>>(), [2, 2]);
}
