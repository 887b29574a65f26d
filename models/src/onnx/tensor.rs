//! The values of tensors.

use half::f16;
use thiserror::Error;

use super::{DataType, StringStringEntryProto, TensorProto};

/// Why a tensor's values cannot be used.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum TensorError {
    /// The tensor has another element type than requested.
    #[error("tensor `{name}` has elements of ONNX type {got}, must have {expected}")]
    Type {
        /// The tensor.
        name: String,
        /// Its element type, a number of `onnx.proto`.
        got: i32,
        /// The requested types.
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
    /// The values are in another file.
    #[error("tensor `{name}` has its values in another file; save the model as a single file")]
    External {
        /// The tensor.
        name: String,
    },
}

impl TensorProto {
    /// A tensor of f32.
    #[must_use]
    pub fn from_f32(name: &str, dims: &[i64], values: &[f32]) -> Self {
        let mut tensor = Self { dims: dims.to_vec(), name: Some(name.to_owned()), ..Self::default() };
        tensor.set_f32(values);
        tensor
    }

    /// A tensor of f16, rounded from f32. Values beyond the range of f16 become infinite.
    #[must_use]
    pub fn from_f32_as_f16(name: &str, dims: &[i64], values: &[f32]) -> Self {
        let bytes = values.iter().flat_map(|&value| f16::from_f32(value).to_le_bytes()).collect();
        Self::from_bytes(name, dims, DataType::Float16, bytes)
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

    /// Number of values, from the shape. Of a shape that no tensor can have (a dimension is negative, or there are too many
    /// values) it is a number that no file reaches.
    #[must_use]
    pub fn elements(&self) -> usize {
        let count = |product: usize, &dim: &i64| product.checked_mul(usize::try_from(dim).ok()?);
        self.dims.iter().try_fold(1, count).unwrap_or(usize::MAX)
    }

    /// Element type; `Undefined` if the number is not an element type of ONNX.
    #[must_use]
    pub fn element_type(&self) -> DataType {
        DataType::try_from(self.data_type()).unwrap_or_default()
    }

    /// Whether the elements are f32 or f16.
    #[must_use]
    pub fn is_float(&self) -> bool {
        matches!(self.element_type(), DataType::Float | DataType::Float16)
    }

    /// The values of an f32 or f16 tensor.
    ///
    /// # Errors
    /// [`TensorError`] if it has another element type, another number of values, or values in another file.
    pub fn to_f32(&self) -> Result<Vec<f32>, TensorError> {
        let from_f16 = |bits: u16| f16::from_bits(bits).to_f32();
        match (self.element_type(), self.raw()?) {
            (DataType::Float, Some(raw)) => self.checked(raw.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b))),
            (DataType::Float, None) => self.checked(self.float_data.iter().copied()),
            (DataType::Float16, Some(raw)) => {
                self.checked(raw.as_chunks().0.iter().map(|b| from_f16(u16::from_le_bytes(*b))))
            }
            (DataType::Float16, None) => self.checked(self.int32_data.iter().map(|&bits| from_f16(bits as u16))),
            _ => Err(self.wrong_type("FLOAT (1) or FLOAT16 (10)")),
        }
    }

    /// The values of an i64 tensor.
    ///
    /// # Errors
    /// [`TensorError`] if it has another element type, another number of values, or values in another file.
    pub fn to_i64(&self) -> Result<Vec<i64>, TensorError> {
        match (self.element_type(), self.raw()?) {
            (DataType::Int64, Some(raw)) => self.checked(raw.as_chunks().0.iter().map(|b| i64::from_le_bytes(*b))),
            (DataType::Int64, None) => self.checked(self.int64_data.iter().copied()),
            _ => Err(self.wrong_type("INT64 (7)")),
        }
    }

    /// Replaces the values by f32 values. Name and shape stay.
    pub fn set_f32(&mut self, values: &[f32]) {
        self.data_type = Some(DataType::Float.into());
        self.float_data.clear();
        self.int32_data.clear();
        self.raw_data = Some(values.iter().flat_map(|value| value.to_le_bytes()).collect());
    }

    /// Name of the other file that has the values, if any.
    #[must_use]
    pub fn external_file(&self) -> Option<&str> {
        let file = self.external_data.iter().find(|entry| entry.key() == "location");
        (self.data_location == Some(1)).then(|| file.map_or("", StringStringEntryProto::value))
    }

    /// The raw bytes, if the values are stored as raw bytes.
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
