"""Compares every URDF of example-robot-data, imported, with Pinocchio; writes models/import/ROBOTS.md

  pip install pin example-robot-data ./client/python
  cargo build --release -p plantd-server -p plantd-client
  python3 tests/peers/robots.py [--server http://127.0.0.1:50051] [ROBOT.urdf ...]

Each robot is imported with `plantctl import`, once held by the world and once with a free base, its scene
uploaded to a running server, and looked at in three random states: the mass matrix by the momenta of unit
velocities, the bias forces by the accelerations that follow. Couplings, damping and friction are taken out
before: Pinocchio has none of them.
"""

import argparse
import json
import pathlib
import re
import subprocess
import sys
import tomllib

import numpy as np
import pinocchio as pin

import plantd

ROOT = pathlib.Path(__file__).resolve().parents[2]
BINARIES = ROOT / "target" / "release"
SHARE = pathlib.Path(pin.__file__).parents[4] / "share/example-robot-data/robots"
BASES = {"fixed": None, "free": "root_joint"}


def plain(name):
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)


def imported(plantctl, file, base):
    """The scene without what Pinocchio does not have, or the first reason against it."""
    run = [plantctl, "import", "--json", "--base", base, "--inputs", "none", file]
    done = subprocess.run(run, capture_output=True, text=True, timeout=60)
    if done.returncode != 0:
        told = json.loads(done.stderr.splitlines()[-1])["error"]["message"]
        return None, told.removeprefix(f"{file} cannot be imported: ").splitlines()[0]
    scene = tomllib.loads(json.loads(done.stdout)["scene_toml"])
    for what in ("constraints", "forces", "coordinates"):
        scene.pop(what, None)
    return scene, done.stderr


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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--server", default="http://127.0.0.1:50051")
    parser.add_argument("--binaries", type=pathlib.Path, default=BINARIES)
    parser.add_argument("robots", nargs="*", type=pathlib.Path)
    options = parser.parse_args()
    files = options.robots or sorted(SHARE.rglob("*.urdf"))
    rows, is_good = [], True
    with plantd.connect(options.server) as client:
        for file in files:
            cells = []
            for base in BASES:
                scene, told = imported(options.binaries / "plantctl", file, base)
                if scene is None:
                    cells.append(f"refused: {told}")
                    continue
                try:
                    count, worst = compared(client, scene, file, base)
                    if worst is None:
                        cells.append("nothing moves")
                        continue
                    is_good &= bool(worst.max() < 1e-9)
                    cells.append(f"{count}: {worst[0]:.0e}, {worst[1]:.0e}")
                except (plantd.PlantdError, ValueError, NotImplementedError) as error:
                    is_good = False
                    cells.append(f"not compared: {error}".replace("\n", " "))
            name = file.relative_to(SHARE) if file.is_relative_to(SHARE) else file.name
            rows.append(f"| {name} | {' | '.join(cells)} |")
            print(rows[-1], flush=True)
    if not options.robots:
        lines = [
            "# Robots in URDF beside Pinocchio",
            "",
            f"Every URDF of example-robot-data 6.0.0, imported, and Pinocchio {pin.__version__}: the number of coordinates, and the largest differences of the mass matrix and of the bias forces over their largest entries, in three random states; held by the world, and with a free base.",
            "Made by `python3 tests/peers/robots.py`.",
            "",
            "| robot | held | free |",
            "| --- | --- | --- |",
            *rows,
        ]
        (ROOT / "models/import/ROBOTS.md").write_text("\n".join(lines) + "\n")
    sys.exit(0 if is_good else 1)


if __name__ == "__main__":
    main()
