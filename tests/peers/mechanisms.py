"""The mechanisms that are compared, and how each peer is told of them.

Bodies hang from joints: `parent` (-1 is the world), `pos` of the joint in the parent's frame, `axis`, `mass`,
centre of mass `com` and diagonal `inertia` about it, in the body's axes. A joint is a hinge unless its `type` says
`slide`, `ball` or `free`; hinges and slides may have `stiffness` about `rest`, and `damping`. In q0 an orientation
is a rotation vector, after the place of a free body; in v0 its velocity is in the body's axes. Robots also have
the orientation `turn` of a joint in its parent as a quaternion, w first, and products of inertia `Ixy`, `Ixz`, `Iyz`
after the moments. `rough` are the largest of the torques that change at each step. A loop holds a point of one body
at a point of another, or of the world, along `axes`: x and z unless it says more. Units are SI.
"""

import math

GRAVITY = 9.8
# What MuJoCo needs at least, kg m².
LEAST_INERTIA = 2e-15
SIZES = {"hinge": 1, "slide": 1, "ball": 3, "free": 6}


def body(parent, pos, axis, mass, com, inertia, **joint):
    return dict(parent=parent, pos=pos, axis=axis, mass=mass, com=com, inertia=inertia) | joint


def mechanism(name, bodies, q0, v0=None, loops=()):
    v0 = v0 or [0.0] * len(q0)
    return dict(name=name, gravity=GRAVITY, bodies=bodies, q0=q0, v0=v0, loops=list(loops))


def joint_type(b):
    return b.get("type", "hinge")


def parts(m):
    """Bodies, each with its part of q0 and of v0."""
    at = 0
    for b in m["bodies"]:
        size = SIZES[joint_type(b)]
        yield b, m["q0"][at : at + size], m["v0"][at : at + size]
        at += size


def quaternion(turn):
    """Of a rotation vector; w first."""
    angle = math.hypot(*turn)
    return [math.cos(angle / 2), *(x * math.sin(angle / 2) / angle if angle else 0.0 for x in turn)]


def point_mass(parent, z, mass=1.0, length=1.0):
    return body(parent, [0, 0, z], [0, 1, 0], mass, [0, 0, -length], [0, 0, 0])


def slider(mass, **joint):
    return body(-1, [0, 0, 0], [1, 0, 0], mass, [0, 0, 0], [0, 0, 0], type="slide", **joint)


def rod(parent, pos, length, mass):
    across = mass * length**2 / 12
    return body(parent, pos, [0, 1, 0], mass, [0, 0, -length / 2], [across, across, 0.0])


def pendulum():
    return mechanism("P", [point_mass(-1, 0)], [math.pi / 2])


def double_pendulum(masses=(1.0, 1.0), lengths=(1.0, 1.0)):
    bodies = [point_mass(-1, 0, masses[0], lengths[0]), point_mass(0, -lengths[0], masses[1], lengths[1])]
    return mechanism("D", bodies, [math.pi / 2, 0.0])


def spherical_pendulum():
    """A point mass on two hinges with nothing between them."""
    massless = body(-1, [0, 0, 0], [1, 0, 0], 0.0, [0, 0, 0], [0, 0, 0])
    return mechanism("S", [massless, point_mass(0, 0)], [0.8, 0.3], [0.5, 1.5])


def chain(n):
    """n uniform thin rods, 1 m and 1 kg together, released from horizontal."""
    length = 1.0 / n
    rods = [rod(i - 1, [0, 0, -length if i else 0], length, length) for i in range(n)]
    return mechanism(f"C{n}", rods, [math.pi / 2] + [0.0] * (n - 1))


def hanging_chain(n):
    """The same chain, released 30 degrees from hanging: a motion that is as gentle for any n."""
    return chain(n) | dict(name=f"H{n}", q0=[math.pi / 6] + [0.0] * (n - 1))


