//! What the map keeps in every step: momenta, the symplectic form, constraints.

use anyhow::{Result, bail};
use nalgebra::{DMatrix, Vector3};
use plantd_models::{Linearization, Model, Plant, Scene};

use crate::case::{Case, Finding, Setup};
use crate::derivatives;
use crate::geometry::Geometry;
use crate::plants::{self, Method, coast, hold, pushed, step};
use crate::random_scene::{self, Kind};

/// Free-flying bodies, one tumbling on a ball joint of the other.
const TUMBLING: &str = r#"
[[frames]]
name = "hull"
joint = { type = "free" }
body = { mass = 2.0, center_of_mass = [0.1, 0.0, -0.05], inertia = [0.02, 0.03, 0.045, 1e-3, 2e-3, -1e-3] }
[[frames]]
name = "arm"
parent = "hull"
translation = [0.0, 0.2, 0.1]
joint = { type = "ball" }
body = { mass = 0.7, center_of_mass = [0.0, 0.2, 0.1], inertia = [0.01, 0.012, 0.008] }
"#;

type Make = fn() -> Result<Scene>;

fn tumbling() -> Result<Scene> {
    plants::parse(TUMBLING)
}

pub(crate) fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    let criterion = "linear and angular momentum: change ≤ 4 ε √steps of their size, the angular one's \
                     with the lever arm travelled";
    cases.push(Case::new("momenta: tumbling bodies", criterion, |setup, finding| {
        momenta(tumbling()?, setup.pick(100_000, 1_000_000), setup, finding)
    }));
    cases.push(Case::new("momenta: random free-flying trees", criterion, |setup, finding| {
        let (count, steps) = setup.pick((8, 2_000), (40, 20_000));
        let mut seeds = setup.seed * 1_000..;
        for _ in 0..count {
            let scene = seeds.find_map(|seed| {
                let text = random_scene::scene(seed, Kind::Floating);
                let scene = Scene::from_toml(&text).ok()?;
                let mut plant = pushed(&scene, 2e-3, 0.8).ok()?;
                coast(&mut plant, 10).ok().map(|()| scene)
            });
            let mut one = Finding::default();
            let Some(scene) = scene else { bail!("no scene of these seeds moves") };
            let name = scene.name.clone();
            momenta(scene, steps, setup, &mut one)?;
            finding.absorb(&name, one);
        }
        finding.note(format!("{count} trees, {steps} steps each"));
        Ok(())
    }));
    let symplectic: [(&str, Make, Method, u64); 15] = [
        ("pendulum", || Ok(plants::scene("pendulum")), 0.05.into(), 1_000_000),
        ("double pendulum", || Ok(plants::scene("double-pendulum")), 0.01.into(), 1_000_000),
        ("spherical pendulum", || Ok(plants::scene("spherical-pendulum")), 0.01.into(), 1_000_000),
        ("tumbling bodies", tumbling, 0.01.into(), 1_000_000),
        ("chain of 12 rods", || Ok(plants::scene("chain-12")), 2e-3.into(), 1_000_000),
        ("four-bar linkage", || Ok(plants::scene("four-bar")), 0.01.into(), 1_000_000),
        ("scissor of 4", || Ok(plants::scene("scissor-4")), 2e-3.into(), 200_000),
        ("scissor of 16", || Ok(plants::scene("scissor-16")), 2e-3.into(), 20_000),
        ("marionette", || Ok(plants::undamped("marionette")), 5e-3.into(), 100_000),
        (
            "double pendulum",
            || Ok(plants::scene("double-pendulum")),
            Method::new(0.02, 4, 1),
            1_000_000,
        ),
        (
            "double pendulum",
            || Ok(plants::scene("double-pendulum")),
            Method::new(0.02, 12, 3),
            100_000,
        ),
        ("tree of 7", || Ok(plants::scene("tree-7")), Method::new(0.01, 6, 1), 100_000),
        ("tumbling bodies", tumbling, Method::new(0.02, 6, 1), 100_000),
        ("four-bar linkage", || Ok(plants::scene("four-bar")), Method::new(0.02, 8, 1), 100_000),
        ("marionette", || Ok(plants::undamped("marionette")), Method::new(0.01, 4, 2), 10_000),
    ];
    for (name, scene, method, long) in symplectic {
        let criterion = "|Aᵀ J A − J| on the tangent space ≤ 300 ε n |A|², all along the run";
        let run = move |setup: &Setup, finding: &mut Finding| {
            let steps = setup.pick((long / 100).max(500), long);
            finding.method = Some((method.order, method.substeps));
            symplectic_form(&scene()?, method, steps, finding)
        };
        let method = method.name();
        cases.push(Case::new(format!("symplectic: {name}{method}"), criterion, run));
    }
    let constrained: [(&str, Make, f64); 7] = [
        ("four-bar linkage", || Ok(plants::scene("four-bar")), 0.01),
        ("scissor of 4", || Ok(plants::scene("scissor-4")), 2e-3),
        ("scissor of 16", || Ok(plants::scene("scissor-16")), 2e-3),
        ("marionette, moved", || Ok(plants::scene("marionette")), 0.01),
        ("weld", || element(include_str!("../../../../models/scenes/elements/weld.toml")), 2e-3),
        ("hoist", || element(include_str!("../../../../models/scenes/elements/hoist.toml")), 5e-3),
        (
            "path length",
            || element(include_str!("../../../../models/scenes/elements/path-length.toml")),
            5e-3,
        ),
    ];
    for (name, scene, time_step_s) in constrained {
        let criterion =
            "violation of every constraint ≤ 1e-12 of the mechanism's size in every step";
        let run = move |setup: &Setup, finding: &mut Finding| {
            let long = if name.starts_with("marionette") { 100_000 } else { 1_000_000 };
            constraints(&scene()?, time_step_s, setup.pick(10_000, long), setup, finding)
        };
        cases.push(Case::new(format!("constraints: {name}"), criterion, run));
    }
    cases
}

