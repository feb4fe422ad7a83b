//! The descriptors that a recording carries, so that any reader can make sense of its messages.

use std::collections::{BTreeMap, BTreeSet};

use prost::Message as _;
use prost_types::{DescriptorProto, FileDescriptorSet};

/// An encoded `FileDescriptorSet` of a message of an encoded set and of all that it is made of, and of nothing
/// else. The message goes by its full name, `plantd.v1.StepRecord`.
pub(super) fn descriptors(all: &[u8], message: &str) -> Vec<u8> {
    let all = FileDescriptorSet::decode(all).unwrap_or_default();
    let mut messages: BTreeMap<String, &DescriptorProto> = BTreeMap::new();
    for file in &all.file {
        let named = |message| (full_name(file.package(), DescriptorProto::name(message)), message);
        messages.extend(file.message_type.iter().map(named));
    }
    let mut needed = BTreeSet::new();
    let mut open = vec![message.to_owned()];
    while let Some(name) = open.pop() {
        if let Some(message) = messages.get(&name) {
            open.extend(parts(message, &messages).filter(|part| !needed.contains(part)));
        }
        needed.insert(name);
    }
    let mut files: Vec<_> = all.file.clone();
    for file in &mut files {
        let package = file.package().to_owned();
        let is_needed = |name: &str| needed.contains(&full_name(&package, name));
        file.message_type.retain(|message| is_needed(message.name()));
        file.enum_type.retain(|kind| is_needed(kind.name()));
        file.service.clear();
        file.source_code_info = None;
    }
    files.retain(|file| !file.message_type.is_empty() || !file.enum_type.is_empty());
    let kept: BTreeSet<_> = files.iter().map(|file| file.name().to_owned()).collect();
    for file in &mut files {
        file.dependency.retain(|name| kept.contains(name));
    }
    FileDescriptorSet { file: files }.encode_to_vec()
}

fn full_name(package: &str, name: &str) -> String {
    format!("{package}.{name}")
}

/// Full names of the messages and enumerations that fields of a message have, those of the messages in it
/// included; of nested ones, that in which they are.
fn parts(
    message: &DescriptorProto,
    messages: &BTreeMap<String, &DescriptorProto>,
) -> impl Iterator<Item = String> {
    let mut parts = Vec::new();
    let mut open = vec![message];
    while let Some(message) = open.pop() {
        open.extend(&message.nested_type);
        for field in message.field.iter().filter(|field| !field.type_name().is_empty()) {
            let name = field.type_name().trim_start_matches('.');
            // The message around a nested one is named by its beginning.
            let mut outer = name.match_indices('.').map(|(end, _)| &name[..end]);
            let around = outer.find(|outer| messages.contains_key(*outer));
            parts.push(around.unwrap_or(name).to_owned());
        }
    }
    parts.into_iter()
}

#[cfg(test)]
mod tests {
    use plantd_proto::{FILE_DESCRIPTOR_SET, foxglove};

    use super::*;

    fn files(all: &[u8], message: &str) -> Vec<prost_types::FileDescriptorProto> {
        FileDescriptorSet::decode(&descriptors(all, message)[..]).unwrap().file
    }

    #[test]
    fn a_schema_has_what_its_message_needs_and_no_more() {
        let of_step = files(FILE_DESCRIPTOR_SET, "plantd.v1.StepRecord");
        let names: Vec<_> =
            of_step.iter().flat_map(|f| &f.message_type).map(|m| m.name().to_owned()).collect();
        let expected = ["State", "StepReport", "Outputs", "StepTiming", "StepRecord"];
        assert_eq!(names, expected);
        // `InitialState` nests messages, `PlantSettings` has enumerations.
        let of_request = files(FILE_DESCRIPTOR_SET, "plantd.v1.CreatePlantRequest");
        let nested = of_request.iter().flat_map(|f| &f.message_type).map(|m| m.nested_type.len());
        assert_eq!(nested.max(), Some(5));
        assert!(of_request.iter().flat_map(|f| &f.enum_type).any(|e| e.name() == "Precision"));
        // Others' packages come along.
        let of_frames = files(foxglove::FILE_DESCRIPTOR_SET, "foxglove.FrameTransforms");
        let names: Vec<_> =
            of_frames.iter().flat_map(|f| &f.message_type).map(|m| m.name().to_owned()).collect();
        let expected = ["Timestamp", "FrameTransforms", "FrameTransform", "Vector3", "Quaternion"];
        assert_eq!(names, expected);
    }
}
