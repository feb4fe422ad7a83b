"""Measures plantd and other engines in one run, alternating: python3 tests/peers/compare.py

See README.md beside this file.
"""

import argparse
import csv
import importlib.util
import json
import math
import os
import pathlib
import platform
import statistics
import subprocess
import sys
import time
from typing import NamedTuple

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parents[1]
TARGET = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "peers"
PACKAGES = ["numpy", "scipy", "matplotlib", "mujoco", "pin", "cmeel-eigen", "example-robot-data"]
PACKAGES += ["casadi", "drake"]

sys.path.insert(0, str(HERE))
import mechanisms  # noqa: E402


def say(text):
    print(text, file=sys.stderr, flush=True)


def enter_environment(script=__file__):
    """Makes the environment if it is not there, and goes on in it."""
    python = TARGET / "venv" / "bin" / "python"
    if pathlib.Path(sys.executable) == python:
        return
    marker = TARGET / "venv" / "installed"
    if not marker.exists():
        subprocess.run([sys.executable, "-m", "venv", TARGET / "venv"], check=True)
        for package in PACKAGES:
            say(f"installing {package}")
            done = subprocess.run([python, "-m", "pip", "install", "--quiet", package])
            if done.returncode:
                say(f"{package} does not install here: compared without it")
        marker.touch()
    os.execv(python, [python, script, *sys.argv[1:]])


# Drivers


class Driver:
    """A process that runs mechanisms on command; see drivers/driver.h."""

    def __init__(self, command, suffix):
        self.suffix = suffix
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
        if hasattr(os, "sched_setaffinity"):
            # All on one processor: on two the same program differs by up to 1.4, for minutes.
            os.sched_setaffinity(self.process.pid, {max(os.sched_getaffinity(0))})

    def ask(self, name, method, dt, steps, passes=1):
        """CPU seconds and the last configuration."""
        path = model_file(name, self.suffix)
        print(path, method, repr(dt), steps, passes, file=self.process.stdin, flush=True)
        words = self.process.stdout.readline().split()
        if not words or words[0] == "error:":
            raise RuntimeError(" ".join(words[1:]) or "the driver has ended")
        numbers = [float(word) for word in words]
        return numbers[0], numbers[1:]


def model_file(name, suffix):
    """The mechanism in a peer's format, written or compiled if it is not there, or is of what these scripts were."""
    path = TARGET / "build" / f"{name}{suffix}"
    if not is_old(path, HERE / "mechanisms.py", HERE / "straight_line.py"):
        return path
    if suffix == ".so":
        source = path.with_suffix(".c")
        derivatives = ["euler-ab"] if name in STRAIGHT_LINE_DERIVATIVES else []
        run([sys.executable, HERE / "straight_line.py", name, source, *derivatives])
        run(["gcc", "-O3", "-march=native", "-shared", "-fPIC", "-o", path, source, "-lm"])
        return path
    write = {".json": json.dumps, ".txt": mechanisms.text, ".xml": mechanisms.mjcf}[suffix]
    path.write_text(write(mechanisms.named(name)))
    return path


def run(command):
    say(" ".join(map(str, command)))
    subprocess.run(command, check=True)


def is_old(path, *sources):
    return not path.exists() or any(s.stat().st_mtime > path.stat().st_mtime for s in sources)


def package_folder(name):
    return pathlib.Path(importlib.util.find_spec(name).origin).parent


def start_plantd():
    build = ["cargo", "build", "--quiet", "--release", "--locked", "-p", "plantd-models"]
    subprocess.run([*build, "--example", "peer"], cwd=ROOT, check=True)
    return Driver([TARGET.parent / "release" / "examples" / "peer"], ".json")


def start_mujoco():
    folder = package_folder("mujoco")
    program, source = TARGET / "build" / "mujoco", HERE / "drivers" / "mujoco.c"
    if is_old(program, source, source.with_name("driver.h")):
        [library] = folder.glob("libmujoco.so.*")
        flags = ["-O3", "-march=native", f"-I{folder}/include", f"-Wl,-rpath,{folder}"]
        run(["gcc", *flags, "-o", program, source, library])
    return Driver([program], ".xml")


