"""Who survives what: violent and long motions in plantd and other engines.

    python3 tests/peers/survive.py [--only NAME ...]

Prints a table, plantd's column by the stress suite: the worst error of the energy, relative to the energy between the mechanism's highest and
lowest places, and of loops the worst violation, m; or the step at which an engine gave up.
"""

import argparse
import math
import re
import subprocess
import sys

import compare
import mechanisms

# Mechanism, time step, steps, start; in the stress suite `violent: ` and the first.
CASES = [
    ("pendulum at 0.7 s", "P", 0.7, 1000, dict(q0=[3.0], v0=[1.0])),
    ("pendulum at 1 s", "P", 1.0, 1000, dict(q0=[3.0], v0=[1.0])),
    ("double-pendulum at 0.01 s for 100000 steps", "D", 0.01, 100_000, {}),
    ("chain-4 at 0.01 s for 20000 steps", "C4", 0.01, 20_000, {}),
    ("chain-32 at 0.01 s", "C32", 0.01, 200, {}),
    ("chain-64 at 0.01 s", "C64", 0.01, 200, {}),
    ("four-bar at 0.01 s for 20000 steps", "L", 0.01, 20_000, {}),
]
# An error beyond this is no motion any more.
LOST = 10.0


def places(m, q):
    """Centres of mass and, of loops, both points, by forward kinematics: hinges about any axes."""
    import numpy as np

    turns, origins, centers = [], [], []
    for b, angle in zip(m["bodies"], q):
        parent = b["parent"]
        turn = np.eye(3) if parent < 0 else turns[parent]
        origin = np.zeros(3) if parent < 0 else origins[parent]
        x, y, z = b["axis"]
        across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        origins.append(origin + turn @ b["pos"])
        turns.append(turn @ (np.eye(3) + math.sin(angle) * across + (1 - math.cos(angle)) * across @ across))
        centers.append(origins[-1] + turns[-1] @ b["com"])
    point = lambda body, at: origins[body] + turns[body] @ at
    loops = [(point(l["body_a"], l["at_a"]), point(l["body_b"], l["at_b"])) for l in m["loops"]]
    return centers, loops


def well_depth(m):
    """All bodies of a chain once up and once down."""


    def reach(i):
        parent = m["bodies"][i]["parent"]
        return 0.0 if parent < 0 else reach(parent) + math.hypot(*m["bodies"][i]["pos"])

    return 2 * m["gravity"] * sum(b["mass"] * (reach(i) + math.hypot(*b["com"])) for i, b in enumerate(m["bodies"]))


def violation(m, q):
    return max((math.dist(a, b) for a, b in places(m, q)[1]), default=0.0)


class MuJoCo:
    def __init__(self, m, dt, integrator):
        import mujoco

        self.step_once, self.gauge = mujoco.mj_step, mujoco.mj_forward
        self.model = mujoco.MjModel.from_xml_string(mechanisms.mjcf(m))
        self.model.opt.timestep = dt
        self.model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
        self.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)

    def step(self):
        self.step_once(self.model, self.data)

    def energy(self):
        self.gauge(self.model, self.data)
        return sum(self.data.energy)

    def q(self):
        return self.data.qpos


class Pinocchio:
    def __init__(self, m, dt, method):
        import numpy as np
        import pinocchio as pin

        if m["loops"]:
            raise NotImplementedError("no loops in its forward dynamics here")
        self.pin, self.dt, self.method = pin, dt, method
        self.model = pin.Model()
        self.model.gravity.linear = np.array([0.0, 0.0, -m["gravity"]])
        for i, b in enumerate(m["bodies"]):
            joint = pin.JointModelRevoluteUnaligned(np.array(b["axis"], float))
            place = pin.SE3(np.eye(3), np.array(b["pos"], float))
            index = self.model.addJoint(b["parent"] + 1, joint, place, f"j{i}")
            inertia = pin.Inertia(b["mass"], np.array(b["com"], float), np.diag(np.array(b["inertia"], float)))
            self.model.appendBodyToJoint(index, inertia, pin.SE3.Identity())
        self.data = self.model.createData()
        self.x, self.v = np.array(m["q0"], float), np.array(m["v0"], float)
        self.none = np.zeros(len(self.x))

    def acceleration(self, q, v):
        return self.pin.aba(self.model, self.data, q, v, self.none).copy()

    def step(self):
        h, q, v = self.dt, self.x, self.v
        if self.method == "semi-implicit Euler":
            self.v = v + h * self.acceleration(q, v)
            self.x = q + h * self.v
            return
        a1 = self.acceleration(q, v)
        v2 = v + h / 2 * a1
        a2 = self.acceleration(q + h / 2 * v, v2)
        v3 = v + h / 2 * a2
        a3 = self.acceleration(q + h / 2 * v2, v3)
        v4 = v + h * a3
        a4 = self.acceleration(q + h * v3, v4)
        self.x = q + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
        self.v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)

    def energy(self):
        kinetic = self.pin.computeKineticEnergy(self.model, self.data, self.x, self.v)
        return kinetic + self.pin.computePotentialEnergy(self.model, self.data, self.x)

    def q(self):
        return self.x


