//! The three formats: round trips, interrupted runs and damaged files.

use std::fs;
use std::path::Path;

use grasp_data::{
    DataError, DataFormat, Dataset, MAX_CLEARANCE, Occupancy, Provenance, Scene, Setup, Trial, packed, processed, raw,
};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};

const N: usize = 8;

fn setup() -> Setup {
    Setup::benchmark(Provenance {
        scene: "pile".into(),
        objects: "train".into(),
        part: "all".to_owned(),
        stretch: None,
        clearance: None,
        points: 2,
        views: "side".into(),
        observations: 2,
        noise: 0.0,
        sensor: "dex".into(),
        correct_depth_scale: false,
        seed: 1,
        observation_seed: None,
        network: None,
        evaluator: None,
        details: false,
        version: "0".into(),
    })
}

fn trials(number: u64) -> Vec<Trial> {
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.1 * number as f64);
    let trial = |success, yaws, share, clearance| Trial {
        position: Point3::new(1.5, 2.0, number as f64),
        rotation,
        width: 3.25,
        success,
        yaws,
        share,
        clearance,
    };
    vec![trial(true, 0b1_0010, 0.75, 0.0125), trial(false, 0, 0.0, MAX_CLEARANCE)]
}

fn volumes(number: u64) -> Vec<Vec<f32>> {
    (0..2)
        .map(|observation| (0..N.pow(3)).map(|i| ((i as u64 + observation + number) % 256) as f32 / 255.0).collect())
        .collect()
}

fn occupancy(number: u64) -> Occupancy {
    let mut occupancy = Occupancy::empty(N.pow(3));
    [number as usize, 100, N.pow(3) - 1].into_iter().for_each(|voxel| occupancy.insert(voxel));
    occupancy
}

/// Compares trials after a round trip through f32.
fn assert_same(read: &[Trial], written: &[Trial]) {
    assert_eq!(read.len(), written.len());
    for (read, written) in read.iter().zip(written) {
        assert!((read.position - written.position).norm() < 1e-5);
        assert!(read.rotation.angle_to(&written.rotation) < 1e-5);
        assert!((read.width - written.width).abs() < 1e-5);
        assert_eq!(read.success, written.success);
        assert_eq!((read.share, read.clearance), (written.share, written.clearance));
    }
}

fn pack(folder: &Path, numbers: impl IntoIterator<Item = u64>) {
    let mut writer = packed::Writer::open(folder, &setup()).unwrap();
    let next = writer.next().unwrap_or(0);
    for number in numbers.into_iter().filter(|&number| number >= next) {
        writer.append(number, &volumes(number), &trials(number), Some(&occupancy(number))).unwrap();
    }
}

#[test]
fn packed_scenes_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    pack(folder.path(), [0, 1, 3]);
    assert_eq!(DataFormat::from_folder(folder.path()).unwrap(), DataFormat::Packed);
    let dataset = Dataset::open(&[folder.path().to_owned()]).unwrap();
    assert_eq!((dataset.len(), dataset.resolution()), (3, N));
    for (index, number) in [0, 1, 3].into_iter().enumerate() {
        assert_eq!(dataset.id(index), format!("{number:08}"));
        assert_same(&dataset.trials(index), &trials(number));
        assert_eq!(dataset.trials(index)[0].yaws, 0b1_0010, "only the packed format stores yaws");
        assert_eq!(dataset.volumes(index), 2);
        for (observation, volume) in volumes(number).iter().enumerate() {
            let read: Vec<f32> =
                dataset.volume(index, observation).iter().map(|&byte| grasp_data::value(byte)).collect();
            assert_eq!(read, *volume);
        }
        assert_eq!(dataset.occupancy(index), Some(occupancy(number)));
    }
}

