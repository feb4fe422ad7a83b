//! What something was made from, as whoever declared it keeps it.

use std::any::Any;
use std::sync::Arc;

/// What channels, a fault or a feedback were made from. The core hands it back and does not look into it.
pub type Origin = Arc<dyn Any + Send + Sync>;
