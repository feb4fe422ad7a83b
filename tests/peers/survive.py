"""Who survives what: the cases of the stress suite in plantd and other engines.

    python3 tests/peers/survive.py [--only TEXT ...]

Prints tables of the worst error of each engine, plantd's by the stress suite; see SURVIVAL.md.
"""

import argparse
import math
import random
import re
from collections.abc import Callable
from dataclasses import dataclass

import compare
import engines
import mechanisms
from engines import number, show

# An error beyond this is no motion any more.
LOST = 10.0


@dataclass
class Case:
    """A case of the stress suite, by its name there."""

    name: str
    mechanism: dict
    dt: float
    steps: int
    # By the word before the same number in the suite's row: from the case and an engine at its start, a function
    # of the steps taken.
    measures: dict[str, Callable]
    # Whether the end alone counts.
    at_end: bool = False
    # Torque or force on the first coordinate in a step, from random numbers.
    push: Callable | None = None
    # plantd's numbers, or a cell, from the row's text, where they are not behind those words.
    by_plantd: Callable | None = None


# Geometry


def places(m, q):
    """Centres of mass, turns about y of a mechanism in that plane, points of loops, and the reach of all joints."""
    import numpy as np

    turns, angles, origins, centers = [], [], [], []
    for b, value in zip(m["bodies"], q):
        parent = b["parent"]
        turn, angle, origin = (turns[parent], angles[parent], origins[parent]) if parent >= 0 else (np.eye(3), 0, 0)
        origin = origin + turn @ b["pos"]
        if mechanisms.joint_type(b) == "slide":
            origin = origin + value * (turn @ b["axis"])
        else:
            c, s = math.cos(value), math.sin(value)
            turn, angle = turn @ [[c, 0, s], [0, 1, 0], [-s, 0, c]], angle + value
        turns.append(turn)
        angles.append(angle)
        origins.append(origin)
        centers.append(origin + turn @ b["com"])
    point = lambda body, at: origins[body] + turns[body] @ at
    loops = [(point(l["body_a"], l["at_a"]), point(l["body_b"], l["at_b"])) for l in m["loops"]]
    return np.array(centers), np.array(angles), loops, max(math.hypot(*origin) for origin in origins)


def violation(m, q):
    """The worst of the loops, relative to the size of the mechanism."""
    _, _, loops, reach = places(m, q)
    return largest(math.dist(a, b) / (reach + math.hypot(*a) + math.hypot(*b)) for a, b in loops)


def onto_loops(m):
    """q0 onto the loops with its first coordinate as it is, and v0 with the impulse of the loops."""
    import numpy as np

    gap = lambda q: np.concatenate([a - b for a, b in places(m, q)[2]])
    slopes = lambda f, q: np.array([(f(q + d) - f(q - d)) / 2e-6 for d in 1e-6 * np.eye(len(q))])
    q, v = np.array(m["q0"], float), np.array(m["v0"], float)
    for _ in range(20):
        q[1:] -= np.linalg.lstsq(slopes(gap, q).T[:, 1:], gap(q), rcond=1e-6)[0]
    centers, turns = slopes(lambda q: places(m, q)[0], q), slopes(lambda q: places(m, q)[1], q)
    mass, inertia = [b["mass"] for b in m["bodies"]], [b["inertia"][1] for b in m["bodies"]]
    weights = np.einsum("ibx,jbx,b", centers, centers, mass) + turns * inertia @ turns.T
    rows = slopes(gap, q).T
    free = np.linalg.solve(weights, rows.T)
    v -= free @ (np.linalg.pinv(rows @ free, rcond=1e-9) @ (rows @ v))
    return m | dict(q0=list(map(float, q)), v0=list(map(float, v)))


def well_depth(m):
    """Energy between the highest and the lowest place: all bodies of a chain once up and once down."""

    def reach(i):
        parent = m["bodies"][i]["parent"]
        return 0.0 if parent < 0 else reach(parent) + math.hypot(*m["bodies"][i]["pos"])

    return 2 * m["gravity"] * sum(b["mass"] * (reach(i) + math.hypot(*b["com"])) for i, b in enumerate(m["bodies"]))


