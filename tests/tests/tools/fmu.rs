//! FMUs that `plantctl fmu` makes, by their C interface: the motion of the plant itself, states, exact
//! derivatives, parameters, and refusals. `client/fmi/tests` has FMPy do the same.

mod library;

use std::ffi::c_void;
use std::process::Command;
use std::sync::Arc;

use library::{DISCARD, ERROR, Fmu, Handle, Instance, OK, messages};
use plantd_models::parameters::{Parameters, change};
use plantd_models::{Initial, Linearization, Model, Plant, Settings, Spare, builtin};
use plantd_tests::links::{new_plant, wiggle};
use plantd_tests::server::binary;

/// Names of the entries of `x`, of the velocity, of the outputs beside them, and of `u`.
struct Names {
    x: Vec<String>,
    seen: Vec<String>,
    u: Vec<String>,
}

impl Names {
    fn of(model: &Model) -> Self {
        let d = model.dimensions();
        let names: Vec<&str> = model.coordinates().iter().map(|c| c.name.as_str()).collect();
        let all = |letter: &str, names: &[&str]| -> Vec<String> {
            names.iter().map(|name| format!("{letter}({name})")).collect()
        };
        let (dynamic, prescribed) = names.split_at(d.dynamic);
        let x = [all("q", &names), all("p", dynamic), all("v", prescribed)].concat();
        let inputs: Vec<&str> = model.scene().inputs.iter().map(|i| i.name.as_str()).collect();
        let u = [all("u", &inputs), all("u", prescribed)].concat();
        let energies = ["energy", "kinetic", "potential", "time"].map(str::to_owned).to_vec();
        let seen = [x.clone(), all("velocity", &names), energies].concat();
        Self { x, seen, u }
    }
}

fn strs(names: &[String]) -> Vec<&str> {
    names.iter().map(String::as_str).collect()
}

fn bits(values: &[f64]) -> Vec<u64> {
    values.iter().map(|value| value.to_bits()).collect()
}

/// The same numbers of a plant.
fn seen(plant: &mut Plant) -> Vec<f64> {
    let (energy, velocity) = (plant.energy(), plant.velocity());
    let energies = [energy.kinetic_j + energy.potential_j, energy.kinetic_j, energy.potential_j];
    [&plant.state().x()[..], &velocity, &energies, &[plant.time_s()]].concat()
}

fn assert_same(instance: &Instance<'_>, plant: &mut Plant, names: &Names, what: &str) {
    let values = instance.get(&strs(&names.seen));
    assert_eq!(bits(&values), bits(&seen(plant)), "{what}: {values:?}");
}

#[test]
fn an_fmu_moves_as_the_plant_itself_bit_for_bit() {
    for (scene, steps, at_once) in
        [("pendulum", 60, 1), ("cart-pole", 60, 3), ("four-bar", 30, 2), ("marionette", 12, 1)]
    {
        let fmu = Fmu::make(scene, &[]);
        let mut plant = new_plant(scene).unwrap();
        let names = Names::of(plant.model());
        let (instance, other) = (fmu.instantiate(), fmu.instantiate());
        instance.initialize();
        other.initialize();
        let before = other.get(&strs(&names.seen));
        assert_same(&instance, &mut plant, &names, scene);
        let h = plant.settings().time_step_s;
        let mut u = vec![0.0; plant.model().dimensions().input()];
        for k in 0..steps {
            wiggle(&plant, k, &mut u);
            instance.set(&strs(&names.u), &u);
            instance.step(k as f64 * at_once as f64 * h, at_once as f64 * h);
            for _ in 0..at_once {
                plant.step(&u).unwrap();
            }
            assert_same(&instance, &mut plant, &names, scene);
        }
        assert_eq!(bits(&other.get(&strs(&names.seen))), bits(&before), "instances are apart");
        assert_eq!(instance.call("fmi3Reset"), OK);
        instance.initialize();
        assert_eq!(bits(&instance.get(&strs(&names.seen))), bits(&before), "after a reset");
    }
}

