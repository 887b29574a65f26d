//! Objects from URDF files with OBJ meshes, as in the public object sets for grasping.
//!
//! A file has one link. Every group (`o` or `g`) of a collision OBJ is one convex part.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use grasp::WORKSPACE_SIZE;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rayon::prelude::*;
use roxmltree::{Document, Node};
use thiserror::Error;

use super::Object;
use crate::hull::convex_hull;
use grasp_picture::Mesh;

/// PyBullet's default friction of a link.
const DEFAULT_FRICTION: f64 = 0.5;
/// Number of sides of the meshes of URDF cylinders and spheres.
const SIDES: u32 = 32;

/// Why objects could not be read or written.
#[derive(Debug, Error)]
pub enum ObjectError {
    /// A file or folder could not be read.
    #[error("cannot read {}: {source}; check the path and its permissions", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A folder without objects.
    #[error("{} contains no .urdf file; use a folder with one URDF file per object", path.display())]
    Empty {
        /// The folder.
        path: PathBuf,
    },
    /// A URDF that is not well-formed XML.
    #[error("{} is not well-formed XML: {source}; fix or remove the file", path.display())]
    Xml {
        /// The URDF.
        path: PathBuf,
        /// The parser's error.
        source: roxmltree::Error,
    },
    /// A URDF with missing or invalid elements.
    #[error("{}: {what}", path.display())]
    Urdf {
        /// The URDF.
        path: PathBuf,
        /// The invalid element, with its value and what is expected.
        what: String,
    },
    /// A mesh file that could not be read.
    #[error("cannot read the mesh {}: {source}; check the file and the name in its URDF", path.display())]
    Mesh {
        /// The OBJ file.
        path: PathBuf,
        /// The parser's error.
        source: tobj::LoadError,
    },
    /// An object larger than the workspace; its meshes may be in millimetres.
    #[error(
        "{}: its thinnest part is {:.0} mm thick, the workspace is {:.0} mm wide; scale the meshes to metres",
        path.display(), thickness * 1e3, WORKSPACE_SIZE * 1e3
    )]
    TooLarge {
        /// The URDF.
        path: PathBuf,
        /// Thickness of the thinnest part, metres.
        thickness: f64,
    },
    /// A file that could not be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A mesh file without faces.
    #[error("the mesh {} has no faces; export it with triangles", path.display())]
    NoFaces {
        /// The OBJ file.
        path: PathBuf,
    },
}

/// Reads all URDF files of a folder, in the order of their names.
pub(super) fn load_folder(dir: &Path) -> Result<Vec<Object>, ObjectError> {
    let unreadable = |source| ObjectError::Read { path: dir.into(), source };
    let entries: Vec<_> = fs::read_dir(dir).and_then(Iterator::collect).map_err(unreadable)?;
    let mut paths: Vec<PathBuf> = entries.into_iter().map(|entry: fs::DirEntry| entry.path()).collect();
    paths.retain(|path| path.extension().is_some_and(|extension| extension == "urdf"));
    paths.sort();
    if paths.is_empty() {
        return Err(ObjectError::Empty { path: dir.into() });
    }
    paths.par_iter().map(|path| load(path)).collect()
}

/// Reads one URDF.
pub(super) fn load(path: &Path) -> Result<Object, ObjectError> {
    let text = fs::read_to_string(path).map_err(|source| ObjectError::Read { path: path.into(), source })?;
    let document = Document::parse(&text).map_err(|source| ObjectError::Xml { path: path.into(), source })?;
    let urdf = Urdf { path };

    let links: Vec<_> = children(document.root_element(), "link").collect();
    let &[link] = links.as_slice() else {
        return Err(urdf.wrong(format!("has {} links; an object must have exactly one", links.len())));
    };
    let mass = descend(link, &["inertial", "mass"]).ok_or_else(|| urdf.wrong("lacks <inertial><mass value=…/>"))?;
    let mass = urdf.number(mass, "value")?;
    if mass <= 0.0 {
        return Err(urdf.wrong(format!("<mass value=\"{mass}\"/> must be greater than 0 kg")));
    }
    let friction = match descend(link, &["contact", "lateral_friction"]) {
        Some(node) => urdf.number(node, "value")?,
        None => DEFAULT_FRICTION,
    };
    if friction < 0.0 {
        return Err(urdf.wrong(format!("<lateral_friction value=\"{friction}\"/> must be at least 0")));
    }

    let mut parts = Vec::new();
    for collision in children(link, "collision") {
        // Convex decompositions contain slivers without volume, which are ignored.
        parts.extend(urdf.geometry(collision)?.iter().filter_map(|mesh| convex_hull(&mesh.vertices)));
    }
    if parts.is_empty() {
        return Err(urdf.wrong("has no <collision> shape that encloses a volume"));
    }
    let thickness = parts.iter().map(|part| part.extents().min()).fold(f64::INFINITY, f64::min);
    if thickness > WORKSPACE_SIZE {
        return Err(ObjectError::TooLarge { path: path.into(), thickness });
    }
    let mut visual = Mesh::default();
    for node in children(link, "visual") {
        urdf.geometry(node)?.iter().for_each(|mesh| visual.append(mesh));
    }
    if visual.triangles.is_empty() {
        visual = Mesh::union(&parts);
    }
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    Ok(Object { name, parts, visual, mass, friction })
}

