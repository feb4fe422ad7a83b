//! Many plants of one model, stepped together.

use std::sync::Arc;

use plantd_math::scalar::Truths;
use plantd_math::simd::{AVX512, has};

use crate::integrator::abreast::{Abreast, States};
use crate::integrator::report::{StepError, StepReport};
use crate::integrator::settings::Settings;
use crate::model::mechanism::{Model, Solver};
use crate::plant::facade::Plant;
use crate::plant::solve::CALM;

/// Plants of one model and one choice of settings that are stepped together, each with its own state and inputs.
///
/// Every plant moves as [`Plant::step`] would move it, to the same bits, whatever the others do; one that fails
/// stays where it was. Where the model allows it, several are computed at once, each in a lane of wide registers:
/// trees of joints in space or in planes with linear springs and dry friction of coordinates, without constraints, ball
/// joints, other springs and forces, signals and prescribed coordinates, by the midpoint rule in one step. All others
/// are stepped one after the other. A plant whose step is not the usual one (the first, or one that has to be halved)
/// is stepped by itself.
///
/// After construction steps allocate nothing, as those of plants. A step costs a plant what it costs it by itself;
/// side by side, for each of many, two thirds to a fourth of that.
///
/// ```
/// use std::sync::Arc;
/// use plantd_models::{Fleet, Initial, Model, Plant, Settings, builtin};
///
/// let model = Arc::new(Model::compile(&builtin::scene("pendulum").unwrap())?);
/// let plant = Plant::new(Arc::clone(&model), Settings::new(&model))?;
/// let mut plants = vec![plant; 5];
/// for (plant, angle) in plants.iter_mut().zip([0.1, 0.2, 0.3, 0.4, 0.5]) {
///     plant.initialize(&Initial::Velocity { q: vec![angle], v: vec![0.0] })?;
/// }
/// let mut alone = plants[3].clone();
/// let mut fleet = Fleet::new(plants);
/// for _ in 0..100 {
///     let results = fleet.step(&[0.0; 5]);
///     assert!(results.iter().all(Result::is_ok));
///     alone.step(&[0.0])?;
/// }
/// assert_eq!(fleet.plant(3).state(), alone.state(), "to the last bit");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Fleet {
    plants: Vec<Plant>,
    /// Plants that are left out of steps.
    resting: Vec<bool>,
    results: Vec<Result<StepReport, StepError>>,
    rows: Rows,
}

/// Plants side by side.
#[derive(Clone, Debug)]
enum Rows {
    None,
    Fours(Box<Wide<4>>),
    Eights(Box<Wide<8>>),
}

/// Rows of plants, and the memory of a step of one of them.
#[derive(Clone, Debug)]
struct Wide<const N: usize> {
    model: Arc<Model>,
    settings: Settings,
    abreast: Abreast<N>,
    rows: Vec<Row<N>>,
}

/// What all plants have in common.
#[derive(Clone, Copy)]
struct Mechanics<'a> {
    model: &'a Arc<Model>,
    settings: &'a Settings,
}

/// A few plants side by side.
#[derive(Clone, Debug)]
struct Row<const N: usize> {
    states: States<N>,
    /// Lanes with the state of their plant; those that take no part in a step have none after it.
    taken: Truths<N>,
    /// Steps that the lanes have taken together.
    steps: u64,
    /// How many those were when the states of plants were written last.
    written: [u64; N],
}

impl Fleet {
    /// Takes plants in.
    ///
    /// # Panics
    ///
    /// If they do not share one model and the same settings.
    pub fn new(plants: Vec<Plant>) -> Self {
        let rows = match plants.first() {
            Some(Plant { model, settings, .. }) => {
                let is_alike = |p: &Plant| Arc::ptr_eq(&p.model, model) && p.settings == *settings;
                assert!(plants.iter().all(is_alike), "plants of one model, with the same settings");
                Rows::new(model, settings, plants.len())
            }
            None => Rows::None,
        };
        let results = vec![Ok(StepReport::default()); plants.len()];
        Self { resting: vec![false; plants.len()], results, plants, rows }
    }

    /// How many plants there are.
    pub fn len(&self) -> usize {
        self.plants.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.plants.is_empty()
    }

    /// Whether several are computed at once.
    pub fn is_side_by_side(&self) -> bool {
        !matches!(self.rows, Rows::None)
    }

    /// Leaves a plant out of steps from now on, or lets it take part again.
    pub fn rest(&mut self, index: usize, is_resting: bool) {
        self.resting[index] = is_resting;
    }

