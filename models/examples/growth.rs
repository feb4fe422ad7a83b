//! How the time of a step, of A and B, of products with them, and the memory of a plant grow with a rope in space that
//! has what sends other programs to dense matrices: a top that is moved, a ball joint, and a spring from its tip to the
//! world.
//!
//! `cargo run --release -p plantd-models --example growth`; in place of the spring to the world, with `-- braced`
//! springs all along, each over two of the joints, with `-- tied` an elastic tendon over five rods, with `-- geared` a
//! rotor behind three joints, with `-- pinned` a tip that is held where it is, with `-- dragged` one that goes with a
//! hook as it is moved, and with `-- welded` one whose rod is held.

use std::error::Error;
use std::f64::consts::TAU;
use std::hint::black_box;
use std::sync::Arc;

use plantd_models::{
    Initial, Layout, Linearization, Model, Plant, Scene, Settings, Spare, StepDerivative, StepError,
};

/// Joints; the ball joint has three.
const SIZES: [usize; 4] = [64, 128, 256, 512];

/// Thin rods, 1 m and 1 kg together, hinged about x and y by turns below a slide that is moved. The last one has a ball
/// joint.
fn rope(joints: usize, kind: &str) -> Result<Scene, Box<dyn Error>> {
    let rods = joints - 2;
    let length = 1.0 / rods as f64;
    let across = length.powi(3) / 12.0;
    let mut text = format!(
        "format = 1\nname = \"rope\"\ngravity = [0.0, 0.0, -9.8]\ntime_step_s = {}\n",
        0.04 * length
    );
    for i in 0..rods {
        let (parent, z) =
            if i == 0 { ("world".to_owned(), 0.0) } else { (format!("rod{}", i - 1), -length) };
        let joint = match i {
            0 => "type = \"prismatic\", axis = [0.0, 1.0, 0.0]",
            _ if i + 1 == rods => "type = \"ball\"",
            _ if i % 2 == 0 => "type = \"revolute\", axis = [1.0, 0.0, 0.0]",
            _ => "type = \"revolute\", axis = [0.0, 1.0, 0.0]",
        };
        let center = -0.5 * length;
        let along = 0.1 * across;
        text += &format!(
            "[[frames]]\nname = \"rod{i}\"\nparent = \"{parent}\"\ntranslation = [0.0, 0.0, {z}]\n\
             joint = {{ {joint} }}\nbody = {{ mass = {length}, center_of_mass = [0.0, 0.0, {center}], \
             inertia = [{across}, {across}, {along}] }}\n"
        );
    }
    text += "[[coordinates]]\nname = \"rod0\"\nkind = \"prescribed\"\n\
             [[coordinates]]\nname = \"rod1\"\ninitial = 0.2\n\
             [[coordinates]]\nname = \"rod2\"\ninitial = 0.2\n";
    let spring = |rod: usize, end: &str| {
        format!(
            "[[springs]]\ntype = \"two_point\"\na = {{ frame = \"rod{rod}\" }}\n\
             b = {{ {end} }}\nstiffness = 2.0\n"
        )
    };
    match kind {
        "braced" => (3..rods).step_by(2).for_each(|rod| {
            text += &spring(rod, &format!("frame = \"rod{}\", at = [0.01, 0.02, 0.0]", rod - 2));
        }),
        "tied" => {
            let rods = [1, rods / 4, rods / 2, 3 * rods / 4, rods - 1];
            let points =
                rods.map(|rod| format!("{{ frame = \"rod{rod}\", at = [0.02, 0.0, 0.0] }}"));
            text += &format!(
                "[[springs]]\ntype = \"path\"\npoints = [{}]\nstiffness = 2.0\nrest_length = 0.9\n",
                points.join(", ")
            );
        }
        "geared" => {
            let rods = [1, rods / 2, rods - 2];
            let terms =
                rods.map(|rod| format!("{{ coordinate = \"rod{rod}\", coefficient = 1.0 }}"));
            text += &format!("[[armatures]]\narmature = 0.001\nterms = [{}]\n", terms.join(", "));
        }
        "pinned" | "dragged" | "welded" => {
            text +=
                "[[frames]]\nname = \"hook\"\nparent = \"world\"\ntranslation = [0.1, 0.2, -0.8]\n";
            if kind == "dragged" {
                text += "joint = { type = \"prismatic\", axis = [0.0, 1.0, 0.0] }\n\
                         [[coordinates]]\nname = \"hook\"\nkind = \"prescribed\"\n";
            }
            let tip = rods - 1;
            text += "[[constraints]]\nname = \"tip\"\n";
            text += &match kind {
                "welded" => format!("type = \"weld\"\na = \"rod{tip}\"\nb = \"hook\"\n"),
                _ => format!(
                    "type = \"point_to_point\"\naxes = [\"x\", \"y\", \"z\"]\n\
                     a = {{ frame = \"rod{tip}\" }}\nb = {{ frame = \"hook\" }}\n"
                ),
            };
        }
        _ => text += &spring(rods - 1, "frame = \"world\", at = [0.0, 0.0, -1.2]"),
    }
    Ok(Scene::from_toml(&text)?)
}

/// How far the top, and what else is moved, is at the end of the next step, m.
fn moved(plant: &Plant) -> f64 {
    0.02 * (3.0 * plant.time_s()).sin()
}

