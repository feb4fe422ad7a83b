"""The mechanisms that are compared, and how each peer is told of them.

Bodies hang from hinges: `parent` (-1 is the world), `pos` of the hinge in the parent's frame, `axis`,
`mass`, centre of mass `com` and diagonal `inertia` about it, in the body's axes. Units are SI.
"""

import math

GRAVITY = 9.8


def body(parent, pos, axis, mass, com, inertia):
    return dict(parent=parent, pos=pos, axis=axis, mass=mass, com=com, inertia=inertia)


def mechanism(name, bodies, q0, v0=None, loops=()):
    v0 = v0 or [0.0] * len(q0)
    return dict(name=name, gravity=GRAVITY, bodies=bodies, q0=q0, v0=v0, loops=list(loops))


def point_mass(parent, z):
    return body(parent, [0, 0, z], [0, 1, 0], 1.0, [0, 0, -1.0], [0, 0, 0])


def rod(parent, pos, length, mass):
    across = mass * length**2 / 12
    return body(parent, pos, [0, 1, 0], mass, [0, 0, -length / 2], [across, across, 0.0])


def pendulum():
    return mechanism("P", [point_mass(-1, 0)], [math.pi / 2])


def double_pendulum():
    return mechanism("D", [point_mass(-1, 0), point_mass(0, -1.0)], [math.pi / 2, 0.0])


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


SINGLE = {"P": pendulum, "D": double_pendulum, "S": spherical_pendulum, "L": four_bar}
FAMILIES = {"C": chain, "H": hanging_chain, "T": tree}


def named(name):
    """The mechanism of that name, for example P or C32."""
    return SINGLE[name]() if name in SINGLE else FAMILIES[name[0]](int(name[1:]))


def text(m):
    """Numbers alone: bodies, loops, gravity; a line per body; q0; v0."""
    lines = [[len(m["bodies"]), len(m["loops"]), m["gravity"]]]
    for b in m["bodies"]:
        lines.append([b["parent"], *b["pos"], *b["axis"], b["mass"], *b["com"], *b["inertia"]])
    lines += [m["q0"], m["v0"]]
    return "".join(" ".join(map(repr, line)) + "\n" for line in lines)


def mjcf(m):
    """For MuJoCo: a motor on every hinge; bodies without mass are merged into their children."""
    children = {i: [] for i in range(-1, len(m["bodies"]))}
    for i, b in enumerate(m["bodies"]):
        children[b["parent"]].append(i)
    spread = lambda numbers: " ".join(map(repr, numbers))
    lines = []

    def open_bodies(parent):
        for i in children[parent]:
            lines.append(f'<body pos="{spread(m["bodies"][i]["pos"])}">')
            b = m["bodies"][i]
            while True:
                lines.append(f'<joint name="j{i}" axis="{spread(b["axis"])}"/>')
                if b["mass"]:
                    break
                [i] = children[i]
                b = m["bodies"][i]
            inertia = [max(entry, 1e-13) for entry in b["inertia"]]
            lines.append(
                f'<inertial pos="{spread(b["com"])}" mass="{b["mass"]!r}" diaginertia="{spread(inertia)}"/>'
            )
            for k, loop in enumerate(m["loops"]):
                for side in "ab":
                    if loop[f"body_{side}"] == i:
                        lines.append(f'<site name="{side}{k}" pos="{spread(loop[f"at_{side}"])}"/>')
            open_bodies(i)
            lines.append("</body>")

    open_bodies(-1)
    n = len(m["q0"])
    motors = "".join(f'<motor joint="j{i}"/>' for i in range(n))
    connects = "".join(f'<connect site1="a{k}" site2="b{k}"/>' for k in range(len(m["loops"])))
    return f"""<mujoco model="{m["name"]}">
<compiler angle="radian" autolimits="false" boundmass="0" boundinertia="0"/>
<option gravity="0 0 {-m["gravity"]!r}"><flag contact="disable" sensor="disable" autoreset="disable"/></option>
<worldbody>{"".join(lines)}</worldbody>
<equality>{connects}</equality>
<actuator>{motors}</actuator>
<keyframe><key qpos="{spread(m["q0"])}" qvel="{spread(m["v0"])}"/></keyframe>
</mujoco>
"""