def chain_in_space(n):
    """The same with hinges across each other: about y and x by turns."""
    m = hanging_chain(n)
    for b in m["bodies"][1::2]:
        b["axis"] = [1, 0, 0]
    q0 = [math.pi / 6, math.pi / 6] + [0.0] * (n - 2)
    return m | dict(name=f"Z{n}", q0=q0)


def tree(n):
    """Balanced binary tree of n boxes, hinged about alternating axes."""
    axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    bodies = []
    for i in range(n):
        parent = (i - 1) // 2 if i else -1
        depth = (i + 1).bit_length() - 1
        pos = [0.05 if i % 2 else -0.05, 0.02, -0.2] if i else [0, 0, 0]
        com = [0.01, 0.005, -0.1]
        bodies.append(body(parent, pos, axes[depth % 3], 0.96, com, [0.003712, 0.003488, 0.0008]))
    q0 = [0.6 * math.sin(0.7 + 1.3 * i) for i in range(n)]
    return mechanism(f"T{n}", bodies, q0, [0.5 * math.cos(2.1 * i) for i in range(n)])


def four_bar():
    bodies = [rod(-1, [0, 0, 0], 0.5, 0.5), rod(0, [0, 0, -0.5], 1.2, 1.2), rod(-1, [1.0, 0, 0], 1.0, 1.0)]
    loop = dict(body_a=1, at_a=[0, 0, -1.2], body_b=2, at_b=[0, 0, -1.0])
    return mechanism("L", bodies, [-1.2, 0.27841001304404134, -0.4355357264293478], loops=[loop])


def ball_pendulum():
    rod = body(-1, [0, 0, 0], [0, 0, 0], 1.0, [0, 0, -1.0], [0.01, 0.01, 0.01], type="ball")
    return mechanism("ball", [rod], [0.8, 0.0, 0.0])


def cart_pole():
    return mechanism("cart", [slider(10.0), point_mass(0, 0)], [0.0, 0.7])


def elastic_pendulum(stiffness):
    """A point mass that slides along a massless rod, held 1 m from its hinge by a spring."""
    hinge = body(-1, [0, 0, 0], [0, 1, 0], 0.0, [0, 0, 0], [0, 0, 0])
    spring = dict(type="slide", stiffness=stiffness, rest=1.0)
    bob = body(0, [0, 0, 0], [0, 0, -1], 1.0, [0, 0, 0], [0, 0, 0], **spring)
    return mechanism("elastic", [hinge, bob], [1.0, 1.0])


