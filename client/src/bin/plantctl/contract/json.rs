//! Messages of the contract as JSON, in the field names of the `.proto` files.

use std::sync::LazyLock;

use anyhow::{Result, anyhow};
use plantd_scene::in_plain_words;
use prost_reflect::{DescriptorPool, DynamicMessage, MessageDescriptor, SerializeOptions};
use serde_json::Value;

use crate::contract::mistakes;

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
    let given: Value = serde_json::from_str(text).map_err(|error| anyhow!("no JSON: {error}"))?;
    read_value(name, given)
}

/// Reads a message from its fields.
///
/// # Errors
/// The first mistake, by its path.
pub(crate) fn read_value<M: prost::Message + Default>(name: &str, given: Value) -> Result<M> {
    let descriptor = descriptor(name);
    mistakes::check(&descriptor, &given).map_err(anyhow::Error::msg)?;
    let dynamic = DynamicMessage::deserialize(descriptor, given);
    Ok(dynamic.map_err(|error| anyhow!(in_plain_words(&error.to_string())))?.transcode_to()?)
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
    fn mistakes_are_told_in_the_words_of_those_who_make_them() {
        for (name, given, said) in [
            ("Channels", json!({"sed": 1}), "there is no key `sed`; did you mean `seed`?"),
            ("Channels", json!({"seed": -1}), "seed: -1 is given; a whole number that is not neg"),
            ("Channels", json!({"outputs": {}}), "outputs: a table is given; a list is needed"),
            (
                "Channels",
                json!({"outputs": [{"name": "a", "noise": "big"}]}),
                "outputs[0].noise: \"big\" is given; a number is needed",
            ),
            (
                "Channels",
                json!({"inputs": [{"input": "tau", "hold": "HOLD_FRST_ORDER"}]}),
                "inputs[0].hold: there is no `HOLD_FRST_ORDER`; did you mean `HOLD_FIRST_ORDER`?",
            ),
            ("FaultSpec", json!({"input": 3}), "input: 3 is given; a text is needed"),
            ("FaultSpec", json!({"stuck": true, "off": true}), "give one of `stuck` and `off`"),
            ("FaultSpec", json!([1]), "a list of 1 is given; a table is needed"),
        ] {
            let error = match name {
                "Channels" => read_value::<v1::Channels>(name, given).unwrap_err(),
                _ => read_value::<v1::FaultSpec>(name, given).unwrap_err(),
            };
            assert!(error.to_string().starts_with(said), "{error}");
        }
        let error = read::<v1::State>("State", "{").unwrap_err().to_string();
        assert!(error.starts_with("no JSON: "), "{error}");
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
