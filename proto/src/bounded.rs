//! Decodes requests only if their memory is bounded by their size.
//!
//! An empty message in a repeated field takes 2 bytes of a request, but up to several hundred bytes in memory. So
//! before a request is decoded, its fields are counted.

use std::fmt::{self, Display, Formatter};
use std::marker::PhantomData;

use prost::bytes::Buf;
use prost::encoding::{DecodeContext, WireType, decode_key, decode_varint, skip_field};
use prost::{DecodeError, Message, Name};
use tonic::Status;
use tonic::codec::{Codec, DecodeBuf, Decoder};
use tonic_prost::{ProstCodec, ProstDecoder, ProstEncoder};

include!(concat!(env!("OUT_DIR"), "/request_types.rs"));

/// A type of message that is part of requests.
struct MessageType {
    /// Full name, such as `grasp.v1.Options`.
    name: &'static str,
    /// The fields that need memory on the heap.
    fields: &'static [Field],
}

/// A field of a message.
struct Field {
    number: u32,
    name: &'static str,
    /// Memory of an element of a repeated field, bytes; 0 for other fields.
    element: usize,
    content: Content,
}

/// How a field is encoded.
#[derive(Clone, Copy)]
enum Content {
    /// A message: its index in [`REQUEST_TYPES`].
    Message(usize),
    /// A string or bytes.
    Bytes,
    /// Numbers of this many bytes.
    Fixed(usize),
    /// Numbers of variable length.
    Varint,
}

/// Memory that every request may need, bytes. Larger requests may need as much as their size in addition.
const ALLOWANCE: usize = 1 << 20;

/// Smallest piece of memory of the allocator, bytes.
const SMALLEST_PIECE: usize = 32;

/// Depth of nested messages at which prost stops.
const MAX_DEPTH: usize = 100;

/// Why a request is not decoded.
#[derive(Debug)]
enum Reason {
    /// prost fails at the same place.
    Malformed,
    /// The fields of the path, outermost last, and the allowed memory in bytes.
    Memory { path: Vec<&'static str>, allowed: usize },
}

impl From<DecodeError> for Reason {
    fn from(_: DecodeError) -> Self {
        Self::Malformed
    }
}

impl Display for Reason {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Malformed => write!(formatter, "malformed"),
            Self::Memory { path, allowed } => {
                let path: Vec<&str> = path.iter().rev().copied().collect();
                write!(
                    formatter,
                    "{}: too many elements: in memory the message would need more than the {allowed} bytes allowed for \
                     its size; send fewer elements",
                    path.join(".")
                )
            }
        }
    }
}

/// Counts the memory of a request.
struct Count {
    allowed: usize,
    used: usize,
}

impl Count {
    fn add(&mut self, bytes: usize) -> Result<(), Reason> {
        self.used = self.used.saturating_add(bytes);
        if self.used <= self.allowed {
            return Ok(());
        }
        Err(Reason::Memory { path: Vec::new(), allowed: self.allowed })
    }

    /// Counts the fields of an encoded message.
    fn message(&mut self, message: &MessageType, mut bytes: &[u8], depth: usize) -> Result<(), Reason> {
        if depth > MAX_DEPTH {
            return Err(Reason::Malformed);
        }
        while !bytes.is_empty() {
            let (number, wire_type) = decode_key(&mut bytes)?;
            let Some(field) = message.fields.iter().find(|field| field.number == number) else {
                skip_field(wire_type, number, &mut bytes, DecodeContext::default())?;
                continue;
            };
            let counted = match wire_type {
                WireType::LengthDelimited => {
                    let length = usize::try_from(decode_varint(&mut bytes)?).map_err(|_| Reason::Malformed)?;
                    let (content, rest) = bytes.split_at_checked(length).ok_or(Reason::Malformed)?;
                    bytes = rest;
                    self.content(field, content, depth)
                }
                // A number of a repeated field that is not packed.
                WireType::Varint | WireType::ThirtyTwoBit | WireType::SixtyFourBit => {
                    skip_field(wire_type, number, &mut bytes, DecodeContext::default())?;
                    self.add(field.element)
                }
                WireType::StartGroup | WireType::EndGroup => return Err(Reason::Malformed),
            };
            counted.map_err(|mut reason| {
                if let Reason::Memory { path, .. } = &mut reason {
                    path.push(field.name);
                }
                reason
            })?;
        }
        Ok(())
    }

