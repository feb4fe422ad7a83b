"""Compares every URDF of example-robot-data, imported, with Pinocchio; writes models/import/ROBOTS.md

  pip install pin example-robot-data ./client/python
  cargo build --release -p plantd-server -p plantd-client
  python3 tests/peers/robots.py [--few] [--server http://127.0.0.1:50051] [ROBOT.urdf ...]

Each robot is imported with `plantctl import`, once held by the world and once with a free base, its scene
uploaded to a running server, and looked at in three random states: the mass matrix by the momenta of unit
velocities and by `Dynamics`, the bias forces by the accelerations that follow and by `Dynamics`, with gravity and
inverse dynamics; poses, velocities and Jacobians of frames and the centre of mass by `Kinematics`. Couplings,
damping and friction are taken out before: Pinocchio has none of them.
"""

import json
import pathlib
import re
import sys

import numpy as np
import pinocchio as pin

import plantd
from importing import arguments, cell, connected, imported, write

SHARE = pathlib.Path(pin.__file__).parents[4] / "share/example-robot-data/robots"
#: Of each kind one, for a quick look.
FEW = ["panda", "allegro_left_hand", "go2", "iris_simple", "ur5_robot", "double_pendulum", "talos_reduced"]
BASES = {"fixed": None, "free": "root_joint"}


def plain(name):
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)


def columns(model, robot_names, root):
    """The entry of the scene's coordinates for each velocity of Pinocchio."""
    places = []
    for joint, name in zip(list(model.joints)[1:], list(model.names)[1:]):
        if name == "root_joint":
            places += [robot_names.index(f"{root}_{end}") for end in ("x", "y", "z", "rx", "ry", "rz")]
        elif joint.nv == 1:
            places.append(robot_names.index(plain(name)))
        else:
            raise NotImplementedError(f"joint `{name}` has {joint.nv} velocities")
    return places