    /// Takes a step with each plant that does not rest; `inputs` has the inputs `u` of all plants, one plant's
    /// after the other's. The results are in the order of the plants, of one that rests its last.
    ///
    /// # Panics
    ///
    /// If `inputs` has not `ni + nk` entries for each plant.
    pub fn step(&mut self, inputs: &[f64]) -> &[Result<StepReport, StepError>] {
        let Self { plants, resting, results, rows } = self;
        let width = plants.first().map_or(0, |plant| plant.model.dimensions.input());
        assert_eq!(inputs.len(), plants.len() * width, "entries of the inputs");
        match rows {
            Rows::None => {
                let all = plants.iter_mut().zip(results.iter_mut()).zip(&*resting);
                for (i, ((plant, result), _)) in all.enumerate().filter(|(_, (_, rests))| !**rests)
                {
                    *result = plant.step(&inputs[i * width..][..width]);
                }
            }
            Rows::Fours(wide) => wide.step(plants, resting, results, inputs),
            Rows::Eights(wide) => wide.step(plants, resting, results, inputs),
        }
        results
    }

    /// A plant as it is now.
    pub fn plant(&mut self, index: usize) -> &Plant {
        self.rows.write(index, &mut self.plants[index]);
        &self.plants[index]
    }

    /// A plant, to be changed: what the next step begins from. It has to stay one of the same model and settings.
    pub fn plant_mut(&mut self, index: usize) -> &mut Plant {
        self.rows.write(index, &mut self.plants[index]);
        self.rows.leave(index);
        &mut self.plants[index]
    }

    /// Writes configuration and momentum of a plant, nd + nk and nd.
    ///
    /// # Panics
    ///
    /// If the lists are shorter.
    pub fn write_state(&self, index: usize, q: &mut [f64], p: &mut [f64]) {
        let d = self.plants[index].model.dimensions;
        let (q, p) = (&mut q[..d.coordinates()], &mut p[..d.dynamic]);
        if !self.rows.write_state(index, q, p) {
            q.copy_from_slice(self.plants[index].q());
            p.copy_from_slice(self.plants[index].p());
        }
    }

    /// The plants as they are now.
    pub fn into_plants(mut self) -> Vec<Plant> {
        for (index, plant) in self.plants.iter_mut().enumerate() {
            self.rows.write(index, plant);
        }
        self.plants
    }
}

impl Rows {
    fn new(model: &Arc<Model>, settings: &Settings, count: usize) -> Self {
        // Of many joints in planes, and without registers for them, eight at once do not fit into the nearest cache. One
        // or two joints wait for each other, and eight plants fill the time.
        let is_few = model.few_joints() > 0;
        let is_wide = has(AVX512) && model.solver != Solver::Planar;
        if count < Row::<4>::FEW || !model.goes_abreast(settings) {
            Self::None
        } else if count <= 4 || !(is_few || is_wide) {
            Self::Fours(Box::new(Wide::new(model, settings, count)))
        } else {
            Self::Eights(Box::new(Wide::new(model, settings, count)))
        }
    }

    /// Writes the state to the plant, if it is in a lane.
    fn write(&mut self, index: usize, plant: &mut Plant) {
        match self {
            Self::None => {}
            Self::Fours(wide) => wide.rows[index / 4].write(index % 4, plant),
            Self::Eights(wide) => wide.rows[index / 8].write(index % 8, plant),
        }
    }

    /// The next step begins from what is in the plant.
    fn leave(&mut self, index: usize) {
        match self {
            Self::None => {}
            Self::Fours(wide) => wide.rows[index / 4].leave(index % 4),
            Self::Eights(wide) => wide.rows[index / 8].leave(index % 8),
        }
    }

    /// Writes a state that is in a lane; whether it is.
    fn write_state(&self, index: usize, q: &mut [f64], p: &mut [f64]) -> bool {
        match self {
            Self::None => false,
            Self::Fours(wide) => wide.rows[index / 4].write_state(index % 4, q, p),
            Self::Eights(wide) => wide.rows[index / 8].write_state(index % 8, q, p),
        }
    }
}

impl<const N: usize> Wide<N> {
    fn new(model: &Arc<Model>, settings: &Settings, count: usize) -> Self {
        let states = States::new(model);
        let row = Row { states, taken: Truths([0; N]), steps: 0, written: [0; N] };
        let (abreast, rows) = (Abreast::new(model, settings), vec![row; count.div_ceil(N)]);
        Self { model: Arc::clone(model), settings: *settings, abreast, rows }
    }

