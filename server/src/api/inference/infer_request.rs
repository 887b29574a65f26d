//! Checks of ModelInfer requests.

use ::grasp::{RequestError, on_a_line};
use grasp_models::INPUT;
use grasp_proto::oip;
use grasp_proto::oip::model_infer_request::InferInputTensor;

/// The only datatype of tensors.
pub(super) const FP32: &str = "FP32";

/// With this parameter Triton's clients request an empty message after the last response of a stream. `ModelInfer` is
/// not a stream, so it has no effect.
const EMPTY_FINAL_RESPONSE: &str = "triton_enable_empty_final_response";

/// Refuses parameters: ignoring, for example, a time limit would surprise the client.
pub(super) fn check_parameters(request: &oip::ModelInferRequest) -> Result<(), RequestError> {
    let of_inputs = request.inputs.iter().enumerate().map(|(i, input)| (format!("inputs[{i}]."), &input.parameters));
    let of_outputs =
        request.outputs.iter().enumerate().map(|(i, output)| (format!("outputs[{i}]."), &output.parameters));
    let all = [(String::new(), &request.parameters)].into_iter().chain(of_inputs).chain(of_outputs);
    for (of, parameters) in all {
        if let Some(name) = parameters.keys().filter(|name| **name != EMPTY_FINAL_RESPONSE).min() {
            let value = format_args!("`{}`", on_a_line(name));
            return Err(RequestError::invalid(format!("{of}parameters"), value, "which is not supported; remove it"));
        }
    }
    Ok(())
}

/// The values of an input.
pub(super) enum Values<'a> {
    /// f32, little-endian.
    Raw(&'a [[u8; 4]]),
    Numbers(&'a [f32]),
}

impl Values<'_> {
    fn len(&self) -> usize {
        match self {
            Self::Raw(values) => values.len(),
            Self::Numbers(values) => values.len(),
        }
    }

    /// The values of each volume of `voxels` voxels.
    pub fn volumes(&self, voxels: usize) -> impl Iterator<Item = Vec<f32>> {
        (0..self.len() / voxels.max(1)).map(move |index| {
            let range = index * voxels..(index + 1) * voxels;
            match self {
                Self::Raw(values) => values[range].iter().map(|&bytes| f32::from_le_bytes(bytes)).collect(),
                Self::Numbers(values) => values[range].to_vec(),
            }
        })
    }
}

/// The number of volumes of a request, and their values: the validated input `[batch, 1, n, n, n]`.
pub(super) fn batch(
    request: &oip::ModelInferRequest,
    n: usize,
    max_batch: usize,
) -> Result<(usize, Values<'_>), RequestError> {
    let [InferInputTensor { name, datatype, shape, contents, .. }] = &request.inputs[..] else {
        let needed = format_args!("must contain exactly one tensor, `{INPUT}`");
        return Err(RequestError::of_length("inputs", request.inputs.len(), needed));
    };
    if name != INPUT {
        return Err(RequestError::invalid(
            "inputs[0].name",
            format_args!("`{name}`"),
            format_args!("must be `{INPUT}`"),
        ));
    }
    if datatype != FP32 {
        return Err(RequestError::invalid("inputs[0].datatype", format_args!("`{datatype}`"), "must be FP32"));
    }
    let edge = n as i64;
    let count = match shape[..] {
        [count, 1, x, y, z] if [x, y, z] == [edge; 3] => usize::try_from(count).unwrap_or(0),
        _ => 0,
    };
    if !(1..=max_batch).contains(&count) {
        let needed = format_args!("must be [batch, 1, {n}, {n}, {n}] with a batch from 1 to {max_batch}");
        return Err(RequestError::invalid("inputs[0].shape", format_args!("{shape:?}"), needed));
    }
    let expected = count * n.pow(3);
    let values = match (&request.raw_input_contents[..], contents) {
        ([raw], None) => match raw.as_chunks() {
            (values, []) if values.len() == expected => Values::Raw(values),
            _ => {
                let needed = format_args!("must be {} bytes for this shape", 4 * expected);
                return Err(RequestError::invalid(
                    "raw_input_contents[0]",
                    format_args!("{} bytes", raw.len()),
                    needed,
                ));
            }
        },
        ([], Some(contents)) => Values::Numbers(&contents.fp32_contents),
        (raw, contents) => {
            let given = usize::from(contents.is_some());
            let needed = format_args!(
                "and inputs[0].contents {given}: the tensor's values must be in exactly one of raw_input_contents[0] and \
                 inputs[0].contents"
            );
            return Err(RequestError::of_length("raw_input_contents", raw.len(), needed));
        }
    };
    if values.len() == expected {
        return Ok((count, values));
    }
    let needed = format_args!("must be {expected} values for this shape");
    Err(RequestError::invalid("inputs[0]", format_args!("{} values", values.len()), needed))
}