    /// Counts one occurrence of a field.
    fn content(&mut self, field: &Field, content: &[u8], depth: usize) -> Result<(), Reason> {
        let numbers = match field.content {
            Content::Message(index) => {
                self.add(field.element)?;
                return self.message(&REQUEST_TYPES[index], content, depth + 1);
            }
            // The content itself is not counted: it is at most the size of the request.
            Content::Bytes => return self.add(field.element + if content.is_empty() { 0 } else { SMALLEST_PIECE }),
            Content::Fixed(size) => content.len() / size,
            // The last byte of each number is less than 128.
            Content::Varint => content.iter().filter(|byte| **byte < 0x80).count(),
        };
        self.add(SMALLEST_PIECE + numbers.saturating_mul(field.element))
    }
}

/// Checks the memory that a request with this full name would need. Other messages are not checked.
fn check(name: &str, bytes: &[u8]) -> Result<(), Reason> {
    let Some(message) = REQUEST_TYPES.iter().find(|message| message.name == name) else { return Ok(()) };
    Count { allowed: ALLOWANCE + bytes.len(), used: 0 }.message(message, bytes, 0)
}

/// The codec of all methods: prost's, with a bound on the memory of requests. A request of n bytes needs at most n + 1
/// MiB for the elements of its repeated fields; vectors that grow may take up to twice as much.
#[derive(Clone, Copy, Debug)]
pub struct BoundedCodec<T, U>(PhantomData<(T, U)>);

impl<T, U> Default for BoundedCodec<T, U> {
    fn default() -> Self {
        Self(PhantomData)
    }
}

impl<T, U> Codec for BoundedCodec<T, U>
where
    T: Message + Send + 'static,
    U: Message + Name + Default + Send + 'static,
{
    type Encode = T;
    type Decode = U;
    type Encoder = ProstEncoder<T>;
    type Decoder = BoundedDecoder<U>;

    fn encoder(&mut self) -> Self::Encoder {
        ProstCodec::<T, U>::default().encoder()
    }

    fn decoder(&mut self) -> Self::Decoder {
        BoundedDecoder(ProstCodec::<T, U>::default().decoder())
    }
}

/// The decoder of [`BoundedCodec`].
#[derive(Clone, Debug)]
pub struct BoundedDecoder<U>(ProstDecoder<U>);

impl<U: Message + Name + Default> Decoder for BoundedDecoder<U> {
    type Item = U;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<U>, Status> {
        // tonic's buffer is contiguous.
        match check(&U::full_name(), buffer.chunk()) {
            Ok(()) | Err(Reason::Malformed) => self.0.decode(buffer),
            // The same code as for a malformed message.
            Err(reason) => Err(Status::internal(reason.to_string())),
        }
    }
}

#[cfg(test)]
mod tests {
    use prost::encoding::{encode_key, encode_varint};

    use super::*;
    use crate::{oip, pb};

    /// A field that holds `content`.
    fn field(number: u32, content: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::new();
        encode_key(number, WireType::LengthDelimited, &mut bytes);
        encode_varint(content.len() as u64, &mut bytes);
        bytes.extend(content);
        bytes
    }