/// Writes an object as URDF and OBJ files that [`load`] reads.
pub(super) fn save(object: &Object, dir: &Path) -> Result<(), ObjectError> {
    let Object { name, parts, visual, mass, friction } = object;
    let urdf = format!(
        "<?xml version=\"1.0\"?>
<robot name=\"{name}\">
  <link name=\"base_link\">
    <contact>
      <lateral_friction value=\"{friction}\"/>
    </contact>
    <inertial>
      <mass value=\"{mass}\"/>
      <inertia ixx=\"1\" ixy=\"0\" ixz=\"0\" iyy=\"1\" iyz=\"0\" izz=\"1\"/>
    </inertial>
    <visual>
      <geometry>
        <mesh filename=\"{name}_visual.obj\"/>
      </geometry>
    </visual>
    <collision>
      <geometry>
        <mesh filename=\"{name}_collision.obj\"/>
      </geometry>
    </collision>
  </link>
</robot>
"
    );
    let files = [
        (format!("{name}_visual.obj"), obj(std::slice::from_ref(visual))),
        (format!("{name}_collision.obj"), obj(parts)),
        // The URDF is written last, because each URDF file of a folder is an object.
        (format!("{name}.urdf"), urdf),
    ];
    for (file, text) in files {
        let path = dir.join(file);
        fs::write(&path, text).map_err(|source| ObjectError::Write { path, source })?;
    }
    Ok(())
}

/// Meshes as the groups of an OBJ.
fn obj(meshes: &[Mesh]) -> String {
    let mut text = String::new();
    let mut first = 1;
    // Writing to a string cannot fail.
    for (index, mesh) in meshes.iter().enumerate() {
        let _ = writeln!(text, "o part_{index}");
        for vertex in &mesh.vertices {
            let _ = writeln!(text, "v {} {} {}", vertex.x, vertex.y, vertex.z);
        }
        for [a, b, c] in mesh.triangles.iter().map(|triangle| triangle.map(|corner| corner + first)) {
            let _ = writeln!(text, "f {a} {b} {c}");
        }
        first += mesh.vertices.len() as u32;
    }
    text
}

/// The URDF file that is being read.
struct Urdf<'a> {
    path: &'a Path,
}

