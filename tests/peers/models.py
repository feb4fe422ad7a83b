"""Compares MJCFs of dm_control's suite and of gymnasium, imported, with MuJoCo; writes models/import/MODELS.md

  pip install mujoco dm_control gymnasium ./client/python
  cargo build --release -p plantd-server -p plantd-client
  python3 tests/peers/models.py [--few] [--server http://127.0.0.1:50051] [MODEL.xml ...]

Each model is imported with `plantctl import`, its scene uploaded to a running server, and looked at in three
random states: the mass matrix by the momenta of unit velocities, and the accelerations with springs, dampers,
armature and actuators under random controls. Contacts, limits, dry friction, equalities and force ranges are
switched off in MuJoCo, and friction and constraints taken out of the scene: they are softer there, or not there.
"""

import importlib.metadata
import importlib.util
import json
import pathlib
import sys
import warnings

import mujoco
import numpy as np

import plantd
from importing import arguments, cell, connected, imported, write

FOLDERS = {"dm_control": "suite", "gymnasium": "envs/mujoco/assets"}
#: Of each kind one, for a quick look.
FEW = [
    *(f"dm_control/{name}.xml" for name in ("cartpole", "finger", "fish", "humanoid_CMU", "manipulator", "swimmer")),
    *(f"gymnasium/{name}.xml" for name in ("ant", "humanoid", "pusher", "walker2d_v5")),
]


def published():
    """Models by name; the suite's common files are parts of others."""
    for package, folder in FOLDERS.items():
        home = pathlib.Path(importlib.util.find_spec(package).origin).parent / folder
        for file in sorted(home.glob("*.xml")):
            yield f"{package}/{file.name}", file


def smooth(plantctl, file):
    """The scene without constraints and friction, or the first reason against it."""
    scene, refusal = imported(plantctl, file, without=("constraints", "operating_points"))
    if scene is not None:
        forces = scene.get("forces", [])
        scene["forces"] = [force for force in forces if force["type"] != "friction"]
    return scene, refusal


def peer(file):
    """The model in MuJoCo with smooth forces only."""
    model = mujoco.MjModel.from_xml_path(str(file))
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= int(
        off.mjDSBL_CONTACT | off.mjDSBL_LIMIT | off.mjDSBL_FRICTIONLOSS | off.mjDSBL_EQUALITY
    )
    model.opt.density = model.opt.viscosity = 0
    model.actuator_forcelimited[:] = 0
    model.actuator_ctrllimited[:] = 0
    model.jnt_actfrclimited[:] = 0
    model.tendon_actfrclimited[:] = 0
    return model


def state(model, rng):
    """A random configuration in MuJoCo's numbers and in the scene's."""
    data, own = mujoco.MjData(model), []
    for joint in range(model.njnt):
        kind, at = mujoco.mjtJoint(model.jnt_type[joint]), model.jnt_qposadr[joint]
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            turn = rng.normal(size=4)
            turn *= np.sign(turn[0]) / np.linalg.norm(turn)
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                data.qpos[at : at + 3] = rng.uniform(-1, 1, 3)
                own += [*data.qpos[at : at + 3]]
                at += 3
            data.qpos[at : at + 4] = turn
            angle = 2 * np.arctan2(np.linalg.norm(turn[1:]), turn[0])
            own += [*(turn[1:] / np.linalg.norm(turn[1:]) * angle)]
        else:
            reach = 1.5 if kind == mujoco.mjtJoint.mjJNT_HINGE else 0.2
            data.qpos[at] = rng.uniform(-reach, reach)
            own.append(data.qpos[at])
    data.qvel[:] = rng.normal(size=model.nv)
    data.ctrl[:] = rng.uniform(-1, 1, size=model.nu)
    mujoco.mj_forward(model, data)
    return data, np.array(own)


def compared(client, scene, file):
    """Freedoms, and the largest differences of mass matrix and accelerations over their largest entries."""
    model = peer(file)
    if model.nv == 0:
        return 0, None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = client.create_model(json.dumps(scene), name="model-under-test")
    try:
        names = [coordinate.name for coordinate in made.coordinates]
        held = len(names) - model.nv
        if held != 6 * model.nmocap or len(made.inputs) != model.nu:
            raise ValueError(
                f"{len(names)} coordinates and {len(made.inputs)} inputs instead of {model.nv} and {model.nu}"
            )
        initial = {c["name"]: c.get("initial", 0.0) for c in scene.get("coordinates", [])}
        tail = np.array([initial.get(name, 0.0) for name in names[model.nv :]])
        plant, worst = client.create_plant(made.name), np.zeros(2)
        rng = np.random.default_rng(1)
        for _ in range(3):
            data, own = state(model, rng)
            own = np.concatenate([own, tail])
            mass = np.zeros((model.nv, model.nv))
            mujoco.mj_fullM(model, data, mass)
            unit = np.eye(model.nv, len(names))
            found = [client.reset(plant.id, q=own, v=unit[j]).p for j in range(model.nv)]
            worst[0] = max(worst[0], abs(np.array(found).T - mass).max() / abs(mass).max())
            v = np.concatenate([data.qvel, np.zeros(held)])
            acceleration = client.evaluate_dynamics(made.name, own, v, inputs=data.ctrl).acceleration
            scale = max(abs(data.qacc).max(), 1e-300)
            worst[1] = max(worst[1], abs(acceleration - data.qacc).max() / scale)
        client.delete_plant(plant.id)
        return len(names), worst
    finally:
        client.delete_model(made.name)


def main():
    options = arguments(__doc__, "models")
    files = [(file.name, file) for file in options.models] or list(published())
    if options.few:
        files = [(name, file) for name, file in files if name in FEW]
    rows, is_good = [], True
    with connected(options) as client:
        for name, file in files:
            scene = smooth(options.binaries / "plantctl", file)
            compare = lambda scene: compared(client, scene, file)
            text, is_close = cell(*scene, compare, (1e-9, 1e-7))
            is_good &= is_close
            rows.append(f"| {name} | {text} |")
            print(rows[-1], flush=True)
    if not options.models and not options.few:
        versions = ", ".join(f"{p} {importlib.metadata.version(p)}" for p in FOLDERS)
        text = f"The MJCFs of {versions}, imported, and MuJoCo {mujoco.__version__}: the number of coordinates, and the largest differences of the mass matrix and of the accelerations (springs, dampers, armature and actuators included) over their largest entries, in three random states."
        title = "Models in MJCF beside MuJoCo"
        write("MODELS.md", title, text, "models.py", ("model", ""), rows)
    sys.exit(0 if is_good else 1)


if __name__ == "__main__":
    main()