#[test]
fn instances_run_in_threads_of_their_own() {
    let fmu = Fmu::make("cart-pole", &[]);
    let names = Names::of(new_plant("cart-pole").unwrap().model());
    let run = || {
        let instance = fmu.instantiate();
        instance.initialize();
        for k in 0..200 {
            instance.set(&["u(force)"], &[(k as f64).sin()]);
            instance.step(k as f64 * 0.01, 0.01);
        }
        bits(&instance.get(&strs(&names.seen)))
    };
    let alone = run();
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..4).map(|_| scope.spawn(run)).collect();
        for thread in threads {
            assert_eq!(thread.join().unwrap(), alone);
        }
    });
}

#[test]
fn settings_and_operating_points_are_those_of_the_command() {
    let fmu = Fmu::make("pendulum", &["--at", "upright", "--dt", "0.02", "--order", "4"]);
    let model = Arc::new(Model::compile(&builtin::scene("pendulum").unwrap()).unwrap());
    let settings = Settings { time_step_s: 0.02, order: 4, ..Settings::new(&model) };
    let upright = Initial::OperatingPoint("upright".to_owned());
    let mut plant = Plant::at(Arc::clone(&model), settings, &upright).unwrap();
    let instance = fmu.instantiate();
    instance.initialize();
    for k in 0..40 {
        instance.set(&["u(tau)"], &[0.3]);
        instance.step(k as f64 * 0.02, 0.02);
        plant.step(&[0.3]).unwrap();
    }
    assert_same(&instance, &mut plant, &Names::of(&model), "upright");
}

#[test]
fn states_are_kept_serialized_and_taken_over_by_other_instances() {
    let fmu = Fmu::make("cart-pole", &[]);
    let names = Names::of(new_plant("cart-pole").unwrap().model());
    let names = strs(&names.seen);
    let (instance, other) = (fmu.instantiate(), fmu.instantiate());
    instance.initialize();
    instance.set(&["frames[pole].body.mass", "u(force)"], &[1.5, 2.0]);
    let run = |instance: &Instance<'_>| {
        for k in 20..40 {
            instance.step(k as f64 * 0.01, 0.01);
        }
        bits(&instance.get(&names))
    };
    instance.step(0.0, 0.2);
    let mut state = instance.save();
    let bytes = instance.serialize(state);
    let first = run(&instance);
    assert_eq!(instance.restore(state), OK);
    assert_eq!(run(&instance), first);
    // Back over a change of parameters.
    instance.set(&["frames[pole].body.mass"], &[0.5]);
    instance.step(0.4, 0.01);
    assert_eq!(instance.restore(state), OK);
    assert_eq!(instance.get(&["frames[pole].body.mass"]), [1.5]);
    assert_eq!(run(&instance), first);

    // Into an instance that has not even begun.
    let (status, copy) = other.deserialize(&bytes);
    assert_eq!((status, other.restore(copy)), (OK, OK), "{}", messages());
    assert_eq!(run(&other), first);
    assert_eq!(other.restore(state), ERROR, "the state is the first instance's");

    assert_eq!(instance.free_state(&mut state), OK);
    assert!(state.is_null());
    assert_eq!(instance.free_state(&mut state), OK);
    for at in 0..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[at] ^= 4;
        assert_eq!(other.deserialize(&damaged), (ERROR, std::ptr::null_mut()), "byte {at}");
        assert_eq!(other.deserialize(&bytes[..at]).0, ERROR);
    }
    messages();
    let pendulum = Fmu::make("pendulum", &[]);
    let stranger = pendulum.instantiate();
    assert_eq!(stranger.deserialize(&bytes).0, ERROR);
    assert!(messages().contains("of another FMU"));
}

