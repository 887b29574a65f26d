//! Outputs of the shipped networks, compared with those stored in `tests/snapshots/`. They show that a change of the
//! runtime, of the graph rewriting or of a dependency has not changed what is served. After a network is replaced, set
//! `UPDATE_SNAPSHOTS=1` once and commit the new file. `ORT_DYLIB_PATH` must name ONNX Runtime's library.

use std::env;
use std::fmt::Write;
use std::fs;
use std::path::Path;

use grasp::Maps;
use grasp_models::{Network, Options};

use crate::scenes;

/// Two libraries or processors sum in a different order.
const TOLERANCE: f64 = 2e-3;

#[test]
fn outputs_of_the_shipped_networks_match_their_snapshots() {
    for path in scenes::shipped(".") {
        let mut network = Network::load(&path, &Options::default()).unwrap();
        let mut text = String::new();
        for (scene, volume) in scenes::all() {
            let output = network.infer(&[&volume]).unwrap();
            summary(&mut text, scene, &output.maps(0));
        }
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        let stored = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/snapshots/{name}.txt"));
        if env::var_os("UPDATE_SNAPSHOTS").is_some() {
            fs::create_dir_all(stored.parent().unwrap()).unwrap();
            fs::write(&stored, &text).unwrap();
        }
        let expected = fs::read_to_string(&stored).unwrap_or_else(|error| panic!("{}: {error}", stored.display()));
        assert_eq!(text.lines().count(), expected.lines().count(), "{name}");
        for (got, expected) in text.lines().zip(expected.lines()) {
            let (got_label, got_values) = parse(got);
            let (label, values) = parse(expected);
            let is_close = got_values.iter().zip(&values).all(|(a, b)| (a - b).abs() <= TOLERANCE * b.abs().max(1.0));
            assert!(
                got_label == label && got_values.len() == values.len() && is_close,
                "{name}: {got}\nnot {expected}"
            );
        }
    }
}

/// A line of each map: statistics, and values at voxels spread over the volume.
fn summary(text: &mut String, scene: &str, maps: &Maps) {
    for (name, values) in [("quality", maps.quality), ("rotation", maps.rotation), ("width", maps.width)] {
        let mean = values.iter().copied().map(f64::from).sum::<f64>() / values.len() as f64;
        let largest = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let _ = write!(text, "{scene}, {name}: {mean:.5} {largest:.5}");
        // A prime step visits all three axes.
        for index in (0..8).map(|sample| (sample * 104_729 + 51_234) % values.len()) {
            let _ = write!(text, " {:.5}", values[index]);
        }
        text.push('\n');
    }
}

fn parse(line: &str) -> (&str, Vec<f64>) {
    let (label, values) = line.split_once(": ").unwrap();
    (label, values.split(' ').map(|value| value.parse().unwrap()).collect())
}
