//! Runs the Python tests in `python/`.

use std::ffi::OsStr;
use std::path::Path;
use std::process::Command;

use grasp_tests::{Server, TestModel, example, grasp, grasp_sim, graspd};
use tempfile::TempDir;

/// Runs the tests of a file. `expected` is the name of one of them, because unittest succeeds if it finds none.
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

/// A folder with one network of the zoo and the classifiers.
fn models() -> TempDir {
    let zoo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/zoo").canonicalize().unwrap();
    let folder = tempfile::tempdir().unwrap();
    for name in ["vgn-packed.onnx", "classifiers"] {
        std::os::unix::fs::symlink(zoo.join(name), folder.path().join(name)).unwrap();
    }
    folder
}

#[test]
fn a_generated_python_client_works() {
    let server = Server::run(&[TestModel::new("mirror")], &["--max-tracked", "4"]);
    let address = server.grpc().to_string();
    let proto = Path::new(env!("CARGO_MANIFEST_DIR")).join("../proto/proto");
    let environment = [("GRASPD_SERVER", address.as_ref()), ("GRASPD_PROTO", proto.as_os_str())];
    run("test_client.py", &environment, "test_the_grasps_are_where_the_blobs_are");
}

#[test]
fn the_deployment_files_match_the_server() {
    run("test_deploy.py", &[("GRASPD", graspd().as_os_str())], "test_the_manifests_are_valid");
}

#[test]
fn prometheus_and_the_dashboard_show_data() {
    // GRASPD_PROMETHEUS and GRASPD_PROMTOOL are inherited from the environment.
    let models = models();
    let environment = [("GRASPD", graspd().as_os_str()), ("GRASPD_MODELS", models.path().as_os_str())];
    run("test_monitoring.py", &environment, "test_panels_show_data");
}

#[test]
fn the_page_works_in_a_browser() {
    // GRASPD_CHROMIUM is inherited from the environment.
    let models = models();
    let environment = [("GRASPD", graspd().as_os_str()), ("GRASPD_MODELS", models.path().as_os_str())];
    run("test_page.py", &environment, "test_the_scene_is_drawn");
}

#[test]
fn the_python_package_works() {
    let models = models();
    let environment = [("GRASPD", graspd().as_os_str()), ("GRASPD_MODELS", models.path().as_os_str())];
    run("test_package.py", &environment, "test_the_grasps_are_at_the_block");
}

#[test]
fn the_files_that_people_have_are_read_or_refused() {
    let models = models();
    let environment = [
        ("GRASPD", graspd().as_os_str()),
        ("GRASP", grasp().as_os_str()),
        ("GRASPD_MODELS", models.path().as_os_str()),
    ];
    run("test_files.py", &environment, "test_lenses");
}

#[test]
fn the_wheels_work_in_a_new_environment() {
    run("test_wheels.py", &[("GRASPD", graspd().as_os_str())], "test_the_demo_needs_no_option");
}

#[test]
fn exported_files_can_be_parsed() {
    let models = models();
    let environment = [
        ("GRASPD", graspd().as_os_str()),
        ("GRASP", grasp().as_os_str()),
        ("GRASPD_MODELS", models.path().as_os_str()),
    ];
    run("test_exports.py", &environment, "test_isaac_files_have_the_fields_of_the_format");
}

#[test]
fn tritonclient_receives_the_maps() {
    let models = models();
    let environment = [("GRASPD", graspd().as_os_str()), ("GRASPD_MODELS", models.path().as_os_str())];
    run("test_inference.py", &environment, "test_calls_run_at_the_same_time");
}

#[test]
fn the_code_blocks_of_the_documents_run() {
    let models = models();
    let environment = [
        ("GRASPD", graspd().as_os_str()),
        ("GRASP", grasp().as_os_str()),
        ("GRASP_SIM", grasp_sim().as_os_str()),
        ("GRASPD_MODELS", models.path().as_os_str()),
    ];
    run("test_docs.py", &environment, "test_links_have_targets");
}

#[test]
fn the_cpp_client_builds_and_receives_grasps() {
    // GRASPD_CPP is inherited from the environment.
    let models = models();
    let environment = [("GRASPD", graspd().as_os_str()), ("GRASPD_MODELS", models.path().as_os_str())];
    run("test_cpp.py", &environment, "test_the_grasps_are_at_the_block");
}

#[test]
fn the_examples_in_three_languages_print_the_same_grasps() {
    // GRASPD_CPP is inherited from the environment.
    let models = models();
    let environment = [
        ("GRASPD", graspd().as_os_str()),
        ("GRASP_EXAMPLE", example().as_os_str()),
        ("GRASPD_MODELS", models.path().as_os_str()),
    ];
    run("test_examples.py", &environment, "test_the_examples_print_the_same_grasps");
}

#[test]
fn the_pybullet_simulator_works() {
    let models = models();
    let environment = [
        ("GRASPD", graspd().as_os_str()),
        ("GRASP_SIM", grasp_sim().as_os_str()),
        ("GRASPD_MODELS", models.path().as_os_str()),
    ];
    run("test_pybullet.py", &environment, "test_a_cube_is_lifted");
}

#[test]
fn python_reads_and_writes_data_sets() {
    run("test_data.py", &[("GRASP_SIM", grasp_sim().as_os_str())], "test_processed_data_load_with_pandas");
}

#[test]
fn label_jobs_generate_the_data_of_one_machine() {
    run("test_label_jobs.py", &[("GRASP_SIM", grasp_sim().as_os_str())], "test_pods_generate_the_data_of_one_machine");
}
