//! Trajectories, first and second derivatives of the reference mechanisms, with the paper's force
//! split, and their continuous-time dynamics.

use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use nalgebra::DMatrix;
use plantd_models::scene::Input;
use plantd_models::{
    Continuous, ContinuousPoint, Contraction, Energy, ForceSplit, Initial, Linearization, Model,
    Plant, Scene, SecondOrder, Settings, builtin,
};
use plantd_tests::reference::{
    ContinuousRecord, Golden, LinearizationRecord, Mechanism, Order, PaperStep, Rows,
    SecondOrderRecord, Tensor, golden, mechanism, read,
};

/// Of q, p and multipliers, relative to the largest value of the trajectory.
const TRAJECTORY_TOLERANCE: f64 = 1e-9;
/// Of energies, relative to the larger of both kinds.
const ENERGY_TOLERANCE: f64 = 1e-10;
/// Of each block of first derivatives, relative to its largest entry.
const DERIVATIVE_TOLERANCE: f64 = 1e-8;
/// Of each block of second derivatives, relative to its largest entry.
const SECOND_TOLERANCE: f64 = 1e-7;
/// Of second derivatives that vanish.
const ROUND_OFF: f64 = 1e-16;
/// Of each block of continuous-time dynamics, relative to its largest entry.
const CONTINUOUS_TOLERANCE: f64 = 1e-8;

/// One reference mechanism, and the scene that has to move like it.
struct Case {
    mechanism: Mechanism,
    golden: Golden,
    order: Order,
    plant: Plant,
}

impl Case {
    /// The mechanism's own scene.
    fn converted(name: &str) -> Result<Self> {
        let mechanism = mechanism(name)?;
        let model = Arc::new(Model::compile(&mechanism.scene()?)?);
        let order = mechanism.order(&model)?;
        Self::new(mechanism, golden(name)?, model, order)
    }

    /// A built-in scene, whose coordinates have other names; `order` gives their indices.
    fn builtin(name: &str, scene: &Scene, order: Option<&[usize]>) -> Result<Self> {
        let model = Arc::new(Model::compile(scene)?);
        let order = match order {
            Some(indices) => Order::new(&model, indices.to_vec())?,
            None => Order::identity(&model)?,
        };
        Self::new(mechanism(name)?, golden(name)?, model, order)
    }

    fn new(mechanism: Mechanism, golden: Golden, model: Arc<Model>, order: Order) -> Result<Self> {
        let settings = Settings {
            time_step_s: golden.dt,
            force_split: ForceSplit::Paper,
            ..Settings::new(&model)
        };
        Ok(Self { mechanism, golden, order, plant: Plant::new(model, settings)? })
    }

    /// Follows the whole trajectory and the linearizations on it.
    fn check(mut self) -> Result<()> {
        self.trajectory()?;
        for record in std::mem::take(&mut self.golden.linearization) {
            self.linearization(&record)
                .with_context(|| format!("linearization at {}", record.k))?;
            let second = self.golden.second_order.iter().position(|second| second.k == record.k);
            if let Some(second) = second {
                let second = self.golden.second_order.swap_remove(second);
                self.second_order(&record, &second)
                    .with_context(|| format!("second order at {}", record.k))?;
            }
        }
        ensure!(self.golden.second_order.is_empty(), "second order of another step");
        match self.golden.continuous.take() {
            Some(record) => self.continuous(&record).context("continuous dynamics"),
            None => Ok(()),
        }
    }

