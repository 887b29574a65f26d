//! The part of the ONNX file format that grasp networks use, as Protocol Buffers messages.
//!
//! Field numbers are those of `onnx.proto` (proto2, hence the optional scalars); what is not declared here is skipped
//! when a file is read.

use std::fs;
use std::path::{Path, PathBuf};

use half::f16;
use prost::{Message, Oneof};
use thiserror::Error;

/// A file: a graph, the operator sets it is written in, and free-form properties.
#[derive(Clone, PartialEq, Message)]
pub struct ModelProto {
    /// Version of the file format.
    #[prost(int64, optional, tag = "1")]
    pub ir_version: Option<i64>,
    /// The program that wrote the file.
    #[prost(string, optional, tag = "2")]
    pub producer_name: Option<String>,
    /// That program's version.
    #[prost(string, optional, tag = "3")]
    pub producer_version: Option<String>,
    /// The network.
    #[prost(message, optional, tag = "7")]
    pub graph: Option<GraphProto>,
    /// Operator sets the nodes belong to.
    #[prost(message, repeated, tag = "8")]
    pub opset_import: Vec<OperatorSetIdProto>,
    /// Free-form properties; see [`crate::Metadata`].
    #[prost(message, repeated, tag = "14")]
    pub metadata_props: Vec<StringStringEntryProto>,
}

/// One property.
#[derive(Clone, PartialEq, Eq, Message)]
pub struct StringStringEntryProto {
    /// Name.
    #[prost(string, optional, tag = "1")]
    pub key: Option<String>,
    /// Value.
    #[prost(string, optional, tag = "2")]
    pub value: Option<String>,
}

/// An operator set and its version; the standard one has an empty domain.
#[derive(Clone, PartialEq, Eq, Message)]
pub struct OperatorSetIdProto {
    /// Whose operators.
    #[prost(string, optional, tag = "1")]
    pub domain: Option<String>,
    /// Which version of them.
    #[prost(int64, optional, tag = "2")]
    pub version: Option<i64>,
}

/// Nodes in an order in which they can be run, and the tensors they start from.
#[derive(Clone, PartialEq, Message)]
pub struct GraphProto {
    /// The operations, topologically sorted.
    #[prost(message, repeated, tag = "1")]
    pub node: Vec<NodeProto>,
    /// Name.
    #[prost(string, optional, tag = "2")]
    pub name: Option<String>,
    /// Weights and constants.
    #[prost(message, repeated, tag = "5")]
    pub initializer: Vec<TensorProto>,
    /// What must be given.
    #[prost(message, repeated, tag = "11")]
    pub input: Vec<ValueInfoProto>,
    /// What is computed.
    #[prost(message, repeated, tag = "12")]
    pub output: Vec<ValueInfoProto>,
}

/// One operation.
#[derive(Clone, PartialEq, Message)]
pub struct NodeProto {
    /// Names of its inputs; an empty name is an optional input left out.
    #[prost(string, repeated, tag = "1")]
    pub input: Vec<String>,
    /// Names of its outputs.
    #[prost(string, repeated, tag = "2")]
    pub output: Vec<String>,
    /// Its own name.
    #[prost(string, optional, tag = "3")]
    pub name: Option<String>,
    /// The operator.
    #[prost(string, optional, tag = "4")]
    pub op_type: Option<String>,
    /// Its settings.
    #[prost(message, repeated, tag = "5")]
    pub attribute: Vec<AttributeProto>,
    /// The operator set; empty for the standard one.
    #[prost(string, optional, tag = "7")]
    pub domain: Option<String>,
}

/// One setting of a node.
#[derive(Clone, PartialEq, Message)]
pub struct AttributeProto {
    /// Name.
    #[prost(string, optional, tag = "1")]
    pub name: Option<String>,
    /// A number.
    #[prost(float, optional, tag = "2")]
    pub f: Option<f32>,
    /// A whole number.
    #[prost(int64, optional, tag = "3")]
    pub i: Option<i64>,
    /// A string.
    #[prost(bytes = "vec", optional, tag = "4")]
    pub s: Option<Vec<u8>>,
    /// A tensor.
    #[prost(message, optional, tag = "5")]
    pub t: Option<TensorProto>,
    /// Numbers.
    #[prost(float, repeated, packed = "false", tag = "7")]
    pub floats: Vec<f32>,
    /// Whole numbers.
    #[prost(int64, repeated, packed = "false", tag = "8")]
    pub ints: Vec<i64>,
    /// Which of the above holds the value.
    #[prost(enumeration = "AttributeType", optional, tag = "20")]
    pub r#type: Option<i32>,
}

