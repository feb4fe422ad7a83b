//! The functions of the standard that this FMU provides.

use std::ffi::{c_char, c_void};
use std::path::Path;
use std::sync::Arc;

use crate::blueprint::{Blueprint, BlueprintError};
use crate::description::LOG_CATEGORIES;
use crate::error::FmuError;
use crate::instances::{Log, call, free, instantiate, slice, slice_mut, text, write};
use crate::package::{RECIPE_FILE, SCENE_FILE};
use crate::saved::Saved;
use crate::simulation::Simulation;
use crate::types::{Environment, Handle, LogMessage, Status, ValueReference};

/// Why there is no instance.
#[derive(Debug, thiserror::Error)]
enum InstantiationError {
    #[error(transparent)]
    Argument(#[from] FmuError),
    #[error("event mode is not provided")]
    EventMode,
    #[error("intermediate updates are not provided, and {0} intermediate variables are required")]
    IntermediateUpdate(usize),
    #[error("{path} cannot be read: {source}")]
    Resource { path: String, source: std::io::Error },
    #[error(transparent)]
    Blueprint(#[from] BlueprintError),
    #[error("the token is `{given}`; this library and these resources have `{own}`")]
    Token { given: String, own: String },
}

#[unsafe(no_mangle)]
extern "C" fn fmi3GetVersion() -> *const c_char {
    c"3.0".as_ptr()
}

/// # Safety
///
/// As the standard has it: pointers are null or point to so many values as the counts say.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3SetDebugLogging(
    instance: Handle,
    _logging_on: bool,
    count: usize,
    categories: *const *const c_char,
) -> Status {
    call(instance, "fmi3SetDebugLogging", |_| {
        // SAFETY: the caller's duty.
        for &category in unsafe { slice(categories, count, "categories") }? {
            // SAFETY: the caller's duty.
            let name = unsafe { text(category, "a category") }?;
            if LOG_CATEGORIES.iter().all(|(known, _)| *known != name) {
                return Err(FmuError::NoCategory(name.to_owned()));
            }
        }
        // There are only messages of calls that fail, and they are always told.
        Ok(())
    })
}

/// # Safety
///
/// As the standard has it: strings are null or end with a zero.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3InstantiateCoSimulation(
    _instance_name: *const c_char,
    token: *const c_char,
    resource_path: *const c_char,
    _visible: bool,
    _logging_on: bool,
    event_mode_used: bool,
    // Allowed or not: a step never ends early.
    _early_return_allowed: bool,
    _required: *const ValueReference,
    required_count: usize,
    environment: Environment,
    log_message: LogMessage,
    _intermediate_update: *const c_void,
) -> Handle {
    instantiate(Log::new(log_message, environment), || {
        if event_mode_used {
            return Err(InstantiationError::EventMode);
        }
        if required_count > 0 {
            return Err(InstantiationError::IntermediateUpdate(required_count));
        }
        // SAFETY: the caller's duty.
        let (token, resources) =
            unsafe { (text(token, "instantiationToken")?, text(resource_path, "resourcePath")?) };
        let read = |name: &str| {
            let path = Path::new(resources).join(name);
            std::fs::read_to_string(&path).map_err(|source| InstantiationError::Resource {
                path: path.display().to_string(),
                source,
            })
        };
        let blueprint = Blueprint::new(&read(SCENE_FILE)?, &read(RECIPE_FILE)?)?;
        if token != blueprint.token {
            let (given, own) = (token.to_owned(), blueprint.token);
            return Err(InstantiationError::Token { given, own });
        }
        Ok(Simulation::new(Arc::new(blueprint)))
    })
}

#[unsafe(no_mangle)]
extern "C" fn fmi3FreeInstance(instance: Handle) {
    free(instance);
}

#[unsafe(no_mangle)]
extern "C" fn fmi3EnterInitializationMode(
    instance: Handle,
    _tolerance_defined: bool,
    // A step is solved to round-off, or as the settings say.
    _tolerance: f64,
    start_s: f64,
    stop_defined: bool,
    stop_s: f64,
) -> Status {
    call(instance, "fmi3EnterInitializationMode", |work| {
        work.simulation.enter_initialization(start_s, stop_defined.then_some(stop_s))
    })
}

