//! The velocity of states.

use std::f64::consts::PI;

use plantd_client::{Client, Follow, v1};

use crate::support::*;
