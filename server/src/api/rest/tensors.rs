//! The JSON messages of an inference, and the tensors in them or behind them.
//!
//! The sizes of lists are limited while they are read, because an empty element takes more memory than its text.

use std::collections::HashMap;
use std::fmt;
use std::marker::PhantomData;

use axum::body::Bytes;
use axum::http::HeaderValue;
use grasp_proto::oip;
use grasp_proto::oip::infer_parameter::ParameterChoice;
use grasp_proto::oip::model_infer_request::{InferInputTensor, InferRequestedOutputTensor};
use grasp_proto::oip::model_repository_parameter::ParameterChoice as RepositoryChoice;
use serde::de::{self, DeserializeSeed, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use tonic::Status;

/// The header with the length of the JSON part of a body with binary tensors.
pub(super) const HEADER_LENGTH: &str = "inference-header-content-length";

/// Maximum length of a list, except those of numbers, and of a set of parameters.
const MAX_ENTRIES: usize = 64;

/// The parameter of an input: the number of its bytes behind the JSON part.
const BINARY_SIZE: &str = "binary_data_size";
/// The parameter of an output: whether it is returned behind the JSON part.
const BINARY: &str = "binary_data";
/// The parameter of a request: the default of [`BINARY`] for all outputs.
const BINARY_OUTPUT: &str = "binary_data_output";

/// An inference request, with the bytes of its binary tensors.
#[derive(Deserialize)]
pub(super) struct InferRequest {
    #[serde(default)]
    id: String,
    #[serde(default)]
    parameters: Parameters,
    inputs: Few<Input>,
    #[serde(default)]
    outputs: Few<Output>,
    #[serde(skip)]
    raw: Vec<Bytes>,
}

#[derive(Deserialize)]
struct Input {
    name: String,
    shape: Few<i64>,
    datatype: String,
    #[serde(default)]
    parameters: Parameters,
    data: Option<Numbers>,
}

#[derive(Deserialize)]
struct Output {
    name: String,
    #[serde(default)]
    parameters: Parameters,
}

/// Which outputs are returned as binary data.
pub(super) struct BinaryOutputs {
    default: bool,
    of: Vec<(String, bool)>,
}

impl InferRequest {
    /// Parses a body. `header_length` is the length of its JSON part; without it the whole body is JSON.
    pub fn parse(bytes: &Bytes, header_length: Option<&HeaderValue>) -> Result<Self, Status> {
        let length = match header_length {
            None => bytes.len(),
            Some(value) => {
                let length = value.to_str().ok().and_then(|text| text.parse().ok());
                length.filter(|length| *length <= bytes.len()).ok_or_else(|| {
                    Status::invalid_argument(format!(
                        "the header {HEADER_LENGTH} is {value:?}, must be at most the {} bytes of the body",
                        bytes.len()
                    ))
                })?
            }
        };
        let mut request: Self = serde_json::from_slice(&bytes[..length])
            .map_err(|error| Status::invalid_argument(format!("the request is not valid: {error}")))?;
        let mut rest = bytes.slice(length..);
        for (index, input) in request.inputs.0.iter_mut().enumerate() {
            let Some(size) = input.parameters.0.remove(BINARY_SIZE) else { continue };
            let size = match size {
                Parameter::Integer(size) => usize::try_from(size).ok().filter(|size| *size <= rest.len()),
                _ => None,
            };
            let size = size.ok_or_else(|| {
                Status::invalid_argument(format!(
                    "inputs[{index}].parameters.{BINARY_SIZE} must be a number of at most the {} bytes that follow",
                    rest.len()
                ))
            })?;
            request.raw.push(rest.split_to(size));
        }
        if !rest.is_empty() {
            return Err(Status::invalid_argument(format!("{} bytes behind the last binary tensor", rest.len())));
        }
        Ok(request)
    }

    /// The gRPC message, and the form of the outputs. Parameters that are not about binary data stay in the message.
    pub fn into_message(self, model_name: String, model_version: String) -> (oip::ModelInferRequest, BinaryOutputs) {
        let Self { id, mut parameters, inputs, outputs, raw } = self;
        let mut binary =
            BinaryOutputs { default: parameters.take_flag(BINARY_OUTPUT).unwrap_or(false), of: Vec::new() };
        let output = |Output { name, mut parameters }: Output| {
            if let Some(flag) = parameters.take_flag(BINARY) {
                binary.of.push((name.clone(), flag));
            }
            InferRequestedOutputTensor { name, parameters: parameters.for_inference() }
        };
        let outputs = outputs.0.into_iter().map(output).collect();
        let input = |Input { name, shape, datatype, parameters, data }: Input| InferInputTensor {
            name,
            datatype,
            shape: shape.0,
            parameters: parameters.for_inference(),
            contents: data
                .map(|Numbers(fp32_contents)| oip::InferTensorContents { fp32_contents, ..Default::default() }),
        };
        let message = oip::ModelInferRequest {
            model_name,
            model_version,
            id,
            parameters: parameters.for_inference(),
            inputs: inputs.0.into_iter().map(input).collect(),
            outputs,
            raw_input_contents: raw,
        };
        (message, binary)
    }
}

impl BinaryOutputs {
    fn is_binary(&self, name: &str) -> bool {
        self.of.iter().find(|(output, _)| output == name).map_or(self.default, |(_, flag)| *flag)
    }
}

#[derive(Serialize)]
struct InferResponse {
    model_name: String,
    model_version: String,
    #[serde(skip_serializing_if = "String::is_empty")]
    id: String,
    parameters: HashMap<String, f64>,
    outputs: Vec<OutputTensor>,
}

#[derive(Serialize)]
struct OutputTensor {
    name: String,
    datatype: String,
    shape: Vec<i64>,
    #[serde(skip_serializing_if = "HashMap::is_empty")]
    parameters: HashMap<&'static str, usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    data: Option<Vec<f32>>,
}

/// The content type, the length of the JSON part if binary data follows it, and the body of a response.
pub(super) fn response(
    message: oip::ModelInferResponse,
    binary: &BinaryOutputs,
) -> (&'static str, Option<usize>, Vec<u8>) {
    let oip::ModelInferResponse { model_name, model_version, id, parameters, outputs, raw_output_contents } = message;
    let mut behind: Vec<Bytes> = Vec::new();
    let outputs = outputs.into_iter().zip(raw_output_contents).map(|(output, bytes)| {
        let (mut parameters, mut data) = (HashMap::new(), None);
        if binary.is_binary(&output.name) {
            parameters.insert(BINARY_SIZE, bytes.len());
            behind.push(bytes);
        } else {
            data = Some(bytes.as_chunks().0.iter().map(|&value| f32::from_le_bytes(value)).collect());
        }
        OutputTensor { name: output.name, datatype: output.datatype, shape: output.shape, parameters, data }
    });
    let outputs = outputs.collect();
    let seconds = parameters.into_iter().filter_map(|(name, parameter)| match parameter.parameter_choice {
        Some(ParameterChoice::DoubleParam(seconds)) => Some((name, seconds)),
        _ => None,
    });
    let response = InferResponse { model_name, model_version, id, parameters: seconds.collect(), outputs };
    let mut body = serde_json::to_vec(&response).expect("strings and numbers can be written as JSON");
    if behind.is_empty() {
        return ("application/json", None, body);
    }
    let length = body.len();
    behind.iter().for_each(|bytes| body.extend_from_slice(bytes));
    ("application/octet-stream", Some(length), body)
}

/// A list of at most [`MAX_ENTRIES`] elements.
struct Few<T>(Vec<T>);

impl<T> Default for Few<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<'de, T: Deserialize<'de>> Deserialize<'de> for Few<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct List<T>(PhantomData<T>);

        impl<'de, T: Deserialize<'de>> Visitor<'de> for List<T> {
            type Value = Few<T>;

            fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(formatter, "a list of at most {MAX_ENTRIES} elements")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut sequence: A) -> Result<Few<T>, A::Error> {
                let mut list = Vec::new();
                while let Some(element) = sequence.next_element()? {
                    if list.len() == MAX_ENTRIES {
                        return Err(de::Error::invalid_length(MAX_ENTRIES + 1, &self));
                    }
                    list.push(element);
                }
                Ok(Few(list))
            }
        }

        deserializer.deserialize_seq(List(PhantomData))
    }
}