/// The shortest of several times of a call, from the same start, µs.
fn shortest_us(
    plant: &mut Plant,
    calls: u32,
    mut call: impl FnMut(&mut Plant, &[f64]) -> Result<(), StepError>,
) -> Result<f64, Box<dyn Error>> {
    let (start, mut best) = (plant.snapshot(), f64::INFINITY);
    let mut u = vec![0.0; plant.model().dimensions().input()];
    for _ in 0..9 {
        plant.restore(&start)?;
        let begin = cpu_time_s();
        for _ in 0..calls {
            u.fill(moved(plant));
            call(plant, &u)?;
        }
        best = best.min((cpu_time_s() - begin) * 1e6 / f64::from(calls));
    }
    Ok(best)
}

/// CPU time of this thread: other programs on the machine do not count.
fn cpu_time_s() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// Resident memory of this process, KiB.
fn resident() -> Result<f64, Box<dyn Error>> {
    let text = std::fs::read_to_string("/proc/self/status")?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")).ok_or("no VmRSS")?;
    Ok(line.trim().trim_end_matches(" kB").parse()?)
}

/// The slope of the logarithms of numbers over those of sizes.
fn exponent(numbers: &[f64]) -> f64 {
    let points: Vec<[f64; 2]> =
        SIZES.iter().zip(numbers).map(|(n, y)| [(*n as f64).ln(), y.ln()]).collect();
    let mean = |k: usize| points.iter().map(|p| p[k]).sum::<f64>() / points.len() as f64;
    let [x, y] = [mean(0), mean(1)];
    let over = points.iter().map(|p| (p[0] - x) * (p[1] - y)).sum::<f64>();
    over / points.iter().map(|p| (p[0] - x).powi(2)).sum::<f64>()
}

fn main() -> Result<(), Box<dyn Error>> {
    let kind = std::env::args().nth(1).unwrap_or_default();
    let mut all: [Vec<f64>; 6] = Default::default();
    println!(
        "µs       step   + A and B   + derivative as map   a product   transposed   plant, KiB"
    );
    for joints in SIZES {
        let model = Arc::new(Model::compile(&rope(joints, &kind)?)?);
        let settings = Settings::new(&model);
        let d = model.dimensions();
        let spare = Spare::new(Arc::clone(&model), settings)?;
        let mut plant = if d.constraints == 0 {
            spare.start(&Initial::Scene)?
        } else {
            // A bent rope, whose tip goes where it is held.
            let bent = |i: usize| match kind.as_str() {
                _ if i >= d.dynamic => 0.0,
                // Upright at its end.
                "welded" => 8.0 / joints as f64 * (TAU * i as f64 / d.dynamic as f64).sin(),
                _ => 4.0 / joints as f64,
            };
            let q = (0..d.coordinates()).map(bent).collect();
            spare.start(&Initial::Projection { q, hold: Vec::new() })?
        };
        // The first steps from rest need more corrections, the more joints there are.
        for _ in 0..100 {
            plant.step(&vec![moved(&plant); d.input()])?;
        }

        let count = 16;
        let before = resident()?;
        let plants: Vec<Plant> = (0..count).map(|_| plant.clone()).collect();
        let memory = (resident()? - before) / f64::from(count);
        drop(black_box(plants));

        let step = shortest_us(&mut plant, 100, |plant, u| plant.step(u).map(drop))?;
        let mut out = Linearization::new(&model);
        let (mut a, mut b) = (vec![0.0; d.state() * d.state()], vec![0.0; d.state() * d.input()]);
        let linearized = shortest_us(&mut plant, 20, |plant, u| {
            plant.step_and_linearize(u, &mut out)?;
            out.a_into(&mut a, Layout::Columns);
            out.b_into(&mut b, Layout::Columns);
            black_box((&a, &b));
            Ok(())
        })?;
        let mut map = StepDerivative::new(&model);
        let differentiated = shortest_us(&mut plant, 100, |plant, u| {
            plant.step_and_differentiate(u, &mut map).map(drop)
        })?;
        let x: Vec<f64> = (0..d.state()).map(|i| (i as f64).sin()).collect();
        let (mut next, mut by_u) = (vec![0.0; d.state()], vec![0.0; d.input()]);
        let pushed = shortest_us(&mut plant, 1000, |_, u| {
            map.push_forward(black_box(&x), u, &mut next);
            black_box(&next);
            Ok(())
        })?;
        let pulled = shortest_us(&mut plant, 1000, |_, _| {
            map.pull_back(black_box(&x), &mut next, &mut by_u);
            black_box((&next, &by_u));
            Ok(())
        })?;
        println!(
            "{joints:4} {step:8.1} {linearized:11.1} {differentiated:21.1} {pushed:11.2} {pulled:12.2} {memory:12.0}"
        );
        let row = [step, linearized, differentiated, pushed, pulled, memory];
        all.iter_mut().zip(row).for_each(|(all, own)| all.push(own));
    }
    let [step, linearized, differentiated, pushed, pulled, memory] =
        all.map(|numbers| exponent(&numbers));
    println!(
        "n^{step:10.2} {linearized:11.2} {differentiated:21.2} {pushed:11.2} {pulled:12.2} {memory:12.2}"
    );
    Ok(())
}