def start_pinocchio():
    include = package_folder("pinocchio").parents[3] / "include"
    program, source = TARGET / "build" / "pinocchio", HERE / "drivers" / "pinocchio.cpp"
    if is_old(program, source, source.with_name("driver.h")):
        flags = ["-std=c++17", "-w", "-O3", "-march=native", "-DNDEBUG"]
        flags += ["-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS"]
        flags += ["-DBOOST_FUSION_INVOKE_MAX_ARITY=12"]
        flags += [f"-I{include}", f"-I{include}/eigen3", f"-I{program.parent}"]
        run(["g++", *flags, "-o", program, source])
    return Driver([program], ".txt")


def write_dop853(path):
    from scipy.integrate._ivp import dop853_coefficients as pair

    numbers = lambda row: "{" + ", ".join(float(x).hex() for x in row) + "}"
    rows = ", ".join(numbers(row[:12]) for row in pair.A[:12])
    lines = [f"static const double DOP853_A[12][12] = {{{rows}}};"]
    for name, row in [("B", pair.B), ("E3", pair.E3), ("E5", pair.E5)]:
        lines.append(f"static const double DOP853_{name}[{len(row)}] = {numbers(row)};")
    path.write_text("\n".join(lines) + "\n")


def start_casadi():
    import casadi  # noqa: F401

    program, source = TARGET / "build" / "casadi", HERE / "drivers" / "casadi.c"
    if is_old(program, source, source.with_name("driver.h")):
        flags = ["-O3", "-march=native", f"-I{program.parent}"]
        run(["gcc", *flags, "-o", program, source, "-ldl", "-lm"])
    return Driver([program], ".so")


def start_drake():
    if importlib.util.find_spec("pydrake") is None:
        raise ModuleNotFoundError("pydrake")
    return Driver([sys.executable, HERE / "drivers" / "drake_plant.py"], ".json")


START = {
    "plantd": start_plantd,
    "Pinocchio": start_pinocchio,
    "MuJoCo": start_mujoco,
    "CasADi C": start_casadi,
    "Drake": start_drake,
}
# Hinges alone, and no more of them than a compiler takes in a few minutes.
STRAIGHT_LINE = ["P", "D", "S", "C4", "C8", "C32", "T7", "T15", "T30", "panda", "g1-fixed"]
STRAIGHT_LINE_DERIVATIVES = ["P", "D", "S", "C8", "T7", "T15", "T30", "panda"]


def start_drivers():
    (TARGET / "build").mkdir(parents=True, exist_ok=True)
    if not (header := TARGET / "build" / "dop853.h").exists():
        write_dop853(header)
    drivers = {}
    for name, start in START.items():
        try:
            drivers[name] = start()
        except (ImportError, AttributeError, OSError, subprocess.CalledProcessError) as error:
            say(f"compared without {name}: {error}")
    return drivers


# Time per call

# A pass is short, so that no method leaves the motion that all of them follow.
STEPS = 50
BATCH_SECONDS = 0.004
PLANTD = ("plantd", "midpoint")
PLANTD_AB = ("plantd", "midpoint-ab")
BY_HAND = ("plantd", "scalar")