impl Urdf<'_> {
    fn wrong(&self, what: impl Into<String>) -> ObjectError {
        ObjectError::Urdf { path: self.path.into(), what: what.into() }
    }

    /// The shapes of a `<visual>` or `<collision>`, in the link's frame.
    fn geometry(&self, node: Node) -> Result<Vec<Mesh>, ObjectError> {
        let pose = match descend(node, &["origin"]) {
            Some(origin) => self.origin(origin)?,
            None => Isometry3::identity(),
        };
        let shape = descend(node, &["geometry"])
            .and_then(|geometry| geometry.children().find(Node::is_element))
            .ok_or_else(|| self.wrong(format!("has a <{}> without <geometry>", node.tag_name().name())))?;
        let meshes = match shape.tag_name().name() {
            "mesh" => self.mesh(shape)?,
            "box" => vec![Mesh::cuboid(self.lengths(shape, "size")?)],
            "cylinder" => {
                let (radius, length) = (self.length(shape, "radius")?, self.length(shape, "length")?);
                vec![Mesh::cylinder(radius, length, SIDES)]
            }
            "sphere" => vec![Mesh::sphere(self.length(shape, "radius")?, SIDES)],
            other => return Err(self.wrong(format!("has a <{other}>; use mesh, box, cylinder or sphere"))),
        };
        Ok(meshes.iter().map(|mesh| mesh.transformed(&pose)).collect())
    }

    /// The groups of an OBJ, scaled.
    fn mesh(&self, node: Node) -> Result<Vec<Mesh>, ObjectError> {
        let name = node.attribute("filename").ok_or_else(|| self.wrong("has a <mesh> without filename"))?;
        let scale = match node.attribute("scale") {
            Some(_) => self.lengths(node, "scale")?,
            None => Vector3::repeat(1.0),
        };
        let groups = load_obj(&self.path.with_file_name(name))?;
        Ok(groups.iter().map(|mesh| mesh.mapped(|p| p.coords.component_mul(&scale).into())).collect())
    }

    fn origin(&self, node: Node) -> Result<Isometry3<f64>, ObjectError> {
        let vector = |name| node.attribute(name).map_or(Ok(Vector3::zeros()), |_| self.vector(node, name));
        let rpy = vector("rpy")?;
        let rotation = UnitQuaternion::from_euler_angles(rpy.x, rpy.y, rpy.z);
        Ok(Isometry3::from_parts(Translation3::from(vector("xyz")?), rotation))
    }

    fn number(&self, node: Node, name: &str) -> Result<f64, ObjectError> {
        let text = node.attribute(name).unwrap_or_default();
        text.trim().parse().ok().filter(|value: &f64| value.is_finite()).ok_or_else(|| {
            self.wrong(format!("<{} {name}=\"{text}\"/> must be a finite number", node.tag_name().name()))
        })
    }

    fn length(&self, node: Node, name: &str) -> Result<f64, ObjectError> {
        let value = self.number(node, name)?;
        if value > 0.0 {
            return Ok(value);
        }
        Err(self.wrong(format!("<{} {name}=\"{value}\"/> must be greater than 0", node.tag_name().name())))
    }

    fn vector(&self, node: Node, name: &str) -> Result<Vector3<f64>, ObjectError> {
        let text = node.attribute(name).unwrap_or_default();
        let values: Option<Vec<f64>> = text.split_whitespace().map(|word| word.parse().ok()).collect();
        match values.as_deref() {
            Some(&[x, y, z]) if [x, y, z].iter().all(|v| v.is_finite()) => Ok(Vector3::new(x, y, z)),
            _ => {
                Err(self.wrong(format!("<{} {name}=\"{text}\"/> must be three finite numbers", node.tag_name().name())))
            }
        }
    }

    fn lengths(&self, node: Node, name: &str) -> Result<Vector3<f64>, ObjectError> {
        let value = self.vector(node, name)?;
        if value.min() > 0.0 {
            return Ok(value);
        }
        let text = node.attribute(name).unwrap_or_default();
        Err(self.wrong(format!("<{} {name}=\"{text}\"/> must be greater than 0", node.tag_name().name())))
    }
}

/// The groups of an OBJ that have faces.
fn load_obj(path: &Path) -> Result<Vec<Mesh>, ObjectError> {
    // With `single_index` each group has its own vertices.
    let options = tobj::LoadOptions { single_index: true, triangulate: true, ..Default::default() };
    let (models, _) =
        tobj::load_obj(path, &options).map_err(|source| ObjectError::Mesh { path: path.into(), source })?;
    let groups: Vec<Mesh> = models
        .into_iter()
        .map(|model| {
            let corner = |p: &[f32]| Point3::new(p[0], p[1], p[2]).cast();
            let vertices = model.mesh.positions.chunks_exact(3).map(corner).collect();
            let triangles = model.mesh.indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect();
            Mesh { vertices, triangles }
        })
        .filter(|mesh| !mesh.triangles.is_empty())
        .collect();
    if groups.is_empty() {
        return Err(ObjectError::NoFaces { path: path.into() });
    }
    Ok(groups)
}

fn children<'a, 'input>(node: Node<'a, 'input>, name: &'a str) -> impl Iterator<Item = Node<'a, 'input>> {
    node.children().filter(move |child| child.has_tag_name(name))
}