def gimbal():
    """A body on three hinges, without gravity."""
    axes = [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    bodies = [body(i - 1, [0, 0, 0], axis, 0.0, [0, 0, 0], [0, 0, 0]) for i, axis in enumerate(axes)]
    bodies[2] |= dict(mass=1.0, inertia=[0.3, 0.4, 0.5])
    return mechanism("gimbal", bodies, [0.0] * 3) | dict(gravity=0.0)


def rigid_body(joint, v0):
    """An asymmetric body, without gravity."""
    free = body(-1, [0, 0, 0], [0, 0, 0], 1.0, [0, 0, 0], [0.02, 0.03, 0.045], type=joint)
    return mechanism(joint, [free], [0.0] * len(v0), v0) | dict(gravity=0.0)


def parallelogram(rocker=1.0, third=None):
    """Four-bar linkage that can be flat, without gravity; `third` is the length of another crank in its middle."""
    crank = lambda pos: body(-1, pos, [0, 1, 0], 1.0, [0, 0, -0.5], [0.1, 0.1, 0.0])
    coupler = body(0, [0, 0, -1.0], [0, 1, 0], 1.0, [1.0, 0, 0], [0.3, 0.3, 0.3])
    bodies = [crank([0, 0, 0]), coupler, crank([2.0, 0, rocker - 1.0])]
    loops = [dict(body_a=1, at_a=[2.0, 0, 0], body_b=2, at_b=[0, 0, -rocker])]
    if third:
        bodies.append(crank([1.0, 0, 0]))
        loops.append(dict(body_a=1, at_a=[1.0, 0, 0], body_b=3, at_b=[0, 0, -third]))
    q0 = [0.3, -0.3, 0.3, 0.3][: len(bodies)]
    return mechanism("parallelogram", bodies, q0, [1.0, -1.0, 1.0, 1.0][: len(bodies)], loops) | dict(gravity=0.0)


def scissor(n):
    """n pairs of crossed links of 5 m below a rail, nearly flat, in two strands that change sides at every pair."""
    length, opening = 5.0, math.pi / 20
    bodies, q0, at = [slider(1.0)], [length * math.cos(opening)], {}
    for start, first_is_right in [(0, True), (-1, False)]:
        parent = start
        for i in range(n):
            right = first_is_right == (i % 2 == 0)
            fold = opening * (2 if i else 1)
            q0.append(math.pi - fold if right else fold + (math.pi if i else 0.0))
            pos = [length if i else 0.0, 0, 0]
            bodies.append(body(parent, pos, [0, 1, 0], 1.0, [length / 2, 0, 0], [1.0] * 3))
            parent = at[i, right] = len(bodies) - 1
    middle = [length / 2, 0, 0]
    loops = [dict(body_a=at[i, False], at_a=middle, body_b=at[i, True], at_b=middle) for i in range(n)]
    return mechanism(f"X{n}", bodies, q0, loops=loops)


def scaled(m, length, mass):
    """The same mechanism of other size and weight."""
    times = lambda factor, numbers: [factor * x for x in numbers]
    bodies = [
        b
        | dict(pos=times(length, b["pos"]), com=times(length, b["com"]), mass=mass * b["mass"])
        | dict(inertia=times(mass * length**2, b["inertia"]))
        for b in m["bodies"]
    ]
    loops = [l | dict(at_a=times(length, l["at_a"]), at_b=times(length, l["at_b"])) for l in m["loops"]]
    return m | dict(bodies=bodies, loops=loops)


def ball_tree(n):
    """Balanced binary tree of n boxes on ball joints, numbered depth first as MuJoCo does."""
    bodies = []

    def add(heap, parent):
        pos = [-0.2 if heap % 2 else 0.2, 0.05, -0.2] if heap else [0, 0, 0]
        bodies.append(ball_box(parent, pos))
        own = len(bodies) - 1
        for child in (2 * heap + 1, 2 * heap + 2):
            if child < n:
                add(child, own)

    add(0, -1)
    return moving(f"B{n}", bodies)


def ball_chain(n):
    """n boxes, each on a ball joint at the end of the one before."""
    return moving(f"K{n}", [ball_box(i - 1, [0, 0, -0.3 if i else 0]) for i in range(n)])


def ball_box(parent, pos):
    inertia = [0.012, 0.010, 0.006]
    return body(parent, pos, [0, 0, 0], 1.0, [0.01, 0.005, -0.1], inertia, type="ball")


def moving(name, bodies):
    """In a pose and a motion of all joints; a base that floats begins upright."""
    q0, v0, rough = [], [], []
    for i, b in enumerate(bodies):
        size = SIZES[joint_type(b)]
        q0 += [0.0 if size == 6 else 0.3 * math.sin(1.3 * (i + k)) for k in range(size)]
        v0 += [0.5 * math.sin(1.7 * (len(v0) + k)) for k in range(size)]
        rough += [0.0 if size == 6 else 0.05 * GRAVITY * b["mass"]] * size
    return mechanism(name, bodies, q0, v0) | dict(rough=rough)


# Robots of example-robot-data: file, whether the base floats, joints that are held.
ROBOTS = {
    "panda": ("panda_description/urdf/panda.urdf", False, ["panda_finger_joint1", "panda_finger_joint2"]),
    "g1-fixed": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", False, []),
    "go1": ("go1_description/urdf/go1.urdf", True, []),
    "anymal": ("anymal_c_simple_description/urdf/anymal.urdf", True, []),
    "g1": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", True, []),
    "talos": ("talos_data/robots/talos_reduced.urdf", True, []),
}


# The same standing: robot, pose of each leg, frames of the feet.
STANDING = {
    "go1-feet": ("go1", [0.1, 0.9, -1.8], ["FL_foot", "FR_foot", "RL_foot", "RR_foot"]),
}


def pinocchio_model(name):
    import pathlib

    import pinocchio as pin

    path, floats, held = ROBOTS[name]
    parents = pathlib.Path(pin.__file__).resolve().parents
    share = "share/example-robot-data/robots"
    [file] = [p / share / path for p in parents if (p / share / path).exists()]
    base = [pin.JointModelFreeFlyer()] if floats else []
    model = pin.buildModelFromUrdf(str(file), *base)
    if held:
        held = [model.getJointId(joint) for joint in held]
        model = pin.buildReducedModel(model, held, pin.neutral(model))
    return model


def robot(name):
    """A robot as Pinocchio reads it."""
    import pinocchio as pin

    model = pinocchio_model(name)
    bodies = []
    for i in range(1, model.njoints):
        place, inertia, kind = model.jointPlacements[i], model.inertias[i], model.joints[i].shortname()
        turn = pin.Quaternion(place.rotation)
        about = inertia.inertia
        joint = dict(turn=[turn.w, turn.x, turn.y, turn.z])
        axis = [0.0, 0.0, 0.0]
        if kind == "JointModelFreeFlyer":
            joint["type"] = "free"
        elif kind[:-1] in ("JointModelR", "JointModelRUB"):
            axis["XYZ".index(kind[-1])] = 1.0
        else:
            axis = [float(a) for a in model.joints[i].extract().axis]
        numbers = [about[0, 0], about[1, 1], about[2, 2], about[0, 1], about[0, 2], about[1, 2]]
        place = [float(x) for x in place.translation]
        com = [float(x) for x in inertia.lever]
        bodies.append(
            body(model.parents[i] - 1, place, axis, float(inertia.mass), com, [*map(float, numbers)], **joint)
        )
    return moving(name, bodies)


def standing(name):
    """A robot each of whose feet is held at a point of the world; its base moves, and the legs as they must."""
    import numpy as np
    import pinocchio as pin

    free, leg, feet = STANDING[name]
    m, model = robot(free), pinocchio_model(free)
    data, feet = model.createData(), [model.getFrameId(foot) for foot in feet]
    q0, v0 = m["q0"][:6] + leg * len(feet), np.zeros(model.nv)
    v0[:6] = m["v0"][:6]
    q = np.array(q0[:3] + [0.0, 0.0, 0.0, 1.0] + q0[6:])
    pin.computeJointJacobians(model, data, q)
    pin.framesForwardKinematics(model, data, q)
    by_v = [pin.getFrameJacobian(model, data, foot, pin.LOCAL_WORLD_ALIGNED)[:3] for foot in feet]
    by_v = np.vstack(by_v)
    v0[6:] = np.linalg.solve(by_v[:, 6:], -by_v[:, :6] @ v0[:6])
    loops = []
    for foot in feet:
        body, at = model.frames[foot].parentJoint - 1, model.frames[foot].placement.translation
        place = data.oMf[foot].translation
        loops.append(dict(body_a=body, at_a=at.tolist(), body_b=-1, at_b=place.tolist(), axes=["x", "y", "z"]))
    return m | dict(name=name, q0=q0, v0=v0.tolist(), loops=loops)


def stewart():
    """A platform on six legs, each a crank with a rod on a universal joint, whose end is held at the platform."""
    import numpy as np

    def turning(axis, angle):
        c, s = math.cos(angle), math.sin(angle)
        return np.array([[[1, 0, 0], [0, c, -s], [0, s, c]], [[c, 0, s], [0, 1, 0], [-s, 0, c]]][axis])

    height, crank, lift = 0.5, 0.2, -0.3
    platform = body(-1, [0, 0, 0], [0, 0, 0], 5.0, [0, 0, 0.03], [0.08, 0.08, 0.14], type="free")
    bodies, loops = [platform], []
    q0, v0 = [0, 0, height, 0, 0, 0], [0.1, 0.05, 0.08, 0.3, 0.2, -0.25]
    for leg in range(6):
        side = 1 if leg % 2 else -1
        at, corner = [math.radians(120 * (leg // 2) + side * spread) for spread in (14, 46)]
        base = [0.35 * math.cos(at), 0.35 * math.sin(at), 0.0]
        corner = np.array([0.25 * math.cos(corner), 0.25 * math.sin(corner), 0.0])
        c, s = math.cos(at), math.sin(at)
        foot = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        on_crank = foot @ turning(1, lift)
        knee = base + on_crank @ [crank, 0, 0]
        tip = corner + [0, 0, height]
        x, y, z = on_crank.T @ (tip - knee)
        length, swing = math.sqrt(x * x + y * y + z * z), math.atan2(x, z)
        tilt = -math.asin(y / length)
        turn = [math.cos(at / 2), 0, 0, math.sin(at / 2)]
        own, inertia = len(bodies), length**2 / 12 * 0.4
        bodies += [
            body(-1, base, [0, 1, 0], 0.6, [crank / 2, 0, 0], [0.0004, 0.002, 0.002], turn=turn),
            body(own, [crank, 0, 0], [0, 1, 0], 0.05, [0, 0, 0], [1e-5, 1e-5, 1e-5]),
            body(own + 1, [0, 0, 0], [1, 0, 0], 0.4, [0, 0, length / 2], [inertia, inertia, 5e-5]),
        ]
        # What the joints turn the tip by, and how the platform moves it.
        on_cross = on_crank @ turning(1, swing)
        arms = [(on_crank[:, 1], tip - base), (on_crank[:, 1], tip - knee), (on_cross[:, 0], tip - knee)]
        by_joints = np.array([np.cross(axis, arm) for axis, arm in arms]).T
        q0 += [lift, swing, tilt]
        v0 += np.linalg.solve(by_joints, v0[:3] + np.cross(v0[3:6], corner)).tolist()
        end = dict(body_a=own + 2, at_a=[0, 0, length], body_b=0, at_b=corner.tolist())
        loops.append(end | dict(axes=["x", "y", "z"]))
    return mechanism("stewart", bodies, q0, v0, loops) | dict(rough=[0] * 6 + [2.0, 0, 0] * 6)


SINGLE = {"stewart": stewart, "P": pendulum, "D": double_pendulum, "S": spherical_pendulum, "L": four_bar}
FAMILIES = {"B": ball_tree, "K": ball_chain, "C": chain, "H": hanging_chain, "T": tree, "X": scissor, "Z": chain_in_space}


def named(name):
    """The mechanism of that name, for example P or C32."""
    if name in ROBOTS:
        return robot(name)
    if name in STANDING:
        return standing(name)
    return SINGLE[name]() if name in SINGLE else FAMILIES[name[0]](int(name[1:]))


def text(m):
    """Numbers alone: bodies, loops, gravity; a line per body; q0; v0; rough torques; a line per loop."""
    lines = [[len(m["bodies"]), len(m["loops"]), m["gravity"]]]
    for b in m["bodies"]:
        inertia = [*b["inertia"], 0, 0, 0][:6]
        lines.append([SIZES[joint_type(b)], b["parent"], *b["pos"], *b.get("turn", [1, 0, 0, 0])])
        lines[-1] += [*b["axis"], b["mass"], *b["com"], *inertia]
    lines += [m["q0"], m["v0"], m.get("rough", [0] * len(m["v0"]))]
    for l in m["loops"]:
        lines.append([len(l.get("axes", "xz")), l["body_a"], *l["at_a"], l["body_b"], *l["at_b"]])
    return "".join(" ".join(map(repr, line)) + "\n" for line in lines)


def mjcf(m):
    """For MuJoCo: a motor on every hinge and slide, and three on a ball where there are rough torques; bodies
    without mass are merged into their children."""
    children = {i: [] for i in range(-1, len(m["bodies"]))}
    for i, b in enumerate(m["bodies"]):
        children[b["parent"]].append(i)
    spread = lambda numbers: " ".join(map(repr, numbers))
    lines = []

    def joint(i, b):
        if joint_type(b) in ("ball", "free"):
            return f'<joint name="j{i}" type="{joint_type(b)}"/>'
        spring = f'stiffness="{b.get("stiffness", 0.0)!r}" springref="{b.get("rest", 0.0)!r}"'
        place = f'type="{joint_type(b)}" axis="{spread(b["axis"])}"'
        return f'<joint name="j{i}" {place} {spring} damping="{b.get("damping", 0.0)!r}"/>'

    def open_bodies(parent):
        for i in children[parent]:
            b = m["bodies"][i]
            turn = f' quat="{spread(b["turn"])}"' if "turn" in b else ""
            lines.append(f'<body pos="{spread(b["pos"])}"{turn}>')
            while True:
                lines.append(joint(i, b))
                if b["mass"]:
                    break
                [i] = children[i]
                b = m["bodies"][i]
            inertia = [max(entry, LEAST_INERTIA) for entry in b["inertia"][:3]] + b["inertia"][3:]
            kind = "fullinertia" if len(inertia) > 3 else "diaginertia"
            lines.append(
                f'<inertial pos="{spread(b["com"])}" mass="{b["mass"]!r}" {kind}="{spread(inertia)}"/>'
            )
            add_sites(i)
            open_bodies(i)
            lines.append("</body>")

    def add_sites(i):
        for k, loop in enumerate(m["loops"]):
            for side in "ab":
                if loop[f"body_{side}"] == i:
                    lines.append(f'<site name="{side}{k}" pos="{spread(loop[f"at_{side}"])}"/>')

    add_sites(-1)
    open_bodies(-1)
    turns = [joint_type(b) in ("ball", "free") for b in m["bodies"]]
    rough, motors, at = m.get("rough"), "", 0
    for i, b in enumerate(m["bodies"]):
        size = SIZES[joint_type(b)]
        gears = [[1]] if size == 1 else [[0] * k + [1] + [0] * (2 - k) for k in range(3)]
        if size == 1 or (size == 3 and rough):
            for k, gear in enumerate(gears):
                most = f' user="{rough[at + k]!r}"' if rough else ""
                motors += f'<motor joint="j{i}" gear="{spread(gear)}"{most}/>'
        at += size
    q0 = [x for (_, q, _), turn in zip(parts(m), turns) for x in (q[:-3] + quaternion(q[-3:]) if turn else q)]
    connects = ""
    for k, loop in enumerate(m["loops"]):
        # As hard as MuJoCo allows; in a plane its third equation is one too many, and the softness is needed.
        hard = ' solimp="0.9999 0.9999"' if len(loop.get("axes", "xz")) == 3 else ""
        connects += f'<connect site1="a{k}" site2="b{k}"{hard}/>'
    return f"""<mujoco model="{m["name"]}">
<compiler angle="radian" autolimits="false" boundmass="0" boundinertia="0"/>
<size nuser_actuator="1"/>
<option gravity="0 0 {-m["gravity"]!r}"><flag contact="disable" sensor="disable" autoreset="disable"/></option>
<worldbody>{"".join(lines)}</worldbody>
<equality>{connects}</equality>
<actuator>{motors}</actuator>
<keyframe><key qpos="{spread(q0)}" qvel="{spread(m["v0"])}"/></keyframe>
</mujoco>
"""