    fn trajectory(&mut self) -> Result<()> {
        let Self { mechanism, golden, order, plant } = self;
        plant.initialize(&mechanism.start(order))?;
        let unconstrained = plant.model().dimensions().constraints == 0;
        let largest = |rows: &Rows| rows.iter().flatten().fold(0.0_f64, |a, x| a.max(x.abs()));
        let (q_scale, p_scale) = (largest(&golden.q), largest(&golden.p));
        let lambda_scale = largest(&golden.lambda1);
        let tolerance = TRAJECTORY_TOLERANCE;
        for k in 0..golden.q.len() {
            let at = |what: &str| format!("{what}[{k}]");
            close(&at("q"), plant.q(), &order.coordinates(&golden.q[k]), tolerance * q_scale)?;
            close(&at("p"), plant.p(), &order.dynamic(&golden.p[k]), tolerance * p_scale)?;
            close(&at("v"), plant.v(), &golden.kin_velocity_v[k], 1e-9)?;
            if unconstrained {
                // Elsewhere the reference takes the momentum as it is, this one its projection.
                energy(&at("energy"), plant.energy(), golden.energy_state[k])?;
            }
            if k == golden.u.len() {
                break;
            }
            let [start, end] = [k, k + 1].map(|k| order.coordinates(&golden.q[k]));
            let middle: Vec<f64> = start.iter().zip(&end).map(|(a, b)| 0.5 * (a + b)).collect();
            let rate: Vec<f64> = start.iter().zip(&end).map(|(a, b)| (b - a) / golden.dt).collect();
            let found = plant.energy_at(&middle, &rate)?;
            energy(&at("midpoint energy"), found, golden.energy_midpoint[k])?;
            plant.step(&[&golden.u[k][..], &golden.k2[k]].concat()).with_context(|| at("step"))?;
            let multipliers = plant.multipliers();
            // The constraints' stiffness makes a unit in the last place of a sine this much of an impulse.
            close(&at("λ"), multipliers, &golden.lambda1[k], 2.0 * tolerance * lambda_scale)?;
        }
        Ok(())
    }

    fn linearization(&mut self, record: &LinearizationRecord) -> Result<()> {
        let Self { golden, order, plant, .. } = self;
        let model = plant.model().clone();
        plant.initialize(&Initial::Momentum {
            q: order.coordinates(&record.q1),
            p: order.dynamic(&record.p1),
            v: golden.kin_velocity_v[record.k].clone(),
        })?;
        let u = [&record.u1[..], &record.k2].concat();
        let mut out = Linearization::new(&model);
        plant.linearize(&u, &mut out)?;

        let blocks = Blocks { order, model: &model, h: golden.dt };
        let (a, b) = (out.a(), out.b());
        blocks.map(&a, &b, 0, [&record.q2_dq1, &record.q2_dp1, &record.q2_du1, &record.q2_dk2])?;
        let p_row = model.dimensions().coordinates();
        blocks.map(
            &a,
            &b,
            p_row,
            [&record.p2_dq1, &record.p2_dp1, &record.p2_du1, &record.p2_dk2],
        )?;
        blocks.multipliers(&out.multipliers_x(), &out.multipliers_u(), record)?;
        blocks.prescribed(&a, &b)?;

        plant.step_and_linearize(&u, &mut out)?;
        ensure!(out.a() == a && out.b() == b, "step_and_linearize differs from linearize");
        let q2 = order.coordinates(&record.q2);
        close("q2", plant.q(), &q2, TRAJECTORY_TOLERANCE * largest(&q2))?;
        let p2 = order.dynamic(&record.p2);
        close("p2", plant.p(), &p2, TRAJECTORY_TOLERANCE * largest(&p2).max(1.0))?;
        let scale = TRAJECTORY_TOLERANCE * largest(&record.lambda1).max(1e-3);
        close("λ", plant.multipliers(), &record.lambda1, scale)
    }
}

/// Variables or outputs of the reference: their indices in the model.
type Indices = Vec<usize>;

