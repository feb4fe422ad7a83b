//! What players show of a plant: where its frames and lines are and what its signals are, at some of its steps.

use std::io::Write;
use std::sync::Arc;

use mcap::McapError;
use plantd_models::drawing::{Drawing, Instant, Poses};
use plantd_models::{Energy, Model, Plant, Settings};
use plantd_proto::v1;

use crate::core::publish::frame::Frame;
use crate::wire::message::drawing;
use crate::wire::record::file::{Times, Writer};
use crate::wire::record::{scene, signals};

/// Pictures in a second of the plant's time, at most.
const PER_SECOND: f64 = 100.0;
/// Models whose drawings are kept: faults put one after the other in force.
const DRAWN_MAX: usize = 32;

/// Draws a plant into its recording.
pub(super) struct Picture {
    settings: Settings,
    /// The models that have been in force, the present one last.
    drawn: Vec<Drawn>,
    /// Which hundredth of a second has been drawn.
    last: Option<u64>,
    buffer: Vec<u8>,
}

/// A model as it is drawn.
struct Drawn {
    digest: u64,
    /// For energies; none where changed numbers make of the scene's initial configuration a guess.
    plant: Option<Plant>,
    drawing: Drawing,
    message: v1::Drawing,
    poses: Poses,
}

impl Drawn {
    fn new(model: &Model, plant: Option<Plant>) -> Self {
        let drawing = Drawing::new(model);
        let message = drawing::drawing(&drawing, |_| None);
        let poses = drawing.poses();
        Self { digest: model.digest(), plant, drawing, message, poses }
    }
}

impl Picture {
    /// Draws a plant that is like this one.
    pub(super) fn new(plant: Plant) -> Self {
        let (model, settings) = (Arc::clone(plant.model()), *plant.settings());
        let drawn = vec![Drawn::new(&model, Some(plant))];
        Self { settings, drawn, last: None, buffer: Vec::new() }
    }

    /// The drawing of the present model.
    pub(super) fn drawing(&self) -> Option<&v1::Drawing> {
        Some(&self.drawn.last()?.message)
    }

    /// Writes the shapes.
    pub(super) fn write_shapes<W: Write>(
        &self,
        writer: &mut Writer<W>,
        times: Times,
    ) -> Result<(), McapError> {
        match self.drawing() {
            Some(drawing) => writer.scene(&scene::shapes(drawing, times.play_ns), times),
            None => Ok(()),
        }
    }

    /// From here on this model is in force; writes its shapes if it is another one.
    pub(super) fn enter<W: Write>(
        &mut self,
        model: &Arc<Model>,
        writer: &mut Writer<W>,
        times: Times,
    ) -> Result<(), McapError> {
        if self.drawn.last().is_some_and(|drawn| drawn.digest == model.digest()) {
            return Ok(());
        }
        let before = self.drawing().cloned();
        let known = self.drawn.iter().position(|drawn| drawn.digest == model.digest());
        let drawn = match known {
            Some(known) => self.drawn.remove(known),
            None => Drawn::new(model, Plant::new(Arc::clone(model), self.settings).ok()),
        };
        self.drawn.push(drawn);
        if self.drawn.len() > DRAWN_MAX {
            self.drawn.remove(0);
        }
        if self.drawing() == before.as_ref() { Ok(()) } else { self.write_shapes(writer, times) }
    }

    /// The plant is in another state: the next one is drawn, whatever its time.
    pub(super) fn begin(&mut self) {
        self.last = None;
    }

    /// Whether a frame is to be drawn: the first in each hundredth of a second.
    pub(super) fn is_due(&self, frame: &Frame) -> bool {
        Some(hundredth(frame)) != self.last
    }

    /// Writes where everything is in a frame.
    pub(super) fn write<W: Write>(
        &mut self,
        frame: &Frame,
        writer: &mut Writer<W>,
        times: Times,
    ) -> Result<(), McapError> {
        let is_of_frame = |drawn: &&mut Drawn| drawn.digest == frame.model_digest;
        let Some(drawn) = self.drawn.last_mut().filter(is_of_frame) else {
            return Ok(());
        };
        self.last = Some(hundredth(frame));
        let at = Instant {
            q: &frame.state.q,
            velocity: &frame.velocity,
            inputs: &frame.input,
            multipliers: &frame.state.multipliers,
            time_step_s: frame.time_step_s,
        };
        drawn.drawing.place(&at, &mut drawn.poses);
        let poses = drawing::poses(&drawn.poses);
        writer.transforms(&scene::transforms(&drawn.message, &poses, times.play_ns), times)?;
        if !drawn.message.lines.is_empty() || !drawn.message.arrows.is_empty() {
            writer.lines(&scene::lines(&drawn.message, &poses, times.play_ns), times)?;
        }
        let unknown = Energy { kinetic_j: f64::NAN, potential_j: f64::NAN };
        let energy = drawn
            .plant
            .as_mut()
            .and_then(|plant| plant.energy_at(&frame.state.q, &frame.velocity).ok())
            .unwrap_or(unknown);
        signals::encode(frame, energy, &mut self.buffer);
        writer.signals(&self.buffer, times)
    }
}

/// The hundredth of a second in which a frame is; times on the edge are in the one that begins there.
fn hundredth(frame: &Frame) -> u64 {
    (frame.time_s * PER_SECOND + 1e-6) as u64
}