# Measures


def largest(values):
    """In size; infinite if one is not a number."""
    return max((math.inf if math.isnan(x) else abs(x) for x in values), default=0.0)


def energy(size=None):
    def watch(_, engine):
        start = sum(engine.energies())
        return lambda k: abs(sum(engine.energies()) - start) / (size or abs(start))

    return watch


def loop(case, engine):
    return lambda k: violation(case.mechanism, engine.q())


def beside(m, dt):
    """First coordinates of another mechanism that must move alike."""

    def watch(case, engine):
        other, at = engine.again(m, dt), 0

        def apart(k):
            nonlocal at
            other.advance(k - at)
            at = k
            return largest(a - b for a, b in zip(engine.q(), other.q()))

        return apart

    return watch


def at_rest(case, engine):
    still, at = engine.again(case.mechanism | dict(q0=[0.0] * len(case.mechanism["q0"])), case.dt), 0

    def moved(k):
        nonlocal at
        still.advance(k - at)
        at = k
        return largest(still.q())

    return moved


def amplitude(omega):
    return lambda _, engine: lambda k: abs(math.hypot(engine.q()[0], engine.v()[0] / omega) - 1)


def decay(case, engine):
    rate = case.mechanism["bodies"][0]["damping"]
    return lambda k: abs(engine.v()[0] - math.exp(-rate * case.dt * k))


def evenly(case, engine):
    angle, speed = case.mechanism["q0"][0], case.mechanism["v0"][0]
    return lambda k: abs(engine.q()[0] - angle - speed * case.dt * k)


def exact_end(case, engine):
    """Against Runge-Kutta 4 in steps whose error is below round-off."""
    import numpy as np

    fine = engines.Pinocchio(case.mechanism, case.dt * case.steps / 1600, "RK4")
    fine.advance(1600)
    expected = np.concatenate([fine.q(), fine.v()])
    return lambda k: largest(np.concatenate([engine.q(), engine.v()]) - expected) / largest(expected)


def turned(rate):
    """About z."""

    def watch(case, engine):
        def error(k):
            c, s = math.cos(rate * case.dt * k), math.sin(rate * case.dt * k)
            off = engine.attitude()[0].T @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
            across = [off[2, 1] - off[1, 2], off[0, 2] - off[2, 0], off[1, 0] - off[0, 1]]
            return math.atan2(math.hypot(*across) / 2, (off[0, 0] + off[1, 1] + off[2, 2] - 1) / 2)

        return error

    return watch


def momentum(case, engine):
    import numpy as np

    inertia = case.mechanism["bodies"][0]["inertia"]

    def of():
        turn, speed = engine.attitude()
        return turn @ (inertia * (turn.T @ speed))

    start = of()
    return lambda k: math.hypot(*(of() - start)) / sum(abs(np.array(start)))


def late_energy(case, engine):
    error = energy()(case, engine)
    return lambda k: error(k) if 2 * k >= case.steps else 0.0


def growth(case, engine):
    """The largest distance of the energy from its start, of the second half over that of the first."""
    start, halves = sum(engine.energies()), [0.0, 0.0]

    def ratio(k):
        late = 2 * k > case.steps
        halves[late] = largest([halves[late], sum(engine.energies()) - start])
        return math.inf if math.isinf(halves[0]) else halves[1] / halves[0]

    return ratio


def kicked(torque, parts=None):
    """Angle of the pendulum after 10 ms from rest, by the midpoint rule in so many parts; or as it is."""
    q = p = 0.0
    h = 0.01 / (parts or 4096)
    gravity = lambda q: torque - 9.8 * math.sin(q)
    for _ in range(parts or 4096):
        if parts:
            x = h * p
            for _ in range(100):
                x = h * (p + h / 2 * gravity(q + x / 2))
            q, p = q + x, p + h * gravity(q + x / 2)
        else:
            a1 = gravity(q)
            a2 = gravity(q + h / 2 * p)
            a3 = gravity(q + h / 2 * p + h * h / 4 * a1)
            a4 = gravity(q + h * p + h * h / 2 * a2)
            q, p = q + h * p + h * h / 6 * (a1 + a2 + a3), p + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return q


