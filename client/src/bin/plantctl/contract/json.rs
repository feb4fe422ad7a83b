//! Messages of the contract as JSON, in the field names of the `.proto` files.

use std::sync::LazyLock;

use anyhow::Result;
use prost_reflect::{DescriptorPool, DynamicMessage, MessageDescriptor, SerializeOptions};
use serde_json::Value;

static CONTRACT: LazyLock<DescriptorPool> = LazyLock::new(|| {
    DescriptorPool::decode(plantd_proto::FILE_DESCRIPTOR_SET).expect("the contract is well-formed")
});

fn descriptor(name: &str) -> MessageDescriptor {
    CONTRACT
        .get_message_by_name(&format!("plantd.v1.{name}"))
        .expect("the name of a message of the contract")
}

/// A message as JSON; `name` is its name in the package, for example `PlantInfo`. Fields that have
/// no value are there with their default, so that a script need not guess them.
pub(crate) fn message(name: &str, message: &impl prost::Message) -> Value {
    let bytes = message.encode_to_vec();
    let dynamic = DynamicMessage::decode(descriptor(name), bytes.as_slice())
        .expect("the bytes were encoded from the same contract");
    let options = SerializeOptions::new()
        .use_proto_field_name(true)
        .skip_default_fields(false)
        .stringify_64_bit_integers(false);
    dynamic
        .serialize_with_options(serde_json::value::Serializer, &options)
        .expect("numbers and strings are JSON")
}

/// Reads a message back from JSON.
pub(crate) fn read<M: prost::Message + Default>(name: &str, text: &str) -> Result<M> {
    let mut deserializer = serde_json::Deserializer::from_str(text);
    let dynamic = DynamicMessage::deserialize(descriptor(name), &mut deserializer)?;
    deserializer.end()?;
    Ok(dynamic.transcode_to()?)
}

/// Messages of one kind as a JSON array.
pub(crate) fn messages<M: prost::Message>(name: &str, all: &[M]) -> Value {
    all.iter().map(|one| message(name, one)).collect()
}

#[cfg(test)]
mod tests {
    use plantd_client::v1;
    use serde_json::json;

    use super::*;

    #[test]
    fn a_message_comes_back_bit_for_bit() {
        let q = vec![0.1 + 0.2, 1e-300, -0.0, 2.0_f64.sqrt()];
        let state = v1::State { step: 1 << 60, q, ..Default::default() };
        let text = message("State", &state).to_string();
        assert_eq!(read::<v1::State>("State", &text).unwrap(), state);
        // As other writers of JSON have it.
        assert_eq!(read::<v1::State>("State", r#"{"step": "7"}"#).unwrap().step, 7);
        assert!(read::<v1::State>("State", "{} x").is_err());
    }

    #[test]
    fn a_message_keeps_its_field_names_and_types() {
        let state = v1::State { step: 7, q: vec![0.5], ..Default::default() };
        let value = message("State", &state);
        assert_eq!(value["step"], 7);
        assert_eq!(value["q"], json!([0.5]));
        assert_eq!(value["multipliers"], json!([]));
    }
}