#[test]
fn a_scene_that_was_observed_again_counts_once() {
    let scene = |id: &str, trials: Vec<Trial>, seen: u64| {
        let volumes = volumes(seen).iter().map(|volume| grasp_data::quantise(volume)).collect();
        Scene { id: id.into(), volumes, trials, occupancy: None }
    };
    let scenes = [("0", trials(0), 0), ("1", trials(1), 0), ("0", trials(0), 1), ("0", trials(1), 0)];
    let scenes = scenes.map(|(id, trials, seen)| scene(id, trials, seen));
    assert_eq!(Dataset::new(scenes.into()).unwrap().distinct(), [0, 1, 3]);
}

#[test]
fn the_fingerprint_depends_on_everything_that_is_trained() {
    let fingerprint_of = |change: fn(&mut Trial), occupancy| {
        let mut trials = trials(0);
        change(&mut trials[0]);
        let volumes = volumes(0).iter().map(|volume| grasp_data::quantise(volume)).collect();
        Dataset::new(vec![Scene { id: "a".into(), volumes, trials, occupancy }]).unwrap().fingerprint()
    };
    let fingerprint = |change| fingerprint_of(change, None);
    let same = fingerprint(|_| {});
    assert_ne!(fingerprint(|trial| trial.share = 0.5), same);
    assert_ne!(fingerprint(|trial| trial.clearance = 0.01), same);
    let [one, other] = [1, 2].map(|number| fingerprint_of(|_| {}, Some(occupancy(number))));
    assert!(one != same && one != other);
}

#[test]
fn an_interrupted_packed_run_continues_without_lost_or_duplicate_scenes() {
    let whole = tempfile::tempdir().unwrap();
    pack(whole.path(), [0, 1, 3]);
    let bytes = fs::read(whole.path().join("scenes-00000.pack")).unwrap();
    for length in (0..bytes.len()).step_by(61) {
        let folder = tempfile::tempdir().unwrap();
        setup().write_or_compare(folder.path()).unwrap();
        fs::write(folder.path().join("scenes-00000.pack"), &bytes[..length]).unwrap();
        pack(folder.path(), [0, 1, 3]);
        let mut reader = packed::Reader::open(folder.path()).unwrap();
        let numbers: Vec<u64> = (0..reader.len()).map(|index| reader.number(index)).collect();
        assert_eq!(numbers, [0, 1, 3], "cut after {length} bytes");
        assert_eq!(reader.volume(2, 0), grasp_data::quantise(&volumes(3)[0]), "cut after {length} bytes");
        assert_eq!(reader.refresh().unwrap(), 0, "cut after {length} bytes");
        assert_eq!(
            fs::read(folder.path().join("scenes-00000.pack")).unwrap(),
            bytes[..length],
            "the existing file does not change"
        );
    }
}

#[test]
fn scenes_are_read_while_they_are_written() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = packed::Writer::open(folder.path(), &setup()).unwrap();
    writer.append(0, &volumes(0), &trials(0), None).unwrap();
    let mut dataset = Dataset::open(&[folder.path().to_owned()]).unwrap();
    assert_eq!(dataset.refresh().unwrap(), 0);
    for number in 1..4 {
        writer.append(number, &volumes(number), &trials(number), Some(&occupancy(number))).unwrap();
        assert_eq!(dataset.refresh().unwrap(), 1);
    }
    drop(writer);
    // A second run starts a second file.
    pack(folder.path(), 0..6);
    assert_eq!(dataset.refresh().unwrap(), 2);
    assert_eq!((dataset.len(), dataset.sizes()), (6, vec![6]));
    let whole = dataset.fingerprint();
    dataset.limit(&[4]);
    assert_eq!(dataset.len(), 4);
    assert_ne!(dataset.fingerprint(), whole);
    dataset.refresh().unwrap();
    assert_eq!(dataset.fingerprint(), whole);
    (0..6).for_each(|index| assert_same(&dataset.trials(index), &trials(index as u64)));
}

