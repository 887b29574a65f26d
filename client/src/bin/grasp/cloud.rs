//! Reading of point clouds.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use anyhow::{Context, bail};
use pcd_rs::{DynReader, Field};
use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{Property, PropertyAccess, PropertyAccessResult};

use crate::files::{self, Format};

/// Name of the points' array in a .npz file with several arrays.
const ARRAY: &str = "points";

/// Reads points, x y z in metres, from a .npy, .npz, .pcd or .ply file.
pub(crate) fn read(path: &Path) -> anyhow::Result<Vec<[f32; 3]>> {
    files::in_file(path, |path| match Format::of(path)? {
        Format::Pcd => pcd(path),
        Format::Ply => ply(path),
        Format::Png | Format::Tiff | Format::Exr => bail!("this is an image; for a depth image give --intrinsics"),
        Format::Other => arrays(path),
    })
}

fn arrays(path: &Path) -> anyhow::Result<Vec<[f32; 3]>> {
    let array = files::array(path, ARRAY)?;
    // Organized clouds are H×W×3.
    let [.., _, 3] = array.shape() else {
        bail!("shape {:?}: a point cloud must be N×3 or H×W×3 (x, y, z)", array.shape())
    };
    Ok(files::floats(array)?.as_chunks().0.iter().map(|point| point.map(|c| c as f32)).collect())
}

fn pcd(path: &Path) -> anyhow::Result<Vec<[f32; 3]>> {
    let reader = DynReader::open(path).context("not a valid PCD file")?;
    let names: Vec<_> = reader.meta().field_defs.iter().map(|field| field.name.clone()).collect();
    let column = |name: &str| {
        let found = names.iter().position(|other| other == name);
        found.with_context(|| format!("no field `{name}`; fields in the file: {}", names.join(", ")))
    };
    let columns = [column("x")?, column("y")?, column("z")?];
    let coordinate = |field: &Field| match field {
        Field::F32(values) => values.first().copied(),
        Field::F64(values) => values.first().map(|&value| value as f32),
        _ => None,
    };
    let point = |record: pcd_rs::Result<pcd_rs::DynRecord>| {
        let record = record.context("not a valid PCD file")?;
        let [x, y, z] = columns.map(|column| record.0.get(column).and_then(coordinate));
        let point = x.zip(y).zip(z).context("x, y and z must be floats, in metres")?;
        let ((x, y), z) = point;
        Ok([x, y, z])
    };
    reader.map(point).collect()
}

/// A vertex of a PLY file.
struct Vertex([f32; 3]);

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self([f32::NAN; 3])
    }

    fn set_property(&mut self, key: &str, property: Property) -> PropertyAccessResult {
        let value = match property {
            Property::Float(value) => value,
            Property::Double(value) => value as f32,
            _ => return PropertyAccessResult::Ignored,
        };
        let Some(axis) = ["x", "y", "z"].iter().position(|axis| *axis == key) else {
            return PropertyAccessResult::Ignored;
        };
        self.0[axis] = value;
        PropertyAccessResult::Set
    }
}

fn ply(path: &Path) -> anyhow::Result<Vec<[f32; 3]>> {
    let mut file = BufReader::new(File::open(path)?);
    let mut ply = Parser::<Vertex>::new().read_ply(&mut file).context("not a valid PLY file")?;
    let vertices = ply.payload.swap_remove("vertex").context("no element `vertex`")?;
    let points: Vec<_> = vertices.into_iter().map(|Vertex(point)| point).collect();
    if points.iter().all(|point| point.iter().any(|c| c.is_nan())) {
        bail!("no vertex has x, y and z as floats, in metres");
    }
    Ok(points)
}
