//! The functions of the standard that this FMU does not provide. Importers bind all functions when they
//! load a library, so these are there, too, and answer an error that says what is missing.

use std::ffi::{c_char, c_void};

use crate::error::FmuError;
use crate::instances::{Log, call, instantiate};
use crate::simulation::Simulation;
use crate::types::{Environment, Handle, LogMessage, Status, ValueReference};

/// What the functions below take beside the instance and do not look at.
type Anything = *const c_void;

/// Variables that are not of the type `Float64` do not exist; of none of them one can have any number.
macro_rules! variables_of_other_types {
    ($($function:ident ($($argument:ty),*) $what:literal;)*) => {$(
        #[unsafe(no_mangle)]
        extern "C" fn $function(
            instance: Handle,
            _references: *const ValueReference,
            count: usize,
            $(_: $argument),*
        ) -> Status {
            call(instance, stringify!($function), |_| match count {
                0 => Ok(()),
                _ => Err(FmuError::Absent(concat!("variables of the type ", $what))),
            })
        }
    )*};
}

variables_of_other_types! {
    fmi3GetFloat32(Anything, usize) "Float32";
    fmi3GetInt8(Anything, usize) "Int8";
    fmi3GetUInt8(Anything, usize) "UInt8";
    fmi3GetInt16(Anything, usize) "Int16";
    fmi3GetUInt16(Anything, usize) "UInt16";
    fmi3GetInt32(Anything, usize) "Int32";
    fmi3GetUInt32(Anything, usize) "UInt32";
    fmi3GetInt64(Anything, usize) "Int64";
    fmi3GetUInt64(Anything, usize) "UInt64";
    fmi3GetBoolean(Anything, usize) "Boolean";
    fmi3GetString(Anything, usize) "String";
    fmi3GetBinary(Anything, Anything, usize) "Binary";
    fmi3GetClock(Anything) "Clock";
    fmi3SetFloat32(Anything, usize) "Float32";
    fmi3SetInt8(Anything, usize) "Int8";
    fmi3SetUInt8(Anything, usize) "UInt8";
    fmi3SetInt16(Anything, usize) "Int16";
    fmi3SetUInt16(Anything, usize) "UInt16";
    fmi3SetInt32(Anything, usize) "Int32";
    fmi3SetUInt32(Anything, usize) "UInt32";
    fmi3SetInt64(Anything, usize) "Int64";
    fmi3SetUInt64(Anything, usize) "UInt64";
    fmi3SetBoolean(Anything, usize) "Boolean";
    fmi3SetString(Anything, usize) "String";
    fmi3SetBinary(Anything, Anything, usize) "Binary";
    fmi3SetClock(Anything) "Clock";
    fmi3GetIntervalDecimal(Anything, Anything) "Clock";
    fmi3GetIntervalFraction(Anything, Anything, Anything) "Clock";
    fmi3GetShiftDecimal(Anything) "Clock";
    fmi3GetShiftFraction(Anything, Anything) "Clock";
    fmi3SetIntervalDecimal(Anything) "Clock";
    fmi3SetIntervalFraction(Anything, Anything) "Clock";
    fmi3SetShiftDecimal(Anything) "Clock";
    fmi3SetShiftFraction(Anything, Anything) "Clock";
}

macro_rules! absent {
    ($($function:ident ($($argument:ty),*) $what:literal;)*) => {$(
        #[unsafe(no_mangle)]
        extern "C" fn $function(instance: Handle, $(_: $argument),*) -> Status {
            call(instance, stringify!($function), |_| Err(FmuError::Absent($what)))
        }
    )*};
}

absent! {
    fmi3EnterEventMode() "event mode";
    fmi3EnterStepMode() "event mode, and so no other mode to come from";
    fmi3EvaluateDiscreteStates() "event mode";
    fmi3UpdateDiscreteStates(Anything, Anything, Anything, Anything, Anything, Anything) "event mode";
    fmi3EnterConfigurationMode() "structural parameters";
    fmi3ExitConfigurationMode() "structural parameters";
    fmi3GetNumberOfVariableDependencies(ValueReference, Anything) "dependencies by element";
    fmi3GetVariableDependencies(
        ValueReference, Anything, Anything, Anything, Anything, usize
    ) "dependencies by element";
    fmi3GetOutputDerivatives(Anything, usize, Anything, Anything, usize) "derivatives of outputs by time";
    fmi3ActivateModelPartition(ValueReference, f64) "scheduled execution";
    fmi3EnterContinuousTimeMode() "model exchange";
    fmi3CompletedIntegratorStep(bool, Anything, Anything) "model exchange";
    fmi3SetTime(f64) "model exchange";
    fmi3SetContinuousStates(Anything, usize) "model exchange";
    fmi3GetContinuousStateDerivatives(Anything, usize) "model exchange";
    fmi3GetEventIndicators(Anything, usize) "model exchange";
    fmi3GetContinuousStates(Anything, usize) "model exchange";
    fmi3GetNominalsOfContinuousStates(Anything, usize) "model exchange";
    fmi3GetNumberOfEventIndicators(Anything) "model exchange";
    fmi3GetNumberOfContinuousStates(Anything) "model exchange";
}

#[unsafe(no_mangle)]
extern "C" fn fmi3InstantiateModelExchange(
    _instance_name: *const c_char,
    _token: *const c_char,
    _resource_path: *const c_char,
    _visible: bool,
    _logging_on: bool,
    environment: Environment,
    log_message: LogMessage,
) -> Handle {
    refuse(Log::new(log_message, environment), "model exchange; instantiate it for co-simulation")
}

#[unsafe(no_mangle)]
extern "C" fn fmi3InstantiateScheduledExecution(
    _instance_name: *const c_char,
    _token: *const c_char,
    _resource_path: *const c_char,
    _visible: bool,
    _logging_on: bool,
    environment: Environment,
    log_message: LogMessage,
    _clock_update: Anything,
    _lock_preemption: Anything,
    _unlock_preemption: Anything,
) -> Handle {
    refuse(
        Log::new(log_message, environment),
        "scheduled execution; instantiate it for co-simulation",
    )
}

fn refuse(log: Log, what: &'static str) -> Handle {
    instantiate(log, || Err::<Simulation, _>(FmuError::Absent(what)))
}