fn element(text: &str) -> Result<Scene> {
    Ok(Scene::from_toml(text)?)
}

fn momenta(scene: Scene, steps: u64, setup: &Setup, finding: &mut Finding) -> Result<()> {
    let mut plant = pushed(&scene, 2e-3, 0.8)?;
    let of = |plant: &mut Plant| {
        let d = plant.diagnose();
        let [p, l, x] =
            [d.linear_momentum, d.angular_momentum, d.center_of_mass].map(Vector3::from);
        (p, l, x)
    };
    let (linear, angular, from) = of(&mut plant);
    let (mut drift, mut turn) = (0.0_f64, 0.0_f64);
    // Momenta of single bodies add up to those that are kept.
    let size = plant.p().iter().map(|p| p.abs()).sum::<f64>();
    let mut arm = 1.0_f64;
    let chunk = steps.div_ceil(20);
    for _ in 0..20 {
        coast(&mut plant, chunk)?;
        let (p, l, x) = of(&mut plant);
        arm = arm.max((x - from).norm());
        drift = drift.max((p - linear).norm());
        turn = turn.max((l - angular).norm());
    }
    let walk = 4.0 * f64::EPSILON * (steps as f64).sqrt();
    finding.at_most("linear", drift, walk * size);
    finding.at_most("angular", turn, walk * size * arm);
    let u = hold(&plant);
    finding.linearization(&plant, &u, setup.seed);
    Ok(())
}

/// The symplectic form of dynamic coordinates and momenta; `[−[p], 1; −1, 0]` in the axes of ball joints.
fn form(model: &Model, p: &[f64]) -> DMatrix<f64> {
    let n = p.len();
    let mut form = DMatrix::zeros(2 * n, 2 * n);
    for i in 0..n {
        form[(i, n + i)] = 1.0;
        form[(n + i, i)] = -1.0;
    }
    for &i in model.orientations().iter().filter(|&&i| i < n) {
        let p = Vector3::new(p[i], p[i + 1], p[i + 2]);
        form.view_mut((i, i), (3, 3)).copy_from(&-p.cross_matrix());
    }
    form
}

fn symplectic_form(scene: &Scene, method: Method, steps: u64, finding: &mut Finding) -> Result<()> {
    const SAMPLES: u64 = 50;
    let mut plant = pushed(scene, method, 0.5)?;
    let model = plant.model().clone();
    let (d, n) = (model.dimensions(), model.dimensions().dynamic);
    let rows: Vec<usize> = (0..n).chain(d.coordinates()..d.coordinates() + n).collect();
    let mut out = Linearization::new(&model);
    let u = hold(&plant);
    let (mut worst, mut bound) = (0.0_f64, f64::INFINITY);
    for _ in 0..SAMPLES {
        coast(&mut plant, steps / SAMPLES)?;
        let mut tangent = DMatrix::identity(2 * n, 2 * n);
        if let Some(kept) = derivatives::tangent(&mut plant) {
            tangent.view_mut((0, 0), (n, n)).copy_from(&kept);
        }
        let before = form(&model, plant.p());
        plant.step_and_linearize(&u, &mut out)?;
        let after = form(&model, plant.p());
        let a = out.a().select_rows(&rows).select_columns(&rows) * &tangent;
        let defect = (a.transpose() * after * &a - tangent.transpose() * before * &tangent).amax();
        let allowed = 300.0 * f64::EPSILON * n as f64 * a.amax().max(1.0).powi(2);
        if !(defect / allowed <= worst / bound) {
            (worst, bound) = (defect, allowed);
        }
    }
    finding.note(format!("{steps} steps"));
    finding.at_most("defect", worst, bound);
    Ok(())
}

fn constraints(
    scene: &Scene,
    time_step_s: f64,
    steps: u64,
    setup: &Setup,
    finding: &mut Finding,
) -> Result<()> {
    let mut plant = plants::plant(scene, time_step_s)?;
    let (model, d) = (plant.model().clone(), plant.model().dimensions());
    let geometry = Geometry::new(&model);
    let mut worst = 0.0_f64;
    let mut u = hold(&plant);
    for k in 0..steps {
        // Slow enough for every mechanism, and never at rest.
        let wave = |i: usize| (0.7 * k as f64 * time_step_s + i as f64).sin() - (i as f64).sin();
        for (i, u) in u.iter_mut().enumerate() {
            *u = match i.checked_sub(d.inputs) {
                None => 0.3 * wave(i),
                Some(k) => model.coordinates()[d.dynamic + k].initial + 0.03 * wave(i),
            };
        }
        step(&mut plant, &u)?;
        let violation = geometry.violation(plant.q());
        worst = if violation <= worst { worst } else { violation };
    }
    finding.note(format!("{steps} steps"));
    finding.at_most("violation", worst, 1e-12);
    finding.linearization(&plant, &u, setup.seed);
    Ok(())
}
