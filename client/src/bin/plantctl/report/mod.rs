//! Results of `plantctl test`: as text, JSON, JUnit XML and a page with plots.

pub(crate) mod html;
pub(crate) mod junit;
pub(crate) mod plot;
pub(crate) mod results;
pub(crate) mod text;