#[test]
fn directional_derivatives_are_exactly_a_and_b() {
    for scene in ["cart-pole", "four-bar", "marionette"] {
        let fmu = Fmu::make(scene, &[]);
        let mut plant = new_plant(scene).unwrap();
        let names = Names::of(plant.model());
        let instance = fmu.instantiate();
        instance.initialize();
        let mut u = vec![0.0; plant.model().dimensions().input()];
        for k in 0..5 {
            wiggle(&plant, k, &mut u);
            instance.set(&strs(&names.u), &u);
            instance.step(k as f64 * plant.settings().time_step_s, plant.settings().time_step_s);
            plant.step(&u).unwrap();
        }
        let mut linearization = Linearization::new(plant.model());
        plant.linearize(&u, &mut linearization).unwrap();
        let next: Vec<String> = names.x.iter().map(|name| format!("next({name})")).collect();
        for (knowns, matrix) in [(&names.x, linearization.a()), (&names.u, linearization.b())] {
            for (j, known) in knowns.iter().enumerate() {
                let which = [&strs(&next)[..], &[known.as_str()]];
                let function = "fmi3GetDirectionalDerivative";
                let column = instance.derivative(function, which, &[1.0], next.len()).unwrap();
                assert_eq!(bits(&column), bits(matrix.column(j).as_slice()), "{scene} {known}");
            }
            if !knowns.is_empty() {
                let seed: Vec<f64> = (0..next.len()).map(|i| (i as f64).sin()).collect();
                let which = [&strs(&next)[..], &strs(knowns)];
                let function = "fmi3GetAdjointDerivative";
                let pulled = instance.derivative(function, which, &seed, knowns.len()).unwrap();
                let expected = matrix.tr_mul(&nalgebra::DVector::from_vec(seed));
                for (pulled, expected) in pulled.iter().zip(expected.iter()) {
                    assert!((pulled - expected).abs() <= 1e-12 * matrix.amax().max(1.0));
                }
            }
        }
        // No output depends on an input of the same time; the plant has not moved by all that.
        if let Some(input) = names.u.first() {
            let which = [&["energy", names.seen[0].as_str()][..], &[input.as_str()]];
            let function = "fmi3GetDirectionalDerivative";
            assert_eq!(instance.derivative(function, which, &[1.0], 2), Ok(vec![0.0, 0.0]));
        }
        let values = instance.get(&strs(&next));
        plant.step(&u).unwrap();
        assert_eq!(bits(&values), bits(&plant.state().x()), "next");
        let refused = instance.derivative(
            "fmi3GetDirectionalDerivative",
            [&["energy"], &[names.x[0].as_str()]],
            &[1.0],
            1,
        );
        assert!(refused.unwrap_err().contains("the derivative of `energy`"));
    }
}

#[test]
fn parameters_change_the_mechanism_as_in_a_plant() {
    let fmu = Fmu::make("cart-pole", &[]);
    let mut plant = new_plant("cart-pole").unwrap();
    let names = Names::of(plant.model());
    let instance = fmu.instantiate();
    instance.initialize();
    for k in 0..10 {
        instance.step(k as f64 * 0.01, 0.01);
        plant.step(&[0.0]).unwrap();
    }
    // Values that none of both has alone may come in two calls.
    instance.set(&["gravity[1]"], &[-1.6]);
    instance.set(&["frames[pole].body.mass"], &[2.5]);
    let changes = [("gravity[1]", -1.6), ("frames[pole].body.mass", 2.5)];
    let changes = changes.map(|(path, value)| (path.to_owned(), value));
    let changed = change(plant.model(), &Parameters::new(), &changes).unwrap().model;
    let spare = Spare::new(Arc::new(changed), *plant.settings()).unwrap();
    let mut plant = spare.go_on_from(&plant).unwrap();
    assert_same(&instance, &mut plant, &names, "changed");
    for k in 10..40 {
        instance.step(k as f64 * 0.01, 0.01);
        plant.step(&[0.0]).unwrap();
    }
    assert_same(&instance, &mut plant, &names, "moved");

    // What is no mechanism is refused when it is needed, and can be put right.
    instance.set(&["frames[cart].body.mass"], &[-1.0]);
    assert_eq!(instance.try_step(0.4, 0.01).0, ERROR);
    let told = messages();
    assert!(told.contains("frames[0].body.mass"), "{told}");
    instance.set(&["frames[cart].body.mass"], &[10.0]);
    assert_same(&instance, &mut plant, &names, "put right");
}

