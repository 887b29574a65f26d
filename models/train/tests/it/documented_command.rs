//! The training command of docs/training.md, on a small data set in the folder that it names.

use std::fs;
use std::process::Command;

use grasp::RESOLUTION;
use grasp_models::Store;

use crate::support;

#[test]
fn the_training_command_of_the_documentation_works() {
    let page = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/training.md")).unwrap();
    let line = page
        .lines()
        .find(|line| line.starts_with("grasp-train train "))
        .expect("docs/training.md has a line with `grasp-train train`");
    let arguments: Vec<&str> = line.split_whitespace().skip(1).collect();
    let value = |flag: &str| arguments[arguments.iter().position(|&word| word == flag).unwrap() + 1];

    let folder = tempfile::tempdir().unwrap();
    let scenes: Vec<_> = (0..8).map(|seed| support::scene(seed, RESOLUTION)).collect();
    support::write(&folder.path().join(value("--data")), &scenes);
    let mut command = Command::new(env!("CARGO_BIN_EXE_grasp-train"));
    let output = command.current_dir(folder.path()).args(&arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));

    let model = folder.path().join(value("--out"));
    assert_eq!(Store::open(model.parent().unwrap()).unwrap().entries().len(), 1);
    assert!(model.with_extension("jsonl").exists() && model.with_extension("png").exists());
}
