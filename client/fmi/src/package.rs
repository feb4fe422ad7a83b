//! What an FMU of a scene is made of, for the program that makes one of this library.

use std::ffi::{CString, c_char};
use std::panic::catch_unwind;

use plantd_models::builtin;
use serde_json::{Value, json};

use crate::blueprint::Blueprint;
use crate::description::description;
use crate::instances::text;

/// Files among the resources.
pub(crate) const SCENE_FILE: &str = "scene.toml";
pub(crate) const RECIPE_FILE: &str = "settings.json";

/// Describes the FMU of a scene (TOML or JSON, or the name of a built-in one) with settings (JSON, see
/// [`crate::recipe::Recipe`]): a JSON object with `identifier`, the name of the library in the FMU without
/// its ending, and `files`, its other files by their path; or with `error`. To be freed by
/// [`plantd_fmi_free`]; null only if there is no memory.
///
/// # Safety
///
/// The strings are null or end with a zero.
#[unsafe(no_mangle)]
unsafe extern "C" fn plantd_fmi_package(
    scene: *const c_char,
    settings: *const c_char,
) -> *mut c_char {
    let answer = catch_unwind(|| {
        // SAFETY: the caller's duty.
        let arguments =
            unsafe { text(scene, "scene").and_then(|s| Ok((s, text(settings, "settings")?))) };
        let packed = match arguments {
            Ok((scene, settings)) => package(scene, settings),
            Err(error) => Err(error.to_string()),
        };
        packed.unwrap_or_else(|error| json!({ "error": error })).to_string()
    });
    let answer =
        answer.unwrap_or_else(|_| json!({ "error": "the library has panicked" }).to_string());
    CString::new(answer).map_or(std::ptr::null_mut(), CString::into_raw)
}

/// Frees what [`plantd_fmi_package`] answered.
///
/// # Safety
///
/// The pointer is null or comes from there, and is not used any more.
#[unsafe(no_mangle)]
unsafe extern "C" fn plantd_fmi_free(answer: *mut c_char) {
    if !answer.is_null() {
        // SAFETY: the caller's duty.
        drop(unsafe { CString::from_raw(answer) });
    }
}

fn package(scene: &str, settings: &str) -> Result<Value, String> {
    let is_name = !scene.trim().contains(|c: char| c.is_whitespace() || "={[".contains(c));
    let builtin = builtin::scene(scene.trim()).map(|scene| scene.to_toml());
    if is_name && builtin.is_none() {
        let known = builtin::NAMES.join(", ");
        return Err(format!(
            "there is no such file, and no built-in scene of that name; there are {known}"
        ));
    }
    let scene = builtin.as_deref().unwrap_or(scene);
    let blueprint = Blueprint::new(scene, settings).map_err(|error| error.to_string())?;
    let mut files = serde_json::Map::new();
    files.insert("modelDescription.xml".to_owned(), description(&blueprint).into());
    files.insert(format!("resources/{SCENE_FILE}"), scene.into());
    files.insert(format!("resources/{RECIPE_FILE}"), settings.into());
    Ok(json!({ "identifier": blueprint.identifier(), "files": files }))
}
