//! Finds the five nodes of the exact GELU, x · (1 + erf(x / √2)) / 2, which libtorch computes in one operation.
//!
//! The feed-forward blocks of a transformer have its largest arrays. One operation instead of five reads and writes them
//! less often.

use std::collections::{HashMap, HashSet};

use grasp_models::onnx::{GraphProto, NodeProto};

/// The GELUs of a graph.
#[derive(Default)]
pub(crate) struct Gelus {
    /// Last node → name of x.
    pub inputs: HashMap<usize, String>,
    /// The other nodes, which need not be computed.
    pub inner: HashSet<usize>,
}

impl Gelus {
    /// Finds them. Values between the nodes must have no other reader.
    pub fn new(graph: &GraphProto) -> Self {
        let mut found = Self::default();
        for erf in (0..graph.node.len()).filter(|&index| graph.node[index].op_type() == "Erf") {
            if let Some((nodes, last, x)) = gelu(graph, erf) {
                found.inner.extend(nodes);
                found.inputs.insert(last, x);
            }
        }
        found
    }
}

/// The nodes before the last, the last, and x.
fn gelu(graph: &GraphProto, erf: usize) -> Option<([usize; 4], usize, String)> {
    let scaled = graph.node[erf].input.first()?;
    let div = graph.node.iter().position(|node| node.op_type() == "Div" && node.output.contains(scaled))?;
    let x = graph.node[div].input.first()?;
    let divisor = graph.node[div].input.get(1)?;
    let add = only_reader(graph, erf, "Add")?;
    let product = only_reader(graph, add, "Mul")?;
    let last = only_reader(graph, product, "Mul")?;
    let has = |node: usize, value: f32| graph.node[node].input.iter().any(|name| is_number(graph, name, value));
    let fits = only_reader(graph, div, "Erf") == Some(erf)
        && is_number(graph, divisor, std::f32::consts::SQRT_2)
        && has(add, 1.0)
        && graph.node[product].input.contains(x)
        && has(last, 0.5);
    fits.then(|| ([div, erf, add, product], last, x.clone()))
}

/// The only node that reads the output of a node, if it is this operator.
fn only_reader(graph: &GraphProto, node: usize, op: &str) -> Option<usize> {
    let output = graph.node[node].output.first()?;
    let reads = |(_, node): &(usize, &NodeProto)| node.input.contains(output);
    let mut readers = graph.node.iter().enumerate().filter(reads);
    let (index, reader) = readers.next()?;
    (readers.next().is_none() && reader.op_type() == op).then_some(index)
}

fn is_number(graph: &GraphProto, name: &str, value: f32) -> bool {
    graph.stored(name).is_some_and(|tensor| tensor.to_f32().is_ok_and(|values| values == [value]))
}

#[cfg(test)]
mod tests {
    use grasp_models::Architecture;

    use super::*;

    #[test]
    fn every_gelu_of_the_transformer_is_found() {
        let model = Architecture::TransformerSmall.build(16, 0).unwrap();
        let graph = model.graph.unwrap();
        let erfs = graph.node.iter().filter(|node| node.op_type() == "Erf").count();
        let gelus = Gelus::new(&graph);
        assert!(erfs > 0);
        assert_eq!((gelus.inputs.len(), gelus.inner.len()), (erfs, 4 * erfs));
    }
}