class Drake:
    def __init__(self, m, dt, _):
        import json

        sys.path.insert(0, str(compare.HERE / "drivers"))
        import drake_plant
        from pydrake.systems.analysis import Simulator

        path = compare.TARGET / "build" / "survive.json"
        path.write_text(json.dumps(m))
        self.plant, self.dt, self.steps = drake_plant.build(path, dt)[1], dt, 0
        self.simulator = Simulator(self.plant)
        self.context = self.simulator.get_mutable_context()
        torques = [0.0] * self.plant.num_actuators()
        self.plant.get_actuation_input_port().FixValue(self.context, torques)
        self.plant.SetPositionsAndVelocities(self.context, m["q0"] + m["v0"])
        self.simulator.Initialize()

    def step(self):
        self.steps += 1
        self.simulator.AdvanceTo(self.steps * self.dt)

    def energy(self):
        return self.plant.CalcKineticEnergy(self.context) + self.plant.CalcPotentialEnergy(self.context)

    def q(self):
        return self.plant.GetPositions(self.context)


ENGINES = [
    ("MuJoCo Euler", MuJoCo, "EULER"),
    ("MuJoCo implicitfast", MuJoCo, "IMPLICITFAST"),
    ("MuJoCo RK4", MuJoCo, "RK4"),
    ("Pinocchio semi-implicit Euler", Pinocchio, "semi-implicit Euler"),
    ("Pinocchio RK4", Pinocchio, "RK4"),
    ("Drake discrete", Drake, None),
]


def follow(engine, m, steps):
    """Worst energy error and violation: of the first ten steps, and of a thousand others."""
    depth, start = well_depth(m), engine.energy()
    worst = loop = 0.0
    for k in range(1, steps + 1):
        engine.step()
        if k > 10 and k % max(1, steps // 1000):
            continue
        error = abs(engine.energy() - start) / depth
        if not error < LOST:
            return f"lost at step {k}"
        worst, loop = max(worst, error), max(loop, violation(m, engine.q()))
    return f"{worst:.1e}" + (f", loop {loop:.0e} m" if m["loops"] else "")


def by_plantd(title):
    """The same of plantd, from the table of the stress suite."""
    out = compare.TARGET / "stress"
    suite = ["cargo", "run", "--quiet", "--release", "--locked", "-p", "plantd-tests", "--bin", "stress", "--"]
    chosen = ["--only", f"violent: {title}", "--out", str(out)]
    subprocess.run([*suite, *chosen], cwd=compare.ROOT, stdout=subprocess.DEVNULL)
    lines = (out / "stress.md").read_text().splitlines()
    row = next((line for line in lines if line.startswith(f"| violent: {title} |")), None)
    if not row:
        return ""
    error = re.search(r"energy error ([0-9.e-]+)", row)
    loop = re.search(r"violation ([0-9.e-]+) ≤", row)
    if not error:
        return row.split("|")[4].strip()
    return error[1] + (f", loop {float(loop[1]):.0e}" if loop and float(loop[1]) else "")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="mechanisms, for example P C32")
    options = parser.parse_args()
    compare.enter_environment(__file__)
    (compare.TARGET / "build").mkdir(parents=True, exist_ok=True)
    rows = [case for case in CASES if not options.only or case[1] in options.only]
    print("| | plantd | plantd, order 8 |", " | ".join(name for name, *_ in ENGINES), "|")
    print("| --- | --- | --- |" + " --- |" * len(ENGINES))
    for title, name, dt, steps, start in rows:
        m = mechanisms.named(name) | start
        cells = [by_plantd(title + order) for order in ("", ", order 8")]
        for _, make, method in ENGINES:
            try:
                cells.append(follow(make(m, dt, method), m, steps))
            except Exception as error:
                cells.append(" ".join(str(error).split())[:60])
        print(f"| {title} |", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
