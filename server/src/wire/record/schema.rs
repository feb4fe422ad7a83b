//! The descriptors that a recording carries, so that any reader can make sense of its messages.

use std::collections::{BTreeMap, BTreeSet};

use plantd_proto::FILE_DESCRIPTOR_SET;
use prost::Message as _;
use prost_types::{DescriptorProto, FileDescriptorSet};

const PACKAGE: &str = ".plantd.v1.";

/// An encoded `FileDescriptorSet` of a message of the contract and of all that it is made of, and of
/// nothing else.
pub(super) fn descriptors(message: &str) -> Vec<u8> {
    let all = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap_or_default();
    let messages: BTreeMap<&str, &DescriptorProto> = all
        .file
        .iter()
        .flat_map(|file| &file.message_type)
        .map(|message| (message.name(), message))
        .collect();
    let mut needed = BTreeSet::new();
    let mut open = vec![message.to_owned()];
    while let Some(name) = open.pop() {
        if let Some(message) = messages.get(name.as_str()) {
            open.extend(parts(message).filter(|part| !needed.contains(part)));
        }
        needed.insert(name);
    }
    let is_needed = |name: &str| needed.contains(name);
    let mut files: Vec<_> = all.file.clone();
    for file in &mut files {
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

/// Names of the messages and enumerations that fields of a message have, those of the messages in it
/// included; of nested ones, that in which they are.
fn parts(message: &DescriptorProto) -> impl Iterator<Item = String> {
    let mut parts = Vec::new();
    let mut open = vec![message];
    while let Some(message) = open.pop() {
        open.extend(&message.nested_type);
        for field in &message.field {
            let name = field.type_name().strip_prefix(PACKAGE).unwrap_or_default();
            parts.extend(name.split('.').next().map(str::to_owned).filter(|name| !name.is_empty()));
        }
    }
    parts.into_iter()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_schema_has_what_its_message_needs_and_no_more() {
        let files = FileDescriptorSet::decode(&descriptors("StepRecord")[..]).unwrap().file;
        let names: Vec<_> =
            files.iter().flat_map(|f| &f.message_type).map(|m| m.name().to_owned()).collect();
        let expected = ["State", "StepReport", "Outputs", "StepTiming", "StepRecord"];
        assert_eq!(names, expected);
        // `InitialState` nests messages, `PlantSettings` has enumerations.
        let files = FileDescriptorSet::decode(&descriptors("CreatePlantRequest")[..]).unwrap().file;
        let nested = files.iter().flat_map(|f| &f.message_type).map(|m| m.nested_type.len());
        assert_eq!(nested.max(), Some(5));
        assert!(files.iter().flat_map(|f| &f.enum_type).any(|e| e.name() == "Precision"));
    }
}