def kick(torque):
    angle = kicked(torque)
    return lambda _, engine: lambda k: abs(engine.q()[0] / angle - 1)


# plantd's numbers by what the suite finds them equal to


def kick_by_plantd(torque):
    def cell(row):
        parts = re.findall(r"error in (\d+) parts", row)
        return [abs(kicked(torque, int(parts[-1])) / kicked(torque) - 1)] if parts else "refused"

    return cell


def decay_by_plantd(z):
    def cell(row):
        factors = {"Symmetric": (1 - z / 2) / (1 + z / 2), "Paper": 1 / (1 + z)}
        off = {
            split: max(abs(factor**k - math.exp(-z * k)) for k in range(1, 21)) + number(split, row)
            for split, factor in factors.items()
        }
        return f"{show(off['Symmetric'])}, with the paper's forces {show(off['Paper'])}"

    return cell


def growth_by_plantd(row):
    second, twice = map(float, re.search(r"energy (\S+) ≤ ([^\s;|]+)", row).groups())
    return [2 * second / twice, number("violation", row)]


# Cases


def violent():
    pendulum = mechanisms.pendulum() | dict(q0=[3.0], v0=[1.0])
    rods = 2 * 9.8 * (0.5 * 0.25 + 1.2 * (0.5 + 0.6) + 1.0 * 0.5)
    for dt in (0.7, 1.0):
        yield Case(f"violent: pendulum at {dt:g} s", pendulum, dt, 1000, {"energy error": energy(2 * 9.8)})
    for text, name, dt, steps in [
        ("double-pendulum at 0.01 s for 100000 steps", "D", 0.01, 100_000),
        ("chain-4 at 0.01 s for 20000 steps", "C4", 0.01, 20_000),
        ("chain-32 at 0.01 s", "C32", 0.01, 200),
        ("chain-64 at 0.01 s", "C64", 0.01, 200),
        ("four-bar at 0.01 s for 20000 steps", "L", 0.01, 20_000),
        ("scissor-4 at 0.001 s", "X4", 0.001, 2000),
        ("scissor-8 at 0.01 s", "X8", 0.01, 200),
        ("scissor-10 at 0.01 s", "X10", 0.01, 200),
        ("scissor-12 at 0.01 s", "X12", 0.01, 200),
    ]:
        m = mechanisms.named(name)
        links = len(m["bodies"]) - 1
        depth = {"L": rods, "X": 9.8 * links * 5.0 * links / 2}.get(name[0]) or well_depth(m)
        measures = {"energy error": energy(depth)} | ({"violation": loop} if m["loops"] else {})
        yield Case(f"violent: {text}", m, dt, steps, measures)


def long_steps():
    m = mechanisms.pendulum() | dict(q0=[3.0])
    for dt in (0.05, 0.2, 0.5, 0.63, 1.5, 5.0):
        yield Case(f"pendulum at steps of {dt:g} s", m, dt, 1000, {"energy error": energy(2 * 9.8)})


def tiny_steps():
    for name, m in [
        ("pendulum", mechanisms.pendulum() | dict(q0=[0.2])),
        ("double-pendulum", mechanisms.double_pendulum()),
        ("spherical-pendulum", mechanisms.spherical_pendulum()),
        ("four-bar", mechanisms.four_bar()),
    ]:
        m = m | dict(v0=[math.sin(1 + i) for i in range(len(m["q0"]))])
        m = onto_loops(m) if m["loops"] else m
        yield Case(f"steps of 1e-7 s: {name}", m, 1e-7, 100_000, {"error": exact_end}, at_end=True)


