"""Compares small MJCFs of one feature each, imported, with MuJoCo: meshes, actuators, tendons, equalities

  pip install mujoco ./client/python
  cargo build --release -p plantd-server -p plantd-client
  python3 tests/peers/units.py [--server http://127.0.0.1:50051]

Mass matrix, springs and dampers, and accelerations under random controls, in random states. Equalities, which are
springs in MuJoCo, are compared as hard ones, in states on them: `M a + Jᵀ λ = f`, `J a = −J̇ v` with MuJoCo's
`M`, `f`, `J` and a difference quotient of its `J`.
"""

import argparse
import itertools
import pathlib
import struct
import sys
import tempfile
import warnings

import mujoco
import numpy as np

import plantd
from importing import ROOT, connected, imported

INERTIAL = '<inertial pos="0.1 -0.02 0.03" mass="1.5" fullinertia="0.02 0.03 0.025 0.002 -0.003 0.001"/>'
CHAIN = f"""<body name="a"><joint name="a" axis="0 1 0"/>{INERTIAL}<site name="s" pos="0.3 0 0.1"/>
  <body name="b" pos="0.4 0 0"><joint name="b" axis="1 0 0"/>{INERTIAL}
  <body name="c" pos="0.3 0.1 0"><joint name="c" axis="0 1 1"/>{INERTIAL}<site name="t" pos="0.1 0 0"/></body></body></body>"""
SMOOTH = {
    "damper actuators": CHAIN
    + """<actuator><damper joint="a" kv="0.4" ctrlrange="0 2"/>
    <damper joint="b" kv="1" gear="-3" ctrlrange="0 1"/>
    <general joint="c" gaintype="affine" gainprm="0 0 -2"/><motor joint="a" gear="2"/></actuator>""",
    "servos with ranges": CHAIN
    + """<actuator><position joint="a" kp="30" kv="2" gear="1.5"/><velocity joint="b" kv="3"/>
    <general joint="c" gainprm="7" biastype="affine" biasprm="0.5 -7 -0.2"/></actuator>""",
    "tendons": CHAIN
    + """<tendon><fixed name="f" stiffness="3" damping="0.2"><joint joint="a" coef="1"/><joint joint="c" coef="-2"/></fixed>
    <fixed name="g" armature="0.4"><joint joint="b" coef="1.5"/></fixed><spatial name="h" stiffness="40" damping="1"><site site="s"/>
    <site site="t"/></spatial></tendon><actuator><motor tendon="f"/><motor tendon="h" gear="3"/></actuator>""",
    "springs and dampers": CHAIN.replace('name="a" axis', 'name="a" stiffness="3 1 0.5" damping="0.2 0.1 0.3" springref="20" axis'),
    "springs of orientations": f"""<body pos="0.1 0 0.2" quat="0.6 0 0.8 0"><joint type="ball" stiffness="4" damping="0.1 0.2"/>{INERTIAL}
    <body pos="0 0.3 0" euler="10 20 30"><joint type="ball" springdamper="0.4 0.8"/>{INERTIAL}</body></body>
    <body pos="1 2 3" quat="0.8 0 0 0.6"><joint type="free" stiffness="5"/>{INERTIAL}</body>""",
    "rotors": CHAIN
    + """<tendon><fixed name="f" armature="0.3" damping="0.2"><joint joint="a" coef="1"/><joint joint="c" coef="-2"/></fixed></tendon>
    <actuator><motor tendon="f" gear="3" armature="0.1" damping="0.2"/><motor joint="b" gear="2" armature="0.2" damping="0.1 0.2 0.3"/>
    <position joint="a" kp="20" dampratio="0.7" armature="0.05"/></actuator>""",
}
EQUALITIES = {
    "connect": '<connect body1="c" body2="e" anchor="0.1 0.2 0"/>',
    "joint": '<joint joint1="a" joint2="c" polycoef="0.1 0.5 -0.2 0.1 0"/>',
    "joint alone": '<joint joint1="b" polycoef="0.3"/>',
    "tendon": '<tendon tendon1="f" tendon2="g" polycoef="0 0.7"/>',
    "weld": '<weld body1="c" body2="e"/>',
}
TENDONS = """<tendon><fixed name="f"><joint joint="a" coef="1"/><joint joint="c" coef="-2"/></fixed>
  <fixed name="g"><joint joint="b" coef="1"/></fixed></tendon>"""
