//! Compiles the .proto files without needing protoc.

use std::collections::BTreeMap;
use std::env;
use std::error::Error;
use std::fmt::Write;
use std::fs;
use std::path::PathBuf;

use heck::ToSnakeCase;
use prost::Message;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FieldDescriptorProto, FileDescriptorSet};

/// Packages and the modules of their generated types.
const MODULES: [(&str, &str); 2] = [(".grasp.v1.", "crate::pb"), (".inference.", "crate::oip")];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    let descriptors =
        protox::compile(["grasp/v1/grasp.proto", "grasp/v1/recording.proto", "inference/inference.proto"], ["proto"])?;
    let out = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(out.join("descriptors.bin"), descriptors.encode_to_vec())?;
    fs::write(out.join("request_types.rs"), request_types(&descriptors)?)?;
    // `Bytes` shares the buffer of the received message instead of copying the volume.
    let mut prost = tonic_prost_build::Config::new();
    prost.enable_type_names();
    let mut config = tonic_prost_build::configure().codec_path("crate::BoundedCodec");
    for field in [
        ".grasp.v1.Volume.data",
        ".grasp.v1.DepthView.data",
        ".grasp.v1.CloudView.points",
        ".grasp.v1.Labels.data",
        ".inference.ModelInferRequest.raw_input_contents",
        ".inference.ModelInferResponse.raw_output_contents",
    ] {
        config = config.bytes(field);
    }
    config.compile_fds_with_config(descriptors, prost)?;
    Ok(())
}

/// The source of the table of all message types that are part of requests, with their fields that need memory on the
/// heap. `bounded.rs` defines its types.
fn request_types(descriptors: &FileDescriptorSet) -> Result<String, Box<dyn Error>> {
    let mut messages = BTreeMap::new();
    for file in &descriptors.file {
        let scope = format!(".{}", file.package());
        file.message_type.iter().for_each(|message| collect(message, &scope, &mut messages));
    }
    let methods = descriptors.file.iter().flat_map(|file| &file.service).flat_map(|service| &service.method);
    let mut types: Vec<&str> = Vec::new();
    for method in methods {
        if !types.contains(&method.input_type()) {
            types.push(method.input_type());
        }
    }
    let mut table = String::from("static REQUEST_TYPES: &[MessageType] = &[\n");
    let mut next = 0;
    while let Some(&name) = types.get(next) {
        next += 1;
        let message = messages.get(name).ok_or_else(|| format!("no message {name}"))?;
        writeln!(table, "    MessageType {{ name: {:?}, fields: &[", &name[1..])?;
        for field in &message.field {
            let is_repeated = field.label() == Label::Repeated;
            let element = match (is_repeated, messages.get(field.type_name())) {
                (false, _) => "0".to_owned(),
                (true, Some(entry)) if entry.options.as_ref().is_some_and(|options| options.map_entry()) => {
                    let types: Result<Vec<String>, _> = entry.field.iter().map(rust_type).collect();
                    format!("size_of::<({})>()", types?.join(", "))
                }
                (true, _) => format!("size_of::<{}>()", rust_type(field)?),
            };
            let content = match field.r#type() {
                Type::Message => {
                    let known = types.iter().position(|name| *name == field.type_name());
                    let index = known.unwrap_or_else(|| {
                        types.push(field.type_name());
                        types.len() - 1
                    });
                    format!("Content::Message({index})")
                }
                Type::String | Type::Bytes => "Content::Bytes".to_owned(),
                Type::Fixed32 | Type::Sfixed32 | Type::Float => "Content::Fixed(4)".to_owned(),
                Type::Fixed64 | Type::Sfixed64 | Type::Double => "Content::Fixed(8)".to_owned(),
                _ => "Content::Varint".to_owned(),
            };
            // A single number needs no memory on the heap.
            if is_repeated || content.starts_with("Content::Message") || content == "Content::Bytes" {
                let (number, name) = (field.number(), field.name());
                writeln!(
                    table,
                    "        Field {{ number: {number}, name: {name:?}, element: {element}, content: {content} }},"
                )?;
            }
        }
        table.push_str("    ] },\n");
    }
    table.push_str("];\n");
    Ok(table)
}

/// Adds a message and the messages declared in it, by their full names.
fn collect<'a>(message: &'a DescriptorProto, scope: &str, messages: &mut BTreeMap<String, &'a DescriptorProto>) {
    let name = format!("{scope}.{}", message.name());
    message.nested_type.iter().for_each(|nested| collect(nested, &name, messages));
    messages.insert(name, message);
}

/// The type that prost generates for an element of a field.
fn rust_type(field: &FieldDescriptorProto) -> Result<String, String> {
    Ok(match field.r#type() {
        Type::Message => {
            let name = field.type_name();
            let module = MODULES.iter().find_map(|(package, module)| Some((module, name.strip_prefix(package)?)));
            let (module, path) = module.ok_or_else(|| format!("{name} is of an unknown package"))?;
            let (parents, own) = path.rsplit_once('.').map_or((None, path), |(parents, own)| (Some(parents), own));
            let parents = parents.into_iter().flat_map(|parents| parents.split('.'));
            let parents: String = parents.map(|parent| format!("{}::", parent.to_snake_case())).collect();
            format!("{module}::{parents}{own}")
        }
        Type::Bool => "bool".to_owned(),
        Type::Fixed64 | Type::Sfixed64 | Type::Double | Type::Int64 | Type::Uint64 | Type::Sint64 => "u64".to_owned(),
        // `Bytes` is larger than `Vec` and `String`.
        Type::String | Type::Bytes => "tonic::codegen::Bytes".to_owned(),
        _ => "u32".to_owned(),
    })
}
