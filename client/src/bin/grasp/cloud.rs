use std::path::Path;

use anyhow::bail;

use crate::files;

/// The name of the points among other arrays of a file.
const ARRAY: &str = "points";

/// Reads points, x y z in metres, from a .npy or .npz file.
pub(crate) fn read(path: &Path) -> anyhow::Result<Vec<[f32; 3]>> {
    files::in_file(path, |path| {
        let array = files::array(path, ARRAY)?;
        // Or H×W×3, with a point for each pixel.
        let [.., _, 3] = array.shape() else { bail!("its shape is {:?}, N×3 is needed: x, y, z", array.shape()) };
        Ok(files::floats(array)?.as_chunks().0.iter().map(|point| point.map(|c| c as f32)).collect())
    })
}