def state(model, places, rng):
    """Random configurations and velocities of both, and what turns the scene's velocities into Pinocchio's."""
    q, own, turn = pin.neutral(model), np.zeros(model.nv), np.eye(model.nv)
    v, drift = rng.normal(size=model.nv), np.zeros(model.nv)
    for joint, name in zip(list(model.joints)[1:], list(model.names)[1:]):
        at = joint.idx_v
        if name == "root_joint":
            quaternion = pin.Quaternion(*(x := rng.normal(size=4)) / np.linalg.norm(x))
            rotation, position = quaternion.toRotationMatrix(), rng.uniform(-1, 1, 3)
            q[:7] = np.concatenate([position, quaternion.coeffs()])
            own[at : at + 6] = np.concatenate([position, pin.log3(rotation)])
            turn[:3, :3] = rotation.T
            drift[:3] = -np.cross(v[3:6], rotation.T @ v[:3])
            continue
        value = rng.uniform(-1.5, 1.5) if joint.nq == 2 or "P" not in joint.shortname() else rng.uniform(-0.2, 0.2)
        own[at] = value
        q[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
    return q, own, v, turn, drift


def off(found, expected):
    """The largest difference over the largest entry."""
    return abs(found - expected).max() / max(abs(expected).max(), 1e-300)


def kinematics(model, data, motion, places, q, v, turn):
    """The largest difference of poses, velocities and Jacobians of links and the centre of mass."""
    pin.forwardKinematics(model, data, q, turn @ v)
    pin.updateFramePlacements(model, data)
    pin.computeJointJacobians(model, data, q)
    worst, axes = 0.0, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    for index, frame in enumerate(model.frames):
        own = motion.frames.get(plain(frame.name)) if frame.type == pin.FrameType.BODY else None
        if own is None:
            continue
        pose, (w, x, y, z) = data.oMf[index], own.orientation
        turned = pin.Quaternion(w, x, y, z).toRotationMatrix()
        jacobian = pin.getFrameJacobian(model, data, index, axes) @ turn
        speed = pin.getFrameVelocity(model, data, index, axes).vector
        worst = max(worst, abs(own.position - pose.translation).max(), abs(turned - pose.rotation).max())
        worst = max(worst, abs(own.jacobian[:, places] - jacobian).max() / max(abs(jacobian).max(), 1))
        velocity = np.concatenate([own.linear_velocity, own.angular_velocity])
        worst = max(worst, abs(velocity - speed).max() / max(abs(speed).max(), 1))
    center = pin.centerOfMass(model, data, q)
    return max(worst, abs(motion.center_of_mass.position - center).max())


def compared(client, scene, file, base):
    """Freedoms, and the largest differences of mass matrix, forces and kinematics over their largest entries."""
    parts = [str(file)] if base == "fixed" else [str(file), pin.JointModelFreeFlyer()]
    model = pin.buildModelFromUrdf(*parts)
    data = model.createData()
    if model.nv == 0:
        return 0, None
    made = client.create_model(json.dumps(scene), name="robot-under-test")
    try:
        names = [coordinate.name for coordinate in made.coordinates]
        root = scene["frames"][0]["name"]
        places = columns(model, names, root)
        if len(places) != len(names):
            raise ValueError(f"{len(names)} coordinates instead of {len(places)}")
        rng, worst = np.random.default_rng(1), np.zeros(3)
        plant = client.create_plant(made.name)
        put = lambda values: np.array(values)[np.argsort(places)]
        for _ in range(3):
            q, own, v, turn, drift = state(model, places, rng)
            upper = np.triu(pin.crba(model, data, q))
            peer = upper + np.triu(upper, 1).T
            bias = turn.T @ (pin.nonLinearEffects(model, data, q, turn @ v) + peer @ drift)
            peer = turn.T @ peer @ turn
            unit = np.eye(len(names))
            found = [client.reset(plant.id, q=put(own), v=put(unit[j])).p[places] for j in range(len(names))]
            worst[0] = max(worst[0], abs(np.array(found).T - peer).max() / abs(peer).max())
            acceleration = client.evaluate_dynamics(made.name, put(own), put(v)).acceleration[places]
            worst[1] = max(worst[1], abs(peer @ acceleration + bias).max() / max(abs(bias).max(), 1e-300))
            asked = rng.normal(size=model.nv)
            own_terms = client.dynamics(made.name, q=put(own), v=put(v), acceleration=put(asked))
            rest = turn.T @ pin.computeGeneralizedGravity(model, data, q)
            at = np.ix_(places, places)
            worst[0] = max(worst[0], off(own_terms.mass_matrix[at], peer))
            for found, expected in [
                (own_terms.bias[places], bias),
                (own_terms.gravity[places], rest),
                (own_terms.inverse.force[places], peer @ asked + bias),
            ]:
                worst[1] = max(worst[1], off(found, expected))
            motion = client.kinematics(made.name, q=put(own), v=put(v), jacobians=True)
            worst[2] = max(worst[2], kinematics(model, data, motion, places, q, v, turn))
        client.delete_plant(plant.id)
        return len(names), worst
    finally:
        client.delete_model(made.name)


def main():
    options = arguments(__doc__, "robots")
    files = options.robots or sorted(SHARE.rglob("*.urdf"))
    if options.few:
        files = [file for file in files if file.stem in FEW]
    rows, is_good = [], True
    # What Pinocchio does not have.
    without = ("constraints", "forces", "coordinates")
    with connected(options) as client:
        for file in files:
            cells = []
            for base in BASES:
                flags = ("--base", base, "--inputs", "none")
                scene = imported(options.binaries / "plantctl", file, *flags, without=without)
                compare = lambda scene: compared(client, scene, file, base)
                text, is_close = cell(*scene, compare, (1e-9, 1e-9, 1e-9))
                cells.append(text)
                is_good &= is_close
            name = file.relative_to(SHARE) if file.is_relative_to(SHARE) else file.name
            rows.append(f"| {name} | {' | '.join(cells)} |")
            print(rows[-1], flush=True)
    if not options.robots and not options.few:
        text = f"Every URDF of example-robot-data 6.0.0, imported, and Pinocchio {pin.__version__}: the number of coordinates, and the largest differences of the mass matrix, of the forces (bias, gravity, inverse dynamics) and of poses, velocities, Jacobians and centre of mass over their largest entries, in three random states; held by the world, and with a free base."
        columns = ("robot", "held", "free")
        write("ROBOTS.md", "Robots in URDF beside Pinocchio", text, "robots.py", columns, rows)
    sys.exit(0 if is_good else 1)


if __name__ == "__main__":
    main()