STEP_METHODS = [
    PLANTD,
    BY_HAND,
    ("CasADi C", "euler"),
    ("Pinocchio", "euler"),
    ("Pinocchio", "rk4"),
    ("MuJoCo", "euler"),
    ("MuJoCo", "implicitfast"),
    ("MuJoCo", "rk4"),
    ("Drake", "discrete"),
]
AB_METHODS = [
    PLANTD_AB,
    ("CasADi C", "euler-ab"),
    ("Pinocchio", "euler-ab"),
    ("MuJoCo", "euler-ab"),
]
# Arms, floating robots and ball joints: motions of 2 ms steps, also with torques that change at each of them.
ROBOTS = ["panda", "g1-fixed", "go1", "anymal", "g1", "talos", "go1-feet", "stewart", "B7", "B15", "K8"]
ROBOT_METHODS = [
    PLANTD,
    ("CasADi C", "euler"),
    ("Pinocchio", "euler"),
    ("MuJoCo", "euler"),
    ("plantd", "midpoint-rough"),
    ("CasADi C", "euler-rough"),
    ("Pinocchio", "euler-rough"),
    ("MuJoCo", "euler-rough"),
    PLANTD_AB,
    ("CasADi C", "euler-ab"),
    ("Pinocchio", "euler-ab"),
]
# plantd's method beside a peer's.
ROBOT_RATIOS = [
    (PLANTD, ("Pinocchio", "euler")),
    (PLANTD, ("MuJoCo", "euler")),
    (("plantd", "midpoint-rough"), ("Pinocchio", "euler-rough")),
    (PLANTD_AB, ("Pinocchio", "euler-ab")),
    (PLANTD, ("CasADi C", "euler")),
    (("plantd", "midpoint-rough"), ("CasADi C", "euler-rough")),
    (PLANTD_AB, ("CasADi C", "euler-ab")),
]
TABLE = ["P", "D", "S", "L"]
TABLE += [f"C{2**k}" for k in range(8)] + ["T7", "T15", "T30", "T63", "Z32", "Z128"]
GROWTH = ["H128", "H256", "H512", "H1024"]

# Mechanism, what plantd is compared with, and the ratio that is aimed at.
STEP_GOALS = [(name, ("Pinocchio", "rk4"), 0.25) for name in ("C8", "C32", "C128")]
STEP_GOALS += [(name, ("MuJoCo", "euler"), 1.0) for name in ("C8", "C32", "C128")]
STEP_GOALS += [("T30", ("Pinocchio", "rk4"), 0.3), ("T30", ("MuJoCo", "euler"), 1.5)]
AB_GOALS = [(name, ("Pinocchio", "euler-ab"), 0.6) for name in ("C8", "C32", "T30", "Z32", "Z128")]
AB_GOALS += [("C8", ("CasADi C", "euler-ab"), 1.2), ("T30", ("CasADi C", "euler-ab"), 0.4)]
AB_GOALS += [(name, ("MuJoCo", "euler-ab"), 0.1) for name in ("C8", "C32", "T30")]


def time_step(name):
    """0.01 s; shorter for robots, and for long chains, whose links swing faster."""
    if name in ROBOTS:
        return 0.002
    return min(0.01, 0.08 / int(name[1:])) if name[0] in "CHZ" else 0.01


def applies(name, method):
    driver, what = method
    if method == BY_HAND:
        return name == "P"
    if driver == "CasADi C":
        return name in (STRAIGHT_LINE_DERIVATIVES if what == "euler-ab" else STRAIGHT_LINE)
    if name in ROBOTS:
        return driver in ("plantd", "Pinocchio", "MuJoCo")
    if name == "L":
        return driver in ("plantd", "MuJoCo")
    return True


def alternate(drivers, name, methods, rounds):
    """Microseconds per call by method, one number per round."""
    dt, passes = time_step(name), {}
    for method in methods:
        if method[0] not in drivers or not applies(name, method):
            continue
        try:
            seconds, _ = drivers[method[0]].ask(name, method[1], dt, STEPS)
            passes[method] = max(1, round(BATCH_SECONDS / seconds))
            drivers[method[0]].ask(name, method[1], dt, STEPS, passes[method])
        except RuntimeError as error:
            say(f"{name}: no {' '.join(method)}: {error}")
    times = {method: [] for method in passes}
    for _ in range(rounds):
        for method, count in passes.items():
            seconds, _ = drivers[method[0]].ask(name, method[1], dt, STEPS, count)
            times[method].append(seconds * 1e6 / (count * STEPS))
    return times


def ratio(times, method, other):
    return statistics.median(a / b for a, b in zip(times[method], times[other]))


def measure_calls(drivers, names, methods, rounds):
    measured = {}
    for name in names:
        measured[name] = alternate(drivers, name, methods, rounds)
        row = {" ".join(m): f"{statistics.median(t):.3g}" for m, t in measured[name].items()}
        say(f"{name}: {row}")
    return measured


def table_of_calls(measured, methods):
    names = list(measured)
    lines = ["| µs per call | " + " | ".join(names) + " |"]
    lines.append("| --- |" + " ---: |" * len(names))
    for method in methods:
        cells = [measured[name].get(method) for name in names]
        if any(cells):
            cells = [f"{statistics.median(cell):.3g}" if cell else "" for cell in cells]
            lines.append(f"| {' '.join(method)} | " + " | ".join(cells) + " |")
    return lines


