"""Compares every URDF of example-robot-data, imported, with Pinocchio; writes models/import/ROBOTS.md

  pip install pin example-robot-data ./client/python
  cargo build --release -p plantd-server -p plantd-client
  python3 tests/peers/robots.py [--server http://127.0.0.1:50051] [ROBOT.urdf ...]

Each robot is imported with `plantctl import`, once held by the world and once with a free base, its scene
uploaded to a running server, and looked at in three random states: the mass matrix by the momenta of unit
velocities, the bias forces by the accelerations that follow. Couplings, damping and friction are taken out
before: Pinocchio has none of them.
"""

import json
import pathlib
import re
import sys

import numpy as np
import pinocchio as pin

import plantd
from importing import arguments, cell, imported, write

SHARE = pathlib.Path(pin.__file__).parents[4] / "share/example-robot-data/robots"
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


def compared(client, scene, file, base):
    """Freedoms, and the largest differences of mass matrix and bias over their largest entries."""
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
        rng, worst = np.random.default_rng(1), np.zeros(2)
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
        client.delete_plant(plant.id)
        return len(names), worst
    finally:
        client.delete_model(made.name)


def main():
    options = arguments(__doc__, "robots")
    files = options.robots or sorted(SHARE.rglob("*.urdf"))
    rows, is_good = [], True
    # What Pinocchio does not have.
    without = ("constraints", "forces", "coordinates")
    with plantd.connect(options.server) as client:
        for file in files:
            cells = []
            for base in BASES:
                flags = ("--base", base, "--inputs", "none")
                scene = imported(options.binaries / "plantctl", file, *flags, without=without)
                compare = lambda scene: compared(client, scene, file, base)
                text, is_close = cell(*scene, compare, (1e-9, 1e-9))
                cells.append(text)
                is_good &= is_close
            name = file.relative_to(SHARE) if file.is_relative_to(SHARE) else file.name
            rows.append(f"| {name} | {' | '.join(cells)} |")
            print(rows[-1], flush=True)
    if not options.robots:
        text = f"Every URDF of example-robot-data 6.0.0, imported, and Pinocchio {pin.__version__}: the number of coordinates, and the largest differences of the mass matrix and of the bias forces over their largest entries, in three random states; held by the world, and with a free base."
        columns = ("robot", "held", "free")
        write("ROBOTS.md", "Robots in URDF beside Pinocchio", text, "robots.py", columns, rows)
    sys.exit(0 if is_good else 1)


if __name__ == "__main__":
    main()