#[test]
fn start_values_hold_and_others_satisfy_the_constraints() {
    let fmu = Fmu::make("four-bar", &[]);
    let plant = new_plant("four-bar").unwrap();
    let names: Vec<String> =
        plant.model().coordinates().iter().map(|c| format!("q({})", c.name)).collect();
    let crank = plant.q()[0] + 0.2;
    let instance = fmu.instantiate();
    instance.set(&[&names[0]], &[crank]);
    instance.initialize();
    let mut q = plant.q().to_vec();
    q[0] = crank;
    let hold = vec![plant.model().coordinates()[0].name.clone()];
    let at = Initial::Projection { q, hold };
    let expected = Plant::at(Arc::clone(plant.model()), *plant.settings(), &at).unwrap();
    assert_eq!(bits(&instance.get(&strs(&names))), bits(expected.q()));
    instance.step(0.0, plant.settings().time_step_s);

    // All held, and not on the constraints.
    assert_eq!(instance.call("fmi3Reset"), OK);
    instance.set(&strs(&names), &[crank, plant.q()[1], plant.q()[2]]);
    assert_eq!(instance.enter_initialization(0.0, None), OK);
    assert_eq!(instance.call("fmi3ExitInitializationMode"), ERROR);
    let told = messages();
    assert!(told.contains("is violated"), "{told}");

    let fmu = Fmu::make("cart-pole", &[]);
    let instance = fmu.instantiate();
    instance.set(&["q(theta)", "velocity(x)"], &[0.25, -0.5]);
    assert_eq!(instance.enter_initialization(3.0, Some(3.5)), OK);
    assert_eq!(instance.get(&["q(theta)", "velocity(x)", "time"])[0], 0.25);
    assert_eq!(instance.call("fmi3ExitInitializationMode"), OK);
    let [x, time] = instance.get(&["velocity(x)", "time"])[..] else { panic!("two") };
    assert!((x + 0.5).abs() < 1e-14 && time == 3.0);
    instance.step(3.0, 0.5);
    assert_eq!(instance.try_step(3.5, 0.01).0, ERROR);
    assert!(messages().contains("after the stop time"));
}

/// The equations of a step have no solution: the instance stays where it was.
#[test]
fn a_step_that_cannot_be_taken_is_discarded() {
    let fmu = Fmu::make("pendulum", &[]);
    let instance = fmu.instantiate();
    instance.initialize();
    let names = ["q(theta)", "p(theta)", "time"];
    instance.step(0.0, 0.3);
    let before = bits(&instance.get(&names));
    let h = instance.get(&["time"])[0];
    instance.set(&["u(tau)"], &[1e12]);
    for count in [1.0, 5.0] {
        assert_eq!(instance.try_step(h, 0.1 * count), (DISCARD, h), "{}", messages());
        assert_eq!(bits(&instance.get(&names)), before);
    }
    assert!(messages().contains("cannot be taken"));
    instance.set(&["u(tau)"], &[0.0]);
    instance.step(h, 0.1);
}