#[test]
fn errors_name_the_damaged_file() {
    let folder = tempfile::tempdir().unwrap();
    pack(folder.path(), [0, 1]);
    let path = folder.path().join("scenes-00000.pack");
    let good = fs::read(&path).unwrap();
    for (at, expected) in
        [(0, "does not begin with"), (8, "make the scenes again"), (15, "at most 256"), (600, "checksum")]
    {
        let mut bad = good.clone();
        bad[at] ^= 0x10;
        fs::write(&path, bad).unwrap();
        let error = packed::Reader::open(folder.path()).err().unwrap().to_string();
        assert!(error.contains("scenes-00000.pack") && error.contains(expected), "{error}");
    }
}

#[test]
fn a_header_with_an_edge_that_overflows_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    pack(folder.path(), [0]);
    let file = folder.path().join("scenes-00000.pack");
    let whole = fs::read(&file).unwrap();
    // Their third powers do not fit u32 and u64.
    for edge in [257_u32, 2000, 3_000_000, u32::MAX] {
        let mut bytes = whole.clone();
        bytes[12..16].copy_from_slice(&edge.to_le_bytes());
        fs::write(&file, bytes).unwrap();
        let error = Dataset::open(&[folder.path().to_owned()]).err().unwrap().to_string();
        assert!(error.contains(&format!("the edge of a volume is {edge} voxels, must be at most 256")), "{error}");
    }
}

#[test]
fn ranges_of_scenes_are_merged() {
    let folder = tempfile::tempdir().unwrap();
    let [a, b, all] = ["a", "b", "all"].map(|name| folder.path().join(name));
    pack(&a, [0, 1]);
    pack(&b, [2, 3, 4]);
    assert_eq!(packed::merge(&[a.clone(), b.clone()], &all).unwrap(), 5);
    let reader = packed::Reader::open(&all).unwrap();
    assert_eq!((0..5).map(|index| reader.number(index)).collect::<Vec<_>>(), [0, 1, 2, 3, 4]);
    assert_eq!(reader.volume(4, 1), packed::Reader::open(&b).unwrap().volume(2, 1));

    let again = folder.path().join("again");
    let error = packed::merge(&[a.clone(), b.clone(), a.clone()], &again).unwrap_err();
    assert!(matches!(&error, DataError::DuplicateScene { id, .. } if id == "00000000"), "{error}");
    assert!(!again.exists(), "nothing is written before all folders are checked");

    let mut other = setup();
    other.provenance.as_mut().unwrap().seed = 2;
    let c = folder.path().join("c");
    packed::Writer::open(&c, &other).unwrap().append(9, &volumes(9), &trials(9), None).unwrap();
    assert!(matches!(packed::merge(&[a, c], &again), Err(DataError::OtherSetup { .. })));
}

#[test]
fn an_interrupted_processed_run_continues_without_lost_or_duplicate_scenes() {
    let folder = tempfile::tempdir().unwrap();
    let write = || {
        let mut writer = processed::Writer::open(folder.path(), &setup()).unwrap();
        let next = writer.next().unwrap_or(0);
        for number in [0, 1, 3].into_iter().filter(|&number| number >= next) {
            writer.append(&format!("{number:08}"), &volumes(number)[0], &trials(number)).unwrap();
        }
    };
    write();
    let table = folder.path().join("grasps.csv");
    let whole = fs::read_to_string(&table).unwrap();
    let header = "scene_id,qx,qy,qz,qw,i,j,k,width,label,share,clearance\n";
    let first =
        "00000000,0.0000000,0.0000000,0.0000000,1.0000000,1.500000,2.000000,0.000000,3.250000,1,0.750000,0.012500\n";
    assert!(whole.starts_with(&format!("{header}{first}")), "{whole}");
    // Cut in a row, between rows, or in a scene number.
    for length in header.len()..whole.len() {
        fs::write(&table, &whole[..length]).unwrap();
        write();
        assert_eq!(fs::read_to_string(&table).unwrap(), whole, "cut after {length} bytes");
    }
    let dataset = Dataset::open(&[folder.path().to_owned()]).unwrap();
    assert_eq!(dataset.len(), 3);
    assert_eq!(dataset.volume(2, 0), grasp_data::quantise(&volumes(3)[0]));
    assert_same(&dataset.trials(2), &trials(3));
}

