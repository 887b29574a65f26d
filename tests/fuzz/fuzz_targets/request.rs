//! Arbitrary bytes as a request: decoded and checked. A valid volume is also decoded as the outputs of a network.

#![no_main]

use grasp::{DecodeParams, Maps, Volume, decode};
use grasp_proto::{encode, pb, resolution};
use libfuzzer_sys::fuzz_target;
use prost::Message;

fuzz_target!(|bytes: &[u8]| {
    let Some((&kind, bytes)) = bytes.split_first() else { return };
    // Random bytes almost never decode to a message with consistent fields, so every other input is built from fields.
    let volume = if kind % 2 == 0 { any(bytes) } else { fitting(bytes) };
    let Some(message) = &volume else { return };
    // The resolution is checked before the data.
    let checked = resolution(message);
    let Ok(volume) = Volume::try_from(message) else { return };
    assert_eq!(checked.ok(), Some(volume.resolution()));
    assert!(volume.values().iter().all(|value| (0.0..=1.0).contains(value)));

    // A valid volume round-trips.
    let again = Volume::try_from(&encode(&volume, pb::DataType::F32, "")).expect("an encoded volume is valid");
    assert_eq!(again.values(), volume.values());

    let values = volume.values();
    let rotation: Vec<f32> = (0..4).flat_map(|_| values).copied().collect();
    let maps = Maps { quality: values, rotation: &rotation, width: values };
    if let Ok(decoded) = decode(&volume, &maps, &DecodeParams::default()) {
        for grasp in &decoded.grasps {
            let message = pb::Grasp::from(grasp);
            let read = grasp::Grasp::try_from(&message).expect("an encoded grasp is valid");
            assert!(read.quality.is_finite() && read.pose.translation.vector.iter().all(|c| c.is_finite()));
        }
    }
});

fn any(bytes: &[u8]) -> Option<pb::Volume> {
    pb::DetectGraspsRequest::decode(bytes).ok()?.volume
}

/// A volume whose data has the length for its resolution and type, with values from the fuzzer.
fn fitting(mut bytes: &[u8]) -> Option<pb::Volume> {
    let [resolution, dtype] = *bytes.split_off(..2)?.first_chunk()?;
    let mut number = || Some(f64::from_le_bytes(*bytes.split_off(..8)?.first_chunk()?));
    let voxel_size = number()?;
    let position = pb::Vector3 { x: number()?, y: number()?, z: number()? };
    let orientation = pb::Quaternion { x: number()?, y: number()?, z: number()?, w: number()? };
    let (resolution, dtype) = (u32::from(resolution % 12), i32::from(dtype % 5));
    let size = [4, 4, 2, 1, 1][dtype as usize];
    let length = (resolution.pow(3) as usize) * size;
    let data: Vec<u8> = bytes.iter().copied().cycle().take(if bytes.is_empty() { 0 } else { length }).collect();
    Some(pb::Volume {
        resolution,
        dtype,
        voxel_size,
        data: data.into(),
        pose: Some(pb::Pose { position: Some(position), orientation: Some(orientation) }),
        ..pb::Volume::default()
    })
}
