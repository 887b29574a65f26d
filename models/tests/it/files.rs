//! Metadata and the store of model files.

use std::fs;
use std::path::Path;

use grasp::VoxelOrigin;
use grasp_models::onnx::{Dimension, ModelProto, StringStringEntryProto, ValueInfoProto};
use grasp_models::{Architecture, INPUT, Metadata, Store, StoreError};

fn vgn() -> ModelProto {
    Architecture::Vgn.build(8, 0).unwrap()
}

fn with(change: impl FnOnce(&mut Metadata)) -> ModelProto {
    let mut model = vgn();
    let mut metadata = Metadata::from_model(&model, Path::new("vgn.onnx")).unwrap();
    change(&mut metadata);
    metadata.write_to(&mut model);
    model
}

fn named(name: &str, version: &str) -> ModelProto {
    with(|metadata| {
        name.clone_into(&mut metadata.name);
        version.clone_into(&mut metadata.version);
    })
}

#[test]
fn metadata_is_stored_in_the_file() {
    let model = with(|metadata| {
        metadata.name = "pile".to_owned();
        metadata.version = "2.1".to_owned();
        metadata.voxel_size = 0.3 / 40.0;
        metadata.voxel_origin = VoxelOrigin::Center;
        metadata.provenance.insert("data".to_owned(), "1000 scenes, seed 7".to_owned());
    });
    let read = Metadata::from_model(&model, Path::new("other.onnx")).unwrap();
    assert_eq!((read.name.as_str(), read.version.as_str(), read.resolution), ("pile", "2.1", 8));
    assert_eq!(read.voxel_size, 0.3 / 40.0, "to the last bit");
    assert_eq!(read.provenance["data"], "1000 scenes, seed 7");
    assert_eq!(read.provenance["architecture"], "vgn");
    assert_eq!(read.decode_params().origin, VoxelOrigin::Center);
}

#[test]
fn a_file_without_metadata_follows_vgns_conventions() {
    let mut model = vgn();
    model.metadata_props.clear();
    let read = Metadata::from_model(&model, Path::new("models/vgn_pile.onnx")).unwrap();
    assert_eq!(read, Metadata::defaults(Path::new("vgn_pile.onnx"), Some(8)));
    assert_eq!((read.name.as_str(), read.version.as_str()), ("vgn_pile", "1"));
    assert_eq!(read.voxel_origin, VoxelOrigin::Corner);
    assert_eq!(Metadata::defaults(Path::new("x.onnx"), None).resolution, 40);
    // The input's N is dynamic, so that it is in a property only.
    let mut model = Architecture::Vgn.build(80, 0).unwrap();
    model.metadata_props.retain(|property| property.key() == "graspd.resolution");
    let input = &mut model.graph.as_mut().unwrap().input[0];
    *input = ValueInfoProto::tensor(INPUT, ["batch", "channels", "x", "y", "z"].map(Dimension::named).to_vec());
    let read = Metadata::from_model(&model, Path::new("x.onnx")).unwrap();
    assert_eq!((read.resolution, read.voxel_size), (80, 0.3 / 80.0));
}

#[test]
fn invalid_metadata_is_an_error_that_names_the_property() {
    for (key, value) in [
        ("resolution", "0"),
        ("resolution", "forty"),
        ("voxel_size", "-1"),
        ("voxel_size", "inf"),
        ("value_convention", "metres"),
        ("voxel_origin", "centre"),
    ] {
        let mut model = vgn();
        let property = model.metadata_props.iter_mut().find(|p| p.key() == format!("graspd.{key}")).unwrap();
        property.value = Some(value.to_owned());
        let error = Metadata::from_model(&model, Path::new("vgn.onnx")).unwrap_err().to_string();
        assert!(error.contains(key) && error.contains(&format!("`{value}`")), "{error}");
    }
}

#[test]
fn an_unknown_property_and_an_empty_name_are_errors() {
    let error = |key: &str, value: &str| {
        let mut model = vgn();
        let (key, value) = (Some(format!("graspd.{key}")), Some(value.to_owned()));
        model.metadata_props.push(StringStringEntryProto { key, value });
        Metadata::from_model(&model, Path::new("vgn.onnx")).unwrap_err().to_string()
    };
    assert!(error("voxel_orign", "center").contains("`graspd.voxel_orign` is not known"));
    assert!(error("name", "").contains("`graspd.name` is ``, must be 1 to 128 bytes"), "{}", error("name", ""));
}

