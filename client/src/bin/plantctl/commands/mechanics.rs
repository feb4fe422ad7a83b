//! `kinematics` and `forces`: frames and the equation of motion at a state.

use std::iter;

use anyhow::Result;
use clap::Args;
use plantd_client::{Client, v1};

use crate::contract::names;
use crate::input::numbers::{Vector, given, numbers, vector};
use crate::input::point::configuration;
use crate::output::page::{Cell, Page, Table, matrix, table};
use crate::output::plant;
use crate::output::text::{self, number};
use crate::server::context::{Context, plant as plant_now};

/// A configuration and a velocity of a model, or of a plant that stays where it is.
#[derive(Debug, Args)]
struct At {
    /// Name of a model.
    #[arg(required_unless_present = "plant")]
    model: Option<String>,
    /// Operating point whose configuration holds where `--q` is not given.
    #[arg(long, value_name = "POINT", default_value = "initial")]
    at: String,
    /// Instead: the model and the present state of this plant.
    #[arg(long, value_name = "ID", conflicts_with_all = ["model", "at"])]
    plant: Option<String>,
    /// Configuration, comma-separated, dynamic coordinates first; or some of it, `theta=0.1`.
    #[arg(long, value_parser = vector, allow_hyphen_values = true)]
    q: Option<Vector>,
    /// Velocity, comma-separated or by name; zero if not given, of a plant without `--q` its present one.
    #[arg(long, value_parser = vector, allow_hyphen_values = true)]
    v: Option<Vector>,
}

impl At {
    /// The state, and the model that it is one of. What is not named is that of the operating point or the plant.
    async fn resolve(self, client: &Client) -> Result<(v1::MechanicalState, v1::Model)> {
        let Some(id) = self.plant else {
            let model = client.get_model(self.model.unwrap_or_default()).await?;
            let q = configuration(client, self.q.as_ref(), &model, &self.at).await?;
            let v = given(self.v.as_ref(), "v", &names::coordinates(&model))?;
            let (name, operating_point) = (model.name.clone(), self.at);
            let state =
                v1::MechanicalState { model: name, operating_point, q, v, ..Default::default() };
            return Ok((state, model));
        };
        let now = plant_now(client, &id).await?;
        let model = client.get_model(&now.model).await?;
        let state = now.state.unwrap_or_default();
        let over = |vector: Option<&Vector>, what: &str, rest: &[f64]| match vector {
            Some(vector) => vector.over(what, &names::coordinates(&model), rest),
            None => Ok(Vec::new()),
        };
        let at_rest = vec![0.0; state.q.len()];
        let velocity = if self.q.is_some() { &at_rest } else { &state.velocity };
        let q = over(self.q.as_ref(), "q", &state.q)?;
        let v = over(self.v.as_ref(), "v", velocity)?;
        Ok((v1::MechanicalState { plant: id, q, v, ..Default::default() }, model))
    }
}

/// Poses and velocities of frames and points, their Jacobians, and the centre of mass.
#[derive(Debug, Args)]
pub(crate) struct Kinematics {
    #[command(flatten)]
    at: At,
    /// Frames, comma-separated; all if neither frames nor points are given.
    #[arg(long, value_delimiter = ',')]
    frames: Vec<String>,
    /// A point of a frame, in its axes, m; may be given several times.
    #[arg(long = "point", value_name = "FRAME=X,Y,Z", value_parser = point)]
    points: Vec<v1::FramePoint>,
    /// Print the Jacobians, too.
    #[arg(long)]
    jacobians: bool,
}

/// Mass matrix, forces and energy at a state; the forces that an acceleration takes.
#[derive(Debug, Args)]
pub(crate) struct Forces {
    #[command(flatten)]
    at: At,
    /// Input forces, comma-separated or by name; those of the operating point, or of the plant, if not given.
    #[arg(long, value_parser = vector, allow_hyphen_values = true)]
    inputs: Option<Vector>,
    /// Accelerations of the dynamic coordinates, comma-separated or by name: print the forces that they take.
    #[arg(long, value_parser = vector, allow_hyphen_values = true)]
    acceleration: Option<Vector>,
    /// Accelerations of the prescribed coordinates, comma-separated or by name; zero if not given.
    #[arg(long, value_parser = vector, allow_hyphen_values = true)]
    prescribed_acceleration: Option<Vector>,
    /// Print the accelerations that follow from the inputs, too.
    #[arg(long)]
    forward: bool,
}

/// Reads `frame=x,y,z`.
fn point(text: &str) -> Result<v1::FramePoint, String> {
    let (frame, at) = text.split_once('=').ok_or("a frame and a point with `=` are needed")?;
    Ok(v1::FramePoint { frame: frame.trim().to_owned(), at: numbers(at)?.0 })
}

impl Kinematics {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let points = self.points.clone();
        let request = v1::KinematicsRequest {
            state: Some(self.at.resolve(&client).await?.0),
            frames: self.frames,
            points: self.points,
            jacobians: self.jacobians,
        };
        let answer = client.kinematics(request).await?;
        context.output.message("KinematicsResponse", &answer, || motions(&answer, &points))
    }
}

