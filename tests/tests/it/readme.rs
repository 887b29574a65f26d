//! Runs every command of the README and of docs/training.md, in order, in one folder.

use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;

use grasp_tests::{grasp, grasp_sim, graspd};

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

/// The pages whose commands run here, in this order.
const PAGES: [&str; 2] = ["README.md", "docs/training.md"];

/// The blocks of one language in these pages, in order.
fn blocks(pages: &[&str], language: &str) -> Vec<String> {
    let fence = format!("```{language}\n");
    let of_page = |page: &&str| -> Vec<String> {
        let text = fs::read_to_string(format!("{ROOT}/{page}")).unwrap();
        text.split(&fence).skip(1).map(|rest| rest.split("```").next().unwrap().to_owned()).collect()
    };
    pages.iter().flat_map(of_page).collect()
}

/// Commands that run elsewhere: those of `make` and Cargo, training, which the tests of `grasp-train` run, and the installation
/// of the wheels, which test_wheels.py installs.
fn is_run_elsewhere(line: &str) -> bool {
    ["make ", "cargo ", "pip install \"graspd", "export LIBTORCH", "grasp-train "]
        .iter()
        .any(|prefix| line.starts_with(prefix))
}

#[test]
fn every_make_target_of_the_readme_exists() {
    let makefile = fs::read_to_string(format!("{ROOT}/Makefile")).unwrap();
    let lines = blocks(&["README.md", "CONTRIBUTING.md", "docs/performance.md"], "sh").join("\n");
    let targets: Vec<&str> =
        lines.lines().filter_map(|line| line.strip_prefix("make ")?.split_whitespace().next()).collect();
    assert!(targets.len() >= 3, "{targets:?}");
    for target in targets {
        assert!(makefile.contains(&format!("\n{target}:")), "the Makefile has no target {target}");
    }
}

#[test]
fn every_command_of_the_readme_works() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["models", "deploy", "proto", "client"] {
        std::os::unix::fs::symlink(Path::new(ROOT).join(name), folder.path().join(name)).unwrap();
    }
    // The ports of the pages may be in use on this machine.
    let [grpc, http] = [50051, 9090].map(|_| TcpListener::bind("127.0.0.1:0").unwrap());
    let [grpc, http] = [grpc, http].map(|listener| listener.local_addr().unwrap().port().to_string());
    let mut script = String::from("set -eu\n");
    let lines = blocks(&PAGES, "sh");
    for line in lines.iter().flat_map(|block| block.lines()).filter(|line| !is_run_elsewhere(line)) {
        if line.starts_with("graspd ") {
            // The following lines need a server that has printed `ready`.
            script += &format!("{} > server.log\n", line.trim_end_matches('&'));
            script = script.replace("> server.log\n", "> server.log & server=$!\ntrap 'kill $server' EXIT\n");
            script += "until grep -q ready server.log; do kill -0 $server; sleep 0.1; done\n";
        } else if let Some(package) = line.strip_prefix("pip install ") {
            // Uses the build backend and the dependencies of the tests' interpreter, without a network.
            let flags = "--quiet --no-index --no-build-isolation --no-deps --target site";
            script += &format!("$GRASPD_PYTHON -m pip install {flags} {package}\n");
        } else {
            script += &format!("echo '$ {}'\n{line}\n", line.replace('\'', ""));
        }
    }
    script += &format!("cat > client.py <<'END'\n{}END\n", blocks(&PAGES, "python").concat());
    script += "PYTHONPATH=site $GRASPD_PYTHON client.py\n";
    script += "trap - EXIT; kill $server; wait $server\n";
    let script = script.replace("50051", &grpc).replace("9090", &http);

    let directories = [graspd(), grasp(), grasp_sim()].map(|binary| binary.parent().unwrap().to_owned());
    let path = std::env::var_os("PATH").unwrap();
    let path = std::env::join_paths(directories.into_iter().chain(std::env::split_paths(&path))).unwrap();
    let mut command = Command::new("sh");
    command
        .args(["-c", &script])
        .current_dir(folder.path())
        .env("PATH", path)
        .env("GRASP_SERVER", format!("127.0.0.1:{grpc}"));
    let output = command.output().unwrap();
    let (stdout, stderr) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{stdout}\n{stderr}");
    for expected in ["vgn-packed", "graspd_", "GSR %", "| random |"] {
        assert!(stdout.contains(expected), "`{expected}` is missing from:\n{stdout}\n{stderr}");
    }
}