/// The first node down a path of tag names.
fn descend<'a, 'input>(node: Node<'a, 'input>, path: &[&str]) -> Option<Node<'a, 'input>> {
    path.iter().try_fold(node, |node, name| node.children().find(|child| child.has_tag_name(*name)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO_BOXES: &str = "\
o low
v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1
f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4
g high
v 0 0 2\nv 1 0 2\nv 0 1 2\nv 0 0 3
f 5 7 6\nf 5 6 8\nf 6 7 8\nf 7 5 8
";

    fn urdf(mass: &str, geometry: &str) -> String {
        format!(
            "<robot name='thing'><link name='base'>
               <contact><lateral_friction value='0.8'/></contact>
               <inertial><mass value='{mass}'/></inertial>
               <visual><geometry>{geometry}</geometry></visual>
               <collision><origin xyz='0 0 0.1' rpy='0 0 1.5707963267948966'/><geometry>{geometry}</geometry></collision>
             </link></robot>"
        )
    }

    /// Loads a folder with this URDF and two OBJ files beside it.
    fn loaded(urdf: &str) -> Result<Vec<Object>, ObjectError> {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("thing.urdf"), urdf).unwrap();
        fs::write(folder.path().join("two.obj"), TWO_BOXES).unwrap();
        fs::write(folder.path().join("none.obj"), "v 0 0 0\n").unwrap();
        load_folder(folder.path())
    }

    fn error(urdf: &str) -> String {
        loaded(urdf).unwrap_err().to_string()
    }

    #[test]
    fn every_group_of_a_mesh_is_a_part() {
        let objects = loaded(&urdf("0.25", "<mesh filename='two.obj' scale='0.1 0.2 0.1'/>")).unwrap();
        let [object] = objects.as_slice() else { panic!("{} objects", objects.len()) };
        assert_eq!((object.name.as_str(), object.mass, object.friction), ("thing", 0.25, 0.8));
        assert_eq!((object.parts.len(), object.visual.triangles.len()), (2, 8));
        assert!((object.parts[0].volume() - 0.1 * 0.2 * 0.1 / 6.0).abs() < 1e-9);
        // A rotation by 90° about z maps y to −x.
        let (low, high) = object.parts[1].bounds();
        assert!((low - Point3::new(-0.2, 0.0, 0.3)).norm() < 1e-6, "{low}");
        assert!((high - Point3::new(0.0, 0.1, 0.4)).norm() < 1e-6, "{high}");
    }

    #[test]
    fn simple_shapes_are_solids() {
        let volume = |geometry: &str| loaded(&urdf("1", geometry)).unwrap()[0].parts[0].volume();
        assert!((volume("<box size='0.03 0.06 0.03'/>") - 5.4e-5).abs() < 1e-9);
        assert!((volume("<cylinder radius='0.02' length='0.1'/>") / 1.2566e-4 - 1.0).abs() < 0.01);
        assert!((volume("<sphere radius='0.03'/>") / 1.1310e-4 - 1.0).abs() < 0.02);
    }

    #[test]
    fn errors_name_the_file_and_the_cause() {
        let cube = "<box size='0.1 0.1 0.1'/>";
        let cases = [
            ("<robot><link>".into(), "thing.urdf is not well-formed XML"),
            ("<robot/>".into(), "has 0 links"),
            (urdf("-1", cube), "value=\"-1\"/> must be greater than 0 kg"),
            (urdf("heavy", cube), "value=\"heavy\"/> must be a finite number"),
            (urdf("1", "<box size='1 1'/>"), "size=\"1 1\"/> must be three finite numbers"),
            (urdf("1", "<sphere radius='-2'/>"), "radius=\"-2\"/> must be greater than 0"),
            (urdf("1", "<capsule/>"), "has a <capsule>"),
            (urdf("1", "<mesh filename='none.obj'/>"), "none.obj has no faces"),
            (urdf("1", "<mesh filename='lost.obj'/>"), "cannot read the mesh"),
            (urdf("1", "<box size='0.5 0.4 0.6'/>"), "is 400 mm thick, the workspace is 300 mm wide"),
        ];
        for (urdf, fault) in cases {
            let message = error(&urdf);
            assert!(message.contains(fault), "{message:?} lacks {fault:?}");
            assert!(message.contains(".urdf") || message.contains(".obj"), "{message:?} names no file");
        }
    }

    #[test]
    fn written_objects_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let object = crate::objects::procedural::object(14);
        save(&object, folder.path()).unwrap();
        let [read] = <[Object; 1]>::try_from(load_folder(folder.path()).unwrap()).unwrap();
        assert_eq!((&read.name, read.mass, read.friction), (&object.name, object.mass, object.friction));
        assert_eq!(read.parts.len(), object.parts.len());
        for (read, written) in read.parts.iter().zip(&object.parts) {
            assert!((read.volume() / written.volume() - 1.0).abs() < 1e-4);
        }
        assert_eq!(read.visual.triangles.len(), object.visual.triangles.len());
        assert!((read.visual.extents() - object.visual.extents()).norm() < 1e-6);
    }

    #[test]
    fn a_folder_without_objects_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(load_folder(folder.path()), Err(ObjectError::Empty { .. })));
        assert!(matches!(load_folder(&folder.path().join("lost")), Err(ObjectError::Read { .. })));
    }
}
