//! Counts the parts of a message before it is decoded: entries of repeated fields that are messages,
//! texts or bytes. Two bytes of an empty one become hundreds in memory; numbers stay as large as they
//! are.
//!
//! The bytes are followed by the descriptors of the contract as they come, so that a message of too
//! many parts is refused before it is whole.

use std::collections::HashMap;
use std::sync::LazyLock;

use plantd_proto::FILE_DESCRIPTOR_SET;
use prost::Message as _;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FileDescriptorSet};

/// Bytes of the smallest part: a tag and a length of 0.
pub(crate) const PART_BYTES_MIN: u64 = 2;

/// What a field means for the count.
#[derive(Clone, Copy, Default)]
struct Field {
    /// Each occurrence is a part.
    is_part: bool,
    /// The message that it holds, as an index into [`Schema::messages`].
    message: Option<usize>,
}

/// The messages of the contract.
struct Schema {
    /// Fields of each message, at their numbers.
    messages: Vec<Vec<Field>>,
    /// Index of the request of each method, by its path.
    requests: HashMap<String, usize>,
}

static SCHEMA: LazyLock<Schema> = LazyLock::new(|| {
    // The descriptors were encoded by the contract's own build.
    Schema::new(&FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap_or_default())
});

impl Schema {
    fn new(set: &FileDescriptorSet) -> Self {
        let mut all = Vec::new();
        for file in &set.file {
            collect(&format!(".{}", file.package()), &file.message_type, &mut all);
        }
        let index = |name: &str| all.iter().position(|(other, _)| other == name);
        let fields = |message: &DescriptorProto| {
            let last = message.field.iter().map(prost_types::FieldDescriptorProto::number).max();
            let mut fields = vec![Field::default(); last.map_or(0, number) + 1];
            for field in &message.field {
                let kind = field.r#type();
                fields[number(field.number())] = Field {
                    is_part: field.label() == Label::Repeated
                        && matches!(kind, Type::Message | Type::String | Type::Bytes),
                    message: index(field.type_name()),
                };
            }
            fields
        };
        let messages = all.iter().map(|(_, message)| fields(message)).collect();
        let mut requests = HashMap::new();
        for file in &set.file {
            for service in &file.service {
                for method in &service.method {
                    let path = format!("/{}.{}/{}", file.package(), service.name(), method.name());
                    requests.extend(index(method.input_type()).map(|request| (path, request)));
                }
            }
        }
        Self { messages, requests }
    }

    fn field(&self, message: usize, number: u64) -> Field {
        let number = usize::try_from(number).ok();
        number.and_then(|number| self.messages[message].get(number)).copied().unwrap_or_default()
    }
}

/// Numbers of fields are positive.
fn number(number: i32) -> usize {
    usize::try_from(number).unwrap_or(0)
}

/// All messages of a scope with their full names, nested ones too.
fn collect<'a>(
    scope: &str,
    messages: &'a [DescriptorProto],
    all: &mut Vec<(String, &'a DescriptorProto)>,
) {
    for message in messages {
        let name = format!("{scope}.{}", message.name());
        collect(&name, &message.nested_type, all);
        all.push((name, message));
    }
}

/// The request of a method of the contract, by its path.
pub(crate) fn request_of(path: &str) -> Option<usize> {
    SCHEMA.requests.get(path).copied()
}

/// A message whose bytes are no message: it is over before its parts are, or holds groups, which the
/// contract does not have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Malformed;

/// What comes next.
enum Next {
    Tag,
    /// Number of a variable length.
    Varint,
    /// Length of what this field holds.
    Length(Field),
}

/// A message on its way.
pub(crate) struct Walk {
    /// Parts so far.
    pub parts: u64,
    /// Bytes so far.
    at: u64,
    /// Messages that are open, each with the byte at which it ends.
    open: Vec<(usize, u64)>,
    next: Next,
    /// Bits of the number that is being read, and how many have come.
    value: u64,
    bits: u32,
    /// Bytes to pass over.
    skip: u64,
}

impl Walk {
    /// A request of this many bytes.
    pub(crate) fn new(request: usize, bytes: u64) -> Self {
        let open = vec![(request, bytes)];
        Self { parts: 0, at: 0, open, next: Next::Tag, value: 0, bits: 0, skip: 0 }
    }

