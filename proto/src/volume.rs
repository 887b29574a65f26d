use grasp::{RequestError, Volume, VolumeError};
use half::f16;
use half::slice::HalfFloatSliceExt;
use nalgebra::Isometry3;

use crate::pb;
use crate::pose::{self, PoseFields};

const POSE: PoseFields = PoseFields { position: "volume.pose.position", orientation: "volume.pose.orientation" };

/// The resolution of a volume message, checked against the length of its data. The server selects the model with it
/// before the data is converted.
///
/// # Errors
/// [`RequestError`] if the resolution or the dtype is not supported, or the length of the data does not match.
pub fn resolution(volume: &pb::Volume) -> Result<usize, RequestError> {
    let value_size = match volume.dtype() {
        pb::DataType::F32 => 4,
        pb::DataType::F16 => 2,
        pb::DataType::U8 => 1,
        pb::DataType::Unspecified => {
            let needed = "must be DATA_TYPE_F32 (1), DATA_TYPE_F16 (2) or DATA_TYPE_U8 (3)";
            return Err(RequestError::invalid("volume.dtype", volume.dtype, needed));
        }
    };
    let resolution = volume.resolution as usize;
    if resolution == 0 || resolution > Volume::MAX_RESOLUTION {
        return Err(VolumeError::Resolution(resolution).into());
    }
    let expected = resolution.pow(3) * value_size;
    if volume.data.len() != expected {
        let needed = format_args!(
            "a resolution of {resolution} needs {resolution}³ · {value_size} = {expected} ({dtype})",
            dtype = volume.dtype().as_str_name(),
        );
        return Err(RequestError::invalid("volume.data", format_args!("{} bytes", volume.data.len()), needed));
    }
    Ok(resolution)
}

impl TryFrom<&pb::Volume> for Volume {
    type Error = RequestError;

    /// Validates every field. The data is copied once, during the conversion to f32.
    fn try_from(volume: &pb::Volume) -> Result<Self, RequestError> {
        let resolution = resolution(volume)?;
        let pose = volume.pose.as_ref().map_or(Ok(Isometry3::identity()), |p| pose::decode(p, &POSE))?;
        let values = match volume.dtype() {
            pb::DataType::F16 => widen_f16(&volume.data),
            pb::DataType::U8 => volume.data.iter().map(|&v| f32::from(v) / 255.0).collect(),
            // `resolution` has rejected an unspecified type.
            pb::DataType::F32 | pb::DataType::Unspecified => {
                volume.data.as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect()
            }
        };
        Ok(Self::new(resolution, volume.voxel_size, pose, values)?)
    }
}

/// Converts block by block on the stack: the input may be unaligned, and `half` converts slices with CPU instructions.
fn widen_f16(data: &[u8]) -> Vec<f32> {
    let mut values = vec![0.0; data.len() / 2];
    let mut block = [f16::ZERO; 512];
    for (bytes, wide) in data.as_chunks().0.chunks(block.len()).zip(values.chunks_mut(block.len())) {
        let narrow = &mut block[..bytes.len()];
        for (value, &bytes) in narrow.iter_mut().zip(bytes) {
            *value = f16::from_le_bytes(bytes);
        }
        narrow.convert_to_f32_slice(wide);
    }
    values
}

/// Encodes a volume as `dtype`, in the frame `frame_id`. U8 rounds to 1/255; values above 0 stay above 0, because 0
/// means unobserved. An unspecified type is encoded as F32.
#[must_use]
pub fn encode(volume: &Volume, dtype: pb::DataType, frame_id: impl Into<String>) -> pb::Volume {
    let values = volume.values();
    let (dtype, data) = match dtype {
        pb::DataType::F32 | pb::DataType::Unspecified => (pb::DataType::F32, to_bytes(values, f32::to_le_bytes)),
        pb::DataType::F16 => (dtype, to_bytes(values, |v| f16::from_f32(v).to_le_bytes())),
        pb::DataType::U8 => (dtype, to_bytes(values, |v| [((v * 255.0).round() as u8).max(u8::from(v > 0.0))])),
    };
    pb::Volume {
        data: data.into(),
        dtype: dtype.into(),
        // No overflow: at most `Volume::MAX_RESOLUTION`.
        resolution: volume.resolution() as u32,
        voxel_size: volume.voxel_size(),
        pose: Some(volume.pose().into()),
        frame_id: frame_id.into(),
        stamp: None,
    }
}

/// Writes into a buffer of the final size, which the compiler turns into wide copies.
fn to_bytes<const N: usize>(values: &[f32], encode: impl Fn(f32) -> [u8; N]) -> Vec<u8> {
    let mut data = vec![0; N * values.len()];
    for (bytes, &value) in data.as_chunks_mut().0.iter_mut().zip(values) {
        *bytes = encode(value);
    }
    data
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::*;

    /// A volume of 9³ voxels, which is not a multiple of the half-precision block.
    fn volume() -> impl Strategy<Value = Volume> {
        let pose = (-5.0..5.0, -3.0..3.0).prop_map(|(x, turn): (f64, f64)| {
            Isometry3::new(nalgebra::Vector3::new(x, -x, 1.0), nalgebra::Vector3::new(0.0, turn, 0.4))
        });
        // Not a range of f32: one draw in 2²⁴ lies below its start, and fails an assertion of proptest 1.12.
        let observed = (1..=1_000_000_u32).prop_map(|millionths| millionths as f32 / 1e6);
        let values = vec(prop_oneof![Just(0.0), observed], 729);
        (pose, values).prop_filter_map("all zero", |(pose, values)| Volume::new(9, 0.01, pose, values).ok())
    }

    proptest! {
        #[test]
        fn encoding_and_decoding_round_trips(volume in volume()) {
            for (dtype, error) in [(pb::DataType::F32, 0.0), (pb::DataType::F16, 0.00025), (pb::DataType::U8, 0.00393)] {
                let message = encode(&volume, dtype, "base");
                let decoded = Volume::try_from(&message).unwrap();
                prop_assert!((decoded.pose().to_homogeneous() - volume.pose().to_homogeneous()).norm() < 1e-9);
                prop_assert_eq!((decoded.resolution(), decoded.voxel_size()), (9, 0.01));
                for (decoded, value) in decoded.values().iter().zip(volume.values()) {
                    prop_assert!((decoded - value).abs() <= error, "{} became {}", value, decoded);
                    prop_assert_eq!(*decoded == 0.0, *value == 0.0, "exactly the unobserved values are 0");
                }
            }
        }

        #[test]
        fn unaligned_data_is_decoded(volume in volume(), offset in 0..4_usize) {
            for dtype in [pb::DataType::F32, pb::DataType::F16] {
                let mut message = encode(&volume, dtype, "");
                let expected = Volume::try_from(&message).unwrap();
                let shifted = [&[0xff; 4][..offset], &message.data].concat();
                message.data = prost::bytes::Bytes::from(shifted).slice(offset..);
                prop_assert_eq!(Volume::try_from(&message).unwrap(), expected);
            }
        }
    }

    #[test]
    fn the_length_is_checked_without_converting_the_data() {
        let message = pb::Volume { dtype: pb::DataType::F16.into(), resolution: 256, ..Default::default() };
        let error = resolution(&message).unwrap_err();
        assert_eq!(error.field(), "volume.data");
        assert_eq!(
            error.to_string(),
            "volume.data is 0 bytes, a resolution of 256 needs 256³ · 2 = 33554432 (DATA_TYPE_F16)"
        );
    }
}
