//! Robots in other formats as scenes of plantd.
//!
//! Text in, a [`Scene`](plantd_models::Scene) and a [`Report`] out; nothing is read or written elsewhere. The report says of
//! everything in the file whether it was taken exactly, taken approximately, has no effect on the motion, or
//! was refused. What would change the motion and cannot be expressed is an error with line and column, unless
//! [`Options::lenient`] makes it a warning: nothing is dropped in silence.
//!
//! ```
//! let text = r#"
//! <robot name="pendulum">
//!   <link name="base"/>
//!   <joint name="hinge" type="continuous">
//!     <parent link="base"/> <child link="rod"/> <axis xyz="0 1 0"/> <dynamics damping="0.1"/>
//!   </joint>
//!   <link name="rod">
//!     <inertial>
//!       <origin xyz="0 0 -0.5"/> <mass value="2"/>
//!       <inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/>
//!     </inertial>
//!   </link>
//! </robot>"#;
//! let robot = plantd_import::import(text, &plantd_import::Options::default())?;
//! let model = plantd_models::Model::compile(&robot.scene)?;
//! assert_eq!(model.coordinates()[0].name, "hinge");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod document;
mod inertia;
mod names;
mod options;
mod report;
mod table;
mod urdf;

pub use crate::options::{Base, Inputs, Options};
pub use crate::report::{Import, ImportError, Kind, Name, Note, Problem, Report};

/// Whether a text is for [`import`] and not a scene: its first character that is not white space is `<`.
pub fn is_xml(text: &str) -> bool {
    text.trim_start_matches('\u{feff}').trim_start().starts_with('<')
}

/// Reads a robot in URDF, versions 1.0 to 1.2.
///
/// The scene is not compiled; [`Import::check`] does that. At most [`plantd_models::scene::MAX_TEXT_BYTES`] are read, in time and memory that grow with the text.
///
/// # Errors
///
/// All problems of the file at once, each with line and column.
pub fn import(text: &str, options: &Options) -> Result<Import, ImportError> {
    document::open(text)
        .and_then(|document| urdf::import(&document, options))
        .map_err(|problems| ImportError { problems })
}