/// The numbers of a tensor, in a flat list or in nested lists.
struct Numbers(Vec<f32>);

impl<'de> Deserialize<'de> for Numbers {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Into<'a>(&'a mut Vec<f32>);

        impl<'de> DeserializeSeed<'de> for Into<'_> {
            type Value = ();

            fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
                deserializer.deserialize_any(self)
            }
        }

        impl<'de> Visitor<'de> for Into<'_> {
            type Value = ();

            fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                formatter.write_str("a number or a list of numbers")
            }

            fn visit_f64<E: de::Error>(self, value: f64) -> Result<(), E> {
                self.0.push(value as f32);
                Ok(())
            }

            fn visit_u64<E: de::Error>(self, value: u64) -> Result<(), E> {
                self.visit_f64(value as f64)
            }

            fn visit_i64<E: de::Error>(self, value: i64) -> Result<(), E> {
                self.visit_f64(value as f64)
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut sequence: A) -> Result<(), A::Error> {
                while sequence.next_element_seed(Into(self.0))?.is_some() {}
                Ok(())
            }
        }

        let mut numbers = Vec::new();
        Into(&mut numbers).deserialize(deserializer)?;
        Ok(Self(numbers))
    }
}

/// At most [`MAX_ENTRIES`] parameters by name.
#[derive(Default)]
pub(super) struct Parameters(HashMap<String, Parameter>);

