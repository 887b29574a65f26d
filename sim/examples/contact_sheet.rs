//! Draws the procedural objects of a split on a table, row by row:
//! `cargo run --example contact_sheet -- train 0 sheet.png` (split, first object, file).

use std::path::Path;

use grasp_sim::objects::{ObjectSet, Split};
use grasp_sim::picture::{Picture, object_color};
use nalgebra::{Isometry3, Point3};

/// Objects across and down, and the distance between them in metres.
const COLUMNS: usize = 10;
const ROWS: usize = 6;
const PITCH: f64 = 0.16;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [split, first, file] = arguments.as_slice() else {
        return Err("usage: contact_sheet <train|pile|packed> <first object> <file.png>".into());
    };
    let set = match split.as_str() {
        "train" => ObjectSet::procedural(Split::Train),
        "pile" => ObjectSet::procedural(Split::PileTest),
        "packed" => ObjectSet::procedural(Split::PackedTest),
        folder => ObjectSet::load(Path::new(folder))?,
    };
    let (eye, target) = (Point3::new(0.72, -1.35, 2.0), Point3::new(0.72, 0.4, 0.03));
    let mut picture = Picture::looking_at(1600, 900, 0.35, eye, target);
    picture.table(0.0);
    for (place, object) in set.iter().skip(first.parse()?).take(COLUMNS * ROWS).enumerate() {
        let (column, row) = ((place % COLUMNS) as f64, (ROWS - 1 - place / COLUMNS) as f64);
        let lift = -object.visual.bounds().0.z;
        let pose = Isometry3::translation(column * PITCH, row * PITCH, lift);
        picture.mesh(&object.visual, &pose, 1.0, object_color(place * 7 + place / 12));
        println!("{:3} {:3} {}", place / COLUMNS, place % COLUMNS, object.name);
    }
    picture.save(Path::new(file))?;
    Ok(())
}
