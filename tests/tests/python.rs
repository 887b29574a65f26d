//! Another language, with the tests in `python/`.

use std::ffi::OsStr;
use std::path::Path;
use std::process::Command;

use grasp_tests::{Server, TestModel, example, grasp, grasp_sim, graspd};
use tempfile::TempDir;

/// Runs the tests of a file; `expected` is one of them, for unittest is content when it finds none at all.
fn run(file: &str, environment: &[(&str, &OsStr)], expected: &str) {
    let python = std::env::var_os("GRASPD_PYTHON").expect("GRASPD_PYTHON is not set: run the tests by `make test`");
    let tests = Path::new(env!("CARGO_MANIFEST_DIR")).join("python");
    let output = Command::new(python)
        .args(["-m", "unittest", "discover", "--verbose", "--pattern", file, "--start-directory"])
        .arg(tests)
        .envs(environment.iter().copied())
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .output()
        .unwrap();
    let report = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && report.contains(expected), "{report}");
}

/// A folder with one network of the zoo and its classifier, however many there are by then.
fn models() -> TempDir {
    let zoo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/zoo").canonicalize().unwrap();
    let folder = tempfile::tempdir().unwrap();
    for name in ["vgn-packed.onnx", "classifiers"] {
        std::os::unix::fs::symlink(zoo.join(name), folder.path().join(name)).unwrap();
    }
    folder
}

#[test]
fn a_python_client_gets_along_with_the_server() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let address = server.grpc().to_string();
    let proto = Path::new(env!("CARGO_MANIFEST_DIR")).join("../proto/proto");
    let environment = [("GRASPD_SERVER", address.as_ref()), ("GRASPD_PROTO", proto.as_os_str())];
    run("test_client.py", &environment, "test_the_grasps_are_where_the_blobs_are");
}

#[test]
fn the_deployment_fits_the_server_seen_from_python() {
    run("test_deploy.py", &[("GRASPD", graspd().as_os_str())], "test_the_manifests_are_valid");
}

#[test]
fn prometheus_sees_what_the_dashboard_shows_seen_from_python() {
    // GRASPD_PROMETHEUS and GRASPD_PROMTOOL are the environment's.
    let models = models();
    let environment = [("GRASPD", graspd().as_os_str()), ("GRASPD_MODELS", models.path().as_os_str())];
    run("test_monitoring.py", &environment, "test_panels_show_data");
}

#[test]
fn a_browser_shows_the_page_seen_from_python() {
    // GRASPD_CHROMIUM is the environment's.
    let models = models();
    let environment = [("GRASPD", graspd().as_os_str()), ("GRASPD_MODELS", models.path().as_os_str())];
    run("test_page.py", &environment, "test_the_scene_is_drawn");
}

#[test]
fn the_python_package_does_what_it_says() {
    let models = models();
    let environment = [("GRASPD", graspd().as_os_str()), ("GRASPD_MODELS", models.path().as_os_str())];
    run("test_package.py", &environment, "test_the_grasps_are_at_the_block");
}

#[test]
fn exports_are_what_other_programs_read_seen_from_python() {
    let models = models();
    let environment = [
        ("GRASPD", graspd().as_os_str()),
        ("GRASP", grasp().as_os_str()),
        ("GRASPD_MODELS", models.path().as_os_str()),
    ];
    run("test_exports.py", &environment, "test_isaac_reads_its_format");
}

#[test]
fn tritonclient_gets_the_maps_seen_from_python() {
    let models = models();
    let environment = [("GRASPD", graspd().as_os_str()), ("GRASPD_MODELS", models.path().as_os_str())];
    run("test_inference.py", &environment, "test_calls_run_at_the_same_time");
}

#[test]
fn the_documents_are_true_seen_from_python() {
    let models = models();
    let environment = [
        ("GRASPD", graspd().as_os_str()),
        ("GRASP", grasp().as_os_str()),
        ("GRASP_SIM", grasp_sim().as_os_str()),
        ("GRASPD_MODELS", models.path().as_os_str()),
    ];
    run("test_docs.py", &environment, "test_what_is_linked_exists");
}

#[test]
fn a_client_in_cpp_is_built_and_gets_grasps_seen_from_python() {
    // GRASPD_CPP is the environment's.
    let models = models();
    let environment = [("GRASPD", graspd().as_os_str()), ("GRASPD_MODELS", models.path().as_os_str())];
    run("test_cpp.py", &environment, "test_the_grasps_are_at_the_block");
}

#[test]
fn the_examples_in_three_languages_print_the_same_grasps_seen_from_python() {
    // GRASPD_CPP is the environment's.
    let models = models();
    let environment = [
        ("GRASPD", graspd().as_os_str()),
        ("GRASP_EXAMPLE", example().as_os_str()),
        ("GRASPD_MODELS", models.path().as_os_str()),
    ];
    run("test_examples.py", &environment, "test_the_examples_print_the_same_grasps");
}

#[test]
fn the_second_simulator_does_what_it_says_seen_from_python() {
    let models = models();
    let environment = [
        ("GRASPD", graspd().as_os_str()),
        ("GRASP_SIM", grasp_sim().as_os_str()),
        ("GRASPD_MODELS", models.path().as_os_str()),
    ];
    run("test_pybullet.py", &environment, "test_a_cube_is_lifted");
}

#[test]
fn python_reads_and_writes_our_data() {
    run("test_data.py", &[("GRASP_SIM", grasp_sim().as_os_str())], "test_processed_data_load_with_pandas");
}

#[test]
fn the_label_jobs_share_the_work_seen_from_python() {
    run("test_label_jobs.py", &[("GRASP_SIM", grasp_sim().as_os_str())], "test_pods_label_what_one_machine_would");
}
