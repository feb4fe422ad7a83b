"""Drake: its discrete plant and its error-controlled integrators, stepped by its own simulator.

The protocol of driver.h; PATH is a JSON mechanism. Methods: `discrete`, and `rk3:ACCURACY`,
`rk5:ACCURACY` (DT times STEPS is the whole time).
"""

import json
import sys
import time

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    PrismaticJoint,
    PrismaticSpring,
    QuaternionFloatingJoint,
    RevoluteJoint,
    RevoluteSpring,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator

AXIAL = {"hinge": (RevoluteJoint, RevoluteSpring), "slide": (PrismaticJoint, PrismaticSpring)}
TURNING = {"ball": BallRpyJoint, "free": QuaternionFloatingJoint}
INTEGRATORS = {"rk3": "runge_kutta3", "rk5": "runge_kutta5"}


def build(path, time_step):
    with open(path) as file:
        m = json.load(file)
    plant = MultibodyPlant(time_step)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -m["gravity"]])
    bodies = []
    for i, b in enumerate(m["bodies"]):
        mass = b["mass"]
        about_com = UnitInertia(*(entry / mass if mass else 0.0 for entry in b["inertia"]))
        inertia = SpatialInertia(mass, b["com"], about_com.ShiftFromCenterOfMass(b["com"]))
        bodies.append(plant.AddRigidBody(f"b{i}", inertia))
        parent = plant.world_body() if b["parent"] < 0 else bodies[b["parent"]]
        hinge = FixedOffsetFrame(f"f{i}", parent.body_frame(), RigidTransform(b["pos"]))
        frame = plant.AddFrame(hinge)
        ends = f"j{i}", frame, bodies[i].body_frame()
        if b.get("type") in TURNING:
            plant.AddJoint(TURNING[b["type"]](*ends))
            continue
        kind, spring = AXIAL[b.get("type", "hinge")]
        joint = plant.AddJoint(kind(*ends, b["axis"], damping=b.get("damping", 0.0)))
        plant.AddJointActuator(f"m{i}", joint)
        if b.get("stiffness"):
            plant.AddForceElement(spring(joint, b["rest"], b["stiffness"]))
    for loop in m["loops"]:
        a, b = bodies[loop["body_a"]], bodies[loop["body_b"]]
        plant.AddBallConstraint(a, loop["at_a"], b, loop["at_b"])
    plant.Finalize()
    return m, plant


class Discrete:
    def __init__(self, path, dt):
        self.dt = dt
        self.mechanism, self.plant = build(path, dt)
        self.start = np.array(self.mechanism["q0"] + self.mechanism["v0"])
        self.torques = np.zeros(self.plant.num_actuators())

    def run(self, steps, passes):
        simulator = Simulator(self.plant)
        context = simulator.get_mutable_context()
        self.plant.get_actuation_input_port().FixValue(context, self.torques)
        begin = time.thread_time()
        for _ in range(passes):
            context.SetTime(0)
            self.plant.SetPositionsAndVelocities(context, self.start)
            simulator.Initialize()
            simulator.AdvanceTo(steps * self.dt)
        return time.thread_time() - begin, self.plant.GetPositions(context)


class Continuous:
    def __init__(self, path, integrator, accuracy):
        self.mechanism, self.plant = build(path, 0.0)
        self.simulator = Simulator(self.plant)
        ResetIntegratorFromFlags(self.simulator, INTEGRATORS[integrator], 0.1)
        self.simulator.get_mutable_integrator().set_target_accuracy(accuracy)
        self.plant.get_actuation_input_port().FixValue(
            self.simulator.get_mutable_context(), np.zeros(self.plant.num_actuators())
        )

    def run(self, end, passes):
        context = self.simulator.get_mutable_context()
        start = self.mechanism["q0"] + self.mechanism["v0"]
        begin = time.thread_time()
        for _ in range(passes):
            context.SetTime(0)
            self.plant.SetPositionsAndVelocities(context, start)
            self.simulator.Initialize()
            self.simulator.AdvanceTo(end)
        return time.thread_time() - begin, self.plant.GetPositions(context)


def answer(cache, path, method, dt, steps, passes):
    dt, steps, passes = float(dt), int(steps), int(passes)
    if ":" in method:
        key = (path, method)
        if key not in cache:
            integrator, accuracy = method.split(":")
            cache[key] = Continuous(path, integrator, float(accuracy))
        return cache[key].run(dt * steps, passes)
    key = (path, method, dt)
    if key not in cache:
        cache[key] = {"discrete": Discrete}[method](path, dt)
    return cache[key].run(steps, passes)


def main():
    cache = {}
    for line in sys.stdin:
        try:
            seconds, q = answer(cache, *line.split())
            print(repr(seconds), *map(repr, map(float, q)), flush=True)
        except Exception as error:
            print("error:", " ".join(str(error).split()), flush=True)


if __name__ == "__main__":
    main()
