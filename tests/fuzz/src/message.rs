//! Messages of the contract with random fields.

use prost_reflect::{
    Cardinality, DynamicMessage, FieldDescriptor, Kind, MapKey, MessageDescriptor, Value,
};

use crate::mutate::Rng;

/// Names that mean something to the server of the fuzzer.
const NAMES: [&str; 12] = [
    "p",
    "c",
    "m",
    "x",
    "pendulum",
    "cart-pole",
    "marionette",
    "theta",
    "cart",
    "r",
    "",
    "\u{1f600}/../a",
];
/// Messages in messages.
const DEPTH_MAX: usize = 5;

/// A message of this kind; `texts` are what long texts are taken from.
pub(crate) fn random(rng: &mut Rng, kind: &MessageDescriptor, texts: &[Vec<u8>]) -> DynamicMessage {
    filled(rng, kind, texts, 0)
}

fn filled(
    rng: &mut Rng,
    kind: &MessageDescriptor,
    texts: &[Vec<u8>],
    depth: usize,
) -> DynamicMessage {
    let mut message = DynamicMessage::new(kind.clone());
    for field in kind.fields() {
        // What names a plant or a model is there most often, or all is refused for the lack of it.
        let is_name =
            matches!(field.name(), "id" | "ids" | "model" | "name" | "plant" | "at" | "point");
        if if is_name { rng.once_in(12) } else { rng.once_in(2) } {
            continue;
        }
        let value = if field.is_map() {
            let Kind::Message(entry) = field.kind() else { continue };
            let value = value(rng, &entry.map_entry_value_field(), texts, depth);
            let Value::String(key) = name(rng) else { continue };
            value.map(|value| Value::Map([(MapKey::String(key), value)].into()))
        } else if field.cardinality() == Cardinality::Repeated {
            let count = match rng.below(8) {
                0 => 40,
                _ => rng.below(5),
            };
            let values = (0..count).filter_map(|_| value(rng, &field, texts, depth)).collect();
            Some(Value::List(values))
        } else {
            value(rng, &field, texts, depth)
        };
        // Of fields of which only one can be there the last one stays.
        if let Some(value) = value {
            let _ = message.try_set_field(&field, value);
        }
    }
    message
}

fn name(rng: &mut Rng) -> Value {
    Value::String((*rng.of(&NAMES)).to_owned())
}

fn value(rng: &mut Rng, field: &FieldDescriptor, texts: &[Vec<u8>], depth: usize) -> Option<Value> {
    Some(match field.kind() {
        Kind::Double => Value::F64(rng.number()),
        Kind::Float => Value::F32(rng.number() as f32),
        Kind::Int32 | Kind::Sint32 | Kind::Sfixed32 => Value::I32(rng.integer() as i32),
        Kind::Int64 | Kind::Sint64 | Kind::Sfixed64 => Value::I64(rng.integer() as i64),
        Kind::Uint32 | Kind::Fixed32 => Value::U32(rng.integer() as u32),
        Kind::Uint64 | Kind::Fixed64 => Value::U64(rng.integer()),
        Kind::Bool => Value::Bool(rng.once_in(2)),
        Kind::Enum(_) => Value::EnumNumber(rng.below(6) as i32),
        Kind::String if field.name().starts_with("scene") && !texts.is_empty() => {
            let text: &Vec<u8> = rng.of(texts);
            Value::String(String::from_utf8_lossy(text).into_owned())
        }
        Kind::String => name(rng),
        Kind::Bytes => Value::Bytes((0..rng.below(40)).map(|_| rng.next() as u8).collect()),
        Kind::Message(_) if depth == DEPTH_MAX => return None,
        Kind::Message(kind) => Value::Message(filled(rng, &kind, texts, depth + 1)),
    })
}
