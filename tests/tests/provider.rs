//! What runs the models is what was asked for, and everybody is told.

use std::process::Command;

use grasp::Volume;
use grasp_client::Options;
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, graspd};
use nalgebra::Isometry3;

fn volume() -> Volume {
    blobs(RESOLUTION, Isometry3::identity(), &[[4, 5, 6], [11, 10, 9]])
}

/// A graspd that does not get as far as listening: its exit code, and what it says.
fn refused(model: &TestModel, args: &[&str]) -> (Option<i32>, String) {
    let models = tempfile::tempdir().unwrap();
    model.write(models.path());
    let mut command = Command::new(graspd());
    command.arg("--models").arg(models.path()).args(["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"]).args(args);
    let output = command.output().unwrap();
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[tokio::test]
async fn the_list_and_the_metric_say_what_runs() {
    for asked in ["auto", "cpu"] {
        let server = Server::run(&[TestModel::new("blobs")], &["--provider", asked, "--workers", "2"]);
        let client = server.client().await;
        let model = client.list_models().await.unwrap().remove(0);
        assert!(asked == "auto" || (&*model.provider, &*model.precision) == ("cpu", "fp32"), "{model:?}");
        let (provider, precision, sha256) = (&model.provider, &model.precision, &model.sha256);
        let labels = format!(r#"model="blobs 1",precision="{precision}",provider="{provider}",sha256="{sha256}""#);
        assert_eq!(server.metric(&format!("graspd_model_info{{{labels}}}")), 1.0);
        let detection = client.detect(&volume(), Options::default()).await.unwrap();
        assert_eq!(detection.grasps.len(), 2, "{asked} ({provider} {precision}) gives the model's answer");
    }
}

/// The library that `make` fetches on x86-64 Linux has OpenVINO.
#[tokio::test]
#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
async fn openvino_runs_where_it_was_asked_for() {
    let server = Server::run(&[TestModel::new("blobs")], &["--provider", "openvino", "--precision", "fp32"]);
    let client = server.client().await;
    let model = client.list_models().await.unwrap().remove(0);
    assert_eq!((&*model.provider, &*model.precision), ("openvino", "fp32"));
    assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 2);
}

/// Processors that multiply bf16 are where this could go wrong.
#[tokio::test]
async fn what_gives_other_answers_is_passed_over_or_refused() {
    let model = TestModel::new("blobs").needs_fp32();
    let server = Server::run(std::slice::from_ref(&model), &[]);
    let client = server.client().await;
    assert_eq!(client.list_models().await.unwrap()[0].precision, "fp32");
    assert_eq!(client.detect(&volume(), Options::default()).await.unwrap().grasps.len(), 2);

    let (code, said) = refused(&model, &["--provider", "openvino", "--precision", "bf16"]);
    assert_eq!(code, Some(1), "{said}");
    let other_answers = said.contains("with openvino bf16 the outputs differ from the reference: `quality` differs by");
    let not_there = said.contains("provider `openvino` not found") || said.contains("does not support bf16");
    assert!(other_answers || not_there, "{said}");
}

#[test]
fn what_cannot_be_had_is_an_error_and_nothing_else_is_taken() {
    let model = TestModel::new("blobs");
    for (args, expected) in [
        (&["--provider", "tensorrt"][..], "provider `tensorrt` not found"),
        (&["--provider", "cpu", "--precision", "fp16"], "`cpu` does not support fp16"),
        (&["--precision", "int8"], "grasp-train export --precision int8"),
    ] {
        let (code, said) = refused(&model, args);
        assert_eq!(code, Some(1), "{said}");
        assert!(said.contains("blobs-1.onnx") && said.contains(expected), "{args:?}: {said}");
    }
    let (code, said) = refused(&model, &["--provider", "gpu", "--precision", "half"]);
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains("--provider (GRASPD_PROVIDER) is `gpu`") && said.contains("--precision"), "{said}");
}
