//! Candidates for the classifier of GPD, tried in simulation: images of what the hand would close on, with labels.
//!
//! GPD labels a candidate by geometry, antipodal or not; here it is what a trial in the simulator came to.

use std::fs;
use std::io::{self, Write};
use std::path::Path;

use grasp::gpd::{CHANNELS, Cloud, IMAGE_SIZE, Image, Params, candidates};
use grasp::{DepthImage, Intrinsics, SurfacePoint};
use npyz::npz::{NpzWriter, file_name_from_array_name};
use npyz::zip::DateTime;
use npyz::zip::write::FileOptions;
use npyz::{AutoSerialize, WriterBuilder};
use rand::seq::index;

use crate::TABLE_HEIGHT;
use crate::camera::View;
use crate::label::{Recipe, is_within_reach};
use crate::trial;

/// How close the hand may come to the table, metres: the simulator's fingers are half a millimetre broader on each side.
const CLEARANCE: f64 = 0.002;

/// A candidate as the classifier sees it, with what came of trying it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Example {
    /// Number of its scene.
    pub scene: u64,
    /// What was between the fingers.
    pub image: Image,
    /// Whether an object was lifted.
    pub success: bool,
}

/// GPD's parameters over the simulator's table.
#[must_use]
pub fn params() -> Params {
    Params::above(TABLE_HEIGHT + CLEARANCE)
}

/// What the views see of the objects, every pixel a point: without the table and the borders of the workspace.
#[must_use]
pub fn sights(views: &[View]) -> Vec<SurfacePoint> {
    let mut sights = Vec::new();
    for view in views {
        let image = DepthImage::new(Intrinsics::BENCHMARK, &view.depth).expect("views are of the benchmark's camera");
        sights.extend(image.points(&view.camera_from_task).filter(|point| is_within_reach(&point.position)));
    }
    sights
}

impl Recipe {
    /// Makes scene number `index`, looks at it, and tries up to [`points`](Self::points) random ones of the candidates.
    #[must_use]
    pub fn candidates(&self, index: u64) -> Vec<Example> {
        let mut rng = self.rng(index);
        let world = self.scene(&mut rng);
        let cloud = Cloud::new(sights(&self.observe(&world, &mut rng)));
        let found = candidates(&cloud, &params(), &mut rng);
        let chosen = index::sample(&mut rng, found.len(), self.points.min(found.len()));
        let example = |candidate: usize| Example {
            scene: index,
            image: Image::of(&cloud, &found[candidate]),
            success: trial::label(&world, &found[candidate].pose).is_success(),
        };
        chosen.into_iter().map(example).collect()
    }
}

/// Writes examples as an `.npz` file: `images` u8 `[n, CHANNELS, IMAGE_SIZE, IMAGE_SIZE]`, `labels` u8 `[n]`, 1 for a
/// success, and `scenes` u64 `[n]`. The file appears when it is whole.
///
/// # Errors
/// What the file system said.
pub fn write(path: &Path, examples: &[Example]) -> io::Result<()> {
    let partial = path.with_extension("npz.partial");
    let mut archive = NpzWriter::create(&partial)?;
    let count = examples.len() as u64;
    let edge = IMAGE_SIZE as u64;
    let pixels = examples.iter().flat_map(|example| example.image.pixels().iter().copied());
    write_array(&mut archive, "images", &[count, CHANNELS as u64, edge, edge], pixels)?;
    write_array(&mut archive, "labels", &[count], examples.iter().map(|example| u8::from(example.success)))?;
    write_array(&mut archive, "scenes", &[count], examples.iter().map(|example| example.scene))?;
    drop(archive);
    fs::rename(&partial, path)
}

fn write_array<T: AutoSerialize>(
    archive: &mut NpzWriter<io::BufWriter<fs::File>>,
    name: &str,
    shape: &[u64],
    values: impl Iterator<Item = T>,
) -> io::Result<()> {
    // Without the time of day: the same examples are the same bytes.
    let options = FileOptions::default().last_modified_time(DateTime::default());
    archive.zip_writer().start_file(file_name_from_array_name(name), options)?;
    // Without a buffer every pixel would be a call to the compressor, which took about as long as the trials.
    let mut file = io::BufWriter::with_capacity(1 << 16, archive.zip_writer());
    let mut array = npyz::WriteOptions::new().default_dtype().shape(shape).writer(&mut file).begin_nd()?;
    array.extend(values)?;
    array.finish()?;
    file.flush()
}
