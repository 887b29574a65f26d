//! The commands of `grasp-sim`. `ORT_DYLIB_PATH` must name ONNX Runtime's library.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::thread::sleep;
use std::time::Duration;

use grasp_data::Dataset;
use grasp_sim::export;
use grasp_sim::objects::ObjectSet;
use serde_json::Value;
use tempfile::TempDir;

const SIM: &str = env!("CARGO_BIN_EXE_grasp-sim");
const NETWORK: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/zoo/vgn-packed.onnx");

/// A temporary working folder.
struct Desk(TempDir);

impl Desk {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn command(&self, arguments: &str) -> Command {
        let mut command = Command::new(SIM);
        command.current_dir(&self.0).args(arguments.split_whitespace()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    fn run(&self, arguments: &str) -> String {
        let output = self.command(arguments).output().unwrap();
        assert!(output.status.success(), "{arguments}: {}", stderr(&output));
        String::from_utf8(output.stdout).unwrap()
    }

    /// Runs a command that must fail, and returns its stderr.
    fn refused(&self, arguments: &str) -> String {
        let output = self.command(arguments).output().unwrap();
        assert!(!output.status.success(), "{arguments} should fail");
        stderr(&output)
    }

    /// The content of a packed data set: each scene's name, volumes and trials.
    fn scenes(&self, name: &str) -> Vec<(String, Vec<Vec<u8>>, Vec<String>)> {
        let data = Dataset::open(&[self.path(name)]).unwrap();
        let scene = |index| {
            let volumes = (0..data.volumes(index)).map(|number| data.volume(index, number).to_vec()).collect();
            let trials =
                data.trials(index).iter().map(|t| format!("{:.3?} {:.3} {}", t.position, t.width, t.success)).collect();
            (data.id(index), volumes, trials)
        };
        let mut scenes: Vec<_> = (0..data.len()).map(scene).collect();
        scenes.sort();
        scenes
    }

    /// The voxels inside the objects of a packed data set, by the scene's name.
    fn occupied(&self, name: &str) -> BTreeMap<String, Vec<usize>> {
        let data = Dataset::open(&[self.path(name)]).unwrap();
        let occupied = |index| data.occupancy(index).unwrap().occupied().collect();
        (0..data.len()).map(|index| (data.id(index), occupied(index))).collect()
    }
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

const LABEL: &str = "label --scene packed --objects generated --views random:1-2 --observations 2 --points 6 --seed 4";

fn bytes_of(folder: &Path) -> u64 {
    let files = fs::read_dir(folder).into_iter().flatten().flatten();
    files.filter_map(|file| file.metadata().ok()).map(|file| file.len()).sum()
}

#[test]
fn a_killed_run_continues_without_lost_or_duplicate_scenes() {
    let desk = Desk::new();
    desk.run(&format!("{LABEL} --scenes 16 --out whole --export whole.jsonl"));
    let mut kills = 0;
    for threshold in [200_000, 600_000, 1_200_000] {
        let mut child =
            desk.command(&format!("{LABEL} --scenes 16 --out killed --export killed.jsonl")).spawn().unwrap();
        while bytes_of(&desk.path("killed")) < threshold && child.try_wait().unwrap().is_none() {
            sleep(Duration::from_millis(2));
        }
        kills += usize::from(child.try_wait().unwrap().is_none());
        child.kill().unwrap();
        child.wait().unwrap();
    }
    assert!(kills > 0, "no run was killed before its end");
    desk.run(&format!("{LABEL} --scenes 16 --out killed --export killed.jsonl"));
    let whole = desk.scenes("whole");
    assert!(whole.len() > 12);
    assert!(whole == desk.scenes("killed"));
    assert_eq!(fs::read(desk.path("whole.jsonl")).unwrap(), fs::read(desk.path("killed.jsonl")).unwrap());
}

#[test]
fn the_same_seed_gives_the_same_bytes_on_any_number_of_threads() {
    let desk = Desk::new();
    let label = |threads: &str| {
        let out = format!("{LABEL} --scenes 12 --out threads-{threads}");
        assert!(desk.command(&out).env("RAYON_NUM_THREADS", threads).output().unwrap().status.success());
        fs::read(desk.path(&format!("threads-{threads}/scenes-00000.pack"))).unwrap()
    };
    let one = label("1");
    assert!(one.len() > 1_000_000 && one == label("3"));
    desk.run(&format!("{} --scenes 12 --out other", LABEL.replace("--seed 4", "--seed 5")));
    assert!(one != fs::read(desk.path("other/scenes-00000.pack")).unwrap());
}

#[test]
fn a_full_disk_is_reported_and_written_scenes_stay() {
    let desk = Desk::new();
    // A limit of the file size simulates a full disk. Its unit is 512 or 1,024 bytes, depending on the shell.
    let command = format!("trap '' XFSZ; ulimit -f 500; exec {SIM} {LABEL} --scenes 12 --out full");
    let output = Command::new("sh").args(["-c", &command]).current_dir(&desk.0).output().unwrap();
    assert!(!output.status.success());
    let error = stderr(&output);
    assert!(error.contains("full/scenes-00000.pack: File too large"), "{error}");
    let kept = desk.scenes("full");
    assert!((1..12).contains(&kept.len()), "{} scenes", kept.len());
    desk.run(&format!("{LABEL} --scenes 12 --out full"));
    desk.run(&format!("{LABEL} --scenes 12 --out whole"));
    assert!(desk.scenes("full") == desk.scenes("whole"));
}

#[test]
fn all_formats_contain_the_same_data() {
    let desk = Desk::new();
    let label = "label --scene pile --points 20 --scenes 6 --seed 2";
    for format in ["raw", "processed", "packed"] {
        desk.run(&format!("{label} --format {format} --out {format}"));
    }
    desk.run("convert --from processed --out from-processed");
    assert!(desk.scenes("packed") == desk.scenes("from-processed"));
    desk.run("convert --from raw --out from-raw");
    // The conversion from raw drops grasps at the borders, and raw files store poses as f32.
    let (packed, fused) = (desk.scenes("packed"), desk.scenes("from-raw"));
    assert_eq!(packed.len(), fused.len());
    for ((_, before, _), (_, after, _)) in packed.iter().zip(&fused) {
        let pairs = || before[0].iter().zip(&after[0]);
        let equal = pairs().filter(|(before, after)| before.abs_diff(**after) <= 1).count();
        assert!(equal as f64 / pairs().count() as f64 > 0.999);
    }
}

#[test]
fn conversions_keep_all_observations() {
    let desk = Desk::new();
    desk.run(&format!("{LABEL} --scenes 3 --out data"));
    desk.run("convert --from data --out copy");
    assert!(desk.scenes("copy") == desk.scenes("data"));
    assert!(desk.occupied("copy") == desk.occupied("data"));
    let error = desk.refused("convert --from data --format processed --out one");
    assert!(error.contains("of data has 2 observations"), "{error}");
    assert!(!desk.path("one").exists());
}

#[test]
fn runs_that_would_lack_scenes_are_refused() {
    let desk = Desk::new();
    for format in ["packed", "processed"] {
        let label = format!("label --points 2 --seed 4 --format {format} --out {format}");
        desk.run(&format!("{label} --first 5 --scenes 3"));
        let error = desk.refused(&format!("{label} --first 0 --scenes 5"));
        assert!(error.contains("--first is 0") && error.contains("would be missing"), "{error}");
        let error = desk.refused(&format!("{label} --first 12 --scenes 3"));
        assert!(error.contains("--first is 12") && error.contains("would be missing"), "{error}");
        let error = desk.refused(&format!("{label} --first 5 --scenes 6 --export scenes.jsonl"));
        assert!(error.contains("--export scenes.jsonl lacks scenes"), "{error}");
        assert!(!desk.path("scenes.jsonl").exists());
        // The next scenes continue the run.
        desk.run(&format!("{label} --first 8 --scenes 3"));
        desk.run(&format!("label --points 2 --seed 4 --format {format} --out {format}-whole --first 5 --scenes 6"));
        assert!(desk.scenes(format) == desk.scenes(&format!("{format}-whole")));
    }
}

#[test]
fn an_export_can_be_replayed() {
    let desk = Desk::new();
    desk.run("label --scene packed --objects train --points 10 --scenes 4 --seed 3 --out data --export scenes.jsonl");
    desk.run("objects --objects train --out objects");
    let lines = export::read(&desk.path("scenes.jsonl")).unwrap();
    let data = Dataset::open(&[desk.path("data")]).unwrap();
    assert_eq!(lines.len(), data.len());
    for (index, line) in lines.iter().enumerate() {
        assert!(!line.objects.is_empty() && line.trials.len() == 10);
        for object in &line.objects {
            assert!((0.7..=0.9).contains(&object.scale) && object.pose[2] > 0.05);
            let urdf = format!("objects/{}.urdf", object.object);
            assert!(desk.path(&urdf).exists(), "`objects --out` did not write {urdf}");
        }
        for (exported, trial) in line.trials.iter().zip(data.trials(index)) {
            let grasp = trial.grasp(0.3 / 40.0);
            assert_eq!(exported.label == 1, trial.success);
            let held = exported.yaws.contains(&1);
            assert_eq!(exported.yaws[exported.yaw] == 1, held, "the labelled yaw succeeded, if any did");
            assert_eq!(exported.share > 0.0, held, "the share includes the first try");
            assert_eq!(exported.share > 0.7, trial.success, "at most one of the tries of a success failed");
            assert_eq!((exported.share, exported.clearance), (trial.share, trial.clearance));
            assert!((exported.width - grasp.width).abs() < 1e-6);
            let position = grasp.pose.translation.vector;
            assert!((0..3).all(|axis| (exported.pose[axis] - position[axis]).abs() < 1e-6));
            assert!(exported.object.is_some_and(|object| object < line.objects.len()));
        }
    }
    // Replayed in the same scenes, grasps that succeeded without pose error succeed again.
    let all = lines.iter().map(|line| line.trials.len()).sum::<usize>();
    let replayed = desk.run("replay --json scenes.jsonl --objects objects --contact forbid --out replayed.jsonl");
    let report: Value = serde_json::from_str(replayed.trim()).unwrap();
    let count = |key: &str| report[key].as_u64().unwrap() as usize;
    assert_eq!(count("successes") + count("failures"), all);
    assert!(count("successes") > 0 && count("successes_kept") * 10 >= count("successes") * 8, "{report}");
    assert_eq!(export::read(&desk.path("replayed.jsonl")).unwrap().len(), lines.len());

    // As if another simulator had found the opposite.
    let inverted = lines.into_iter().map(|mut line| {
        line.trials.iter_mut().for_each(|trial| trial.label = 1 - trial.label);
        serde_json::to_string(&line).unwrap() + "\n"
    });
    fs::write(desk.path("inverted.jsonl"), inverted.collect::<String>()).unwrap();
    desk.run("replay inverted.jsonl --objects objects --contact forbid --differences differences.png");
    assert!(fs::metadata(desk.path("differences.png")).unwrap().len() > 10_000);
}

#[test]
fn statistics_count_every_grasp_once() {
    let desk = Desk::new();
    desk.run("label --scene pile --points 25 --scenes 6 --seed 2 --out data --export scenes.jsonl");
    let printed = desk.run("stats data --export scenes.jsonl --out statistics");
    assert!(printed.contains("150 grasps"), "{printed}");
    let json: Value = serde_json::from_slice(&fs::read(desk.path("statistics/statistics.json")).unwrap()).unwrap();
    let sum =
        |bins: &Value, key: &str| bins.as_array().unwrap().iter().map(|bin| bin[key].as_u64().unwrap()).sum::<u64>();
    let data = &json["data"];
    let [failures, successes] = ["failures", "successes"].map(|key| data["grasps"][key].as_u64().unwrap());
    assert_eq!(failures + successes, 150);
    for over in ["heights", "approaches"] {
        assert_eq!(sum(&data[over]["bins"], "failures"), failures, "{over}");
        assert_eq!(sum(&data[over]["bins"], "successes"), successes, "{over}");
    }
    assert_eq!(sum(&data["widths"]["bins"], "successes"), successes);
    let by_object = json["objects"].as_object().unwrap().values();
    assert_eq!(by_object.map(|count| count["successes"].as_u64().unwrap()).sum::<u64>(), successes);
    for picture in ["statistics.png", "objects.png"] {
        assert!(fs::read(desk.path("statistics").join(picture)).unwrap().starts_with(b"\x89PNG"));
    }
}

#[test]
fn a_benchmark_reports_every_attempt() {
    let desk = Desk::new();
    let bench = format!("bench --json --planner random --planner {NETWORK} --rounds 1 --seeds 2 --seed 3");
    let lines = desk.run(&format!("{bench} --attempts attempts.jsonl"));
    let summaries: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let attempts = fs::read_to_string(desk.path("attempts.jsonl")).unwrap();
    let attempts: Vec<Value> = attempts.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(summaries.len(), 2);
    for summary in &summaries {
        let count = |outcome: &str| {
            let of_planner = attempts.iter().filter(|attempt| attempt["planner"] == summary["planner"]);
            of_planner.filter(|attempt| attempt["outcome"] == outcome).count() as u64
        };
        let figure = |name: &str| summary[name].as_u64().unwrap();
        assert_eq!(count("lifted"), figure("successes"));
        for outcome in ["blocked_at_pregrasp", "closed_on_nothing", "lost_in_lift"] {
            assert_eq!(count(outcome), figure(outcome), "{outcome}");
        }
        let failed = figure("blocked_at_pregrasp") + figure("closed_on_nothing") + figure("lost_in_lift");
        assert_eq!(figure("successes") + failed, figure("attempts"));
        let ended = ["cleared", "nothing_seen", "nothing_proposed", "gave_up"].map(figure).iter().sum::<u64>();
        assert_eq!((ended, summary["seeds"]["gsr"]["n"].as_u64()), (2, Some(2)));
        assert!(summary["fusion_p50_ms"].as_f64().unwrap() > 0.0);
    }
    let [of_random, of_network] = [0, 1].map(|planner: usize| &summaries[planner]["decoding"]);
    assert!(of_random.is_null() && of_network["no_border"] == false, "{of_random} {of_network}");
    assert!(attempts.iter().any(|attempt| attempt["object"].is_string()), "attempts name their objects");
    desk.run("bench --planner random --rounds 1 --attempts drawn.jsonl --pictures pictures");
    let drawn = fs::read_to_string(desk.path("drawn.jsonl")).unwrap().lines().count();
    let pictures = fs::read_dir(desk.path("pictures")).unwrap().count();
    assert!(drawn > 0 && pictures == drawn, "a picture for each attempt: {pictures} of {drawn}");

    let error = desk.refused("reliability here=attempts.jsonl");
    assert!(error.contains("attempts.jsonl has attempts of several planners ("), "{error}");
    let of_network = attempts.iter().filter(|attempt| attempt["planner"] == summaries[1]["planner"]);
    let of_network: Vec<String> = of_network.map(|attempt| format!("{attempt}\n")).collect();
    fs::write(desk.path("one.jsonl"), of_network.concat()).unwrap();
    let line = desk.run("reliability --json here=one.jsonl --out reliability.png");
    let reliability: Value = serde_json::from_str(&line).unwrap();
    let whole = &reliability["reliability"]["whole"];
    assert_eq!((&reliability["name"], whole["attempts"].as_u64()), (&"here".into(), Some(of_network.len() as u64)));
    assert!((0.0..=1.0).contains(&reliability["reliability"]["error"].as_f64().unwrap()));
    assert!(fs::read(desk.path("reliability.png")).unwrap().starts_with(b"\x89PNG"));

    let rows = desk.run(&format!("bench --planner {NETWORK} --rounds 1 --seeds 2 --seed 3"));
    let of_network = rows.lines().find(|line| line.contains("vgn-packed.onnx |")).unwrap();
    let gsr = format!("{:.1} ±", summaries[1]["seeds"]["gsr"]["mean"].as_f64().unwrap() * 100.0);
    assert!(of_network.contains(&gsr), "{of_network}: {gsr}");
}

#[test]
fn an_interrupted_benchmark_prints_the_rounds_that_have_ended() {
    let desk = Desk::new();
    let command = "bench --planner random --rounds 100000 --pictures pictures";
    let mut child = desk.command(command).env("RAYON_NUM_THREADS", "1").spawn().unwrap();
    // random-SEED-ROUND-ATTEMPT-OUTCOME.png: with three rounds, two have ended.
    let rounds = || {
        let names = fs::read_dir(desk.path("pictures")).into_iter().flatten().flatten().map(|file| file.file_name());
        names.filter_map(|name| name.to_str()?.split('-').nth(2).map(str::to_owned)).collect::<BTreeSet<_>>().len()
    };
    while rounds() < 3 && child.try_wait().unwrap().is_none() {
        sleep(Duration::from_millis(20));
    }
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let reason = stderr(&output);
    let table = String::from_utf8(output.stdout).unwrap();
    assert!(table.lines().any(|line| line.starts_with("| random | ")), "{table}");
    assert!(reason.contains("interrupted: ") && reason.contains(" of 100000 rounds of `random`"), "{reason}");
}

#[test]
fn the_benchmark_tells_the_room_beside_the_fingers() {
    let desk = Desk::new();
    let table = desk.run("bench --planner random --objects containers --rounds 4 --attempts attempts.jsonl");
    let of_rooms = table.lines().find(|line| line.starts_with("- random: no room ")).unwrap();
    let attempts = fs::read_to_string(desk.path("attempts.jsonl")).unwrap();
    let rooms = attempts.lines().filter_map(|line| serde_json::from_str::<Value>(line).unwrap()["room"].as_f64());
    let tight = rooms.filter(|room| (0.0..0.004).contains(room)).count();
    assert!(of_rooms.contains(&format!(" of {tight}, 4 to 8 mm ")), "{of_rooms}: {tight}");
}

#[test]
fn a_benchmark_without_a_result_has_no_table() {
    let output = Desk::new().command("bench --planner missing.onnx --rounds 1").output().unwrap();
    assert_eq!(String::from_utf8(output.stdout).unwrap(), "");
    assert!(String::from_utf8(output.stderr).unwrap().contains("missing.onnx"));
}

#[test]
fn objects_can_be_low_only() {
    let desk = Desk::new();
    assert_eq!(
        desk.run("objects --objects generated --count 6 --max-height 0.032 --out low").lines().next(),
        Some("6 objects")
    );
    let low = ObjectSet::load(&desk.path("low")).unwrap();
    assert_eq!(low.listed().len(), 6);
    assert!(low.listed().iter().all(|object| object.visual.extents().z < 0.0321));
    assert!(desk.refused("objects --max-height 0").contains("at least 0.01 m"));
}

#[test]
fn a_part_of_a_folder_is_every_fifth_object() {
    let desk = Desk::new();
    desk.run("objects --objects test --scene packed --out objects");
    let mut names: Vec<String> = fs::read_dir(desk.path("objects"))
        .unwrap()
        .filter_map(|file| file.unwrap().file_name().to_str()?.strip_suffix(".urdf").map(str::to_owned))
        .collect();
    names.sort();
    let seen = |part: &str| {
        desk.run(&format!(
            "label --objects objects --part {part} --points 2 --scenes 12 --out {part} --export {part}.jsonl"
        ));
        let scenes = export::read(&desk.path(&format!("{part}.jsonl"))).unwrap();
        scenes.into_iter().flat_map(|scene| scene.objects).map(|object| object.object).collect::<BTreeSet<_>>()
    };
    let (train, validation) = (seen("train"), seen("validation"));
    assert!(!train.is_empty() && !validation.is_empty());
    for (index, name) in names.iter().enumerate() {
        assert!(!(if index % 5 == 4 { &train } else { &validation }).contains(name), "{name}");
    }
    let refused = desk.command("bench --planner random --part validation").output().unwrap();
    assert!(stderr(&refused).contains("--part needs a folder of URDF files"), "{}", stderr(&refused));
}

#[test]
fn the_first_failures_are_drawn_on_a_sheet() {
    let desk = Desk::new();
    let bench = |name: &str| {
        let arguments = format!("bench --planner random --rounds 2 --seed 5 --failures {name}");
        let output = desk.command(&arguments).output().unwrap();
        assert!(output.status.success(), "{}", stderr(&output));
        (fs::read(desk.path(name)).unwrap(), stderr(&output))
    };
    let (sheet, log) = bench("first.png");
    // Each of the two rounds ends with two failures of the random planner. The sheet has three pictures per row.
    assert!(sheet.starts_with(b"\x89PNG"));
    assert_eq!((&sheet[16..20], &sheet[20..24]), (&1440u32.to_be_bytes()[..], &720u32.to_be_bytes()[..]));
    assert_eq!(log.matches("first.png: seed 5, round").count(), 4, "{log}");
    assert!(bench("second.png").0 == sheet, "the sheet does not depend on the scheduling of the rounds");
}

#[test]
fn all_planners_get_the_same_scenes() {
    let desk = Desk::new();
    // The number of objects at the start of each round. A round without a proposal has no attempt.
    let objects = |planner: &str| -> BTreeMap<u64, u64> {
        desk.run(&format!("bench --planner {planner} --rounds 7 --seed 9 --attempts {planner}.jsonl"));
        let attempts = fs::read_to_string(desk.path(&format!("{planner}.jsonl"))).unwrap();
        let attempts = attempts.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
        let first = attempts.filter(|attempt| attempt["attempt"] == 0);
        first.map(|attempt| (attempt["round"].as_u64().unwrap(), attempt["objects"].as_u64().unwrap())).collect()
    };
    let (random, shaf) = (objects("random"), objects("shaf"));
    let both = || random.iter().filter_map(|(round, count)| Some((count, shaf.get(round)?)));
    assert!(both().count() >= 6 && both().all(|(count, other)| count == other), "{random:?} {shaf:?}");
    assert!(both().map(|(count, _)| count).collect::<BTreeSet<_>>().len() > 1, "different scenes: {random:?}");
}

#[test]
fn scenes_are_observed_again() {
    let desk = Desk::new();
    desk.run(&format!("{LABEL} --scenes 5 --out data"));
    let before = desk.scenes("data");
    desk.run("observe data --views random:1-2 --observations 2 --seed 4 --out same");
    assert_eq!(desk.scenes("same"), before, "with the same seed and views nothing changes");
    desk.run("observe data --views random:1,circle --observations 3 --noise 0 --seed 9 --out other");
    let other = desk.scenes("other");
    assert_eq!(other.len(), before.len());
    let occupied = desk.occupied("data");
    assert!(occupied.values().all(|voxels| (20..6_400).contains(&voxels.len())), "at most a tenth of the volume");
    assert!(desk.occupied("other") == occupied, "the objects stay where they are");
    for ((id, volumes, trials), (id_before, volumes_before, trials_before)) in other.iter().zip(&before) {
        assert_eq!((id, trials), (id_before, trials_before));
        assert!(volumes.len() == 3 && volumes.iter().all(|volume| !volumes_before.contains(volume)));
    }

    // Observed data sets can be observed again, and a completed run adds nothing.
    desk.run("observe other --views random:1-2 --observations 2 --seed 4 --out again");
    assert_eq!(desk.scenes("again"), before);
    let bytes = bytes_of(&desk.path("again"));
    desk.run("observe other --views random:1-2 --observations 2 --seed 4 --out again");
    assert_eq!(bytes_of(&desk.path("again")), bytes);

    // A part of a folder of objects.
    desk.run("objects --objects test --out objects");
    let label = "label --objects objects --part validation --scenes 2 --points 2 --seed 4";
    desk.run(&format!("{label} --views side --out part"));
    desk.run("observe part --views side --seed 4 --out part-again");
    assert_eq!(desk.scenes("part-again"), desk.scenes("part"));

    // The sensor is stored: without it the first scene would differ, and the command would refuse.
    desk.run(&format!("{LABEL} --scenes 5 --sensor stereo --out stereo"));
    desk.run("observe stereo --views random:1-2 --observations 2 --sensor stereo --seed 4 --out stereo-again");
    assert_eq!(desk.scenes("stereo-again"), desk.scenes("stereo"));
    for ((_, volumes, trials), (_, volumes_before, trials_before)) in desk.scenes("stereo").iter().zip(&before) {
        assert_eq!(trials, trials_before);
        assert_ne!(volumes, volumes_before);
    }

    // A data set of another simulator: its first scene differs.
    let setup = fs::read_to_string(desk.path("data/setup.json")).unwrap();
    fs::write(desk.path("data/setup.json"), setup.replace("\"seed\": 4", "\"seed\": 5")).unwrap();
    let error = desk.refused("observe data --views side --out refused");
    assert!(error.contains("another simulator"), "{error}");
}

#[test]
fn proposals_are_tried_and_an_interrupted_run_continues() {
    let desk = Desk::new();
    let command = format!("proposals --network {NETWORK} --grasps 12 --seed 3");
    desk.run(&format!("{command} --scenes 3 --out one"));
    desk.run(&format!("{command} --scenes 1 --out other"));
    desk.run(&format!("{command} --scenes 3 --out other"));
    let [one, other] = ["one", "other"].map(|name| Dataset::open(&[desk.path(name)]).unwrap());
    assert_eq!((one.len(), one.fingerprint()), (3, other.fingerprint()), "the same seed gives the same trials");
    let trials: Vec<_> = (0..3).flat_map(|scene| one.trials(scene)).collect();
    assert_eq!(trials.len(), 36);
    assert!(trials.iter().all(|trial| !trial.success || trial.share == 1.0), "a success has lifted an object");
    let lifted = trials.iter().filter(|trial| trial.share == 1.0).count();
    assert!((1..36).contains(&lifted), "{lifted} of 36");
    desk.run(&format!("{command} --scenes 1 --details --out details"));
    let details = Dataset::open(&[desk.path("details")]).unwrap();
    assert_eq!((one.resolution(), details.resolution()), (40, 80));
    for (coarse, fine) in one.trials(0).iter().zip(details.trials(0)) {
        assert!(
            (fine.position - 2.0 * coarse.position.coords).coords.norm() < 1e-4,
            "the same tries, in smaller voxels"
        );
    }
    assert!(details.volume(0, 0).contains(&grasp::Details::FREE) && !one.volume(0, 0).contains(&grasp::Details::FREE));
    let refused = desk.refused("proposals --scenes 1 --out x");
    assert!(refused.contains("--network"), "{refused}");
    let refused = desk.refused("observe one --views side --out again");
    assert!(refused.contains("one holds the grasps of a network"), "{refused}");
}

#[test]
fn conditions_of_the_tables_run_once() {
    let desk = Desk::new();
    fs::create_dir(desk.path("zoo")).unwrap();
    fs::copy(NETWORK, desk.path("zoo/vgn-packed.onnx")).unwrap();
    let tables = "tables --models zoo --out out/tables.md --results out/tables.jsonl --rounds 1 --seeds 1 --timed 1";
    let missing = |desk: &Desk| {
        let output = desk.command(tables).output().unwrap();
        assert!(output.status.success(), "{}", stderr(&output));
        let log = stderr(&output);
        let words: Vec<usize> = log.split_whitespace().filter_map(|word| word.parse().ok()).collect();
        (words[0], words[1])
    };
    let (first, all) = missing(&desk);
    assert!(first == all && all > 10);
    let text = fs::read_to_string(desk.path("out/tables.md")).unwrap();
    for row in ["| shaf |", "| vgn |", "74.5 ± 1.3", "`vgn-packed.onnx` | 3,774 |", "| vgn on packed |"] {
        assert!(text.contains(row), "`{row}` is missing from:\n{text}");
    }
    let (_, corrected) = text.split_once("### Objects of `test`, corrected\n").expect("a table with corrected depths");
    assert!(corrected.lines().any(|row| row.starts_with("| vgn |") && row.matches(" → ").count() == 1), "{corrected}");
    assert_eq!(missing(&desk), (0, all));
    assert_eq!(fs::read_to_string(desk.path("out/tables.md")).unwrap(), text);

    // A log that ends in the middle of a line, and a changed network.
    let log = fs::read_to_string(desk.path("out/tables.jsonl")).unwrap();
    assert_eq!(log.lines().count(), all);
    fs::write(desk.path("out/tables.jsonl"), &log[..log.len() - 20]).unwrap();
    assert_eq!(missing(&desk), (1, all));
    let mut network = fs::read(NETWORK).unwrap();
    // An unknown ONNX field: another file, the same network.
    network.extend([0xF8, 0x3F, 0x01]);
    fs::write(desk.path("zoo/vgn-packed.onnx"), network).unwrap();
    let (repeated, _) = missing(&desk);
    assert!(repeated > 5 && repeated < all, "{repeated} of {all}: conditions without the network are kept");

    // The results of a network that is not in the folder stay, those of the earlier file do not.
    let log = fs::read_to_string(desk.path("out/tables.jsonl")).unwrap();
    let of_vgn = log.lines().find(|line| line.contains(r#""method":"vgn""#)).unwrap();
    let of_other = of_vgn.replace(r#""key":""#, r#""key":"other-"#).replace(r#""method":"vgn""#, r#""method":"other""#);
    fs::write(desk.path("out/tables.jsonl"), format!("{log}{of_other}\n")).unwrap();
    assert_eq!(missing(&desk), (0, all));
    let kept = fs::read_to_string(desk.path("out/tables.jsonl")).unwrap();
    assert!(kept.lines().count() == all + 1 && kept.contains(r#""method":"other""#), "{kept}");
}

#[test]
fn errors_name_the_cause() {
    let desk = Desk::new();
    desk.run("label --scene pile --points 5 --scenes 3 --format processed --out half");
    for folder in ["empty", "urdf", "flat", "wide", "half/scenes"] {
        fs::create_dir_all(desk.path(folder)).unwrap();
    }
    let urdf = |mesh: &str| {
        format!(
            "<robot name='o'><link name='l'><inertial><mass value='0.1'/></inertial><collision><geometry>\
             <mesh filename='{mesh}'/></geometry></collision></link></robot>"
        )
    };
    fs::write(desk.path("urdf/a.urdf"), "<robot><link>").unwrap();
    fs::write(desk.path("flat/a.urdf"), urdf("a.obj")).unwrap();
    fs::write(desk.path("flat/a.obj"), "v 0 0 0\nv 1 0 0\n").unwrap();
    fs::write(desk.path("wide/a.urdf"), urdf("a.obj")).unwrap();
    let corners = (0..8)
        .map(|i| format!("v {} {} {}\n", 0.3 * f64::from(i & 1), 0.3 * f64::from(i >> 1 & 1), 0.3 * f64::from(i >> 2)));
    let faces = ["1 2 4 3", "5 6 8 7", "1 2 6 5", "3 4 8 7", "1 3 7 5", "2 4 8 6"].map(|face| format!("f {face}\n"));
    fs::write(desk.path("wide/a.obj"), corners.chain(faces).collect::<String>()).unwrap();
    fs::write(desk.path("data.jsonl"), "{}\n").unwrap();
    let label = "label --scene packed --scenes 1 --out never --objects";
    for (arguments, expected) in [
        (format!("{label} nowhere"), "nowhere"),
        (format!("{label} empty"), "empty"),
        (format!("{label} urdf"), "urdf/a.urdf"),
        (format!("{label} flat"), "flat/a.obj"),
        (format!("{label} wide"), "wide/a.urdf"),
        ("label --scenes 1 --out never --views top".to_owned(), "use side, side:90, side:random, circle, random:1-6"),
        ("label --scenes 1 --out never --noise 2".to_owned(), "must be from 0 to 1"),
        ("label --scenes 1 --out never --observations 2 --format raw".to_owned(), "only --format packed"),
        ("label --scenes 3 --scene pile --points 6 --format processed --out half".to_owned(), "half/setup.json"),
        ("bench --planner vgn-pakced --rounds 1".to_owned(), "Did you mean `vgn-packed`?"),
        ("proposals --network vgn-pakced --scenes 1 --out never".to_owned(), "Did you mean `vgn-packed`?"),
        ("proposals --network vgn-refined --scenes 1 --out never".to_owned(), "is not a network alone"),
        ("proposals --network vgn-packed --evaluator vgn-pile --scenes 1 --out never".to_owned(), "has no evaluator"),
        ("bench --planner nowhere.onnx --rounds 1".to_owned(), "nowhere.onnx"),
        ("bench --planner grpc:127.0.0.1:1 --rounds 1".to_owned(), "127.0.0.1:1"),
        ("bench --planner random --rounds 1 --threshold 2".to_owned(), "must be greater than 0 and at most 1"),
        ("bench --planner random --rounds 1 --force nan".to_owned(), "must be greater than 0 and at most 1, or `none`"),
        ("bench --planner random --rounds 1 --out-th 2".to_owned(), "must be from 0 to 1"),
        ("bench --planner random --rounds 1 --views side:nan".to_owned(), "--views is `side:nan`"),
        ("bench --planner random --rounds 1 --failures nowhere/sheet.png".to_owned(), "nowhere/sheet.png"),
        ("tables --models nowhere".to_owned(), "nowhere"),
        ("tables --objects some/test".to_owned(), "--objects is some/test"),
        ("tables --objects a/things --objects b/things".to_owned(), "--objects a/things and --objects b/things"),
        ("label --scenes 0 --out never".to_owned(), "--scenes is 0, must be greater than 0"),
        ("label --scenes 1 --observations 0 --out never".to_owned(), "--observations is 0, must be greater than 0"),
        ("label --scenes 1 --stretch 1.2 --export x.jsonl --out never".to_owned(), "leave out --stretch"),
        ("label --scenes 1 --clearance 0.02 --export x.jsonl --out never".to_owned(), "and --clearance"),
        ("label --scenes 1 --clearance 25 --out never".to_owned(), "must be from 0.001 to 0.035 metres"),
        ("label --scenes 1 --export data.jsonl --out never".to_owned(), "--export data.jsonl already exists"),
        ("label --scene pile --scenes 3 --points 5 --out half".to_owned(), "half has scenes in another format"),
        ("observe half --views side --out never".to_owned(), "half has no packed scenes"),
        ("observe half --views side --observations 0 --out never".to_owned(), "--observations is 0"),
        ("observe half --views top --out never".to_owned(), "--views is `top`"),
        ("merge half empty --out never".to_owned(), "half"),
        ("stats empty".to_owned(), "empty"),
    ] {
        let error = desk.refused(&arguments);
        assert!(error.contains(expected) && !error.contains("panicked"), "{arguments}: {error}");
    }
    assert!(!desk.path("never").exists(), "no output is created after an error");

    // A damaged data set: a truncated scene file, a missing scene file, a truncated table.
    let scene = fs::read_dir(desk.path("half/scenes")).unwrap().next().unwrap().unwrap().path();
    let name = scene.file_name().unwrap().to_str().unwrap().to_owned();
    let whole = fs::read(&scene).unwrap();
    fs::write(&scene, &whole[..whole.len() / 2]).unwrap();
    assert!(desk.refused("convert --from half --out other").contains(&name));
    fs::remove_file(&scene).unwrap();
    assert!(desk.refused("convert --from half --out another").contains(&name));
    fs::write(&scene, whole).unwrap();
    let table = fs::read_to_string(desk.path("half/grasps.csv")).unwrap();
    fs::write(desk.path("half/grasps.csv"), &table[..table.len() - 9]).unwrap();
    let error = desk.refused("convert --from half --out third");
    assert!(error.contains("half/grasps.csv, line 16"), "{error}");
    // Labelling again repairs it: the last scene is generated again.
    desk.run("label --scene pile --points 5 --scenes 3 --format processed --out half");
    assert_eq!(fs::read_to_string(desk.path("half/grasps.csv")).unwrap(), table);
}
