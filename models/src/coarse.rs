//! A coarse evaluator in the file of an evaluator: a second graph beside the first, which shares nothing with it. Its
//! names begin with `coarse.`, those of its provenance with `graspd.provenance.coarse.`.

use crate::metadata::PROVENANCE;
use crate::metadata_error::PREFIX as OURS;
use crate::onnx::{GraphProto, ModelProto, StringStringEntryProto};

const PREFIX: &str = "coarse.";

/// The evaluator with a coarse one, which replaces the one that it has.
#[must_use]
pub fn with_coarse_evaluator(evaluator: &ModelProto, coarse: &ModelProto) -> ModelProto {
    let mut model = without_coarse_evaluator(evaluator);
    let mut added = coarse.graph.clone().unwrap_or_default();
    rename(&mut added, |name| format!("{PREFIX}{name}"));
    let graph = model.graph.get_or_insert_default();
    graph.node.extend(added.node);
    graph.initializer.extend(added.initializer);
    graph.input.extend(added.input);
    graph.output.extend(added.output);
    for property in &coarse.metadata_props {
        if let Some(key) = provenance(property.key()) {
            let key = Some(format!("{OURS}{PROVENANCE}{PREFIX}{key}"));
            model.metadata_props.push(StringStringEntryProto { key, ..property.clone() });
        }
    }
    model
}

/// The evaluator alone.
#[must_use]
pub fn without_coarse_evaluator(model: &ModelProto) -> ModelProto {
    let mut model = part(model, false);
    let is_of_coarse = |key: &str| provenance(key).is_some_and(|key| key.starts_with(PREFIX));
    model.metadata_props.retain(|property| !is_of_coarse(property.key()));
    model
}

/// What a metadata key says of the provenance.
fn provenance(key: &str) -> Option<&str> {
    key.strip_prefix(OURS)?.strip_prefix(PROVENANCE)
}

/// The coarse evaluator alone, if there is one.
#[must_use]
pub fn coarse_evaluator_of(model: &ModelProto) -> Option<ModelProto> {
    let mut coarse = part(model, true);
    let graph = coarse.graph.as_mut().filter(|graph| !graph.node.is_empty())?;
    rename(graph, |name| name.strip_prefix(PREFIX).unwrap_or(name).to_owned());
    Some(coarse)
}

fn part(model: &ModelProto, is_coarse: bool) -> ModelProto {
    let mut model = model.clone();
    let is_of_part = |name: &str| name.starts_with(PREFIX) == is_coarse;
    if let Some(graph) = &mut model.graph {
        graph.node.retain(|node| node.output.iter().all(|name| is_of_part(name)));
        graph.initializer.retain(|weight| is_of_part(weight.name()));
        graph.input.retain(|input| is_of_part(input.name()));
        graph.output.retain(|output| is_of_part(output.name()));
    }
    model
}

/// Renames all nodes and values.
fn rename(graph: &mut GraphProto, rename: impl Fn(&str) -> String) {
    let of_nodes = graph.node.iter_mut().flat_map(|node| {
        let values = node.input.iter_mut().chain(&mut node.output);
        // An empty name stands for an input that is left out.
        values.filter(|name| !name.is_empty()).chain(node.name.as_mut())
    });
    let of_weights = graph.initializer.iter_mut().filter_map(|weight| weight.name.as_mut());
    let of_values = graph.input.iter_mut().chain(&mut graph.output).filter_map(|value| value.name.as_mut());
    for name in of_nodes.chain(of_weights).chain(of_values) {
        *name = rename(name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{coarse_evaluator, evaluator};

    #[test]
    fn both_evaluators_of_a_file_are_found_again() {
        let (fine, coarse) = (evaluator(1), coarse_evaluator(2));
        assert_eq!(coarse_evaluator_of(&fine), None);
        let both = with_coarse_evaluator(&fine, &coarse_evaluator(3));
        let both = with_coarse_evaluator(&both, &coarse);
        assert_eq!(without_coarse_evaluator(&both), fine);
        let graph =
            |model: ModelProto| model.graph.map(|graph| (graph.node, graph.initializer, graph.input, graph.output));
        let seed = both.metadata_props.iter().find(|property| property.key() == "graspd.provenance.coarse.seed");
        assert_eq!(seed.map(StringStringEntryProto::value), Some("2"));
        assert_eq!(coarse_evaluator_of(&both).and_then(graph), graph(coarse));
    }
}
