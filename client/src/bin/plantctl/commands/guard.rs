//! `guard`: bounds that protect a plant.

use anyhow::Result;
use clap::Args;
use plantd_client::v1;
use serde_json::json;

use crate::server::context::{Context, plant};

const GUARD: &str = "\
Quantities are coordinates, v(coordinate), force(constraint) and energy; actions are freeze (if none is
given), reset and disconnect.
Examples:
  plantctl guard cart 'x<2' 'x>-2' 'energy<50:reset'
  plantctl guard cart";

/// Sets bounds that protect a plant, in place of those before.
#[derive(Debug, Args)]
#[command(after_help = GUARD)]
pub(crate) struct Guard {
    /// Plant.
    id: String,
    /// Bounds; none takes the protection away.
    #[arg(value_name = "QUANTITY<VALUE[:ACTION]", value_parser = watchdog)]
    bounds: Vec<v1::Watchdog>,
}

impl Guard {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let Self { id, bounds: watchdogs } = self;
        let count = watchdogs.len();
        let is_bare = count == 0 && plant(&client, &id).await?.safety.is_none();
        let request = v1::SetSafetyRequest { id: id.clone(), watchdogs, on_step_failure: 0 };
        client.set_safety(request).await?;
        let output = &context.output;
        let said = match count {
            0 => format!("nothing protects plant `{id}` any more"),
            1 => format!("a bound protects plant `{id}`"),
            count => format!("{count} bounds protect plant `{id}`"),
        };
        if is_bare {
            output.nothing_to_do(&format!("nothing protects plant `{id}`"));
        }
        output.confirm(!is_bare, json!({ "guarded": { "plant": id, "watchdogs": count } }), &said)
    }
}

/// A watchdog on the command line: `theta<1.5`, `v(x)>-2`, `energy<10:reset`.
fn watchdog(given: &str) -> Result<v1::Watchdog, String> {
    let (bound, action) = given.rsplit_once(':').unwrap_or((given, "freeze"));
    let action = match action {
        "freeze" => v1::WatchdogAction::Freeze,
        "reset" => v1::WatchdogAction::Reset,
        "disconnect" => v1::WatchdogAction::Disconnect,
        other => return Err(format!("`{other}` is none of freeze, reset and disconnect")),
    };
    let at = bound.find(['<', '>']).ok_or("a quantity, `<` or `>`, and a number are needed")?;
    let (quantity, rest) = bound.split_at(at);
    let value: f64 =
        rest[1..].trim().parse().map_err(|_| format!("`{}` is no number", &rest[1..]))?;
    let is_max = rest.starts_with('<');
    Ok(v1::Watchdog {
        quantity: quantity.trim().to_owned(),
        min: (!is_max).then_some(value),
        max: is_max.then_some(value),
        action: action.into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn watchdogs_are_read() {
        let dog = watchdog("v(x) > -2.5:reset").unwrap();
        assert_eq!((dog.quantity.as_str(), dog.min, dog.max), ("v(x)", Some(-2.5), None));
        assert_eq!(dog.action(), v1::WatchdogAction::Reset);
        let dog = watchdog("energy<10").unwrap();
        assert_eq!(
            (dog.min, dog.max, dog.action()),
            (None, Some(10.0), v1::WatchdogAction::Freeze)
        );
        for wrong in ["theta", "theta<", "theta<1:stop", "theta=1"] {
            assert!(watchdog(wrong).is_err(), "{wrong}");
        }
    }
}