FREE = f'<body name="e" pos="0.5 0.4 0.3"><freejoint name="e"/>{INERTIAL}</body>'


def beam():
    """A beam with an L for a section, which is not convex: points and triangles that look outwards."""
    flat = [(0, 0), (0.2, 0), (0.2, 0.1), (0.1, 0.1), (0.1, 0.3), (0, 0.3)]
    points = np.array([(x, y, z) for z in (0, 0.07) for x, y in flat])
    n, triangles = len(flat), []
    for i in range(n):
        j = (i + 1) % n
        triangles += [(i, j, n + j), (i, n + j, n + i)]
    for i, j, k in [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]:
        triangles += [(k, j, i), (n + i, n + j, n + k)]
    return points, np.array(triangles)


def mesh_files(folder):
    """The beam in files of all kinds."""
    points, triangles = beam()
    corners = points[triangles].astype("<f4")
    body = b"".join(struct.pack("<3f", 0, 0, 0) + t.tobytes() + b"\0\0" for t in corners)
    (folder / "beam.stl").write_bytes(b" " * 80 + struct.pack("<I", len(corners)) + body)
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles]
    (folder / "beam.obj").write_text("\n".join(lines) + "\n")
    head = struct.pack("<4i", len(points), 0, 0, len(triangles))
    (folder / "beam.msh").write_bytes(head + points.astype("<f4").tobytes() + triangles.astype("<i4").tobytes())


def meshes():
    """Models with a moving mesh, by file, rule and placement."""
    rules = ["", 'inertia="legacy"', 'inertia="exact"', 'inertia="convex"', 'inertia="shell"']
    places = ["", 'scale="0.5 -2 3" refpos="0.1 0.2 0.3" refquat="1 0.2 0.3 0.4"']
    for end, rule, place in itertools.product(("stl", "obj", "msh"), rules, places):
        geom = '<geom type="mesh" mesh="m" pos="0.1 0.2 0.3" euler="10 20 30"/><geom type="mesh" mesh="m" mass="2"/>'
        yield f"mesh {end} {rule} {place}", (
            f'<mujoco><compiler meshdir="parts"/><asset><mesh name="m" file="beam.{end}" {rule} {place}/></asset>'
            f'<worldbody><body><joint axis="1 2 3"/><joint type="slide" axis="1 0 0"/>{geom}<body pos="0.3 0 0">'
            f'<joint axis="0 1 0"/><geom type="mesh" mesh="m" density="500"/></body></body></worldbody></mujoco>'
        )


def model_of(parts):
    split = next((i for i in (parts.find(f"<{what}>") for what in ("tendon", "actuator", "equality")) if i >= 0), len(parts))
    return f"<mujoco><worldbody>{parts[:split]}</worldbody>{parts[split:]}</mujoco>"


def own_state(model, data):
    """The scene's coordinates of a state."""
    own = []
    for joint in range(model.njnt):
        at = model.jnt_qposadr[joint]
        kind = model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            own += [*data.qpos[at : at + 3]]
            at += 3
        elif kind != mujoco.mjtJoint.mjJNT_BALL:
            own.append(data.qpos[at])
            continue
        turn = data.qpos[at : at + 4] * np.sign(data.qpos[at])
        length = np.linalg.norm(turn[1:])
        own += [*(turn[1:] / max(length, 1e-300) * (2 * np.arctan2(length, turn[0])))]
    return np.array(own)


def off(found, expected):
    return abs(found - expected).max() / max(abs(expected).max(), 1e-9)