def table_of_robots(measured):
    own = lambda method: " ".join(method)
    lines = ["| | " + " | ".join(f"{own(a)} / {own(b)}" for a, b in ROBOT_RATIOS) + " | difference |"]
    lines.append("| --- |" + " ---: |" * (len(ROBOT_RATIOS) + 1))
    for name, (times, difference) in measured.items():
        cells = [f"{ratio(times, *pair):.2f}" if all(m in times for m in pair) else "" for pair in ROBOT_RATIOS]
        lines.append(f"| {name} | " + " | ".join([*cells, f"{difference:.0e}"]) + " |")
    return lines


def measure_robots(drivers, names, rounds):
    """Times by method, and the largest difference of coordinates from the peers' after 0.1 s."""
    measured = {}
    for name in names:
        [(_, times)] = measure_calls(drivers, [name], ROBOT_METHODS, rounds).items()
        ends = []
        for driver, method in [("plantd", "order-4"), ("CasADi C", "rk4"), ("Pinocchio", "rk4"), ("MuJoCo", "rk4")]:
            if driver in drivers and applies(name, (driver, method)):
                ends.append(coordinates(name, driver, drivers[driver].ask(name, method, 1e-3, 100)[1]))
        measured[name] = times, max(error_of(q, ends[0]) for q in ends)
    return measured


def coordinates(name, driver, numbers):
    """With rotation vectors in place of quaternions."""
    if driver == "plantd":
        return numbers
    own, at = [], 0
    for b in mechanisms.named(name)["bodies"]:
        size = mechanisms.SIZES[mechanisms.joint_type(b)]
        if size > 1:
            own += numbers[at : at + size - 3]
            at += size - 3
            w, *v = numbers[at : at + 4] if driver == "MuJoCo" else [numbers[at + 3], *numbers[at : at + 3]]
            length = math.hypot(*v)
            angle = 2 * math.atan2(length, w)
            angle -= 2 * math.pi if angle > math.pi else 0
            own += [x / length * angle if length else 0.0 for x in v]
            at += 4
        else:
            own.append(numbers[at])
            at += 1
    return own


def table_of_goals(steps, derivatives):
    lines = ["| plantd's | mechanism | compared with | ratio | goal | |", "| --- | --- | --- | ---: | ---: | --- |"]
    for what, measured, own, goals in [
        ("step", steps, PLANTD, STEP_GOALS),
        ("step, A and B", derivatives, PLANTD_AB, AB_GOALS),
    ]:
        for name, other, goal in goals:
            times = measured.get(name, {})
            if own not in times or other not in times:
                continue
            value = ratio(times, own, other)
            verdict = "met" if value <= goal else "missed"
            lines.append(f"| {what} | {name} | {' '.join(other)} | {value:.3g} | {goal} | {verdict} |")
    if BY_HAND in steps.get("P", {}):
        value = ratio(steps["P"], PLANTD, BY_HAND)
        lines.append(f"| step | P | the same map by hand | {value:.1f} | | |")
    return lines


def exponent(times):
    """Slope of the logarithm of time over that of size."""
    import numpy as np

    sizes = [math.log(int(name[1:])) for name in times]
    return np.polyfit(sizes, [math.log(t) for t in times.values()], 1)[0]


def measure_growth(plantd):
    """plantd's exponents over long chains, of steps after the first."""
    exponents = {}
    moving = {"step": "midpoint-moving", "step, A and B": "midpoint-ab-moving"}
    for what, method in moving.items():
        times = {}
        for name in GROWTH:
            times[name] = repeated(plantd, name, method, time_step(name), STEPS + 1)[0] / STEPS
        row = ", ".join(f"{name} {t * 1e6:.0f} µs" for name, t in times.items())
        exponents[what] = exponent(times)
        say(f"{what}: {row}, exponent {exponents[what]:.2f}")
        yield f"| {what} | {exponents[what]:.2f} | {row} |"


# Run time against error