def ratios():
    for exponent in (-8, -6, -4, -2, 2, 4, 6, 8):
        m = mechanisms.double_pendulum(masses=(1.0, 10.0**exponent)) | dict(gravity=9.81)
        name = f"mass ratio 1e{exponent} in a double pendulum"
        yield Case(name, m, 1e-3, 10_000, {"energy error": energy(well_depth(m))})
    for exponent in (-6, -3, 3, 6):
        m = mechanisms.double_pendulum(lengths=(1.0, 10.0**exponent)) | dict(gravity=9.81)
        dt = 2 * math.pi * math.sqrt(min(1.0, 10.0**exponent) / 9.81) / 100
        name = f"length ratio 1e{exponent} in a double pendulum"
        yield Case(name, m, dt, 10_000, {"energy error": energy(well_depth(m))})


def similarity():
    for what, exponent, shown in [
        *zip(["lengths"] * 4, (-10, -3, 3, 10), ("1e-6", "2e-2", "6e1", "1e6")),
        *zip(["masses"] * 4, (-10, -3, 3, 10), ("9e-10", "2e-3", "5e2", "1e9")),
    ]:
        length, mass = (4.0**exponent, 1.0) if what == "lengths" else (1.0, 8.0**exponent)
        for word, m in [("double-pendulum", mechanisms.double_pendulum()), ("four-bar", mechanisms.four_bar())]:
            measure = beside(mechanisms.scaled(m, length, mass), 0.01 * math.sqrt(length))
            yield Case(f"{what} times {shown}", m, 0.01, 300, {word: measure}, at_end=True)


def springs():
    for exponent in (-2, 0, 2, 4):
        omega = 10.0**exponent / 0.01
        m = mechanisms.mechanism("spring", [mechanisms.slider(1.0, stiffness=omega**2, rest=0.0)], [1.0])
        yield Case(f"spring with ω h = 1e{exponent}", m | dict(gravity=0.0), 0.01, 10_000, {"error": amplitude(omega)})


def elastic_pendulums():
    rigid = mechanisms.pendulum() | dict(q0=[1.0], gravity=9.81)
    for stretch, exponent in [(0, 0), (0, 1), (0, 2), (0, 4), (0.02, 0), (0.02, 2), (0.02, 4)]:
        stiffness = (10.0**exponent / 0.01) ** 2
        m = mechanisms.elastic_pendulum(stiffness) | dict(gravity=9.81)
        m["q0"][1] += 9.81 * math.cos(1.0) / stiffness + stretch
        size = stiffness * stretch**2 / 2 + 2 * 9.81
        measure = {"energy error": energy(size)} if stretch else {"angle": beside(rigid, 0.01)}
        yield Case(f"elastic pendulum, ω h = 1e{exponent}, stretched {stretch}", m, 0.01, 1000, measure)


def damping():
    for z, shown in [(1e-2, "1e-2"), (1.0, "1e0"), (2.0, "2e0"), (1e2, "1e2"), (1e4, "1e4"), (1e8, "1e8")]:
        m = mechanisms.mechanism("damped", [mechanisms.slider(1.0, damping=z / 0.01)], [0.0], [1.0])
        row = dict(measures={"error": decay}, by_plantd=decay_by_plantd(z))
        yield Case(f"damping with h c/m = {shown}", m | dict(gravity=0.0), 0.01, 20, **row)


def singular():
    for miss, shown in [(1e-1, "1e-1"), (1e-2, "1e-2"), (1e-4, "1e-4"), (1e-8, "1e-8"), (0.0, "0e0")]:
        m = mechanisms.spherical_pendulum() | dict(gravity=0.0, q0=[0.0, 0.0], v0=[miss, 1.0])
        yield Case(f"pole of two hinges missed by {shown}", m, 0.01, 400, {"energy error": energy()})
    for off, shown in [(1e-2, "1e-2"), (1e-5, "1e-5"), (1e-8, "1e-8"), (1e-12, "1e-12"), (0.0, "0e0")]:
        m = mechanisms.gimbal() | dict(q0=[0.3, math.pi / 2 - off, 0.2], v0=[0.0, 1.0, 0.7])
        yield Case(f"gimbal lock at {shown} rad", m, 1e-3, 300, {"energy error": energy()})


