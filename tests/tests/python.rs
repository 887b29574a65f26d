//! Another language: a client made from the .proto file alone, in `python/`.

use std::path::Path;
use std::process::Command;

use grasp_tests::{Server, TestModel};

#[test]
fn a_python_client_gets_along_with_the_server() {
    let python = std::env::var_os("GRASPD_PYTHON").expect("GRASPD_PYTHON is not set: run the tests by `make test`");
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new(python)
        .args(["-m", "unittest", "discover", "--verbose", "--start-directory"])
        .arg(tests.join("python"))
        .env("GRASPD_SERVER", server.grpc().to_string())
        .env("GRASPD_PROTO", tests.join("../proto/proto"))
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .output()
        .unwrap();
    let report = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{report}");
    // unittest is content when it finds no test at all.
    assert!(report.contains("test_the_grasps_are_where_the_blobs_are"), "{report}");
}