ERRORS = [1e-2, 1e-4, 1e-6, 1e-8, 1e-10]
CASES = [("P", 2), ("P", 10), ("D", 2), ("D", 10), ("S", 2), ("S", 10), ("C4", 2)]
ROBOT_CASES = [("panda", 1), ("go1", 1), ("g1", 1), ("B7", 1), ("go1-feet", 0.2), ("stewart", 0.5)]
PRECISIONS = ("", "-fast", "-coarse")
HIGH_ORDERS = [("plantd", f"order-{order}{to}") for order in (4, 6, 8, 12, 16) for to in PRECISIONS]
FIXED_STEP = [PLANTD, *HIGH_ORDERS]
FIXED_STEP += [m for m in STEP_METHODS if m[0] not in ("plantd", "CasADi C")] + [("CasADi C", "rk4")]
ADAPTIVE = [("Pinocchio", "dop853"), ("CasADi C", "dop853"), ("Drake", "rk3"), ("Drake", "rk5")]
# Code of one mechanism is compared by itself.
ENGINES = ["Pinocchio", "MuJoCo", "Drake"]
LONGEST_SECONDS = 0.2
# How many of the fastest, on each side, are asked again by turns.
CANDIDATES = 4


def error_of(q, reference):
    worst = max(abs(a - b) for a, b in zip(q, reference))
    return worst if math.isfinite(worst) else math.inf


def repeated(driver, *command):
    """The smallest of several CPU times, of short runs of many passes, and the last configuration."""
    seconds, q = driver.ask(*command)
    if seconds < 0.1:
        passes = max(1, min(200, round(0.002 / seconds)))
        seconds = min(driver.ask(*command, passes)[0] / passes for _ in range(3))
    return seconds, q


class Point(NamedTuple):
    error: float
    seconds: float
    command: tuple


def curve(drivers, name, method, end, reference):
    """Errors and CPU seconds over time steps or tolerances, coarse to fine."""
    driver_name, method = method
    driver, points = drivers[driver_name], []
    if method in ("dop853", "rk3", "rk5"):
        commands = [(f"{method}:{10 ** -(k / 2):.3e}", 0.1, round(end / 0.1)) for k in range(2, 28)]
    else:
        counts = sorted({max(1, round(end * 2 * 2 ** (k / 2))) for k in range(46)})
        commands = [(method, end / steps, steps) for steps in counts]
    for what, dt, steps in commands:
        try:
            seconds, q = repeated(driver, name, what, dt, steps)
        except RuntimeError:
            continue  # Too coarse.
        error = error_of(coordinates(name, driver_name, q), reference)
        points.append(Point(error, seconds, (name, what, dt, steps)))
        if seconds > LONGEST_SECONDS or error < 1e-13:
            break
    return points


def time_to_reach(points, error):
    """Smallest time of a point at least that exact."""
    return min((p.seconds for p in points if p.error <= error), default=None)


def fastest(methods, drivers, error):
    """Drivers, of those that are given, and commands that are at least that exact: the fastest few."""
    found = [
        (point.seconds, driver, point.command)
        for (driver, _), points in methods.items()
        for point in points
        if driver in drivers and point.error <= error
    ]
    return [(driver, command) for _, driver, command in sorted(found)[:CANDIDATES]]


def by_turns(drivers, candidates, rounds):
    """The least CPU seconds of each, all asked in every round."""
    best = {}
    for driver, command in candidates:
        seconds, _ = drivers[driver].ask(*command)
        best[driver, command] = seconds, max(1, round(BATCH_SECONDS / seconds))
    for _ in range(rounds):
        for (driver, command), (least, passes) in best.items():
            seconds = drivers[driver].ask(*command, passes)[0] / passes
            best[driver, command] = min(least, seconds), passes
    return {candidate: least for candidate, (least, _) in best.items()}