def smooth(client, name, file, binaries):
    """The largest differences of mass matrix and accelerations."""
    scene, refusal = imported(binaries / "plantctl", file)
    if scene is None:
        raise ValueError(refusal)
    model = mujoco.MjModel.from_xml_path(str(file))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # The whole way once more: the client sends the files that the importer asks for.
        client.create_model(file, name="unit")
    rng, worst = np.random.default_rng(2), np.zeros(2)
    for _ in range(3):
        data = mujoco.MjData(model)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1)
        data.qvel[:], data.ctrl[:] = rng.normal(size=model.nv), rng.uniform(0, 1, model.nu)
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        q = own_state(model, data)
        own = client.dynamics("unit", q=q, v=data.qvel)
        found = client.evaluate_dynamics("unit", q, data.qvel, inputs=data.ctrl).acceleration
        worst = np.maximum(worst, [off(own.mass_matrix, mass), off(found, data.qacc)])
    client.delete_model("unit")
    return worst


def rows(model, data):
    mujoco.mj_forward(model, data)
    jacobian = data.efc_J.reshape(-1, model.nv)[: data.ne]
    return data.efc_pos[: data.ne].copy(), jacobian.copy()


def equality(client, file):
    """The largest difference of accelerations on the equalities."""
    model = mujoco.MjModel.from_xml_path(str(file))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        client.create_model(file, name="unit")
    rng, worst = np.random.default_rng(3), 0.0
    for _ in range(3):
        data = mujoco.MjData(model)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv) * 0.3, 1)
        for _ in range(50):
            residual, jacobian = rows(model, data)
            mujoco.mj_integratePos(model, data.qpos, -np.linalg.pinv(jacobian) @ residual, 1)
        residual, jacobian = rows(model, data)
        if abs(residual).max() > 1e-10:
            raise ValueError(f"no configuration found: {abs(residual).max()}")
        speed = rng.normal(size=model.nv)
        data.qvel[:] = speed - np.linalg.pinv(jacobian) @ (jacobian @ speed)
        rows(model, data)
        mass, step = np.zeros((model.nv, model.nv)), 1e-6
        mujoco.mj_fullM(model, data, mass)
        ends = []
        for way in (step, -step):
            there = mujoco.MjData(model)
            there.qpos[:] = data.qpos
            mujoco.mj_integratePos(model, there.qpos, data.qvel, way)
            ends.append(rows(model, there)[1])
        drift = (ends[0] - ends[1]) @ data.qvel / (2 * step)
        n = len(drift)
        system = np.block([[mass, jacobian.T], [jacobian, np.zeros((n, n))]])
        right = np.concatenate([data.qfrc_passive - data.qfrc_bias, -drift])
        expected = np.linalg.lstsq(system, right, rcond=1e-12)[0][: model.nv]
        found = client.evaluate_dynamics("unit", own_state(model, data), data.qvel).acceleration
        worst = max(worst, off(found, expected))
    client.delete_model("unit")
    return worst


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--server", help="address of one that runs; by default one is started")
    parser.add_argument("--binaries", type=pathlib.Path, default=ROOT / "target" / "release")
    options = parser.parse_args()
    is_good = True
    with connected(options) as client, tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        (folder / "parts").mkdir()
        mesh_files(folder / "parts")
        file = folder / "unit.xml"
        cases = [(name, model_of(parts)) for name, parts in SMOOTH.items()] + list(meshes())
        for name, text in cases:
            file.write_text(text)
            worst = smooth(client, name, file, options.binaries)
            is_good &= bool(worst[0] < 1e-9 and worst[1] < 1e-7)
            print(f"{name}: {worst[0]:.0e}, {worst[1]:.0e}", flush=True)
        for name, equation in EQUALITIES.items():
            free = FREE if "body2" in equation else ""
            file.write_text(model_of(f"{CHAIN}{free}{TENDONS}<equality>{equation}</equality>"))
            worst = equality(client, file)
            is_good &= worst < 1e-6
            print(f"equality {name}: {worst:.0e}", flush=True)
    sys.exit(0 if is_good else 1)


if __name__ == "__main__":
    main()