#[test]
fn wrong_calls_are_refused_by_name_and_change_nothing() {
    let fmu = Fmu::make("cart-pole", &[]);
    for (token, resources, events, intermediate, why) in [
        ("wrong", true, false, 0, "this library and these resources have"),
        (&*fmu.token, false, false, 0, "resourcePath is a null pointer"),
        (&*fmu.token, true, true, 0, "event mode"),
        (&*fmu.token, true, false, 2, "intermediate"),
    ] {
        assert!(fmu.try_instantiate(token, resources, events, intermediate).is_null());
        let told = messages();
        assert!(told.contains(why), "{told}");
    }
    let instance = fmu.instantiate();
    let refused = |status: i32, why: &str| {
        let told = messages();
        assert!(status == ERROR && told.contains(why), "{status} {told}");
    };
    refused(instance.try_step(0.0, 0.01).0, "outside of the step mode");
    refused(instance.call("fmi3ExitInitializationMode"), "outside of the initialization mode");
    refused(instance.enter_initialization(f64::NAN, None), "start time NaN");
    refused(instance.enter_initialization(1.0, Some(0.0)), "no interval");
    instance.initialize();
    refused(instance.enter_initialization(0.0, None), "right after the instantiation");
    let before = instance.save();
    for size in [0.0, -0.01, 0.005, 0.0151, f64::NAN, f64::INFINITY] {
        refused(instance.try_step(0.0, size).0, "no multiple of the time step");
    }
    for at in [0.01, -0.01, f64::NAN] {
        refused(instance.try_step(at, 0.01).0, "the instance is at 0 s");
    }
    let (force, theta) = (fmu.find(&["u(force)"])[0], fmu.find(&["q(theta)"])[0]);
    refused(instance.try_set(&[force], &[f64::NAN]), "`u(force)` is to become NaN");
    refused(instance.try_set(&[force, theta], &[1.0, 1.0]), "until the initialization mode ends");
    assert_eq!(instance.get(&["u(force)"]), [0.0]);
    refused(instance.try_set(&fmu.find(&["energy"]), &[1.0]), "`energy` cannot be set");
    refused(instance.try_set(&[9999], &[1.0]), "value reference 9999");
    refused(instance.try_set(&[force], &[]), "0 values; 1 are needed");
    refused(instance.try_get(&[u32::MAX], &mut [0.0]), "value reference");
    refused(instance.try_get(&[force], &mut []), "values");
    for function in ["fmi3EnterEventMode", "fmi3EnterStepMode", "fmi3EnterContinuousTimeMode"] {
        refused(instance.call(function), "this FMU has no");
    }
    let derive = |seed: &[f64], count| {
        let which = [&["next(q(x))"][..], &["u(force)"]];
        instance.derivative("fmi3GetDirectionalDerivative", which, seed, count)
    };
    assert!(derive(&[], 1).unwrap_err().contains("seeds"));
    assert!(derive(&[1.0], 2).unwrap_err().contains("sensitivities"));
    refused(instance.restore(before.wrapping_byte_add(1)), "no state");
    refused(instance.restore(std::ptr::null_mut()), "no state");
    null_pointers_are_refused(&instance);
    instance.step(0.0, 0.01);
    assert_eq!(instance.call("fmi3Terminate"), OK);
    refused(instance.try_step(0.01, 0.01).0, "outside of the step mode");

    // Handles of nothing.
    let dead = fmu.instantiate();
    let handle = dead.handle;
    drop(dead);
    for handle in [handle, std::ptr::null_mut(), usize::MAX as Handle] {
        let nobody = Instance { fmu: &fmu, handle };
        assert_eq!(nobody.call("fmi3Reset"), ERROR);
        assert_eq!(nobody.try_get(&[0], &mut [0.0]), ERROR);
    }
}

