//! Checks of ModelInfer requests.

use grasp_models::INPUT;
use grasp_proto::oip;
use grasp_proto::oip::model_infer_request::InferInputTensor;
use grasp_proto::{FieldError, on_a_line};

/// The only datatype of tensors.
pub(super) const FP32: &str = "FP32";

/// The parameter with which Triton's clients ask for an empty message after the last response of a stream. There is no
/// such stream here, so that it has no effect on any server.
const EMPTY_FINAL_RESPONSE: &str = "triton_enable_empty_final_response";

/// Refuses parameters: ignoring, for example, a time limit would surprise the client.
pub(super) fn check_parameters(request: &oip::ModelInferRequest) -> Result<(), FieldError> {
    let of_inputs = request.inputs.iter().enumerate().map(|(i, input)| (format!("inputs[{i}]."), &input.parameters));
    let of_outputs =
        request.outputs.iter().enumerate().map(|(i, output)| (format!("outputs[{i}]."), &output.parameters));
    let all = [(String::new(), &request.parameters)].into_iter().chain(of_inputs).chain(of_outputs);
    for (of, parameters) in all {
        if let Some(name) = parameters.keys().filter(|name| **name != EMPTY_FINAL_RESPONSE).min() {
            let value = format_args!("`{}`", on_a_line(name));
            return Err(FieldError::new(format!("{of}parameters"), value, "which is not supported; remove it"));
        }
    }
    Ok(())
}

/// The validated values of the input `[batch, 1, n, n, n]`.
pub(super) fn batches(request: &oip::ModelInferRequest, n: usize, max_batch: usize) -> Result<Vec<f32>, FieldError> {
    let [InferInputTensor { name, datatype, shape, contents, .. }] = &request.inputs[..] else {
        let needed = format_args!("must contain exactly one tensor, `{INPUT}`");
        return Err(FieldError::new("inputs", format_args!("a list of {}", request.inputs.len()), needed));
    };
    if name != INPUT {
        return Err(FieldError::new("inputs[0].name", format_args!("`{name}`"), format_args!("must be `{INPUT}`")));
    }
    if datatype != FP32 {
        return Err(FieldError::new("inputs[0].datatype", format_args!("`{datatype}`"), "must be FP32"));
    }
    let edge = n as i64;
    let batch = match shape[..] {
        [batch, 1, x, y, z] if [x, y, z] == [edge; 3] => usize::try_from(batch).unwrap_or(0),
        _ => 0,
    };
    if !(1..=max_batch).contains(&batch) {
        let needed = format_args!("must be [batch, 1, {n}, {n}, {n}] with a batch from 1 to {max_batch}");
        return Err(FieldError::new("inputs[0].shape", format_args!("{shape:?}"), needed));
    }
    let expected = batch * n.pow(3);
    let values: Vec<f32> = match (&request.raw_input_contents[..], contents) {
        ([raw], None) if raw.len() % 4 == 0 => {
            raw.as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect()
        }
        ([raw], None) => {
            let needed = format_args!("must be {} bytes for this shape", 4 * expected);
            return Err(FieldError::new("raw_input_contents[0]", format_args!("{} bytes", raw.len()), needed));
        }
        ([], Some(contents)) if contents.fp32_contents.len() != expected => {
            let value = format_args!("{} values", contents.fp32_contents.len());
            let needed = format_args!("must be {expected} values for this shape");
            return Err(FieldError::new("inputs[0]", value, needed));
        }
        ([], Some(contents)) => contents.fp32_contents.clone(),
        (raw, contents) => {
            let given = usize::from(contents.is_some());
            let value = format_args!("a list of {} with {given} of contents", raw.len());
            return Err(FieldError::new(
                "raw_input_contents",
                value,
                "the tensor's values must be in exactly one of raw_input_contents[0] and inputs[0].contents",
            ));
        }
    };
    if values.len() == expected {
        Ok(values)
    } else {
        Err(FieldError::new(
            "inputs[0]",
            format_args!("{} values", values.len()),
            format_args!("must be {expected} values for this shape"),
        ))
    }
}