def measure_accuracy(drivers, only):
    references = json.loads((HERE / "references.json").read_text())["q"]
    curves = {}
    for name, end in CASES + ROBOT_CASES:
        if only and name not in only:
            continue
        if name in references:
            reference = references[name][str(end)]
        else:
            # Of robots the peer's finest, which is none of plantd's.
            q = drivers["Pinocchio"].ask(name, "dop853:1e-14", 0.1, round(end / 0.1))[1]
            reference = coordinates(name, "Pinocchio", q)
        for method in FIXED_STEP + ADAPTIVE:
            if method[0] in drivers and applies(name, method):
                points = curve(drivers, name, method, end, reference)
                curves.setdefault((name, end), {})[method] = points
        say(f"{name}, T = {end} s: done")
    return curves


def table_of_best(drivers, curves, rounds, what, peers):
    """plantd's time, order free, over that of the best of its peers, at each error, and their geometric means. The
    candidates are asked again by turns: curves are found one after the other, while the machine slows now and then."""
    lines = [f"| plantd / {what} | " + " | ".join(f"{e:.0e}" for e in ERRORS) + f" | {ERRORS[1]:.0e} to {ERRORS[-1]:.0e} |"]
    lines.append("| --- |" + " ---: |" * (len(ERRORS) + 1))
    for (name, end), methods in curves.items():
        ratios = []
        for e in ERRORS:
            own, others = fastest(methods, ["plantd"], e), fastest(methods, peers, e)
            if own and others:
                times = by_turns(drivers, own + others, rounds)
                ratios.append(min(times[c] for c in own) / min(times[c] for c in others))
            else:
                ratios.append(None)
        met = [r for r in ratios[1:] if r]
        cells = [f"{r:.2f}" if r else "" for r in [*ratios, statistics.geometric_mean(met) if met else None]]
        lines.append(f"| {name}, {end} s | " + " | ".join(cells) + " |")
    return lines


def table_of_accuracy(curves):
    lines = ["| CPU µs to reach an error in configuration | " + " | ".join(f"{e:.0e}" for e in ERRORS) + " |"]
    lines.append("| --- |" + " ---: |" * len(ERRORS))
    for (name, end), methods in curves.items():
        best = {e: {m: t for m, p in methods.items() if (t := time_to_reach(p, e))} for e in ERRORS}
        for method in methods:
            cells = []
            for e in ERRORS:
                seconds = best[e].get(method)
                text = f"{seconds * 1e6:.0f}" if seconds else ""
                cells.append(f"**{text}**" if seconds and seconds == min(best[e].values()) else text)
            if any(cells):
                lines.append(f"| {name}, {end} s: {' '.join(method)} | " + " | ".join(cells) + " |")
    return lines


def plots():
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    plt.rcParams["svg.fonttype"] = "none"
    return plt


def plot_accuracy(curves, path):
    plt = plots()
    rows = (len(curves) + 1) // 2
    figure, axes = plt.subplots(rows, 2, figsize=(10, 3.2 * rows), squeeze=False)
    for axis, ((name, end), methods) in zip(axes.flat, curves.items()):
        for index, (method, points) in enumerate(methods.items()):
            points = [(p.seconds, p.error) for p in points if 0 < p.error < 10]
            if points:
                width = 2.5 if method[0] == "plantd" else 1
                marks = dict(marker=".", color=f"C{index}", linewidth=width, label=" ".join(method))
                axis.loglog(*zip(*points), **marks)
        axis.set(title=f"{name}, T = {end} s", xlabel="CPU time, s", ylabel="error, rad", ylim=(1e-13, 10))
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(curves) :]:
        axis.axis("off")
    axes.flat[0].legend(fontsize=6)
    figure.tight_layout()
    figure.savefig(path)


def plot_calls(measured, path, title):
    plt = plots()
    figure, axis = plt.subplots(figsize=(6, 4.5))
    chains = {name: times for name, times in measured.items() if name[0] == "C"}
    methods = dict.fromkeys(method for times in chains.values() for method in times)
    for method in methods:
        points = [(int(n[1:]), statistics.median(t[method])) for n, t in chains.items() if method in t]
        width = 2.5 if method[0] == "plantd" else 1
        axis.loglog(*zip(*points), marker=".", linewidth=width, label=" ".join(method))
    axis.set(title=title, xlabel="rods", ylabel="CPU time per call, µs")
    axis.legend(fontsize=7)
    axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path)


# Report


REGISTERS = {"avx512f": "AVX-512", "avx2": "AVX2", "avx": "AVX", "sse2": "SSE2"}