impl Case {
    /// Second derivatives, full or contracted.
    fn second_order(&mut self, at: &LinearizationRecord, record: &SecondOrderRecord) -> Result<()> {
        if record.arrays.get::<String>("error")?.is_some() {
            // The program that made the file has none for this mechanism.
            return Ok(());
        }
        let Self { golden, order, plant, .. } = self;
        let model = plant.model().clone();
        let d = model.dimensions();
        plant.initialize(&Initial::Momentum {
            q: order.coordinates(&at.q1),
            p: order.dynamic(&at.p1),
            v: golden.kin_velocity_v[at.k].clone(),
        })?;
        let u = [&at.u1[..], &at.k2].concat();
        let mut first = Linearization::new(&model);
        let mut second = SecondOrder::new(&model)?;
        plant.linearize_second_order(&u, &mut first, &mut second)?;
        let tensors: Vec<DMatrix<f64>> = (0..d.state())
            .map(|i| whole(&second.xx(i), &second.xu(i), &second.uu(i)))
            .chain((0..d.constraints).map(|c| {
                let xx = second.multiplier_xx(c);
                whole(&xx, &second.multiplier_xu(c), &second.multiplier_uu(c))
            }))
            .collect();

        let (n, state) = (d.coordinates(), d.state());
        let coordinates = order.indices.clone();
        let momenta: Indices = order.indices[..d.dynamic].iter().map(|i| n + i).collect();
        if let Some(z) = record.arrays.get::<Vec<f64>>("z")? {
            let velocities = n + d.dynamic..state;
            let x: Indices = coordinates.into_iter().chain(momenta).chain(velocities).collect();
            let inputs: Indices = (state..state + d.input()).collect();
            let mut weights = vec![0.0; state];
            x.iter().zip(&z).for_each(|(i, z)| weights[*i] = *z);
            let mut out = Contraction::new(&model);
            let none = vec![0.0; d.constraints];
            plant.contract_second_order(&u, &weights, &none, &mut first, &mut out)?;
            let contracted = whole(&out.xx, &out.xu, &out.uu);
            let mut sum = DMatrix::zeros(contracted.nrows(), contracted.ncols());
            tensors.iter().zip(&weights).for_each(|(tensor, weight)| sum += tensor * *weight);
            let blocks = [("fdxdx", &x, &x), ("fdxdu", &x, &inputs), ("fdudu", &inputs, &inputs)];
            for (name, rows, columns) in blocks {
                let expected: Rows = record.arrays.get(name)?.context(name)?;
                compare_block(name, &contracted, rows, columns, &expected)?;
                compare_block(name, &sum, rows, columns, &expected)?;
            }
            return Ok(());
        }
        let variables = [
            ("q1", coordinates.clone()),
            ("p1", momenta.clone()),
            ("u1", (state..state + d.inputs).collect()),
            ("k2", (state + d.inputs..state + d.input()).collect()),
        ];
        let outputs = [
            ("q2", coordinates[..d.dynamic].to_vec()),
            ("p2", momenta),
            ("lambda1", (state..state + d.constraints).collect()),
        ];
        for (output, rows) in &outputs {
            for (i, (first, first_indices)) in variables.iter().enumerate() {
                for (second, second_indices) in &variables[i..] {
                    let name = format!("{output}_d{first}d{second}");
                    let expected: Tensor = record.arrays.get(&name)?.context(name.clone())?;
                    let by = [first_indices, second_indices];
                    compare_tensor(&name, &tensors, rows, by, &expected, SECOND_TOLERANCE)?;
                }
            }
        }
        Ok(())
    }

    /// Accelerations, multipliers, and their derivatives.
    fn continuous(&self, record: &ContinuousRecord) -> Result<()> {
        let (order, model) = (&self.order, self.plant.model());
        let d = model.dimensions();
        let (n, nd) = (d.coordinates(), d.dynamic);
        let mut continuous = Continuous::new(model.clone());
        let point = ContinuousPoint {
            q: order.coordinates(&record.q),
            v: order.coordinates(&record.dq),
            inputs: record.u.clone(),
            prescribed_acceleration: record.ddqk.clone(),
        };
        let linear = continuous.linearize(&point)?;
        let second: Vec<_> = continuous
            .second_order(&point)?
            .into_iter()
            .enumerate()
            .map(|(row, tensor)| if row < nd { tensor } else { -tensor })
            .collect();
        let f = order.dynamic(&record.f);
        close("f", &linear.value.acceleration, &f, CONTINUOUS_TOLERANCE * largest(&f))?;
        let lambda: Vec<_> = linear.value.multipliers.iter().map(|lambda| -lambda).collect();
        close("λ", &lambda, &record.lambda_, CONTINUOUS_TOLERANCE * largest(&record.lambda_))?;

        let variables: [(&str, Indices); 4] = [
            ("dq", order.indices.clone()),
            ("ddq", order.indices.iter().map(|i| n + i).collect()),
            ("dddk", (2 * n + d.inputs..2 * n + d.input()).collect()),
            ("du", (2 * n..2 * n + d.inputs).collect()),
        ];
        let outputs = [
            ("f", order.indices[..nd].to_vec(), 1.0),
            ("lambda", (nd..nd + d.constraints).collect(), -1.0),
        ];
        for (output, rows, sign) in &outputs {
            for (first, first_indices) in &variables {
                let name = format!("{output}_{first}");
                let expected: Rows = record.arrays.get(&name)?.context(name.clone())?;
                let jacobian = &linear.jacobian * *sign;
                let scale = largest_of(&expected);
                for (row, expected) in rows.iter().zip(&expected) {
                    let found: Vec<_> =
                        first_indices.iter().map(|column| jacobian[(*row, *column)]).collect();
                    close(&name, &found, expected, CONTINUOUS_TOLERANCE * scale)?;
                }
                for (second_name, second_indices) in &variables {
                    let name = format!("{output}_{first}{second_name}");
                    // Large models have none, and small ones one of each two mixed orders.
                    let Some(expected) = record.arrays.get::<Tensor>(&name)? else { continue };
                    let by = [first_indices, second_indices];
                    compare_tensor(&name, &second, rows, by, &expected, CONTINUOUS_TOLERANCE)?;
                }
            }
        }
        Ok(())
    }
}