/// The kinds of [`AttributeProto`] that are used here.
#[derive(Clone, Copy, Debug, PartialEq, Eq, prost::Enumeration)]
#[repr(i32)]
pub enum AttributeType {
    /// Not stated.
    Undefined = 0,
    /// `f`.
    Float = 1,
    /// `i`.
    Int = 2,
    /// `s`.
    String = 3,
    /// `t`.
    Tensor = 4,
    /// `floats`.
    Floats = 6,
    /// `ints`.
    Ints = 7,
}

/// A tensor's shape, element type and values, row-major.
#[derive(Clone, PartialEq, Message)]
pub struct TensorProto {
    /// Shape.
    #[prost(int64, repeated, packed = "false", tag = "1")]
    pub dims: Vec<i64>,
    /// Element type.
    #[prost(enumeration = "DataType", optional, tag = "2")]
    pub data_type: Option<i32>,
    /// Values of f32, unless raw.
    #[prost(float, repeated, tag = "4")]
    pub float_data: Vec<f32>,
    /// Values of the integers up to 32 bits and, bit for bit, of f16, unless raw.
    #[prost(int32, repeated, tag = "5")]
    pub int32_data: Vec<i32>,
    /// Values of i64, unless raw.
    #[prost(int64, repeated, tag = "7")]
    pub int64_data: Vec<i64>,
    /// Name.
    #[prost(string, optional, tag = "8")]
    pub name: Option<String>,
    /// The values' bytes, little-endian.
    #[prost(bytes = "vec", optional, tag = "9")]
    pub raw_data: Option<Vec<u8>>,
    /// Where in another file the values lie, as `location`, `offset` and `length`.
    #[prost(message, repeated, tag = "13")]
    pub external_data: Vec<StringStringEntryProto>,
    /// 1 when the values lie in another file, which is not supported.
    #[prost(int32, optional, tag = "14")]
    pub data_location: Option<i32>,
}

/// The element types that are used here.
#[derive(Clone, Copy, Debug, PartialEq, Eq, prost::Enumeration)]
#[repr(i32)]
pub enum DataType {
    /// Not stated.
    Undefined = 0,
    /// 32-bit floating point.
    Float = 1,
    /// 8-bit integer, unsigned.
    Uint8 = 2,
    /// 8-bit integer.
    Int8 = 3,
    /// 32-bit integer.
    Int32 = 6,
    /// 64-bit integer.
    Int64 = 7,
    /// 16-bit floating point (IEEE 754 binary16).
    Float16 = 10,
}

/// Name and type of an input or output.
#[derive(Clone, PartialEq, Message)]
pub struct ValueInfoProto {
    /// Name.
    #[prost(string, optional, tag = "1")]
    pub name: Option<String>,
    /// Type.
    #[prost(message, optional, tag = "2")]
    pub r#type: Option<TypeProto>,
}

/// The type of a value: here always a tensor.
#[derive(Clone, PartialEq, Message)]
pub struct TypeProto {
    /// Element type and shape.
    #[prost(message, optional, tag = "1")]
    pub tensor_type: Option<TensorTypeProto>,
}

/// Element type and shape of a tensor.
#[derive(Clone, PartialEq, Message)]
pub struct TensorTypeProto {
    /// Element type.
    #[prost(enumeration = "DataType", optional, tag = "1")]
    pub elem_type: Option<i32>,
    /// Shape.
    #[prost(message, optional, tag = "2")]
    pub shape: Option<TensorShapeProto>,
}

/// A shape, of which some dimensions may be known by name only.
#[derive(Clone, PartialEq, Message)]
pub struct TensorShapeProto {
    /// The dimensions.
    #[prost(message, repeated, tag = "1")]
    pub dim: Vec<Dimension>,
}

/// One dimension of a shape.
#[derive(Clone, PartialEq, Message)]
pub struct Dimension {
    /// Its size, if anything is known of it.
    #[prost(oneof = "DimensionValue", tags = "1, 2")]
    pub value: Option<DimensionValue>,
}

/// The size of a dimension.
#[derive(Clone, PartialEq, Eq, Oneof)]
pub enum DimensionValue {
    /// Fixed.
    #[prost(int64, tag = "1")]
    Size(i64),
    /// Free, known by a name.
    #[prost(string, tag = "2")]
    Name(String),
}

/// Why a file could not be read or written.
#[derive(Debug, Error)]
pub enum FileError {
    /// The file system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What it said.
        source: std::io::Error,
    },
    /// The bytes are not an ONNX model.
    #[error("{}: not an ONNX model, or cut short: {reason}; fetch or export the file again", path.display())]
    Decode {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
}

