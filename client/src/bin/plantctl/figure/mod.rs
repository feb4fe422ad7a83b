//! Signals over time as pictures: of characters, and SVG.

pub(crate) mod axis;
pub(crate) mod browser;
pub(crate) mod chart;
pub(crate) mod terminal;
