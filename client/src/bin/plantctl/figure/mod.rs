//! Pictures: signals over time, of characters or SVG, and films of a page.

pub(crate) mod axis;
pub(crate) mod browser;
pub(crate) mod chart;
pub(crate) mod film;
pub(crate) mod tab;
pub(crate) mod terminal;