/// Why a tensor's values cannot be used.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum TensorError {
    /// The element type is not one that was asked for.
    #[error("tensor `{name}` has elements of ONNX type {got}, {expected} needed")]
    Type {
        /// The tensor.
        name: String,
        /// Its element type, as `onnx.proto` numbers them.
        got: i32,
        /// What was asked for.
        expected: &'static str,
    },
    /// The number of values does not fit the shape.
    #[error("tensor `{name}` holds {got} values, its shape {dims:?} needs {expected}")]
    Length {
        /// The tensor.
        name: String,
        /// Values it holds.
        got: usize,
        /// Values its shape needs.
        expected: usize,
        /// Its shape.
        dims: Vec<i64>,
    },
    /// The values lie in another file.
    #[error("tensor `{name}` keeps its values in another file; save the model as a single file")]
    External {
        /// The tensor.
        name: String,
    },
}

impl ModelProto {
    /// Reads a file.
    ///
    /// # Errors
    /// [`FileError`] names the file and what is wrong with it.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let bytes = fs::read(path).map_err(|source| FileError::Io { path: path.to_owned(), source })?;
        Self::from_bytes(&bytes).map_err(|reason| FileError::Decode { path: path.to_owned(), reason })
    }

    /// Reads a file's bytes; the error says what is wrong with them.
    pub(crate) fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        let model = Self::decode(bytes).map_err(|error| error.to_string())?;
        match &model.graph {
            Some(graph) if !graph.output.is_empty() => Ok(model),
            _ => Err("it holds no graph".to_owned()),
        }
    }

    /// Writes a file; whoever reads it meanwhile sees the old one or the new one, never a part.
    ///
    /// # Errors
    /// [`FileError`] when the file system refuses.
    pub fn write(&self, path: &Path) -> Result<(), FileError> {
        let part = path.with_extension("onnx.part");
        fs::write(&part, self.encode_to_vec())
            .and_then(|()| fs::rename(&part, path))
            .map_err(|source| FileError::Io { path: path.to_owned(), source })
    }
}

impl NodeProto {
    /// A setting by its name.
    #[must_use]
    pub fn attribute(&self, name: &str) -> Option<&AttributeProto> {
        self.attribute.iter().find(|attribute| attribute.name() == name)
    }
}

impl AttributeProto {
    fn new(name: &str, r#type: AttributeType) -> Self {
        Self { name: Some(name.to_owned()), r#type: Some(r#type.into()), ..Self::default() }
    }

    /// A number.
    #[must_use]
    pub fn float(name: &str, value: f32) -> Self {
        Self { f: Some(value), ..Self::new(name, AttributeType::Float) }
    }

    /// A whole number.
    #[must_use]
    pub fn int(name: &str, value: i64) -> Self {
        Self { i: Some(value), ..Self::new(name, AttributeType::Int) }
    }

    /// A string.
    #[must_use]
    pub fn string(name: &str, value: &str) -> Self {
        Self { s: Some(value.into()), ..Self::new(name, AttributeType::String) }
    }

    /// A tensor.
    #[must_use]
    pub fn tensor(name: &str, value: TensorProto) -> Self {
        Self { t: Some(value), ..Self::new(name, AttributeType::Tensor) }
    }

    /// Whole numbers.
    #[must_use]
    pub fn ints(name: &str, values: &[i64]) -> Self {
        Self { ints: values.to_vec(), ..Self::new(name, AttributeType::Ints) }
    }
}

impl TensorProto {
    /// A tensor of f32.
    #[must_use]
    pub fn from_f32(name: &str, dims: &[i64], values: &[f32]) -> Self {
        let mut tensor = Self { dims: dims.to_vec(), name: Some(name.to_owned()), ..Self::default() };
        tensor.set_f32(values);
        tensor
    }

    /// A tensor of i64.
    #[must_use]
    pub fn from_i64(name: &str, dims: &[i64], values: &[i64]) -> Self {
        Self::from_bytes(name, dims, DataType::Int64, values.iter().flat_map(|value| value.to_le_bytes()).collect())
    }

    /// A tensor of i32.
    #[must_use]
    pub fn from_i32(name: &str, dims: &[i64], values: &[i32]) -> Self {
        Self::from_bytes(name, dims, DataType::Int32, values.iter().flat_map(|value| value.to_le_bytes()).collect())
    }

    /// A tensor of i8.
    #[must_use]
    pub fn from_i8(name: &str, dims: &[i64], values: &[i8]) -> Self {
        Self::from_bytes(name, dims, DataType::Int8, values.iter().map(|&value| value as u8).collect())
    }

    /// A tensor of u8.
    #[must_use]
    pub fn from_u8(name: &str, dims: &[i64], values: &[u8]) -> Self {
        Self::from_bytes(name, dims, DataType::Uint8, values.to_vec())
    }

    fn from_bytes(name: &str, dims: &[i64], data_type: DataType, bytes: Vec<u8>) -> Self {
        Self {
            dims: dims.to_vec(),
            data_type: Some(data_type.into()),
            name: Some(name.to_owned()),
            raw_data: Some(bytes),
            ..Self::default()
        }
    }

