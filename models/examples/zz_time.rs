use plantd_models::{Linearization, Model, Plant, Scene, Settings};
use std::sync::Arc;
fn cpu() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    t.tv_sec as f64 + 1e-9 * t.tv_nsec as f64
}
fn main() {
    for path in std::env::args().skip(1) {
        let scene = Scene::from_toml(&std::fs::read_to_string(&path).unwrap()).unwrap();
        let model = Arc::new(Model::compile(&scene).unwrap());
        if std::env::var("PLAN").is_ok() {
            println!("{}", model.plan());
        }
        let mut plant = Plant::new(model.clone(), Settings::new(&model)).unwrap();
        let d = model.dimensions();
        let mut u = vec![0.0; d.input()];
        plant.hold_input(&mut u);
        let start = plant.clone();
        let (mut best, mut lin) = (f64::MAX, f64::MAX);
        let mut its = 0;
        let mut fac = 0;
        let n = 200;
        for pass in 0..40 {
            plant = start.clone();
            let b = cpu();
            for k in 0..n {
                for i in 0..d.inputs {
                    u[i] = if std::env::var("ROUGH").is_ok() {
                        20.0 * ((k * 7 + i * 3) as f64).sin()
                    } else {
                        10.0 + i as f64
                    };
                }
                let r = plant.step(&u).unwrap();
                if pass == 0 {
                    its += r.iterations;
                    fac += r.factorizations;
                }
            }
            best = best.min(cpu() - b);
            if pass == 0 {
                println!(
                    "q {:?} iter {} fact {}",
                    &plant.q()[..6.min(plant.q().len())],
                    its as f64 / n as f64,
                    fac as f64 / n as f64
                );
            }
            plant = start.clone();
            let mut out = Linearization::new(&model);
            let b = cpu();
            for _ in 0..n / 4 {
                plant.step_and_linearize(&u, &mut out).unwrap();
            }
            lin = lin.min(cpu() - b);
        }
        println!(
            "{path} step {:.3} us, with linearization {:.3}",
            best * 1e6 / n as f64,
            lin * 1e6 / (n / 4) as f64
        );
    }
}
