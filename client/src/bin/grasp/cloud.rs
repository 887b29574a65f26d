use std::path::Path;

use anyhow::bail;

use crate::files;

/// Name of the points' array in a .npz file with several arrays.
const ARRAY: &str = "points";

/// Reads points, x y z in metres, from a .npy or .npz file.
pub(crate) fn read(path: &Path) -> anyhow::Result<Vec<[f32; 3]>> {
    files::in_file(path, |path| {
        let array = files::array(path, ARRAY)?;
        // Organized clouds are H×W×3.
        let [.., _, 3] = array.shape() else {
            bail!("shape {:?}: a point cloud must be N×3 or H×W×3 (x, y, z)", array.shape())
        };
        Ok(files::floats(array)?.as_chunks().0.iter().map(|point| point.map(|c| c as f32)).collect())
    })
}