impl Forces {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let (state, model) = self.at.resolve(&client).await?;
        let dynamic: Vec<_> = names::dynamic(&model).collect();
        let prescribed: Vec<_> = names::prescribed(&model).collect();
        let prescribed_acceleration = self.prescribed_acceleration.as_ref();
        let request = v1::DynamicsRequest {
            state: Some(state),
            inputs: given(self.inputs.as_ref(), "inputs", &model.inputs)?,
            acceleration: given(self.acceleration.as_ref(), "acceleration", &dynamic)?,
            prescribed_acceleration: given(
                prescribed_acceleration,
                "prescribed-acceleration",
                &prescribed,
            )?,
            forward: self.forward,
        };
        let answer = client.dynamics(request).await?;
        context.output.message("DynamicsResponse", &answer, || forces(&answer))
    }
}

/// Frames, points and the centre of mass, then the Jacobians that there are.
fn motions(answer: &v1::KinematicsResponse, points: &[v1::FramePoint]) -> Page {
    let named = |name: &String, values: [&[f64]; 4]| {
        iter::once(name.clone()).chain(values.map(text::numbers)).collect()
    };
    let frames = answer.frames.iter().map(|frame| {
        let v1::FrameMotion { position, orientation, linear_velocity, angular_velocity, .. } =
            frame;
        named(&frame.frame, [position, orientation, linear_velocity, angular_velocity])
    });
    let labels: Vec<_> = points
        .iter()
        .map(|point| format!("{}({})", point.frame, text::numbers(&point.at)))
        .collect();
    let points = answer
        .points
        .iter()
        .zip(&labels)
        .map(|(point, label)| named(label, [&point.position, &[], &point.velocity, &[]]));
    let mut rows: Vec<Vec<String>> = frames.chain(points).collect();
    let center = answer.center_of_mass.clone().unwrap_or_default();
    let label = format!("centre of {} kg", number(center.mass_kg));
    rows.push(named(&label, [&center.position, &[], &center.velocity, &[]]));
    let head = ["", "position/m", "orientation w, x, y, z", "velocity/m/s", "turning/rad/s"];
    let mut out = Page::from(table(&head, rows));
    let axes: Vec<String> = ["vx", "vy", "vz", "wx", "wy", "wz"].map(str::to_owned).to_vec();
    let of_frames = answer.frames.iter().map(|frame| (&frame.frame, &frame.jacobian));
    let of_points = labels.iter().zip(answer.points.iter().map(|point| &point.jacobian));
    let jacobians = of_frames.chain(of_points).chain([(&label, &center.jacobian)]);
    for (name, jacobian) in jacobians.filter_map(|(name, j)| Some((name, j.as_ref()?))) {
        let title = format!("Jacobian of {name}");
        out.next_table(matrix(&title, jacobian, &axes, &answer.coordinates));
    }
    out
}

/// The terms by coordinate, with forward and inverse dynamics where they were asked for, and the matrices.
fn forces(answer: &v1::DynamicsResponse) -> Page {
    let (names, constraints) = (&answer.coordinates, &answer.constraints);
    let (forward, inverse) = (answer.forward.as_ref(), answer.inverse.as_ref());
    let mut terms = vec![
        ("bias", &answer.bias),
        ("gravity", &answer.gravity),
        ("passive", &answer.passive),
        ("input", &answer.input),
    ];
    terms.extend(forward.map(|forward| ("acceleration", &forward.acceleration)));
    terms.extend(inverse.map(|inverse| ("tau", &inverse.force)));
    let mut out = Page::from(columns(names, &terms));
    answer.energy.iter().for_each(|energy| out.append(plant::energy(energy)));
    if let Some(mass) = &answer.mass_matrix {
        out.next_table(matrix("mass matrix", mass, names, names));
    }
    let Some(dh) = answer.constraint_jacobian.as_ref().filter(|_| !constraints.is_empty()) else {
        return out;
    };
    out.next_table(matrix("Jacobian of the constraints", dh, constraints, names));
    let mut terms = Vec::new();
    terms.extend(forward.map(|forward| ("λ with tau = 0", &forward.multipliers)));
    terms.extend(inverse.map(|inverse| ("λ with tau", &inverse.multipliers)));
    terms.extend(inverse.map(|inverse| ("d²h/dt²", &inverse.constraint_acceleration)));
    if !terms.is_empty() {
        out.next_table(columns(constraints, &terms));
    }
    out
}

/// A table of named columns, a row for each name.
fn columns(names: &[String], columns: &[(&str, &Vec<f64>)]) -> Table {
    let head: Vec<&str> = iter::once("").chain(columns.iter().map(|(title, _)| *title)).collect();
    let row = |(i, name): (usize, &String)| {
        let values = columns.iter().map(|(_, values)| values[i].into());
        iter::once(Cell::from(name.as_str())).chain(values).collect()
    };
    table(&head, names.iter().enumerate().map(row))
}
