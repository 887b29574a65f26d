use std::path::{Path, PathBuf};

use grasp_models::{MAX_MODEL_BYTES, own_models};
use grasp_planner::{ModelFiles, ModelSpec};

use super::PlannerSpec;

/// The model of this name among those that come with graspd.
pub(super) fn planner(name: &str) -> Result<PlannerSpec, String> {
    let folder = own_models().ok_or_else(|| format!("no file `{name}`, and no models come with this program"))?;
    named(name, &folder)
}

fn named(name: &str, folder: &Path) -> Result<PlannerSpec, String> {
    /// Similarity of a name that was probably meant.
    const SIMILAR: f64 = 0.8;
    let specs = ModelFiles::read(folder, MAX_MODEL_BYTES).map_err(|error| error.to_string())?.specs;
    let name = ModelSpec::current_name(specs.iter(), name);
    // The versions of a name are in ascending order.
    if let Some(spec) = specs.iter().rfind(|spec| spec.name() == name) {
        let file = || spec.path().map(PathBuf::from).unwrap_or_default();
        return Ok(match spec {
            ModelSpec::Network(_) => PlannerSpec::Network(file()),
            ModelSpec::Evaluated { network, .. } => {
                PlannerSpec::Evaluated { evaluator: file(), network: network.path.clone() }
            }
            ModelSpec::Gpd(_) => PlannerSpec::Gpd(file()),
            ModelSpec::Shaf => PlannerSpec::Highest,
        });
    }
    let names = || specs.iter().map(ModelSpec::name);
    let lower = name.to_lowercase();
    let similarity = |other: &str| strsim::jaro(&lower, other);
    let closest = names().max_by(|a, b| similarity(a).total_cmp(&similarity(b)));
    let meant = closest.filter(|closest| similarity(closest) >= SIMILAR);
    let meant = meant.map_or_else(String::new, |meant| format!(" Did you mean `{meant}`?"));
    let available = names().collect::<Vec<_>>().join(", ");
    Err(format!("no file `{name}`, and no model of that name in {}.{meant} Its models: {available}", folder.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_are_found_by_name() {
        let zoo = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/zoo"));
        let network = zoo.join("vgn-packed.onnx");
        assert_eq!(named("vgn-packed", zoo), Ok(PlannerSpec::Network(network.clone())));
        let refined = PlannerSpec::Evaluated { evaluator: zoo.join("evaluators/vgn-refined.onnx"), network };
        assert_eq!(named("vgn-refined", zoo), Ok(refined.clone()));
        assert_eq!(named("graspd", zoo), Ok(refined), "its former name");
        assert_eq!(named("gpd", zoo), Ok(PlannerSpec::Gpd(zoo.join("classifiers/gpd.onnx"))));
        assert_eq!(named("shaf", zoo), Ok(PlannerSpec::Highest));
        let error = named("vgn-pakced", zoo).unwrap_err();
        assert!(error.contains("no file `vgn-pakced`") && error.contains("Did you mean `vgn-packed`?"), "{error}");
        assert!(named("VGN-Packed", zoo).unwrap_err().contains("Did you mean `vgn-packed`?"));
        let error = named("yolo", zoo).unwrap_err();
        assert!(!error.contains("Did you mean") && error.contains("Its models: transformer-packed, "), "{error}");
    }
}
