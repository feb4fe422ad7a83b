//! The question whether to go on.

use crate::optimize::error::OptimizeError;

/// Steps between two questions.
const STEPS_BETWEEN_QUESTIONS: usize = 16;

/// Says whether to go on.
pub(super) type Question<'a> = &'a mut dyn FnMut() -> bool;

/// Asks whether to go on.
pub(super) fn ask(go_on: Question<'_>) -> Result<(), OptimizeError> {
    if go_on() { Ok(()) } else { Err(OptimizeError::Cancelled) }
}

/// Asks at some steps.
pub(super) fn ask_at(k: usize, go_on: Question<'_>) -> Result<(), OptimizeError> {
    if k.is_multiple_of(STEPS_BETWEEN_QUESTIONS) { ask(go_on) } else { Ok(()) }
}