/// Second derivatives by `(x, u)`.
fn whole(xx: &DMatrix<f64>, xu: &DMatrix<f64>, uu: &DMatrix<f64>) -> DMatrix<f64> {
    let (state, input) = xu.shape();
    DMatrix::from_fn(state + input, state + input, |a, b| match (a < state, b < state) {
        (true, true) => xx[(a, b)],
        (true, false) => xu[(a, b - state)],
        (false, true) => xu[(b, a - state)],
        (false, false) => uu[(a - state, b - state)],
    })
}

fn largest_of(rows: &Rows) -> f64 {
    rows.iter().map(|row| largest(row)).fold(0.0, f64::max)
}

fn compare_block(
    what: &str,
    found: &DMatrix<f64>,
    rows: &[usize],
    columns: &[usize],
    expected: &Rows,
) -> Result<()> {
    ensure!(expected.len() == rows.len(), "{what}: {} rows", expected.len());
    let tolerance = SECOND_TOLERANCE * largest_of(expected) + ROUND_OFF;
    for (row, expected) in rows.iter().zip(expected) {
        let found: Vec<_> = columns.iter().map(|column| found[(*row, *column)]).collect();
        close(&format!("{what}, row {row}"), &found, expected, tolerance)?;
    }
    Ok(())
}

/// A block of second derivatives, `expected[first][second][output]`.
fn compare_tensor(
    what: &str,
    found: &[DMatrix<f64>],
    outputs: &[usize],
    [first, second]: [&Indices; 2],
    expected: &Tensor,
    tolerance: f64,
) -> Result<()> {
    ensure!(expected.len() == first.len(), "{what}: {} matrices", expected.len());
    let tolerance = tolerance * expected.iter().map(largest_of).fold(0.0, f64::max) + ROUND_OFF;
    for (a, expected) in first.iter().zip(expected) {
        ensure!(expected.len() == second.len(), "{what}: {} rows", expected.len());
        for (b, expected) in second.iter().zip(expected) {
            let found: Vec<_> = outputs.iter().map(|output| found[*output][(*a, *b)]).collect();
            close(&format!("{what} by {a} and {b}"), &found, expected, tolerance)?;
        }
    }
    Ok(())
}

/// Blocks of `A` and `B` against those of the reference.
struct Blocks<'a> {
    order: &'a Order,
    model: &'a Model,
    h: f64,
}