#[unsafe(no_mangle)]
extern "C" fn fmi3ExitInitializationMode(instance: Handle) -> Status {
    call(instance, "fmi3ExitInitializationMode", |work| work.simulation.exit_initialization())
}

#[unsafe(no_mangle)]
extern "C" fn fmi3Terminate(instance: Handle) -> Status {
    call(instance, "fmi3Terminate", |work| work.simulation.terminate())
}

#[unsafe(no_mangle)]
extern "C" fn fmi3Reset(instance: Handle) -> Status {
    call(instance, "fmi3Reset", |work| {
        work.simulation.reset();
        Ok(())
    })
}

/// # Safety
///
/// As the standard has it: pointers are null or point to so many values as the counts say.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3GetFloat64(
    instance: Handle,
    references: *const ValueReference,
    count: usize,
    values: *mut f64,
    value_count: usize,
) -> Status {
    call(instance, "fmi3GetFloat64", |work| {
        check_counts(count, value_count, "values")?;
        // SAFETY: the caller's duty.
        let (references, values) = unsafe {
            (slice(references, count, "valueReferences")?, slice_mut(values, count, "values")?)
        };
        for (reference, value) in references.iter().zip(values) {
            *value = work.simulation.value(*reference)?;
        }
        Ok(())
    })
}

/// # Safety
///
/// As the standard has it: pointers are null or point to so many values as the counts say.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3SetFloat64(
    instance: Handle,
    references: *const ValueReference,
    count: usize,
    values: *const f64,
    value_count: usize,
) -> Status {
    call(instance, "fmi3SetFloat64", |work| {
        check_counts(count, value_count, "values")?;
        // SAFETY: the caller's duty.
        let (references, values) = unsafe {
            (slice(references, count, "valueReferences")?, slice(values, count, "values")?)
        };
        work.simulation.set(references, values)
    })
}

/// # Safety
///
/// As the standard has it: the pointer is null or points to a state.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3GetFMUState(instance: Handle, state: *mut Handle) -> Status {
    call(instance, "fmi3GetFMUState", |work| {
        // SAFETY: the caller's duty.
        let place = unsafe { slice_mut(state, 1, "FMUState") }?;
        let saved = work.simulation.save();
        // A state that is there already is replaced.
        let _ = work.free(place[0]);
        place[0] = work.keep(saved);
        Ok(())
    })
}

#[unsafe(no_mangle)]
extern "C" fn fmi3SetFMUState(instance: Handle, state: Handle) -> Status {
    call(instance, "fmi3SetFMUState", |work| work.restore(state))
}

/// # Safety
///
/// As the standard has it: the pointer is null or points to a state.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3FreeFMUState(instance: Handle, state: *mut Handle) -> Status {
    call(instance, "fmi3FreeFMUState", |work| {
        if state.is_null() {
            return Ok(());
        }
        // SAFETY: the caller's duty.
        let place = unsafe { slice_mut(state, 1, "FMUState") }?;
        if !place[0].is_null() {
            work.free(place[0])?;
            place[0] = std::ptr::null_mut();
        }
        Ok(())
    })
}

/// # Safety
///
/// As the standard has it: the pointer is null or points to a size.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3SerializedFMUStateSize(
    instance: Handle,
    state: Handle,
    size: *mut usize,
) -> Status {
    call(instance, "fmi3SerializedFMUStateSize", |work| {
        let bytes = work.state(state)?.to_bytes(&work.simulation.blueprint);
        // SAFETY: the caller's duty.
        unsafe { write(size, bytes.len(), "size") }
    })
}

/// # Safety
///
/// As the standard has it: the pointer is null or points to so many bytes.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3SerializeFMUState(
    instance: Handle,
    state: Handle,
    serialized: *mut u8,
    size: usize,
) -> Status {
    call(instance, "fmi3SerializeFMUState", |work| {
        let bytes = work.state(state)?.to_bytes(&work.simulation.blueprint);
        if size < bytes.len() {
            return Err(FmuError::Count { what: "bytes", given: size, needed: bytes.len() });
        }
        // SAFETY: the caller's duty.
        let place = unsafe { slice_mut(serialized, bytes.len(), "serializedState") }?;
        place.copy_from_slice(&bytes);
        Ok(())
    })
}

