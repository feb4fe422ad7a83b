//! `diagnose`: what can be said of a state.

use std::fmt::Write as _;

use anyhow::Result;
use clap::Args;
use plantd_client::v1;

use crate::output::page::Page;
use crate::output::plant;
use crate::output::text::{number, numbers};
use crate::server::context::{Context, model_of};

/// Degrees of freedom, redundant constraints, energy, momenta and forces of a state.
#[derive(Debug, Args)]
pub(crate) struct Diagnose {
    /// Name of a model.
    #[arg(required_unless_present = "plant")]
    model: Option<String>,
    /// Operating point of the model.
    #[arg(long, value_name = "POINT", default_value = "initial")]
    at: String,
    /// Instead: the present state of this plant.
    #[arg(long, value_name = "ID", conflicts_with_all = ["model", "at"])]
    plant: Option<String>,
}

impl Diagnose {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let (model, request) = match self.plant {
            Some(id) => {
                let model = model_of(&client, &id).await?;
                (model, v1::DiagnoseRequest { id, ..Default::default() })
            }
            None => {
                let name = self.model.unwrap_or_default();
                let form = v1::initial_state::Form::OperatingPoint(self.at);
                let initial = Some(v1::InitialState { form: Some(form) });
                let model = client.get_model(&name).await?;
                (model, v1::DiagnoseRequest { model: name, initial, ..Default::default() })
            }
        };
        let answer = client.diagnose(request).await?;
        context.output.message("DiagnoseResponse", &answer, || text(&answer, &model))
    }
}

/// What can be said of a state.
fn text(answer: &v1::DiagnoseResponse, model: &v1::Model) -> Page {
    let redundant = match answer.redundant_constraints.as_slice() {
        [] => "none".to_owned(),
        names => names.join(", "),
    };
    let mut text = format!(
        "step {}\n  degrees of freedom: {}\n  independent constraints: {} of {}; redundant: \
         {redundant}\n",
        answer.step,
        answer.degrees_of_freedom,
        answer.constraint_rank,
        model.constraints.len(),
    );
    text += &answer.energy.as_ref().map(plant::energy).unwrap_or_default();
    let _ = write!(
        text,
        "  mass: {} kg, centre at ({}) m\n  linear momentum: ({}) kg m/s\n  angular momentum about \
         the origin: ({}) kg m²/s\n  reciprocal condition: {} mass matrix, {} constraints\n",
        number(answer.mass_kg),
        numbers(&answer.center_of_mass),
        numbers(&answer.linear_momentum),
        numbers(&answer.angular_momentum),
        number(answer.mass_matrix_reciprocal_condition),
        number(answer.constraint_reciprocal_condition),
    );
    let mut page = Page::from(text);
    if !answer.constraint_forces.is_empty() {
        page.next_table(plant::forces(&answer.constraint_forces, model));
    }
    page
}