#[test]
fn an_unsupported_resolution_is_an_error() {
    // From the property, then from the shape of the input.
    let model = with(|metadata| metadata.resolution = 257);
    let error = Metadata::from_model(&model, Path::new("vgn.onnx")).unwrap_err().to_string();
    assert!(error.contains("257") && error.contains("from 1 to 256"), "{error}");
    let mut model = with(|metadata| metadata.resolution = 256);
    assert_eq!(Metadata::from_model(&model, Path::new("vgn.onnx")).unwrap().resolution, 256);
    let input = ValueInfoProto::tensor("tsdf", [1, 1, 264, 264, 264].map(Dimension::size).to_vec());
    model.graph.as_mut().unwrap().input = vec![input];
    let error = Metadata::from_model(&model, Path::new("vgn.onnx")).unwrap_err().to_string();
    assert!(error.contains("264"), "{error}");
}

#[test]
fn a_store_returns_the_newest_or_the_requested_version() {
    let folder = tempfile::tempdir().unwrap();
    for (file, name, version) in [("a", "pile", "1.9"), ("b", "pile", "1.10"), ("c", "packed", "3")] {
        named(name, version).write(&folder.path().join(file).with_extension("onnx")).unwrap();
    }
    fs::write(folder.path().join("notes.txt"), "no model").unwrap();
    let store = Store::open(folder.path()).unwrap();
    assert_eq!(store.entries().len(), 3);
    assert_eq!(store.get("pile", None).unwrap().path, folder.path().join("b.onnx"));
    let old = store.get("pile", Some("1.9")).unwrap();
    assert_eq!(old.path, folder.path().join("a.onnx"));
    let error = store.get("pile", Some("2")).unwrap_err().to_string();
    assert!(error.contains("`pile 2`") && error.contains("packed 3, pile 1.9, pile 1.10"), "{error}");
}

#[test]
fn the_hash_of_a_model_is_the_sha256_of_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("vgn.onnx");
    vgn().write(&path).unwrap();
    let output = std::process::Command::new("sha256sum").arg(&path).output().unwrap();
    let expected = String::from_utf8(output.stdout).unwrap();
    assert_eq!(Some(Store::open(folder.path()).unwrap().entries()[0].sha256.as_str()), expected.split(' ').next());
}

#[test]
fn errors_of_a_folder_name_every_invalid_file() {
    let folder = tempfile::tempdir().unwrap();
    assert!(matches!(Store::open(&folder.path().join("none")), Err(StoreError::Io { .. })));
    assert!(matches!(Store::open(folder.path()), Err(StoreError::Empty(_))));

    named("pile", "1").write(&folder.path().join("a.onnx")).unwrap();
    named("pile", "1").write(&folder.path().join("b.onnx")).unwrap();
    let error = Store::open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("a.onnx") && error.contains("b.onnx") && error.contains("`pile` version 1"), "{error}");

    let bytes = fs::read(folder.path().join("a.onnx")).unwrap();
    fs::write(folder.path().join("b.onnx"), &bytes[..bytes.len() - 100]).unwrap();
    let error = Store::open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("b.onnx") && error.contains("cut short"), "{error}");
    fs::write(folder.path().join("b.onnx"), "").unwrap();
    assert!(Store::open(folder.path()).unwrap_err().to_string().contains("no graph"));

    // One line per invalid file.
    with(|metadata| metadata.resolution = 300).write(&folder.path().join("c.onnx")).unwrap();
    named("pile", "1").write(&folder.path().join("d.onnx")).unwrap();
    let error = Store::open(folder.path()).unwrap_err().to_string();
    let lines: Vec<&str> = error.lines().collect();
    assert_eq!(lines.len(), 4, "{error}");
    assert!(lines[1].contains("b.onnx") && lines[1].contains("no graph"), "{error}");
    assert!(lines[2].contains("c.onnx") && lines[2].contains("300"), "{error}");
    assert!(lines[3].contains("a.onnx") && lines[3].contains("d.onnx"), "{error}");
}
