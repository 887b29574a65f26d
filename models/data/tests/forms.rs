//! What is written is read again, whatever happened in between.

use std::fs;
use std::path::Path;

use grasp_data::{DataError, Dataset, Form, Provenance, Setup, Trial, packed, processed, raw};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};

const N: usize = 8;

fn setup() -> Setup {
    Setup::benchmark(Provenance {
        scene: "pile".into(),
        objects: "train".into(),
        points: 2,
        views: "side".into(),
        looks: 2,
        noise: 0.0,
        seed: 1,
        look_seed: None,
        version: "0".into(),
    })
}

fn trials(number: u64) -> Vec<Trial> {
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.1 * number as f64);
    let trial = |success, turns| Trial {
        position: Point3::new(1.5, 2.0, number as f64),
        rotation,
        width: 3.25,
        success,
        turns,
    };
    vec![trial(true, 0b1_0010), trial(false, 0)]
}

fn volumes(number: u64) -> Vec<Vec<f32>> {
    (0..2).map(|look| (0..N.pow(3)).map(|i| ((i as u64 + look + number) % 256) as f32 / 255.0).collect()).collect()
}

/// Trials as they are after a round trip through f32.
fn assert_same(read: &[Trial], written: &[Trial]) {
    assert_eq!(read.len(), written.len());
    for (read, written) in read.iter().zip(written) {
        assert!((read.position - written.position).norm() < 1e-5);
        assert!(read.rotation.angle_to(&written.rotation) < 1e-5);
        assert!((read.width - written.width).abs() < 1e-5);
        assert_eq!(read.success, written.success);
    }
}

fn pack(folder: &Path, numbers: impl IntoIterator<Item = u64>) {
    let mut writer = packed::Writer::open(folder, &setup()).unwrap();
    let next = writer.next().unwrap_or(0);
    for number in numbers.into_iter().filter(|&number| number >= next) {
        writer.append(number, &volumes(number), &trials(number)).unwrap();
    }
}

#[test]
fn packed_scenes_are_read_as_they_were_written() {
    let folder = tempfile::tempdir().unwrap();
    pack(folder.path(), [0, 1, 3]);
    assert_eq!(Form::of(folder.path()).unwrap(), Form::Packed);
    let dataset = Dataset::open(&[folder.path().to_owned()]).unwrap();
    assert_eq!((dataset.len(), dataset.resolution()), (3, N));
    for (index, number) in [0, 1, 3].into_iter().enumerate() {
        assert_eq!(dataset.id(index), format!("{number:08}"));
        assert_same(&dataset.trials(index), &trials(number));
        assert_eq!(dataset.trials(index)[0].turns, 0b1_0010, "which other forms do not keep");
        assert_eq!(dataset.volumes(index), 2);
        for (look, volume) in volumes(number).iter().enumerate() {
            let read: Vec<f32> = dataset.volume(index, look).iter().map(|&byte| grasp_data::value(byte)).collect();
            assert_eq!(read, *volume);
        }
    }
}

#[test]
fn the_first_version_of_the_packed_form_is_read_too() {
    let folder = tempfile::tempdir().unwrap();
    let first: Vec<Trial> = trials(0).into_iter().map(|trial| Trial { turns: 0, ..trial }).collect();
    packed::Writer::open(folder.path(), &setup()).unwrap().append(0, &volumes(0), &first).unwrap();
    let path = folder.path().join("scenes-00000.pack");
    let mut bytes = fs::read(&path).unwrap();
    bytes[8] = 1;
    fs::write(&path, bytes).unwrap();
    assert_same(&Dataset::open(&[folder.path().to_owned()]).unwrap().trials(0), &first);
}

#[test]
fn a_packed_run_cut_off_anywhere_goes_on_without_a_lost_or_doubled_scene() {
    let whole = tempfile::tempdir().unwrap();
    pack(whole.path(), [0, 1, 3]);
    let bytes = fs::read(whole.path().join("scenes-00000.pack")).unwrap();
    for length in (0..bytes.len()).step_by(61) {
        let folder = tempfile::tempdir().unwrap();
        setup().claim(folder.path()).unwrap();
        fs::write(folder.path().join("scenes-00000.pack"), &bytes[..length]).unwrap();
        pack(folder.path(), [0, 1, 3]);
        let reader = packed::Reader::open(folder.path()).unwrap();
        let numbers: Vec<u64> = (0..reader.len()).map(|index| reader.number(index)).collect();
        assert_eq!(numbers, [0, 1, 3], "cut after {length} bytes");
        assert_eq!(fs::read(folder.path().join("scenes-00000.pack")).unwrap(), bytes[..length], "no file is changed");
    }
}

