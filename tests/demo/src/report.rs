//! What the demo prints: numbers beside those of the paper, in at most 100 columns.

use crate::latency::RoundTrips;
use crate::{marionette, pendulum};

/// Largest offset from upright, rad, and error norm at which a run counts as settled.
const SETTLED: f64 = 1e-3;

/// Comparisons made so far.
#[derive(Default)]
pub(crate) struct Table {
    good: usize,
    off: usize,
}

impl Table {
    /// All numbers were as they should be.
    pub(crate) fn is_good(&self) -> bool {
        self.off == 0
    }

    pub(crate) fn verdict(&self) -> String {
        let all = self.good + self.off;
        match self.off {
            0 => format!("all {all} numbers are as they should be"),
            off => format!("{off} OF {all} NUMBERS ARE OFF"),
        }
    }

    fn header(&self) {
        println!("   {:38}{:>22}{:>22}{:>11}", "", "here", "paper", "difference");
    }

    /// A number beside the one that it must reproduce to a relative tolerance.
    fn compare(&mut self, name: &str, here: f64, paper: f64, tolerance: f64) {
        let difference = (here / paper - 1.0).abs();
        let mark = self.mark(difference <= tolerance);
        let difference =
            if difference == 0.0 { "0".to_owned() } else { format!("{difference:.0e}") };
        println!("   {name:38}{here:>22.15}{paper:>22.15}{difference:>11} {mark}");
    }

    /// A count beside the one that it must equal.
    fn compare_count(&mut self, name: &str, here: u32, paper: u32) {
        let mark = self.mark(here == paper);
        println!("   {name:38}{here:>22}{paper:>22}{:>11} {mark}", "");
    }

    /// A statement that must hold.
    fn state(&mut self, name: &str, value: &str, holds: bool) {
        let mark = self.mark(holds);
        println!("   {name:38}{value:>55} {mark}");
    }

    fn mark(&mut self, good: bool) -> &'static str {
        if good {
            self.good += 1;
            "ok"
        } else {
            self.off += 1;
            "OFF"
        }
    }
}

fn section(title: &str, pids: &[u32]) {
    let pids: Vec<_> = pids.iter().map(u32::to_string).collect();
    println!();
    println!("{title} (by process {})", pids.join(", "));
}

pub(crate) fn pendulum(table: &mut Table, pid: u32, report: &pendulum::Report) {
    section("1  The paper's pendulum, over gRPC", &[pid]);
    table.header();
    // One step of 0.1 s from θ = 0.2, p = 0.5 with torque 0.8. The paper prints six to eight digits;
    // these are its reference implementation's.
    table.compare("one step: θ, rad", report.theta, 0.247_136_194_155_571_6, 1e-12);
    table.compare("          p, kg·m²/s", report.p, 0.362_723_883_111_432_1, 1e-12);
    let paper = [
        ("A  ∂θ/∂θ", report.a[0], 0.953_334_338_555_231_6),
        ("   ∂θ/∂p", report.a[1], 0.097_666_716_927_761_58),
        ("   ∂p/∂θ", report.a[2], -0.933_313_228_895_366_7),
        ("   ∂p/∂p", report.a[3], 0.953_334_338_555_231_6),
        ("B  ∂θ/∂u", report.b[0], 0.009_766_671_692_776_159),
        ("   ∂p/∂u", report.b[1], 0.095_333_433_855_523_18),
    ];
    for (name, here, paper) in paper {
        table.compare(name, here, paper, 1e-12);
    }
    table.compare_count("controllability rank", report.controllability_rank, 2);

    println!();
    let gain: Vec<_> = report.gain.iter().map(|k| format!("{k:.4}")).collect();
    println!(
        "   LQR about upright, step {} s, Q = diag(100, 1), R = 1: K = [{}]",
        pendulum::TIME_STEP_S,
        gain.join(", ")
    );
    let radius = report.spectral_radius;
    table.state("spectral radius of the closed loop", &format!("{radius:.6} < 1"), radius < 1.0);
    let settled = |angles: &[f64]| angles.last().is_some_and(|angle| angle.abs() < SETTLED);
    let end =
        |angles: &[f64]| format!("{:+.1e} rad from upright at the end", angles[angles.len() - 1]);
    let disturbance =
        format!("{} rad off, {} N·m push at 3 s", pendulum::OFFSET_RAD, pendulum::PUSH_N_M);
    table.state(&disturbance, &end(&report.regulated), settled(&report.regulated));
    table.state("the same without feedback", "falls", !settled(&report.unregulated));
}

pub(crate) fn marionette(table: &mut Table, pid: u32, report: &marionette::Report) {
    section("2  The marionette, over shared memory", &[pid]);
    println!(
        "   {} dynamic and {} prescribed coordinates, {} constraints, {} states; step {} s, {:.0} s",
        report.dynamic,
        report.prescribed,
        report.constraints,
        2 * (report.dynamic + report.prescribed),
        marionette::TIME_STEP_S,
        report.open_loop.error_norms.len() as f64 * marionette::TIME_STEP_S,
    );
    println!(
        "   reference motion, linearization along it, and LQR by the server: {:.2} s in all",
        report.solve_s
    );
    println!();
    table.header();
    let sum = |run: &marionette::Run| run.error_norms.iter().sum::<f64>();
    table.compare("‖K₀‖, Frobenius", report.first_gain_norm, 3.898_428_610_873_976, 1e-9);
    table.compare("Σ ‖q − q_ref‖, open loop", sum(&report.open_loop), 52.214_878_681_008_35, 1e-8);
    table.compare(
        "Σ ‖q − q_ref‖, closed loop",
        sum(&report.closed_loop),
        17.730_391_012_395_955,
        1e-8,
    );
}

pub(crate) fn round_trips(pids: [u32; 3], links: &[(&str, &RoundTrips)]) {
    section("3  Round trips, µs: input out, step, state back", &pids);
    println!("   {:38}{:>12}{:>12}{:>12}{:>12}", "", "p50", "p99", "p99.9", "steps");
    for (name, RoundTrips { p50_us, p99_us, p999_us, steps }) in links {
        println!("   {name:38}{p50_us:>12.1}{p99_us:>12.1}{p999_us:>12.1}{steps:>12}");
    }
}
