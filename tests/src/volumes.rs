use grasp::{DecodeParams, Decoded, Maps, Volume, WORKSPACE_SIZE, decode};
use nalgebra::Isometry3;

use crate::WIDTH;

/// Free space (0.6) with a block of 5³ voxels of value 1 around each of `centres`. A test model has a grasp at each.
///
/// # Panics
/// If a block exceeds the volume.
#[must_use]
pub fn blobs(resolution: usize, pose: Isometry3<f64>, centres: &[[usize; 3]]) -> Volume {
    let mut values = vec![0.6; resolution.pow(3)];
    for &[x, y, z] in centres {
        for dx in x - 2..=x + 2 {
            for dy in y - 2..=y + 2 {
                for dz in z - 2..=z + 2 {
                    values[(dx * resolution + dy) * resolution + dz] = 1.0;
                }
            }
        }
    }
    let voxel_size = WORKSPACE_SIZE / resolution as f64;
    Volume::new(resolution, voxel_size, pose, values).expect("0.6 and 1 are values of a volume")
}

/// The decoded outputs of a test model, computed without a server.
///
/// # Panics
/// Never: the maps fit the volume.
#[must_use]
pub fn expected(volume: &Volume, params: &DecodeParams) -> Decoded {
    let voxels = volume.values().len();
    let mut rotation = vec![0.0; 4 * voxels];
    rotation[3 * voxels..].fill(1.0);
    let maps = Maps { quality: volume.values(), rotation: &rotation, width: &vec![WIDTH; voxels] };
    decode(volume, &maps, params).expect("the maps fit the volume")
}