#[test]
fn a_table_whose_scene_ids_are_not_numbers_is_not_continued() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = processed::Writer::open(folder.path(), &setup()).unwrap();
    // As VGN names its scenes.
    writer.append("0c6a1f", &volumes(0)[0], &trials(0)).unwrap();
    drop(writer);
    let table = fs::read_to_string(folder.path().join("grasps.csv")).unwrap();
    let error = processed::Writer::open(folder.path(), &setup()).err().unwrap().to_string();
    assert!(error.contains("line 2: the scene id has no number"), "{error}");
    assert_eq!(fs::read_to_string(folder.path().join("grasps.csv")).unwrap(), table);
}

#[test]
fn raw_scenes_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    let setup = setup();
    let pixels = setup.intrinsic.width * setup.intrinsic.height;
    let view = |depth: f32| raw::View {
        depth: vec![depth; pixels],
        camera_from_task: Isometry3::new(Vector3::new(0.1, -0.2, 0.5), Vector3::new(1.0, 0.5, 0.25)),
    };
    let mut writer = raw::Writer::open(folder.path(), &setup).unwrap();
    let views = [view(0.5), view(0.25)];
    writer.append("00000007", &views, &trials(7)).unwrap();
    drop(writer);
    assert_eq!(raw::Writer::open(folder.path(), &setup).unwrap().next(), Some(7), "the last scene is written again");
    raw::Writer::open(folder.path(), &setup).unwrap().append("00000007", &views, &trials(7)).unwrap();

    assert_eq!(DataFormat::from_folder(folder.path()).unwrap(), DataFormat::Raw);
    let reader = raw::Reader::open(folder.path()).unwrap();
    let (id, read) = reader.trials().next().unwrap();
    assert_eq!(id, "00000007");
    assert_same(read, &trials(7));
    for (read, written) in reader.views(id).unwrap().iter().zip(&views) {
        assert_eq!(read.depth, written.depth);
        let difference = read.camera_from_task.inv_mul(&written.camera_from_task);
        assert!(difference.translation.vector.norm() < 1e-6 && difference.rotation.angle() < 1e-6);
    }
    let error = Dataset::open(&[folder.path().to_owned()]).err().unwrap().to_string();
    assert!(error.contains("grasp-sim convert"), "{error}");
}

#[test]
fn a_folder_with_another_setup_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    setup().write_or_compare(folder.path()).unwrap();
    let mut other = setup();
    other.provenance.as_mut().unwrap().seed = 2;
    assert!(matches!(processed::Writer::open(folder.path(), &other), Err(DataError::OtherSetup { .. })));
    assert!(matches!(packed::Writer::open(folder.path(), &other), Err(DataError::OtherSetup { .. })));
}

#[test]
fn errors_name_the_invalid_file_and_line() {
    let folder = tempfile::tempdir().unwrap();
    let error = || Dataset::open(&[folder.path().to_owned()]).err().unwrap().to_string();
    assert!(error().contains("holds no grasps"), "{}", error());

    let mut writer = processed::Writer::open(folder.path(), &setup()).unwrap();
    writer.append("00000001", &volumes(1)[0], &trials(1)).unwrap();
    let table = folder.path().join("grasps.csv");
    let good = fs::read_to_string(&table).unwrap();
    let line = good.lines().nth(2).unwrap();
    for (bad, expected) in [
        (line.replace("00000001,", "00000009,"), "00000009.npz"),
        ("00000001,0,0,0,1,1,2,3,4,2,1,0".to_owned(), "line 4: label is 2"),
        ("00000001,0,0,0,0.5,1,2,3,4,1,1,0".to_owned(), "line 4: the quaternion has length 0.5"),
        ("00000001,0,0,0,1,nan,2,3,4,1,1,0".to_owned(), "line 4: the position is NaN"),
        ("00000001,0,0,0,1,one,2,3,4,1,1,0".to_owned(), "line 4:"),
        ("00000001,0,0,0,1,1,2,3,4,1,1.5,0".to_owned(), "line 4: share is 1.5, must be from 0 to 1"),
        ("00000001,0,0,0,1,1,2,3,4,1,nan,0".to_owned(), "line 4: share is NaN"),
        ("00000001,0,0,0,1,1,2,3,4,1,1,0.03".to_owned(), "line 4: clearance is 0.03, must be from 0 to 0.02 metres"),
        ("00000001,0,0,0,1,1,2,3,4,1,1,-0.01".to_owned(), "line 4: clearance is -0.01"),
        ("00000001,0,0,0,1,1,2,3,4,1,1,".to_owned(), "line 4:"),
        ("00000001,0,0,0".to_owned(), "line 4:"),
    ] {
        fs::write(&table, format!("{good}{bad}\n")).unwrap();
        assert!(error().contains(expected), "{bad}: {}", error());
    }
    fs::write(&table, good.lines().next().unwrap()).unwrap();
    assert!(error().contains("holds no grasps"), "{}", error());
    fs::write(&table, &good).unwrap();
    fs::write(folder.path().join("scenes/00000001.npz"), "not an archive").unwrap();
    assert!(error().contains("00000001.npz"), "{}", error());
}