def conditions():
    import importlib.metadata as metadata

    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            pass
    about = {}
    for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
        key, _, value = line.partition(":")
        about.setdefault(key.strip(), value.strip())
    flags = about.get("flags", "").split()
    widest = next((name for flag, name in REGISTERS.items() if flag in flags), "no wide registers")
    family = f"family {about.get('cpu family')}, model {about.get('model')}, {widest}"
    processor = f"{about.get('model name', platform.processor())} ({family})"
    tool = lambda *command: subprocess.run(command, capture_output=True, text=True, cwd=ROOT).stdout
    commit = tool("git", "describe", "--always", "--dirty").strip()
    compilers = f"{tool('rustc', '--version').strip()}; {tool('g++', '--version').splitlines()[0]}"
    peers = ", ".join(f"{package} {version}" for package, version in versions.items())
    return [
        f"Measured on {time.strftime('%Y-%m-%d')} at commit {commit}, on {os.cpu_count()} processors of {processor}.",
        f"{compilers}; {peers}.",
    ]


def write_csv(path, steps, derivatives, curves):
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["what", "mechanism", "method", "error", "median_cpu_us"])
        for what, measured in [("step", steps), ("step, A and B", derivatives)]:
            for name, times in measured.items():
                for method, values in times.items():
                    rows.writerow([what, name, " ".join(method), "", statistics.median(values)])
        for (name, end), methods in curves.items():
            for method, points in methods.items():
                for error, seconds, _ in points:
                    rows.writerow([f"{end} s", name, " ".join(method), error, seconds * 1e6])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=15, help="alternations per mechanism")
    parser.add_argument("--only", nargs="*", help="mechanisms, for example P C8 T30")
    parser.add_argument("--without-accuracy", action="store_true")
    parser.add_argument("--accuracy-alone", action="store_true")
    parser.add_argument("--out", type=pathlib.Path, default=TARGET / "results")
    options = parser.parse_args()
    enter_environment()
    drivers = start_drivers()
    options.out.mkdir(parents=True, exist_ok=True)
    names = [] if options.accuracy_alone else options.only or TABLE
    robots = [] if options.accuracy_alone else options.only or ROBOTS
    names, robots = [n for n in names if n not in ROBOTS], [n for n in robots if n in ROBOTS]
    robots = measure_robots(drivers, robots, options.rounds)
    steps = measure_calls(drivers, names, STEP_METHODS, options.rounds)
    derivatives = measure_calls(drivers, names, AB_METHODS, options.rounds)
    growth = [] if options.accuracy_alone or not names else list(measure_growth(drivers["plantd"]))
    curves = {} if options.without_accuracy else measure_accuracy(drivers, options.only)
    report = ["# plantd beside its peers", "", *conditions(), "", "## One step", ""]
    report += [*table_of_calls(steps, STEP_METHODS), "", "## One step, A and B", ""]
    report += [*table_of_calls(derivatives, AB_METHODS), "", "## Goals", ""]
    report += [*table_of_goals(steps, derivatives), "", "## Growth over chains", ""]
    report += ["| plantd's | exponent | |", "| --- | ---: | --- |", *growth, ""]
    if robots:
        times = {name: times for name, (times, _) in robots.items()}
        report += ["## Robots and ball joints", "", *table_of_calls(times, ROBOT_METHODS), ""]
        report += [*table_of_robots(robots), ""]
    if curves:
        report += ["## Run time against error", "", *table_of_accuracy(curves), ""]
        for what, peers in [("best engine", ENGINES), ("straight-line C", ["CasADi C"])]:
            report += [*table_of_best(drivers, curves, options.rounds, what, peers), ""]
        plot_accuracy(curves, options.out / "accuracy.svg")
    if any(name[0] == "C" for name in names):
        plot_calls(steps, options.out / "steps.svg", "One step of a chain")
        plot_calls(derivatives, options.out / "derivatives.svg", "One step of a chain, A and B")
    write_csv(options.out / "results.csv", steps, derivatives, curves)
    (options.out / "results.md").write_text("\n".join(report))
    print("\n".join(report))


if __name__ == "__main__":
    main()