impl Blocks<'_> {
    /// Rows `row + i` of the dynamic coordinates `i`, by q1, p1, u and k2.
    fn map(&self, a: &DMatrix<f64>, b: &DMatrix<f64>, row: usize, by: [&Rows; 4]) -> Result<()> {
        let d = self.model.dimensions();
        let rows: Vec<_> = (0..d.dynamic).map(|r| row + self.order.indices[r]).collect();
        self.compare(&format!("rows {row} by q1"), a, &rows, &self.coordinate_columns(), by[0])?;
        self.compare(&format!("rows {row} by p1"), a, &rows, &self.momentum_columns(), by[1])?;
        self.compare(&format!("rows {row} by u"), b, &rows, &Vec::from_iter(0..d.inputs), by[2])?;
        self.compare(
            &format!("rows {row} by k2"),
            b,
            &rows,
            &Vec::from_iter(d.inputs..d.input()),
            by[3],
        )
    }

    fn multipliers(
        &self,
        by_x: &DMatrix<f64>,
        by_u: &DMatrix<f64>,
        record: &LinearizationRecord,
    ) -> Result<()> {
        let d = self.model.dimensions();
        let rows = Vec::from_iter(0..d.constraints);
        self.compare("λ by q1", by_x, &rows, &self.coordinate_columns(), &record.lambda1_dq1)?;
        self.compare("λ by p1", by_x, &rows, &self.momentum_columns(), &record.lambda1_dp1)?;
        self.compare("λ by u", by_u, &rows, &Vec::from_iter(0..d.inputs), &record.lambda1_du1)?;
        let k2 = Vec::from_iter(d.inputs..d.input());
        self.compare("λ by k2", by_u, &rows, &k2, &record.lambda1_dk2)
    }

    fn coordinate_columns(&self) -> Vec<usize> {
        self.order.indices.clone()
    }

    fn momentum_columns(&self) -> Vec<usize> {
        let d = self.model.dimensions();
        self.order.indices[..d.dynamic].iter().map(|i| d.coordinates() + i).collect()
    }

    /// Rows of prescribed positions and velocities, which do not depend on the mechanism.
    fn prescribed(&self, a: &DMatrix<f64>, b: &DMatrix<f64>) -> Result<()> {
        let d = self.model.dimensions();
        let (nd, nk, n) = (d.dynamic, d.prescribed, d.coordinates());
        for i in 0..nk {
            let (position, velocity) = (nd + i, n + nd + i);
            for j in 0..d.state() {
                let slope = if j == nd + i { -1.0 / self.h } else { 0.0 };
                ensure!(
                    a[(position, j)] == 0.0 && a[(velocity, j)] == slope,
                    "A, prescribed {i} by {j}"
                );
            }
            for j in 0..d.input() {
                let one = if j == d.inputs + i { 1.0 } else { 0.0 };
                let found = (b[(position, j)], b[(velocity, j)]);
                ensure!(found == (one, one / self.h), "B, prescribed {i} by {j}");
            }
        }
        let velocities = a.columns(n + nd, nk);
        ensure!(velocities.iter().all(|x| *x == 0.0), "A depends on prescribed velocities");
        Ok(())
    }

    fn compare(
        &self,
        what: &str,
        found: &DMatrix<f64>,
        rows: &[usize],
        columns: &[usize],
        expected: &Rows,
    ) -> Result<()> {
        ensure!(expected.len() == rows.len(), "{what}: {} rows", expected.len());
        let scale = expected.iter().flatten().fold(0.0_f64, |a, x| a.max(x.abs()));
        for (row, values) in rows.iter().zip(expected) {
            let found: Vec<_> = columns.iter().map(|column| found[(*row, *column)]).collect();
            close(&format!("{what}, row {row}"), &found, values, DERIVATIVE_TOLERANCE * scale)?;
        }
        Ok(())
    }
}

fn energy(what: &str, found: Energy, expected: f64) -> Result<()> {
    let scale = found.kinetic_j.abs().max(found.potential_j.abs()).max(1.0);
    let total = found.kinetic_j + found.potential_j;
    close(what, &[total], &[expected], ENERGY_TOLERANCE * scale)
}

fn largest(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |a, x| a.max(x.abs()))
}

fn close(what: &str, found: &[f64], expected: &[f64], tolerance: f64) -> Result<()> {
    ensure!(
        found.len() == expected.len(),
        "{what}: {} and {} entries",
        found.len(),
        expected.len()
    );
    for (i, (x, y)) in found.iter().zip(expected).enumerate() {
        let error = (x - y).abs();
        // A NaN is not within any tolerance.
        let within = error <= tolerance;
        ensure!(within, "{what}, entry {i}: {x} instead of {y}, error {error:e} > {tolerance:e}");
    }
    Ok(())
}

/// Every case whose coordinates the converted scene keeps in order.
const CASES: &[&str] = &[
    "pendulum",
    "damped_pendulum",
    "chain_4",
    "config_spring",
    "pend_on_cart",
    "marionette",
    "puppet_moving",
    "unit_point_to_point",
    "unit_body_wrench",
    "dual_pendulums",
];

#[test]
fn converted_scenes_follow_the_reference() -> Result<()> {
    for name in CASES {
        let case = Case::converted(name).with_context(|| name.to_string())?;
        ensure!(case.order.is_identity(), "{name}: coordinates are in another order");
        case.check().with_context(|| name.to_string())?;
    }
    Ok(())
}

