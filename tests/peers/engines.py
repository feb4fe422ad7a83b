"""Engines other than plantd, stepped from Python; see survive.py and drift.py.

All of them take a mechanism, a time step and a method, and have

- `advance(steps)`, with the torque or force of `push(u)` on the first coordinate,
- `energies()`, kinetic and potential, J,
- `q()` and `v()`, in which orientations are as each engine likes them,
- `attitude()`, rotation matrix and angular velocity, in the world's axes, of a single body on a ball joint or free,
- `again(mechanism, time step)`, another one with the same method.
"""

import json
import re
import subprocess
import sys

import compare
import mechanisms


class MuJoCo:
    def __init__(self, m, dt, integrator):
        import mujoco

        mujoco.set_mju_user_warning(lambda _: None)  # A motion that is lost shows in its error.
        self.mujoco, self.integrator = mujoco, integrator
        self.model = mujoco.MjModel.from_xml_string(mechanisms.mjcf(m))
        self.model.opt.timestep = dt
        self.model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
        # Loops as stiff as it lets them be.
        self.model.eq_solref[:, 0] = 2 * dt
        self.model.eq_solimp[:, :2] = 0.9999
        self.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)

    def again(self, m, dt):
        return MuJoCo(m, dt, self.integrator)

    def push(self, u):
        self.data.ctrl[0] = u

    def advance(self, steps):
        self.mujoco.mj_step(self.model, self.data, nstep=steps)

    def energies(self):
        self.mujoco.mj_forward(self.model, self.data)
        potential, kinetic = self.data.energy
        return kinetic, potential

    def q(self):
        return self.data.qpos.copy()

    def v(self):
        return self.data.qvel.copy()

    def attitude(self):
        import numpy as np

        turn = np.zeros(9)
        self.mujoco.mju_quat2Mat(turn, self.data.qpos[-4:])
        return turn.reshape(3, 3), turn.reshape(3, 3) @ self.data.qvel[-3:]


class Pinocchio:
    """Articulated-body algorithm, with loops the constrained dynamics with Baumgarte's correction over ten steps."""

    def __init__(self, m, dt, method):
        import numpy as np
        import pinocchio as pin

        self.pin, self.dt, self.method = pin, dt, method
        self.model = pin.Model()
        self.model.gravity.linear = np.array([0.0, 0.0, -m["gravity"]])
        still = pin.SE3.Identity()
        place = lambda at: pin.SE3(np.eye(3), np.array(at, float))
        q, v, springs = [], [], []
        # Where the rotation vectors of orientations stand in a velocity.
        self.turns = []
        for i, (b, q0, v0) in enumerate(mechanisms.parts(m)):
            kind, axis = mechanisms.joint_type(b), np.array(b["axis"], float)
            joint = {
                "hinge": lambda: pin.JointModelRevoluteUnaligned(axis),
                "slide": lambda: pin.JointModelPrismaticUnaligned(axis),
                "ball": pin.JointModelSpherical,
                "free": pin.JointModelFreeFlyer,
            }[kind]()
            index = self.model.addJoint(b["parent"] + 1, joint, place(b["pos"]), f"j{i}")
            inertia = pin.Inertia(b["mass"], np.array(b["com"], float), np.diag(np.array(b["inertia"], float)))
            self.model.appendBodyToJoint(index, inertia, still)
            v += v0
            if kind in ("ball", "free"):
                w, *vector = mechanisms.quaternion(q0[-3:])
                q += [*q0[:-3], *vector, w]
                self.turns.append(slice(len(v) - 3, len(v)))
            else:
                q += q0
            springs += [[b.get(key, 0.0) for key in ("stiffness", "rest", "damping")]] * len(v0)
        self.stiffness, self.rest, self.damping = np.array(springs).T
        self.data = self.model.createData()
        self.x, self.u = (np.array(q, float), np.array(v, float)), np.zeros(len(v))
        self.has_forces = bool(self.stiffness.any() or self.damping.any())
        self.loops = None
        if m["loops"]:
            loops, data = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
            for l in m["loops"]:
                ends = l["body_a"] + 1, place(l["at_a"]), l["body_b"] + 1, place(l["at_b"])
                loop = pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, self.model, *ends)
                loop.m_baumgarte_parameters.Kp = 1 / (10 * dt) ** 2
                loop.m_baumgarte_parameters.Kd = 2 / (10 * dt)
                loops.append(loop)
                data.append(loop.createData())
            pin.initConstraintDynamics(self.model, self.data, loops, data)
            softness = 1e-8 / sum(b["mass"] for b in m["bodies"])
            self.loops = loops, data, pin.ProximalSettings(1e-12, softness, 20)

    def again(self, m, dt):
        return Pinocchio(m, dt, self.method)

    def push(self, u):
        self.u[0] = u

    def acceleration(self, q, v):
        force = self.u
        if self.has_forces:
            force = force - self.stiffness * (q - self.rest) - self.damping * v
        if self.loops:
            return self.pin.constraintDynamics(self.model, self.data, q, v, force, *self.loops).copy()
        return self.pin.aba(self.model, self.data, q, v, force).copy()

    def moved(self, q, change):
        return self.pin.integrate(self.model, q, change) if self.turns else q + change

    def rate(self, change, v):
        """Rate of a change of configuration; of rotation vectors to the third order in them (Munthe-Kaas)."""
        if not self.turns:
            return v
        rate = v.copy()
        for turn in self.turns:
            first = cross(change[turn], v[turn])
            rate[turn] += first / 2 + cross(change[turn], first) / 12
        return rate

    def advance(self, steps):
        step = self.euler if self.method == "semi-implicit Euler" else self.rk4
        for _ in range(steps):
            self.x = step(*self.x)

    def euler(self, q, v):
        v = v + self.dt * self.acceleration(q, v)
        return self.moved(q, self.dt * v), v

    def rk4(self, q, v):
        h = self.dt
        a1 = self.acceleration(q, v)
        v2, c2 = v + h / 2 * a1, h / 2 * v
        a2 = self.acceleration(self.moved(q, c2), v2)
        r2 = self.rate(c2, v2)
        v3, c3 = v + h / 2 * a2, h / 2 * r2
        a3 = self.acceleration(self.moved(q, c3), v3)
        r3 = self.rate(c3, v3)
        v4, c4 = v + h * a3, h * r3
        a4 = self.acceleration(self.moved(q, c4), v4)
        change = h / 6 * (v + 2 * r2 + 2 * r3 + self.rate(c4, v4))
        return self.moved(q, change), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)

    def energies(self):
        q, v = self.x
        kinetic = self.pin.computeKineticEnergy(self.model, self.data, q, v)
        potential = self.pin.computePotentialEnergy(self.model, self.data, q)
        if self.has_forces:
            potential += 0.5 * self.stiffness @ (q - self.rest) ** 2
        return kinetic, potential

    def q(self):
        return self.x[0]

    def v(self):
        return self.x[1]

    def attitude(self):
        q, v = self.x
        self.pin.forwardKinematics(self.model, self.data, q)
        turn = self.data.oMi[1].rotation
        return turn, turn @ v[-3:]


