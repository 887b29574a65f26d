//! Models run on the requested provider and precision, which the list of models and the metrics report.

use std::path::Path;
use std::process::Command;

use grasp::Volume;
use grasp_client::Options;
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, graspd};
use nalgebra::Isometry3;

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[4, 5, 6], [11, 10, 9]])
}

/// The exit code and stderr of a graspd that must fail to start.
fn refused(model: &TestModel, args: &[&str]) -> (Option<i32>, String) {
    let models = tempfile::tempdir().unwrap();
    model.write(models.path());
    let mut command = Command::new(graspd());
    command.arg("--models").arg(models.path()).args(["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"]).args(args);
    let output = command.output().unwrap();
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[tokio::test]
async fn the_list_of_models_and_the_metric_report_the_provider() {
    for requested in ["auto", "cpu"] {
        let server = Server::run(&[TestModel::new("blobs")], &["--provider", requested, "--workers", "2"]);
        let client = server.client().await;
        let model = client.list_models().await.unwrap().remove(0);
        assert!(requested == "auto" || (&*model.provider, &*model.precision) == ("cpu", "fp32"), "{model:?}");
        let (provider, precision, sha256) = (&model.provider, &model.precision, &model.sha256);
        let labels = format!(r#"model="blobs 1",precision="{precision}",provider="{provider}",sha256="{sha256}""#);
        assert_eq!(server.metric(&format!("graspd_model_info{{{labels}}}")), 1.0);
        let detection = client.detect(&volume(), Options::default()).await.unwrap();
        assert_eq!(detection.grasps.len(), 2, "{requested} ({provider} {precision}) gives the grasps of the model");
    }
}

/// The library that `make` downloads on x86-64 Linux has OpenVINO.
#[tokio::test]
#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
async fn openvino_runs_when_requested() {
    let server = Server::run(&[TestModel::new("blobs")], &["--provider", "openvino", "--precision", "fp32"]);
    let client = server.client().await;
    let model = client.list_models().await.unwrap().remove(0);
    assert_eq!((&*model.provider, &*model.precision), ("openvino", "fp32"));
    assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 2);
}

#[test]
#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
fn a_model_has_two_sessions_with_openvino_and_one_with_cpu_by_default() {
    for (provider, sessions) in [("openvino", std::thread::available_parallelism().unwrap().get().min(2)), ("cpu", 1)] {
        let server = Server::run(&[TestModel::new("blobs")], &["--provider", provider]);
        let threads = std::fs::read_dir(format!("/proc/{}/task", server.id())).unwrap();
        let names = threads.filter_map(|thread| std::fs::read_to_string(thread.unwrap().path().join("comm")).ok());
        assert_eq!(names.filter(|name| name.starts_with("blobs ")).count(), sessions, "{provider}");
    }
}

/// By default OpenVINO binds the threads of every session to the same CPUs while it runs.
#[tokio::test]
#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
async fn sessions_of_openvino_are_not_bound_to_the_same_cpu() {
    let server = Server::run(&[TestModel::new("blobs")], &["--provider", "openvino"]);
    let client = server.client().await;
    let cpus = |status: &Path| {
        let status = std::fs::read_to_string(status).ok()?;
        status.lines().find(|line| line.starts_with("Cpus_allowed_list")).map(str::to_owned)
    };
    let all = cpus(Path::new("/proc/self/status")).unwrap();
    for _ in 0..100 {
        let detection = tokio::spawn({
            let client = client.clone();
            async move { client.detect(&volume(), Options::default()).await }
        });
        while !detection.is_finished() {
            for thread in std::fs::read_dir(format!("/proc/{}/task", server.id())).unwrap() {
                let status = thread.unwrap().path().join("status");
                // A thread may have ended meanwhile.
                assert_eq!(cpus(&status).unwrap_or_else(|| all.clone()), all, "{}", status.display());
            }
            tokio::task::yield_now().await;
        }
        detection.await.unwrap().unwrap();
    }
}

/// Only processors with bf16 instructions exercise the check of the outputs.
#[tokio::test]
async fn backends_with_other_outputs_are_skipped_by_auto_and_refused_on_request() {
    let model = TestModel::new("blobs").needs_fp32();
    let server = Server::run(std::slice::from_ref(&model), &[]);
    let client = server.client().await;
    assert_eq!(client.list_models().await.unwrap()[0].precision, "fp32");
    assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 2);

    let (code, stderr) = refused(&model, &["--provider", "openvino", "--precision", "bf16"]);
    assert_eq!(code, Some(1), "{stderr}");
    let other_outputs =
        stderr.contains("with openvino bf16 the outputs differ from the reference: `quality` differs by");
    let unavailable = stderr.contains("provider `openvino` not found") || stderr.contains("does not support bf16");
    assert!(other_outputs || unavailable, "{stderr}");
}

#[test]
fn an_unavailable_backend_is_an_error_without_fallback() {
    let model = TestModel::new("blobs");
    for (args, expected) in [
        (&["--provider", "tensorrt"][..], "provider `tensorrt` not found"),
        (&["--provider", "cpu", "--precision", "fp16"], "`cpu` does not support fp16"),
        (&["--precision", "int8"], "grasp-train export --precision int8"),
    ] {
        let (code, stderr) = refused(&model, args);
        assert_eq!(code, Some(1), "{stderr}");
        assert!(stderr.contains("blobs-1.onnx") && stderr.contains(expected), "{args:?}: {stderr}");
    }
    let (code, stderr) = refused(&model, &["--provider", "gpu", "--precision", "half"]);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(stderr.contains("--provider (GRASPD_PROVIDER) is `gpu`") && stderr.contains("--precision"), "{stderr}");
}