    /// Takes a step with all plants that do not rest.
    fn step(
        &mut self,
        plants: &mut [Plant],
        resting: &[bool],
        results: &mut [Result<StepReport, StepError>],
        inputs: &[f64],
    ) {
        let Self { model, settings, abreast, rows } = self;
        let mechanics = Mechanics { model, settings };
        let width = model.dimensions.input();
        let parts = plants.chunks_mut(N).zip(results.chunks_mut(N)).zip(resting.chunks(N));
        for (i, (row, ((plants, results), resting))) in rows.iter_mut().zip(parts).enumerate() {
            let inputs = &inputs[i * N * width..][..plants.len() * width];
            row.step(abreast, mechanics, Members { plants, results, resting, inputs, width });
        }
    }
}

/// The plants of a row, and what goes with each.
struct Members<'a> {
    plants: &'a mut [Plant],
    results: &'a mut [Result<StepReport, StepError>],
    resting: &'a [bool],
    /// Those of one plant after those of the other, so many of each.
    inputs: &'a [f64],
    width: usize,
}

impl<const N: usize> Row<N> {
    /// Plants that move, below which one after the other is faster.
    const FEW: usize = N / 2;

    /// Takes the state of a plant in, if it can be stepped side by side.
    fn enter(&mut self, lane: usize, own: Mechanics<'_>, plant: &Plant) {
        let Plant { model, settings, state, workspace, .. } = plant;
        if Arc::ptr_eq(model, own.model)
            && settings == own.settings
            && self.states.load(lane, settings, state, &workspace.response)
        {
            (self.taken.0[lane], self.written[lane]) = (u64::MAX, self.steps);
        }
    }

    fn leave(&mut self, lane: usize) {
        if std::mem::take(&mut self.taken.0[lane]) != 0 {
            self.states.clear(lane);
        }
    }

    fn write(&mut self, lane: usize, plant: &mut Plant) {
        let taken = self.steps - self.written[lane];
        if self.taken.of(lane) && taken > 0 {
            self.states.store(lane, &mut plant.state);
            let state = &mut plant.state;
            state.step = state.step.saturating_add(taken);
            state.calm = state.calm.saturating_add(taken.min(CALM.into()) as u8).min(CALM);
            self.written[lane] = self.steps;
        }
    }

    fn write_state(&self, lane: usize, q: &mut [f64], p: &mut [f64]) -> bool {
        let is_here = self.taken.of(lane);
        if is_here {
            self.states.write(lane, q, p);
        }
        is_here
    }

    /// Takes a step with all plants that do not rest.
    fn step(&mut self, abreast: &mut Abreast<N>, own: Mechanics<'_>, mut members: Members<'_>) {
        let Members { plants, results, resting, inputs, width } = &mut members;
        let is_worth = resting.iter().filter(|rests| !**rests).count() >= Self::FEW;
        let mut done = Truths([0; N]);
        if is_worth {
            let are_finite = abreast.set_inputs(inputs, *width);
            let (mut lanes, mut count) = (Truths([0; N]), 0);
            for (lane, (plant, rests)) in plants.iter().zip(*resting).enumerate() {
                if !self.taken.of(lane) && !rests {
                    self.enter(lane, own, plant);
                }
                let moves = if *rests { 0 } else { self.taken.0[lane] & are_finite.0[lane] };
                (lanes.0[lane], count) = (moves, count + usize::from(moves != 0));
            }
            if count >= Self::FEW {
                done = abreast.solve(own.model, own.settings, &mut self.states, lanes, results);
            }
        }
        if (0..plants.len()).all(|lane| done.of(lane)) {
            abreast.move_on(own.model, &mut self.states);
            self.steps += 1;
        } else {
            self.part(abreast, own, done, is_worth, members);
        }
    }

    /// Those that are not done go on by themselves, from where they are, or rest.
    #[cold]
    fn part(
        &mut self,
        abreast: &mut Abreast<N>,
        own: Mechanics<'_>,
        done: Truths<N>,
        is_worth: bool,
        members: Members<'_>,
    ) {
        let Members { plants, results, resting, inputs, width } = members;
        let others = |lane: &usize| !done.of(*lane);
        for lane in (0..plants.len()).filter(others) {
            self.write(lane, &mut plants[lane]);
        }
        if done.0 != [0; N] {
            abreast.move_on(own.model, &mut self.states);
            self.steps += 1;
        }
        for lane in (0..plants.len()).filter(others) {
            self.leave(lane);
            if !resting[lane] {
                results[lane] = plants[lane].step(&inputs[lane * width..][..width]);
                if is_worth {
                    self.enter(lane, own, &plants[lane]);
                }
            }
        }
    }
}
