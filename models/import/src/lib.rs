//! Robots in URDF and MJCF as scenes of plantd.
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

mod attach;
mod document;
mod draft;
mod inertia;
pub mod meshes;
mod mjcf;
mod names;
mod options;
mod report;
mod source;
mod surface;
mod table;
mod urdf;
mod xml;

pub use crate::options::{Base, EARTH, Inputs, Options};
pub use crate::report::{Import, ImportError, Kind, Name, Note, Problem, Report};
pub use crate::source::Files;

use crate::document::Reader;
use crate::source::Source;

/// Whether a text is for [`import`] and not a scene: its first character that is not white space is `<`.
pub fn is_xml(text: &str) -> bool {
    text.trim_start_matches('\u{feff}').trim_start().starts_with('<')
}

/// Reads a robot in URDF, versions 1.0 to 1.2, or in MJCF, as MuJoCo 4 reads it; the root element says which.
///
/// The scene is not compiled; [`Import::check`] does that. At most [`plantd_models::scene::MAX_TEXT_BYTES`] are read, in time and memory that grow with the text.
/// An MJCF that includes or attaches files, or takes inertia from those of meshes, is refused; [`import_with_files`] takes it.
///
/// # Errors
///
/// All problems of the file at once, each with line and column.
pub fn import(text: &str, options: &Options) -> Result<Import, ImportError> {
    read(&Source::single(text), options, None).map_err(|problems| ImportError { problems })
}

/// As [`import`], with the files that an MJCF includes or attaches, and the meshes (STL, OBJ, MSH) from which it takes the
/// inertia of what moves; no other files are asked for.
///
/// # Errors
///
/// As [`import`]; and that a file cannot be read, or is included twice.
pub fn import_with_files(
    text: &str,
    options: &Options,
    files: &mut Files<'_>,
) -> Result<Import, ImportError> {
    source(text, files)
        .and_then(|source| read(&source, options, Some(files)))
        .map_err(|problems| ImportError { problems })
}

/// A text with the files that it includes, if it is an MJCF; others are as they were. What it attaches is not put in
/// place.
///
/// # Errors
///
/// That a file cannot be read, is no XML, or is included twice.
pub fn with_includes(text: &str, files: &mut Files<'_>) -> Result<String, ImportError> {
    if !is_mjcf_with(text, &["<include"]) {
        return Ok(text.to_owned());
    }
    let whole = Source::with_includes(text, files);
    whole.map(|whole| whole.text.into_owned()).map_err(|problems| ImportError { problems })
}

fn source<'t>(text: &'t str, files: &mut Files<'_>) -> Result<Source<'t>, Vec<Problem>> {
    if is_mjcf_with(text, &["<include", "<attach"]) {
        attach::whole(text, files)
    } else {
        Ok(Source::single(text))
    }
}

/// Whether a text may be an MJCF that has one of some tags.
fn is_mjcf_with(text: &str, tags: &[&str]) -> bool {
    is_xml(text) && text.contains("<mujoco") && tags.iter().any(|tag| text.contains(tag))
}

fn read<'f>(
    source: &Source<'_>,
    options: &Options,
    files: Option<&'f mut Files<'f>>,
) -> Result<Import, Vec<Problem>> {
    let document = xml::open(&source.text)?;
    let mut reader = Reader::new(source, options.lenient);
    let root = document.root_element();
    let scene = match root.tag_name().name() {
        "robot" => urdf::scene(&mut reader, root, options),
        "mujoco" => mjcf::scene(&mut reader, root, options, files),
        name => {
            let allowed = "must be `robot` (URDF) or `mujoco` (MJCF)";
            reader.fail(root, format!("the root is `{name}`; {allowed}"));
            None
        }
    };
    let report = reader.finish()?;
    Ok(Import { scene: scene.unwrap_or_default(), report })
}
