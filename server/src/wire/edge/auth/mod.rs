//! Who is asked who they are, and what they may do.
//!
//! | file | what |
//! | --- | --- |
//! | `settings` | what the configuration says of it |
//! | `role` | the table from methods to roles |
//! | `credential` | by what somebody is known, and until when |
//! | `file` | files of TOML that are read again |
//! | `tokens` | the file of bearer tokens |
//! | `rules` | who the holders of certificates and the users of this machine are |
//! | `gateway` | whom a proxy in front speaks for |
//! | `door` | who somebody is, by token, certificate or user; credentials that are over |
//! | `guard` | the layer through which every request passes |

pub mod credential;
pub mod door;
pub mod file;
pub mod gateway;
pub mod guard;
pub mod role;
pub mod rules;
pub mod settings;
pub mod tokens;