    /// Requests with many small elements of each repeated field that a message can contain: the path of the field and
    /// the encoded message.
    fn floods(message: &MessageType, size: usize) -> Vec<(String, Vec<u8>)> {
        let mut floods = Vec::new();
        for part in message.fields {
            let Field { number, name, element, content } = *part;
            if element > 0 {
                let many = match content {
                    Content::Varint => field(number, &vec![1; size]),
                    Content::Fixed(_) => continue,
                    Content::Message(_) | Content::Bytes => field(number, &[]).repeat(size / 2),
                };
                floods.push((name.to_owned(), many));
            }
            if let Content::Message(index) = content {
                let inner = floods_in(index, size);
                floods.extend(inner.into_iter().map(|(path, bytes)| (format!("{name}.{path}"), field(number, &bytes))));
            }
        }
        floods
    }

    fn floods_in(index: usize, size: usize) -> Vec<(String, Vec<u8>)> {
        floods(&REQUEST_TYPES[index], size)
    }

    #[test]
    fn many_small_elements_are_refused_in_each_repeated_field() {
        let mut paths = Vec::new();
        for message in REQUEST_TYPES {
            for (path, bytes) in floods(message, 4 << 20) {
                match check(message.name, &bytes) {
                    Err(reason @ Reason::Memory { .. }) => {
                        let text = reason.to_string();
                        assert!(text.starts_with(&format!("{path}: too many elements")), "{}: {text}", message.name);
                    }
                    // A number of one byte that is not larger in memory.
                    Ok(()) if path.ends_with("bool_contents") => {}
                    other => panic!("{}: {path}: {other:?}", message.name),
                }
                paths.push(format!("{}.{path}", message.name));
            }
        }
        for path in ["inference.ModelInferRequest.inputs.contents.int64_contents", "grasp.v1.TrackGraspsRequest.views"]
        {
            assert!(paths.iter().any(|known| known == path), "{path} is missing: {paths:?}");
        }
    }

    #[test]
    fn every_occurrence_counts() {
        let mut request = Vec::new();
        // Occurrences of a field that is not repeated are merged by prost.
        for _ in 0..1000 {
            let options = pb::Options { objects: vec![1; 1000], ..Default::default() };
            request.extend(field(3, &options.encode_to_vec()));
        }
        assert!(pb::DetectGraspsRequest::decode(&*request).unwrap().options.unwrap().objects.len() == 1_000_000);
        let reason = check("grasp.v1.DetectGraspsRequest", &request).unwrap_err();
        assert!(reason.to_string().starts_with("options.objects: "), "{reason}");
    }

    #[test]
    fn requests_of_the_largest_useful_size_pass() {
        let volume = pb::Volume { resolution: 100, data: vec![0; 4_000_000].into(), ..Default::default() };
        let request = pb::DetectGraspsRequest { volume: Some(volume), ..Default::default() };
        check("grasp.v1.DetectGraspsRequest", &request.encode_to_vec()).unwrap();

        let pose = pb::Pose { position: Some(pb::Vector3 { x: 0.1, y: 0.2, z: 0.3 }), ..Default::default() };
        let candidate = pb::Candidate { pose: Some(pose), ..Default::default() };
        let request = pb::ScoreGraspsRequest { candidates: vec![candidate; 4096], ..Default::default() };
        check("grasp.v1.ScoreGraspsRequest", &request.encode_to_vec()).unwrap();

        for numbers in [64_000, 1_000_000] {
            let contents = oip::InferTensorContents { fp32_contents: vec![0.5; numbers], ..Default::default() };
            let input = oip::model_infer_request::InferInputTensor { contents: Some(contents), ..Default::default() };
            let request = oip::ModelInferRequest { inputs: vec![input], ..Default::default() };
            check("inference.ModelInferRequest", &request.encode_to_vec()).unwrap();
        }
    }

    #[test]
    fn malformed_messages_are_left_to_prost() {
        let mut request = field(3, &[]);
        request.push(0xff);
        assert!(matches!(check("grasp.v1.DetectGraspsRequest", &request), Err(Reason::Malformed)));
        assert!(matches!(check("grasp.v1.DetectGraspsRequest", &[0x1a, 0x05, 0x00]), Err(Reason::Malformed)));
        assert!(matches!(check("grasp.v1.DetectGraspsResponse", &request), Ok(())));
    }
}