    /// Goes on with the next bytes of the message.
    pub(crate) fn advance(&mut self, mut piece: &[u8]) -> Result<(), Malformed> {
        while !piece.is_empty() {
            if self.skip > 0 {
                let count = piece.len().min(usize::try_from(self.skip).unwrap_or(usize::MAX));
                self.skip -= count as u64;
                self.at += count as u64;
                piece = &piece[count..];
            } else {
                self.take(piece[0])?;
                piece = &piece[1..];
            }
            if self.skip == 0 && matches!(self.next, Next::Tag) && self.bits == 0 {
                while self.open.pop_if(|(_, end)| *end == self.at).is_some() {}
            }
        }
        Ok(())
    }

    /// The next byte of a number.
    fn take(&mut self, byte: u8) -> Result<(), Malformed> {
        let &(message, end) = self.open.last().ok_or(Malformed)?;
        if self.at >= end || self.bits > 63 {
            return Err(Malformed);
        }
        self.at += 1;
        self.value |= u64::from(byte & 0x7f) << self.bits;
        self.bits += 7;
        if byte & 0x80 != 0 {
            return Ok(());
        }
        let value = std::mem::take(&mut self.value);
        self.bits = 0;
        match std::mem::replace(&mut self.next, Next::Tag) {
            Next::Tag => match value & 7 {
                0 => self.next = Next::Varint,
                1 => self.pass(8)?,
                2 => self.next = Next::Length(SCHEMA.field(message, value >> 3)),
                5 => self.pass(4)?,
                _ => return Err(Malformed),
            },
            Next::Varint => {}
            Next::Length(field) => {
                self.parts += u64::from(field.is_part);
                match field.message {
                    Some(message) if value <= end - self.at => {
                        self.open.push((message, self.at + value));
                    }
                    Some(_) => return Err(Malformed),
                    None => self.pass(value)?,
                }
            }
        }
        Ok(())
    }

    fn pass(&mut self, bytes: u64) -> Result<(), Malformed> {
        let end = self.open.last().map_or(0, |(_, end)| *end);
        self.skip = bytes;
        if bytes <= end - self.at { Ok(()) } else { Err(Malformed) }
    }
}

#[cfg(test)]
mod tests {
    use plantd_proto::v1;

    use super::*;

    fn walk(path: &str, bytes: &[u8], size: usize) -> Result<u64, Malformed> {
        let mut walk = Walk::new(request_of(path).unwrap(), bytes.len() as u64);
        for piece in bytes.chunks(size) {
            walk.advance(piece)?;
        }
        Ok(walk.parts)
    }

    const OPTIMIZE: &str = "/plantd.v1.ControlService/OptimizeTrajectory";

    fn request() -> v1::OptimizeTrajectoryRequest {
        let stage = v1::StageWeights { x_linear: vec![1.0, 2.0], ..Default::default() };
        let cost = v1::TrajectoryCost { stages: vec![stage; 3], ..Default::default() };
        let bound = v1::Bound { entry: "force".to_owned(), ..Default::default() };
        let bounds = v1::TrajectoryBounds { input: vec![bound; 2], ..Default::default() };
        v1::OptimizeTrajectoryRequest {
            cost: Some(cost),
            bounds: Some(bounds),
            ..Default::default()
        }
    }

    #[test]
    fn parts_are_counted_however_deep_and_however_cut() {
        let bytes = request().encode_to_vec();
        for size in 1..=bytes.len() {
            assert_eq!(walk(OPTIMIZE, &bytes, size), Ok(5), "pieces of {size}");
        }
        let hold = vec![String::new(); 4];
        let guess = HashMap::from([("a".to_owned(), 1.0), ("b".to_owned(), 2.0)]);
        let settle = v1::SettleRequest { hold, guess, q: vec![0.0; 9], ..Default::default() };
        let path = "/plantd.v1.ModelService/Settle";
        assert_eq!(walk(path, &settle.encode_to_vec(), 7), Ok(6));
    }

    #[test]
    fn what_is_no_message_is_refused_or_counted_but_never_followed_beyond_its_end() {
        let bytes = request().encode_to_vec();
        for at in 0..bytes.len() {
            for byte in [0x00, 0x0b, 0x22, 0x7f, 0x80, 0xff] {
                let mut wrong = bytes.clone();
                wrong[at] = byte;
                let whole = walk(OPTIMIZE, &wrong, wrong.len());
                assert_eq!(whole, walk(OPTIMIZE, &wrong, 1), "{byte} at {at}");
            }
        }
        assert_eq!(walk(OPTIMIZE, &[0x0b], 1), Err(Malformed), "a group");
        assert_eq!(walk(OPTIMIZE, &[0xff; 20], 20), Err(Malformed), "a tag without end");
    }
}