def redundant():
    for misfit, shown in [(0.0, "0e0"), (1e-13, "1e-13"), (1e-11, "1e-11"), (1e-7, "1e-7")]:
        m = mechanisms.parallelogram(third=1.0 + misfit) | dict(q0=[0.5, -0.5, 0.5, 0.5])
        measures = {"violation": loop} | ({} if misfit else {"angle": evenly})
        yield Case(f"third parallel crank, misfit {shown}", m, 0.01, 100, measures)
    for over in ("", ".0000000001", ".000001", ".001", ".05"):
        m = onto_loops(mechanisms.parallelogram(rocker=float(f"1{over}")))
        measures = {"energy error": energy(), "violation": loop}
        yield Case(f"flat four-bar linkage, rocker 1{over}", m, 0.01, 1000, measures)


def spin():
    for turn in (0.01, 1, 3, 10):
        for joint in ("ball", "free"):
            v0 = [0.0] * (mechanisms.SIZES[joint] - 1) + [1e4]
            name, m = f"spin about an axis, {turn} rad per step", mechanisms.rigid_body(joint, v0)
            yield Case(name, m, turn / 1e4, 10_000, {joint: turned(1e4)}, at_end=True)
    for turn in (0.01, 0.1, 0.5):
        m = mechanisms.rigid_body("free", [0.0, 0.0, 0.0, 3e3, 9e3, 3e3])
        measures = {"energy": late_energy, "momentum": momentum}
        yield Case(f"tumbling, {turn} rad per step", m, turn / 1e4, 100_000, measures)


def long_chains():
    for n in (128, 256):
        m = mechanisms.hanging_chain(n)
        measures = {"energy error": energy(well_depth(m)), "at rest": at_rest}
        yield Case(f"chain of {n} rods", m, 0.08 / n, 200, measures)


def torques():
    for torque, shown in [(1e2, "1e2"), (1e4, "1e4"), (6e4, "6e4"), (7e4, "7e4"), (1e6, "1e6"), (1e12, "1e12")]:
        row = dict(measures={"error": kick(torque)}, push=lambda _, torque=torque: torque)
        m = mechanisms.pendulum() | dict(q0=[0.0])
        yield Case(f"impulsive torque of {shown} N m", m, 0.01, 1, **row, by_plantd=kick_by_plantd(torque))


def noise():
    for name, m, size in [
        ("pendulum", mechanisms.pendulum() | dict(q0=[0.2]), 3.0),
        ("cart-pole", mechanisms.cart_pole(), 5.0),
        ("chain-8", mechanisms.hanging_chain(8), 0.5),
        ("four-bar", mechanisms.four_bar(), 3.0),
    ]:
        m = m | dict(bodies=[b | dict(damping=0.2) for b in m["bodies"]])
        measures = {"energy": growth} | ({"violation": loop} if m["loops"] else {})
        push = lambda source, size=size: source.uniform(-size, size)
        yield Case(f"noise: {name}", m, 0.01, 10_000, measures, push=push, by_plantd=growth_by_plantd)


GROUPS = [
    ("Violent and long motion", "energy, of the well depth; loop, of the size of the mechanism", violent),
    ("A pendulum from 3 rad at long steps", "energy, of the well depth, in 1000 steps", long_steps),
    ("Tiny steps", "q and v after 0.01 s, relative to their largest", tiny_steps),
    ("Unlike masses and lengths", "energy, of the well depth, in 10⁴ steps", ratios),
    ("Other sizes and weights", "rad, after 300 steps, from the motion of the mechanism as it was", similarity),
    ("Stiff springs", "amplitude, relative, in 10⁴ steps", springs),
    (
        "Elastic pendulums",
        "not stretched: rad, from the rigid pendulum; stretched: energy, of what is in spring and pendulum",
        elastic_pendulums,
    ),
    ("Strong damping", "velocity, of that at the start, from exp(−t c/m), in 20 steps", damping),
    ("Singular hinges", "energy, of that at the start", singular),
    (
        "Redundant and flat loops",
        "third crank: loop, of the size of the mechanism, and rad from the even turn; flat: energy, of that at the "
        "start, and loop",
        redundant,
    ),
    (
        "Spin at 10⁴ rad/s",
        "spin: rad, after 10⁴ steps; tumbling: energy in the second half of 10⁵ steps, and angular momentum",
        spin,
    ),
    ("Long chains", "energy, of the well depth, and rad of a chain that hangs at rest, in 200 steps", long_chains),
    ("A torque for one step of 10 ms", "angle, relative", torques),
    (
        "Noise on the input, damped",
        "largest distance of the energy from its start, of the second half of 10⁴ steps over the first; loop",
        noise,
    ),
]