enum Parameter {
    Flag(bool),
    Integer(i64),
    Float(f64),
    Text(String),
}

impl Parameters {
    fn take_flag(&mut self, name: &str) -> Option<bool> {
        match self.0.get(name) {
            Some(&Parameter::Flag(flag)) => {
                self.0.remove(name);
                Some(flag)
            }
            _ => None,
        }
    }

    fn for_inference(self) -> HashMap<String, oip::InferParameter> {
        let choice = |parameter| match parameter {
            Parameter::Flag(flag) => ParameterChoice::BoolParam(flag),
            Parameter::Integer(number) => ParameterChoice::Int64Param(number),
            Parameter::Float(number) => ParameterChoice::DoubleParam(number),
            Parameter::Text(text) => ParameterChoice::StringParam(text),
        };
        let parameter = |parameter| oip::InferParameter { parameter_choice: Some(choice(parameter)) };
        self.0.into_iter().map(|(name, value)| (name, parameter(value))).collect()
    }

    pub fn for_repository(self) -> HashMap<String, oip::ModelRepositoryParameter> {
        let choice = |parameter| match parameter {
            Parameter::Flag(flag) => RepositoryChoice::BoolParam(flag),
            Parameter::Integer(number) => RepositoryChoice::Int64Param(number),
            Parameter::Float(number) => RepositoryChoice::StringParam(number.to_string()),
            Parameter::Text(text) => RepositoryChoice::StringParam(text),
        };
        let parameter = |parameter| oip::ModelRepositoryParameter { parameter_choice: Some(choice(parameter)) };
        self.0.into_iter().map(|(name, value)| (name, parameter(value))).collect()
    }
}

impl<'de> Deserialize<'de> for Parameters {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Map;

        impl<'de> Visitor<'de> for Map {
            type Value = Parameters;

            fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(formatter, "at most {MAX_ENTRIES} parameters")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Parameters, A::Error> {
                let mut parameters = HashMap::new();
                while let Some((name, value)) = map.next_entry()? {
                    if parameters.len() == MAX_ENTRIES {
                        return Err(de::Error::invalid_length(MAX_ENTRIES + 1, &self));
                    }
                    parameters.insert(name, value);
                }
                Ok(Parameters(parameters))
            }
        }

        deserializer.deserialize_map(Map)
    }
}

impl<'de> Deserialize<'de> for Parameter {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Scalar;

        impl Visitor<'_> for Scalar {
            type Value = Parameter;

            fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                formatter.write_str("true, false, a number or a text")
            }

            fn visit_bool<E>(self, value: bool) -> Result<Parameter, E> {
                Ok(Parameter::Flag(value))
            }

            fn visit_i64<E>(self, value: i64) -> Result<Parameter, E> {
                Ok(Parameter::Integer(value))
            }

            fn visit_u64<E>(self, value: u64) -> Result<Parameter, E> {
                Ok(i64::try_from(value).map_or(Parameter::Float(value as f64), Parameter::Integer))
            }

            fn visit_f64<E>(self, value: f64) -> Result<Parameter, E> {
                Ok(Parameter::Float(value))
            }

            fn visit_str<E>(self, value: &str) -> Result<Parameter, E> {
                Ok(Parameter::Text(value.to_owned()))
            }
        }

        deserializer.deserialize_any(Scalar)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(json: &str, header_length: Option<usize>) -> Result<InferRequest, String> {
        let length = header_length.map(HeaderValue::from);
        let parsed = InferRequest::parse(&Bytes::copy_from_slice(json.as_bytes()), length.as_ref());
        parsed.map_err(|status| status.message().to_owned())
    }

    #[test]
    fn numbers_may_be_nested_and_binary_data_follows_the_json() {
        let json = r#"{"id": "7", "unknown": [[]], "inputs": [{"name": "tsdf", "datatype": "FP32", "shape": [1, 3],
            "data": [[0, [0.5]], -1]}]}"#;
        let (message, binary) = parse(json, None).unwrap().into_message("m".to_owned(), String::new());
        let input = &message.inputs[0];
        assert_eq!((&*message.id, &*input.name, &*input.shape), ("7", "tsdf", &[1, 3][..]));
        assert_eq!(input.contents.as_ref().unwrap().fp32_contents, [0.0, 0.5, -1.0]);
        assert!(!binary.is_binary("width"));

        let json = r#"{"parameters": {"binary_data_output": true, "priority": 1}, "outputs": [{"name": "width",
            "parameters": {"binary_data": false}}], "inputs": [{"name": "tsdf", "datatype": "FP32", "shape": [1],
            "parameters": {"binary_data_size": 4}}]}"#;
        let (message, binary) =
            parse(&format!("{json}1234"), Some(json.len())).unwrap().into_message(String::new(), String::new());
        assert_eq!(message.raw_input_contents, [Bytes::from_static(b"1234")]);
        assert_eq!(message.parameters.keys().collect::<Vec<_>>(), ["priority"], "refused later");
        assert!(message.inputs[0].parameters.is_empty() && message.outputs[0].parameters.is_empty());
        assert!(binary.is_binary("quality") && !binary.is_binary("width"));
    }

    #[test]
    fn invalid_requests_are_named() {
        let input =
            |more: &str| format!(r#"{{"inputs": [{{"name": "tsdf", "datatype": "FP32", "shape": [1]{more}}}]}}"#);
        for (json, length, expected) in [
            ("{}".to_owned(), None, "missing field `inputs`"),
            (input(r#", "data": ["a"]"#), None, "expected a number or a list of numbers"),
            (input(r#", "parameters": {"a": []}"#), None, "expected true, false, a number or a text"),
            (input(r#", "parameters": {"binary_data_size": 4}"#), None, "at most the 0 bytes that follow"),
            (input("") + "1234", Some(input("").len()), "4 bytes behind the last binary tensor"),
            (input(""), Some(1000), "must be at most the"),
            (format!(r#"{{"inputs": [{}]}}"#, vec!["0"; 65].join(",")), None, "invalid type"),
        ] {
            let error = parse(&json, length).err().unwrap_or_default();
            assert!(error.contains(expected), "{error} for {json}");
        }
        let many = format!(r#"{{"inputs": [], "outputs": [{}]}}"#, vec![r#"{"name": ""}"#; 65].join(","));
        assert!(parse(&many, None).err().unwrap().contains("a list of at most 64 elements"));
    }

    #[test]
    fn a_response_has_each_output_in_its_form() {
        let output = |name: &str| oip::model_infer_response::InferOutputTensor {
            name: name.to_owned(),
            datatype: "FP32".to_owned(),
            shape: vec![2],
            ..Default::default()
        };
        let bytes = |values: [f32; 2]| Bytes::from(values.map(f32::to_le_bytes).concat());
        let message = oip::ModelInferResponse {
            outputs: vec![output("quality"), output("width")],
            raw_output_contents: vec![bytes([0.25, 1.0]), bytes([5.0, 6.0])],
            ..Default::default()
        };
        let binary = BinaryOutputs { default: false, of: vec![("width".to_owned(), true)] };
        let (content_type, length, body) = response(message.clone(), &binary);
        let length = length.unwrap();
        let json: serde_json::Value = serde_json::from_slice(&body[..length]).unwrap();
        assert_eq!((content_type, &body[length..]), ("application/octet-stream", &*bytes([5.0, 6.0])));
        assert_eq!(json["outputs"][0]["data"], serde_json::json!([0.25, 1.0]));
        assert_eq!(json["outputs"][1]["parameters"]["binary_data_size"], 8);
        let (content_type, length, _) = response(message, &BinaryOutputs { default: false, of: Vec::new() });
        assert_eq!((content_type, length), ("application/json", None));
    }
}
