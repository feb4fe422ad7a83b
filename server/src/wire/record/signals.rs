//! Signals under their names: a message that is made for the plant, `plantd.Signals`, with a group for each
//! quantity and a field for each of its entries, so that a player finds `/signals.q.theta`.

use std::collections::BTreeSet;

use plantd_models::Energy;
use plantd_proto::v1;
use prost::Message as _;
use prost::encoding::{WireType, double, encode_key, encode_varint};
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet};

use crate::core::publish::frame::Frame;

/// Full name of the message.
pub(super) const NAME: &str = "plantd.Signals";
/// Quantities, in the order of their field numbers, which are the same for all plants.
const GROUPS: [&str; 8] = ["q", "p", "velocity", "v", "u", "y", "force", "energy"];

/// An encoded `FileDescriptorSet` of the message of a plant.
pub(super) fn descriptors(model: &v1::Model, outputs: &[String]) -> Vec<u8> {
    let all = || model.coordinates.iter();
    let names = |prescribed| all().filter(move |c| c.prescribed == prescribed).map(|c| &c.name);
    let entries: [Vec<&String>; 7] = [
        all().map(|c| &c.name).collect(),
        names(false).collect(),
        all().map(|c| &c.name).collect(),
        names(true).collect(),
        model.inputs.iter().chain(names(true)).collect(),
        outputs.iter().collect(),
        model.constraints.iter().collect(),
    ];
    let energy = ["kinetic", "potential", "total"].map(str::to_owned);
    let mut message = DescriptorProto { name: Some("Signals".to_owned()), ..Default::default() };
    let entries = entries.into_iter().chain([energy.iter().collect()]);
    for ((group, entries), number) in GROUPS.iter().zip(entries).zip(1..) {
        if entries.is_empty() {
            continue;
        }
        let kind = format!("{}{}", group[..1].to_uppercase(), &group[1..]);
        let mut taken = BTreeSet::new();
        let fields = entries.iter().zip(1..).map(|(entry, number)| {
            field(unused(identifier(entry), &mut taken), number, Type::Double)
        });
        message.field.push(FieldDescriptorProto {
            type_name: Some(format!(".{NAME}.{kind}")),
            ..field((*group).to_owned(), number, Type::Message)
        });
        message.nested_type.push(DescriptorProto {
            name: Some(kind),
            field: fields.collect(),
            ..Default::default()
        });
    }
    let file = FileDescriptorProto {
        name: Some("plantd/signals.proto".to_owned()),
        package: Some("plantd".to_owned()),
        message_type: vec![message],
        syntax: Some("proto3".to_owned()),
        ..Default::default()
    };
    FileDescriptorSet { file: vec![file] }.encode_to_vec()
}

/// Encodes what a frame has, and the energy there.
pub(super) fn encode(frame: &Frame, energy: Energy, buffer: &mut Vec<u8>) {
    let Energy { kinetic_j, potential_j } = energy;
    let force: Vec<f64> =
        frame.state.multipliers.iter().map(|impulse| impulse / frame.time_step_s).collect();
    let energy = [kinetic_j, potential_j, kinetic_j + potential_j];
    let state = &frame.state;
    let groups: [&[f64]; 8] = [
        &state.q,
        &state.p,
        &frame.velocity,
        &state.v,
        &frame.input,
        &frame.outputs,
        &force,
        &energy,
    ];
    buffer.clear();
    for (numbers, group) in groups.into_iter().zip(1..) {
        if numbers.is_empty() {
            continue;
        }
        encode_key(group, WireType::LengthDelimited, buffer);
        let length =
            numbers.iter().zip(1..).map(|(x, tag)| double::encoded_len(tag, x)).sum::<usize>();
        encode_varint(length as u64, buffer);
        numbers.iter().zip(1..).for_each(|(x, tag)| double::encode(tag, x, buffer));
    }
}

fn field(name: String, number: i32, kind: Type) -> FieldDescriptorProto {
    FieldDescriptorProto {
        name: Some(name),
        number: Some(number),
        label: Some(Label::Optional.into()),
        r#type: Some(kind.into()),
        ..Default::default()
    }
}

/// The name as a field may have it.
fn identifier(name: &str) -> String {
    let is_fit = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let mut fit: String = name.chars().map(|c| if is_fit(c) { c } else { '_' }).collect();
    if !fit.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_') {
        fit.insert(0, '_');
    }
    fit
}

/// The name, with a number where it is taken.
fn unused(name: String, taken: &mut BTreeSet<String>) -> String {
    let numbered = (2..).map(|number| format!("{name}_{number}"));
    let mut all = std::iter::once(name.clone()).chain(numbered);
    let free = all.find(|name| !taken.contains(name)).unwrap_or(name);
    taken.insert(free.clone());
    free
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_become_fields_that_differ() {
        let mut taken = BTreeSet::new();
        let names = ["tip.x", "tip-x", "2nd", "θ"].map(|name| unused(identifier(name), &mut taken));
        assert_eq!(names, ["tip_x", "tip_x_2", "_2nd", "_"]);
    }

    #[test]
    fn what_is_encoded_is_what_the_descriptors_say() {
        let coordinate =
            |name: &str| v1::Coordinate { name: name.to_owned(), ..Default::default() };
        let model = v1::Model { coordinates: vec![coordinate("theta")], ..Default::default() };
        let set = FileDescriptorSet::decode(&descriptors(&model, &[])[..]).unwrap();
        let message = &set.file[0].message_type[0];
        let numbers: Vec<_> = message.field.iter().map(|f| (f.name(), f.number())).collect();
        assert_eq!(numbers, [("q", 1), ("p", 2), ("velocity", 3), ("energy", 8)]);
        let mut frame = Frame { velocity: vec![0.5], time_step_s: 0.1, ..Frame::default() };
        (frame.state.q, frame.state.p) = (vec![0.0], vec![2.0]);
        let mut buffer = Vec::new();
        encode(&frame, Energy { kinetic_j: 1.0, potential_j: 2.0 }, &mut buffer);
        // Group 1 of 9 bytes, in it field 1 of 8 bytes; groups 2 and 3 alike; group 8 of three numbers.
        assert_eq!(buffer[..3], [0x0a, 9, 0x09]);
        assert_eq!(buffer.len(), 3 * (2 + 9) + 2 + 27);
        assert_eq!(buffer[buffer.len() - 8..], 3.0_f64.to_le_bytes());
    }
}