# Tables


def text(names, values):
    """Numbers in one cell: the first alone, others by what they are of."""
    words = [{"violation": "loop "}.get(name, f"{name} ") for name in names]
    return ", ".join(("" if i == 0 else word) + show(value) for i, (word, value) in enumerate(zip(words, values)))


def follow(case, engine):
    """The worst of each measure: of the first ten steps, and of a thousand others."""
    stride = 1 if case.push else max(1, case.steps // 1000)
    samples = sorted({*range(1, min(10, case.steps) + 1), *range(stride, case.steps + 1, stride)})
    if case.at_end:
        samples = [case.steps]
    checks = [measure(case, engine) for measure in case.measures.values()]
    worst, at, source = [0.0] * len(checks), 0, random.Random(1)
    for k in samples:
        if case.push:
            engine.push(case.push(source))
        engine.advance(k - at)
        at = k
        found = [check(k) for check in checks]
        if not all(value < LOST for value in found):
            return "lost" if case.at_end or case.steps == 1 else f"lost by step {k}"
        worst = [max(pair) for pair in zip(worst, found)]
    return text(case.measures, found if growth in case.measures.values() else worst)


def by_plantd(case, rows):
    """The same of plantd, from the table of the stress suite."""
    row = rows.get(case.name)
    if row is None:
        return ""
    if case.by_plantd:
        cell = case.by_plantd(row)
        return cell if isinstance(cell, str) else text(case.measures, cell)
    refused = re.search(r"refused after (\d+) steps|^step (\d+):", row)
    step = refused and int(refused[1] or refused[2])
    if refused and (step == 0 or refused[2]):
        return f"refused at step {step}" if step else "refused"
    values = [number(word, row) for word in case.measures]
    cell = row.split("; ")[0] if None in values else text(case.measures, values)
    return f"{cell}, refused at step {step}" if refused else cell


def by_engine(case, make, method):
    try:
        return follow(case, make(case.mechanism, case.dt, method))
    except Exception as error:
        compare.say(f"{case.name}: {make.__name__}: {error}")
        return "refused"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[""], help="parts of names of cases, for example violent noise")
    options = parser.parse_args()
    compare.enter_environment(__file__)
    (compare.TARGET / "build").mkdir(parents=True, exist_ok=True)
    rows = engines.stress()
    print("\n".join(compare.conditions()))
    for title, measure, cases in GROUPS:
        chosen = [case for case in cases() if any(part in case.name for part in options.only)]
        if not chosen:
            continue
        print(f"\n### {title}\n\n{measure[0].upper()}{measure[1:]}.\n")
        print("| | plantd |", " | ".join(name for name, *_ in engines.ENGINES), "|")
        print("| --- | --- |" + " --- |" * len(engines.ENGINES))
        for case in chosen:
            high = Case(**vars(case) | dict(name=f"{case.name}, order 8"))
            own = [by_plantd(case, rows)] + [f"order 8: {cell}" for cell in [by_plantd(high, rows)] if cell]
            cells = [by_engine(case, make, method) for _, make, method in engines.ENGINES]
            name = case.name.removeprefix("violent: ").removeprefix("noise: ")
            word = next(iter(case.measures))
            name += f": {word}" if case.at_end and word != "error" else ""
            print(f"| {name} |", " | ".join(["; ".join(own), *cells]), "|", flush=True)


if __name__ == "__main__":
    main()