fn null_pointers_are_refused(instance: &Instance<'_>) {
    type Two = unsafe extern "C" fn(Handle, *const u32, usize, *const c_void, usize) -> i32;
    let nothing = std::ptr::null();
    for name in ["fmi3GetFloat64", "fmi3SetFloat64"] {
        let function = instance.fmu.function::<Two>(name);
        // SAFETY: null pointers are what is tested.
        let status = unsafe { function(instance.handle, nothing, 1, std::ptr::null(), 1) };
        assert_eq!(status, ERROR);
        assert!(messages().contains("null pointer"));
        // SAFETY: nothing is read.
        let status = unsafe { function(instance.handle, nothing, 0, std::ptr::null(), 0) };
        assert_eq!(status, OK, "nothing is asked for");
    }
    for name in ["fmi3GetInt32", "fmi3SetBoolean", "fmi3GetString"] {
        let function = instance.fmu.function::<Two>(name);
        // SAFETY: nothing is read.
        let statuses =
            [0, 1].map(|n| unsafe { function(instance.handle, nothing, n, std::ptr::null(), n) });
        assert_eq!(statuses, [OK, ERROR]);
        assert!(messages().contains("variables of the type"));
    }
    let save = instance
        .fmu
        .function::<unsafe extern "C" fn(Handle, *mut Handle) -> i32>("fmi3GetFMUState");
    // SAFETY: null pointers are what is tested.
    assert_eq!(unsafe { save(instance.handle, std::ptr::null_mut()) }, ERROR);
    messages();
}

/// FMPy and others bind every function of the standard when they load a library.
#[test]
fn every_function_of_the_standard_is_exported() {
    let fmu = Fmu::make("pendulum", &[]);
    let types = "Float32 Float64 Int8 UInt8 Int16 UInt16 Int32 UInt32 Int64 UInt64 Boolean String \
                 Binary Clock";
    let mut names: Vec<String> = types
        .split_whitespace()
        .flat_map(|kind| ["Get", "Set"].map(|verb| format!("{verb}{kind}")))
        .collect();
    let others = "GetVersion SetDebugLogging InstantiateModelExchange InstantiateCoSimulation \
        InstantiateScheduledExecution FreeInstance EnterInitializationMode ExitInitializationMode \
        EnterEventMode Terminate Reset GetNumberOfVariableDependencies GetVariableDependencies \
        GetFMUState SetFMUState FreeFMUState SerializedFMUStateSize SerializeFMUState \
        DeserializeFMUState GetDirectionalDerivative GetAdjointDerivative EnterConfigurationMode \
        ExitConfigurationMode GetIntervalDecimal GetIntervalFraction GetShiftDecimal \
        GetShiftFraction SetIntervalDecimal SetIntervalFraction SetShiftDecimal SetShiftFraction \
        EvaluateDiscreteStates UpdateDiscreteStates EnterContinuousTimeMode \
        CompletedIntegratorStep SetTime SetContinuousStates GetContinuousStateDerivatives \
        GetEventIndicators GetContinuousStates GetNominalsOfContinuousStates \
        GetNumberOfEventIndicators GetNumberOfContinuousStates EnterStepMode GetOutputDerivatives \
        DoStep ActivateModelPartition";
    names.extend(others.split_whitespace().map(str::to_owned));
    assert_eq!(names.len(), 75);
    for name in names {
        fmu.function::<unsafe extern "C" fn()>(&format!("fmi3{name}"));
    }
}

#[test]
fn what_cannot_be_an_fmu_is_refused_with_the_reason() {
    let plantctl = |arguments: &[&str]| {
        let mut command = Command::new(binary("plantctl").unwrap());
        let output =
            command.arg("fmu").args(arguments).env_remove("PLANTD_ADDRESS").output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8(output.stderr).unwrap()
    };
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("scene.toml");
    let mut scene = builtin::scene("pendulum").unwrap();
    scene.frames[0].parent = "nobody".to_owned();
    std::fs::write(&file, scene.to_toml()).unwrap();
    let file = file.to_str().unwrap();
    let told = plantctl(&[file]);
    assert!(told.contains("frames[0].parent"), "{told}");
    assert!(plantctl(&["pendulm"]).contains("no built-in scene of that name"));
    assert!(plantctl(&["pendulum", "--order", "5"]).contains("order 5"));
    assert!(plantctl(&["pendulum", "--at", "sideways"]).contains("`sideways`"));
    assert!(plantctl(&["pendulum", "--library", "/nowhere.so"]).contains("/nowhere.so"));
}