#[test]
fn scenes_are_read_while_they_are_written() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = packed::Writer::open(folder.path(), &setup()).unwrap();
    writer.append(0, &volumes(0), &trials(0)).unwrap();
    let mut dataset = Dataset::open(&[folder.path().to_owned()]).unwrap();
    assert_eq!(dataset.refresh().unwrap(), 0);
    for number in 1..4 {
        writer.append(number, &volumes(number), &trials(number)).unwrap();
        assert_eq!(dataset.refresh().unwrap(), 1);
    }
    drop(writer);
    // A second run writes a second file.
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
fn a_damaged_file_is_named() {
    let folder = tempfile::tempdir().unwrap();
    pack(folder.path(), [0, 1]);
    let path = folder.path().join("scenes-00000.pack");
    let good = fs::read(&path).unwrap();
    for (at, said) in [(0, "does not begin with"), (8, "version"), (600, "checksum")] {
        let mut bad = good.clone();
        bad[at] ^= 0x10;
        fs::write(&path, bad).unwrap();
        let error = packed::Reader::open(folder.path()).err().unwrap().to_string();
        assert!(error.contains("scenes-00000.pack") && error.contains(said), "{error}");
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
    assert!(matches!(&error, DataError::Twice { id, .. } if id == "00000000"), "{error}");
    assert!(!again.exists(), "nothing is written before all is known to fit");

    let mut other = setup();
    other.provenance.as_mut().unwrap().seed = 2;
    let c = folder.path().join("c");
    packed::Writer::open(&c, &other).unwrap().append(9, &volumes(9), &trials(9)).unwrap();
    assert!(matches!(packed::merge(&[a, c], &again), Err(DataError::OtherSetup { .. })));
}

#[test]
fn a_processed_run_cut_off_anywhere_goes_on_without_a_lost_or_doubled_scene() {
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
    let header = "scene_id,qx,qy,qz,qw,i,j,k,width,label\n";
    let first = "00000000,0.0000000,0.0000000,0.0000000,1.0000000,1.500000,2.000000,0.000000,3.250000,1\n";
    assert!(whole.starts_with(&format!("{header}{first}")), "{whole}");
    // In a row, between two, or in a scene's number.
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
fn raw_scenes_are_read_as_they_were_written() {
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
    assert_eq!(raw::Writer::open(folder.path(), &setup).unwrap().next(), Some(7), "the last scene is made again");
    raw::Writer::open(folder.path(), &setup).unwrap().append("00000007", &views, &trials(7)).unwrap();

    assert_eq!(Form::of(folder.path()).unwrap(), Form::Raw);
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
fn another_recipe_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    setup().claim(folder.path()).unwrap();
    let mut other = setup();
    other.provenance.as_mut().unwrap().seed = 2;
    assert!(matches!(processed::Writer::open(folder.path(), &other), Err(DataError::OtherSetup { .. })));
    assert!(matches!(packed::Writer::open(folder.path(), &other), Err(DataError::OtherSetup { .. })));
}

#[test]
fn what_cannot_be_read_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let error = || Dataset::open(&[folder.path().to_owned()]).err().unwrap().to_string();
    assert!(error().contains("holds no grasps"), "{}", error());

    let mut writer = processed::Writer::open(folder.path(), &setup()).unwrap();
    writer.append("00000001", &volumes(1)[0], &trials(1)).unwrap();
    let table = folder.path().join("grasps.csv");
    let good = fs::read_to_string(&table).unwrap();
    let line = good.lines().nth(2).unwrap();
    for (bad, said) in [
        (line.replace("00000001,", "00000009,"), "00000009.npz"),
        ("00000001,0,0,0,1,1,2,3,4,2".to_owned(), "line 4: label is 2"),
        ("00000001,0,0,0,0.5,1,2,3,4,1".to_owned(), "line 4: the quaternion has length 0.5"),
        ("00000001,0,0,0,1,nan,2,3,4,1".to_owned(), "line 4: the position is NaN"),
        ("00000001,0,0,0,1,one,2,3,4,1".to_owned(), "line 4:"),
        ("00000001,0,0,0".to_owned(), "line 4:"),
    ] {
        fs::write(&table, format!("{good}{bad}\n")).unwrap();
        assert!(error().contains(said), "{bad}: {}", error());
    }
    fs::write(&table, good.lines().next().unwrap()).unwrap();
    assert!(error().contains("holds no grasps"), "{}", error());
    fs::write(&table, &good).unwrap();
    fs::write(folder.path().join("scenes/00000001.npz"), "no archive").unwrap();
    assert!(error().contains("00000001.npz"), "{}", error());
}

#[test]
fn scenes_stay_on_their_side_of_the_split() {
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