    /// How many values its shape needs.
    #[must_use]
    pub fn elements(&self) -> usize {
        self.dims.iter().map(|&dim| usize::try_from(dim).unwrap_or(0)).product()
    }

    /// Whether it holds floating-point numbers.
    #[must_use]
    pub fn is_float(&self) -> bool {
        matches!(self.data_type(), DataType::Float | DataType::Float16)
    }

    /// The values of an f32 or f16 tensor.
    ///
    /// # Errors
    /// [`TensorError`] when it holds something else, or too little of it.
    pub fn to_f32(&self) -> Result<Vec<f32>, TensorError> {
        let halves = |bits: u16| f16::from_bits(bits).to_f32();
        match (self.data_type(), self.raw()?) {
            (DataType::Float, Some(raw)) => self.checked(raw.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b))),
            (DataType::Float, None) => self.checked(self.float_data.iter().copied()),
            (DataType::Float16, Some(raw)) => {
                self.checked(raw.as_chunks().0.iter().map(|b| halves(u16::from_le_bytes(*b))))
            }
            (DataType::Float16, None) => self.checked(self.int32_data.iter().map(|&bits| halves(bits as u16))),
            _ => Err(self.wrong_type("FLOAT (1) or FLOAT16 (10)")),
        }
    }

    /// The values of an i64 tensor.
    ///
    /// # Errors
    /// [`TensorError`] when it holds something else, or too little of it.
    pub fn to_i64(&self) -> Result<Vec<i64>, TensorError> {
        match (self.data_type(), self.raw()?) {
            (DataType::Int64, Some(raw)) => self.checked(raw.as_chunks().0.iter().map(|b| i64::from_le_bytes(*b))),
            (DataType::Int64, None) => self.checked(self.int64_data.iter().copied()),
            _ => Err(self.wrong_type("INT64 (7)")),
        }
    }

    /// Replaces the values, as f32, keeping name and shape.
    pub fn set_f32(&mut self, values: &[f32]) {
        self.data_type = Some(DataType::Float.into());
        self.float_data.clear();
        self.int32_data.clear();
        self.raw_data = Some(values.iter().flat_map(|value| value.to_le_bytes()).collect());
    }

    /// The other file that the values lie in, if they do.
    #[must_use]
    pub fn external_file(&self) -> Option<&str> {
        let file = self.external_data.iter().find(|entry| entry.key() == "location");
        (self.data_location == Some(1)).then(|| file.map_or("", StringStringEntryProto::value))
    }

    /// The raw bytes, if the values are stored so.
    fn raw(&self) -> Result<Option<&[u8]>, TensorError> {
        if self.external_file().is_some() {
            return Err(TensorError::External { name: self.name().to_owned() });
        }
        Ok(self.raw_data.as_deref())
    }

    fn checked<T>(&self, values: impl Iterator<Item = T>) -> Result<Vec<T>, TensorError> {
        let values: Vec<T> = values.collect();
        let expected = self.elements();
        if values.len() == expected {
            return Ok(values);
        }
        Err(TensorError::Length { name: self.name().to_owned(), got: values.len(), expected, dims: self.dims.clone() })
    }

    fn wrong_type(&self, expected: &'static str) -> TensorError {
        TensorError::Type { name: self.name().to_owned(), got: self.data_type.unwrap_or_default(), expected }
    }
}

impl Dimension {
    /// A fixed size.
    #[must_use]
    pub fn size(size: i64) -> Self {
        Self { value: Some(DimensionValue::Size(size)) }
    }

    /// A free size, known by a name.
    #[must_use]
    pub fn named(name: &str) -> Self {
        Self { value: Some(DimensionValue::Name(name.to_owned())) }
    }
}

impl ValueInfoProto {
    /// A tensor of f32.
    #[must_use]
    pub fn tensor(name: &str, dim: Vec<Dimension>) -> Self {
        let shape = Some(TensorShapeProto { dim });
        let tensor_type = Some(TensorTypeProto { elem_type: Some(DataType::Float.into()), shape });
        Self { name: Some(name.to_owned()), r#type: Some(TypeProto { tensor_type }) }
    }

    /// What a free dimension is called, if it is free and has a name.
    #[must_use]
    pub fn free(&self, dimension: usize) -> Option<&str> {
        let shape = self.r#type.as_ref()?.tensor_type.as_ref()?.shape.as_ref()?;
        match shape.dim.get(dimension)?.value.as_ref()? {
            DimensionValue::Name(name) if !name.is_empty() => Some(name),
            DimensionValue::Name(_) | DimensionValue::Size(_) => None,
        }
    }
}