/// The reference numbers the scissor's angles pair by pair, a model strand by strand.
#[test]
fn converted_scissor_follows_the_reference() -> Result<()> {
    let case = Case::converted("scissor_4")?;
    ensure!(case.order.indices == SCISSOR_ORDER, "{:?}", case.order);
    case.check()
}

/// Slider, then left and right of each pair; the model has the strand that starts on the right first.
const SCISSOR_ORDER: [usize; 9] = [0, 5, 1, 2, 6, 7, 3, 4, 8];

fn scene(name: &str) -> Result<Scene> {
    builtin::scene(name).with_context(|| format!("no scene {name}"))
}

#[test]
fn builtin_pendulum_follows_the_reference() -> Result<()> {
    Case::builtin("pendulum", &scene("pendulum")?, None)?.check()
}

#[test]
fn builtin_damped_pendulum_follows_the_reference() -> Result<()> {
    Case::builtin("damped_pendulum", &scene("damped-pendulum")?, None)?.check()
}

/// The reference also has a torque on the pole.
#[test]
fn builtin_cart_pole_follows_the_reference() -> Result<()> {
    let mut scene = scene("cart-pole")?;
    let torque = Input {
        name: "torque".to_owned(),
        coordinate: Some("theta".to_owned()),
        ..Input::default()
    };
    scene.inputs.push(torque);
    Case::builtin("pend_on_cart", &scene, None)?.check()
}

/// The reference has no force on the slider.
#[test]
fn builtin_scissor_follows_the_reference() -> Result<()> {
    let mut scene = scene("scissor-4")?;
    scene.inputs.clear();
    Case::builtin("scissor_4", &scene, Some(&SCISSOR_ORDER))?.check()
}

#[test]
fn builtin_marionette_follows_the_reference() -> Result<()> {
    Case::builtin("marionette", &scene("marionette")?, None)?.check()
}

#[test]
fn builtin_marionette_starts_where_the_reference_does() -> Result<()> {
    let model = Model::compile(&scene("marionette")?)?;
    let initial: Vec<_> = model.coordinates().iter().map(|c| c.initial).collect();
    ensure!(initial == mechanism("marionette")?.initial.q1());
    Ok(())
}

/// The single step of the paper's section II, and the rank of its controllability matrix.
#[test]
fn pendulum_reproduces_the_paper() -> Result<()> {
    let paper: PaperStep = read("golden/pendulum_paper_step.json")?;
    ensure!(
        (paper.q1 - 0.247136194155572).abs() < 1e-15
            && (paper.p1 - 0.362723883111432).abs() < 1e-15
    );
    let model = Arc::new(Model::compile(&scene("pendulum")?)?);
    let settings = Settings { force_split: ForceSplit::Paper, ..Settings::new(&model) };
    ensure!(settings.time_step_s == paper.dt);
    let mut plant = Plant::new(model.clone(), settings)?;
    plant.initialize(&Initial::Momentum { q: vec![paper.q0], p: vec![paper.p0], v: vec![] })?;
    let mut out = Linearization::new(&model);
    plant.step_and_linearize(&[paper.u0], &mut out)?;

    close("q", plant.q(), &[paper.q1], 1e-15)?;
    close("p", plant.p(), &[paper.p1], 1e-15)?;
    let (a, b) = (out.a(), out.b());
    let matrix = |rows: &Rows| DMatrix::from_fn(rows.len(), rows[0].len(), |i, j| rows[i][j]);
    close("A", a.as_slice(), matrix(&paper.a).as_slice(), 1e-14)?;
    close("B", b.as_slice(), matrix(&paper.b).as_slice(), 1e-14)?;
    let printed = DMatrix::from_row_slice(2, 2, &[0.95333434, 0.09766672, -0.93331323, 0.95333434]);
    close("printed A", a.as_slice(), printed.as_slice(), 5e-9)?;
    close("printed B", b.as_slice(), &[0.00976667, 0.09533343], 5e-9)?;
    let ab = &a * &b;
    let controllability = DMatrix::from_fn(2, 2, |i, j| if j == 0 { b[i] } else { ab[i] });
    close("C", controllability.as_slice(), matrix(&paper.controllability).as_slice(), 1e-14)?;
    ensure!(controllability.rank(1e-6) == 2);
    Ok(())
}