def cross(a, b):
    return a[[1, 2, 0]] * b[[2, 0, 1]] - a[[2, 0, 1]] * b[[1, 2, 0]]


class Drake:
    def __init__(self, m, dt, _):
        sys.path.insert(0, str(compare.HERE / "drivers"))
        import drake_plant
        from pydrake.common.eigen_geometry import Quaternion
        from pydrake.math import RollPitchYaw, RotationMatrix
        from pydrake.systems.analysis import Simulator

        path = compare.TARGET / "build" / "engine.json"
        path.write_text(json.dumps(m))
        self.plant, self.dt, self.steps = drake_plant.build(path, dt)[1], dt, 0
        self.simulator = Simulator(self.plant)
        self.context = self.simulator.get_mutable_context()
        self.push(0.0)
        positions, velocities = self.q().copy(), self.v().copy()
        for i, (b, q, v) in enumerate(mechanisms.parts(m)):
            joint, kind = self.plant.GetJointByName(f"j{i}"), mechanisms.joint_type(b)
            if kind in ("ball", "free"):
                turn = mechanisms.quaternion(q[-3:])
                rotation = RotationMatrix(Quaternion(turn))
                about = list(rotation.matrix() @ v[-3:])
                q = list(RollPitchYaw(rotation).vector()) if kind == "ball" else turn + q[:3]
                v = about if kind == "ball" else about + v[:3]
            at, rate = joint.position_start(), joint.velocity_start()
            positions[at : at + len(q)], velocities[rate : rate + len(v)] = q, v
        self.plant.SetPositions(self.context, positions)
        self.plant.SetVelocities(self.context, velocities)
        self.simulator.Initialize()

    def again(self, m, dt):
        return Drake(m, dt, None)

    def push(self, u):
        torques = [0.0] * self.plant.num_actuators()
        torques[:1] = [u] * len(torques[:1])
        self.plant.get_actuation_input_port().FixValue(self.context, torques)

    def advance(self, steps):
        self.steps += steps
        self.simulator.AdvanceTo(self.steps * self.dt)

    def energies(self):
        return self.plant.CalcKineticEnergy(self.context), self.plant.CalcPotentialEnergy(self.context)

    def q(self):
        return self.plant.GetPositions(self.context)

    def v(self):
        return self.plant.GetVelocities(self.context)

    def attitude(self):
        body = self.plant.GetBodyByName("b0")
        turn = self.plant.EvalBodyPoseInWorld(self.context, body).rotation().matrix()
        return turn, self.plant.EvalBodySpatialVelocityInWorld(self.context, body).rotational()


ENGINES = [
    ("MuJoCo Euler", MuJoCo, "EULER"),
    ("MuJoCo implicitfast", MuJoCo, "IMPLICITFAST"),
    ("MuJoCo RK4", MuJoCo, "RK4"),
    ("Pinocchio semi-implicit Euler", Pinocchio, "semi-implicit Euler"),
    ("Pinocchio RK4", Pinocchio, "RK4"),
    ("Drake discrete", Drake, None),
]


def stress(*arguments):
    """Rows of the stress suite by name: what it found."""
    out = compare.TARGET / "stress"
    (out / "stress.md").unlink(missing_ok=True)
    suite = ["cargo", "run", "--quiet", "--release", "--locked", "-p", "plantd-tests", "--bin", "stress", "--"]
    subprocess.run([*suite, *arguments, "--out", str(out)], cwd=compare.ROOT, stdout=subprocess.DEVNULL)
    rows = [line.split(" | ") for line in (out / "stress.md").read_text().splitlines() if line.startswith("| ")]
    return {row[0][2:]: row[3] for row in rows[1:]}


def number(word, row):
    """The number after a word in a row."""
    found = re.search(rf"(?:^|[ ;]){re.escape(word)} ([0-9.]+e-?[0-9]+)", row)
    return float(found[1]) if found else None


def show(value):
    """With as few characters as two digits need."""
    if value == 0 or 0.1 <= value < 100:
        return f"{value:.2g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"