/// # Safety
///
/// As the standard has it: pointers are null or point to so many bytes, and to a state.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3DeserializeFMUState(
    instance: Handle,
    serialized: *const u8,
    size: usize,
    state: *mut Handle,
) -> Status {
    call(instance, "fmi3DeserializeFMUState", |work| {
        // SAFETY: the caller's duty.
        let (bytes, place) = unsafe {
            (slice(serialized, size, "serializedState")?, slice_mut(state, 1, "FMUState")?)
        };
        let saved = Saved::from_bytes(bytes, &work.simulation.blueprint)?;
        let _ = work.free(place[0]);
        place[0] = work.keep(saved);
        Ok(())
    })
}

/// # Safety
///
/// As the standard has it: pointers are null or point to so many values as the counts say.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3GetDirectionalDerivative(
    instance: Handle,
    unknowns: *const ValueReference,
    unknown_count: usize,
    knowns: *const ValueReference,
    known_count: usize,
    seed: *const f64,
    seed_count: usize,
    sensitivity: *mut f64,
    sensitivity_count: usize,
) -> Status {
    call(instance, "fmi3GetDirectionalDerivative", |work| {
        check_counts(known_count, seed_count, "seeds")?;
        check_counts(unknown_count, sensitivity_count, "sensitivities")?;
        // SAFETY: the caller's duty.
        let (unknowns, knowns, seed, sensitivity) = unsafe {
            (
                slice(unknowns, unknown_count, "unknowns")?,
                slice(knowns, known_count, "knowns")?,
                slice(seed, seed_count, "seed")?,
                slice_mut(sensitivity, sensitivity_count, "sensitivity")?,
            )
        };
        sensitivity.copy_from_slice(&work.simulation.directional(unknowns, knowns, seed)?);
        Ok(())
    })
}

/// # Safety
///
/// As the standard has it: pointers are null or point to so many values as the counts say.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3GetAdjointDerivative(
    instance: Handle,
    unknowns: *const ValueReference,
    unknown_count: usize,
    knowns: *const ValueReference,
    known_count: usize,
    seed: *const f64,
    seed_count: usize,
    sensitivity: *mut f64,
    sensitivity_count: usize,
) -> Status {
    call(instance, "fmi3GetAdjointDerivative", |work| {
        check_counts(unknown_count, seed_count, "seeds")?;
        check_counts(known_count, sensitivity_count, "sensitivities")?;
        // SAFETY: the caller's duty.
        let (unknowns, knowns, seed, sensitivity) = unsafe {
            (
                slice(unknowns, unknown_count, "unknowns")?,
                slice(knowns, known_count, "knowns")?,
                slice(seed, seed_count, "seed")?,
                slice_mut(sensitivity, sensitivity_count, "sensitivity")?,
            )
        };
        sensitivity.copy_from_slice(&work.simulation.adjoint(unknowns, knowns, seed)?);
        Ok(())
    })
}

/// # Safety
///
/// As the standard has it: pointers are null or point to a value.
#[unsafe(no_mangle)]
unsafe extern "C" fn fmi3DoStep(
    instance: Handle,
    at_s: f64,
    size_s: f64,
    _no_set_state_prior: bool,
    event_handling_needed: *mut bool,
    terminate_simulation: *mut bool,
    early_return: *mut bool,
    last_successful_s: *mut f64,
) -> Status {
    call(instance, "fmi3DoStep", |work| {
        // SAFETY: the caller's duty.
        unsafe {
            write(event_handling_needed, false, "eventHandlingNeeded")?;
            write(terminate_simulation, false, "terminateSimulation")?;
            write(early_return, false, "earlyReturn")?;
            write(last_successful_s, at_s, "lastSuccessfulTime")?;
        }
        work.simulation.step(at_s, size_s)?;
        // SAFETY: the caller's duty.
        unsafe { write(last_successful_s, at_s + size_s, "lastSuccessfulTime") }
    })
}

fn check_counts(needed: usize, given: usize, what: &'static str) -> Result<(), FmuError> {
    if given == needed { Ok(()) } else { Err(FmuError::Count { what, given, needed }) }
}