#[test]
fn columns_are_found_by_name_and_share_and_clearance_are_optional() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = processed::Writer::open(folder.path(), &setup()).unwrap();
    writer.append("00000001", &volumes(1)[0], &trials(1)).unwrap();
    let table = folder.path().join("grasps.csv");
    let read = |text: &str| {
        fs::write(&table, text).unwrap();
        let trials = Dataset::open(&[folder.path().to_owned()]).map(|dataset| dataset.trials(0));
        trials.map(|trials| trials.iter().map(|trial| (trial.share, trial.clearance)).collect::<Vec<_>>())
    };
    // As written by VGN and GIGA.
    let old = "scene_id,qx,qy,qz,qw,i,j,k,width,label\n00000001,0,0,0,1,1,2,3,4,1\n00000001,0,0,0,1,1,2,3,4,0\n";
    assert_eq!(read(old).unwrap(), [(1.0, 0.0), (0.0, 0.0)]);
    let one = "label,share,scene_id,qx,qy,qz,qw,more,i,j,k,width\n1,0.25,00000001,0,0,0,1,7,1,2,3,4\n";
    assert_eq!(read(one).unwrap(), [(0.25, 0.0)]);
    let other = "scene_id,qx,qy,qz,qw,i,j,k,width,clearance,label\n00000001,0,0,0,1,1,2,3,4,0.01,1\n";
    assert_eq!(read(other).unwrap(), [(1.0, 0.01)]);
    assert!(read(&other.replace("width", "wide")).unwrap_err().to_string().contains("the column `width` is missing"));

    // Rows of the current version are not appended to a table with an older header.
    let old = format!("{old}00000002,0,0,0,1,1,2,3,4,1\n");
    fs::write(&table, &old).unwrap();
    let Err(DataError::Row { line: 1, reason, .. }) = processed::Writer::open(folder.path(), &setup()) else {
        panic!("a table with other columns must be refused")
    };
    assert!(reason.contains("write into another folder"), "{reason}");
    assert_eq!(fs::read_to_string(&table).unwrap(), old, "nothing is lost");
}

#[test]
fn added_scenes_do_not_change_the_split() {
    let folders: Vec<_> = (0..2).map(|_| tempfile::tempdir().unwrap()).collect();
    pack(folders[0].path(), 0..200);
    pack(folders[1].path(), 0..400);
    let [few, many] = [0, 1].map(|i| Dataset::open(&[folders[i].path().to_owned()]).unwrap());
    let (training, held_out) = few.split(0.1);
    assert_eq!(training.len() + held_out.len(), 200);
    assert!((8..=35).contains(&held_out.len()), "{} of 200", held_out.len());
    assert!(held_out.iter().all(|scene| many.split(0.1).1.contains(scene)));
    assert_eq!(few.split(0.0).1, [0_usize; 0]);
}
