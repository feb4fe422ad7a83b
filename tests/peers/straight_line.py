"""Writes straight-line C for one mechanism of hinges with CasADi: python straight_line.py NAME FILE.c [euler-ab]"""

import pathlib
import sys

import casadi as ca

import mechanisms


def cross(v):
    return ca.vertcat(
        ca.horzcat(0, -v[2], v[1]), ca.horzcat(v[2], 0, -v[0]), ca.horzcat(-v[1], v[0], 0)
    )


def rotation(axis, angle):
    """From the axes of a joint to those that turn with it."""
    if sorted(map(abs, axis)) != [0, 0, 1]:
        k = ca.DM(cross(ca.DM(axis)))
        return ca.DM.eye(3) - ca.sin(angle) * k + (1 - ca.cos(angle)) * (k @ k)
    c, s = ca.cos(angle), ca.sin(angle) * sum(axis)
    i = [abs(a) for a in axis].index(1)
    j, k = (i + 1) % 3, (i + 2) % 3
    e = ca.SX(3, 3)
    e[i, i] = 1
    e[j, j] = e[k, k] = c
    e[j, k], e[k, j] = s, -s
    return e


def placed(turn):
    """From the parent's axes to those of a joint, whose orientation there is a quaternion, w first."""
    w, v = turn[0], ca.DM(turn[1:])
    k = cross(v)
    return ca.sparsify(ca.DM.eye(3) - 2 * w * k + 2 * k @ k)


def tensor(inertia):
    """Of moments, and products of inertia if there are any."""
    xx, yy, zz, xy, xz, yz = [*inertia, 0, 0, 0][:6]
    return ca.sparsify(ca.DM([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))


def motion_cross(v):
    w, u = cross(v[:3]), cross(v[3:])
    return ca.blockcat([[w, ca.SX(3, 3)], [u, w]])


def symmetric(m):
    upper = ca.triu(m)
    return upper + ca.triu(m, False).T


def accelerations(m, q, v, tau):
    """Featherstone, Rigid Body Dynamics Algorithms, table 7.1."""
    n = len(m["bodies"])
    X, S, c, inertia, bias, velocity = ([None] * n for _ in range(6))
    for i, b in enumerate(m["bodies"]):
        e = ca.sparsify(rotation(b["axis"], q[i]) @ placed(b.get("turn", [1, 0, 0, 0])))
        offset = ca.sparsify(ca.SX(cross(b["pos"])))
        X[i] = ca.sparsify(ca.blockcat([[e, ca.SX(3, 3)], [-e @ offset, e]]))
        S[i] = ca.sparsify(ca.SX(ca.DM(b["axis"] + [0, 0, 0])))
        rate = S[i] * v[i]
        parent = b["parent"]
        velocity[i] = rate if parent < 0 else X[i] @ velocity[parent] + rate
        c[i] = ca.sparsify(motion_cross(velocity[i]) @ rate)
        lever = ca.DM(cross(ca.DM(b["com"])))
        about_joint = tensor(b["inertia"]) + b["mass"] * lever @ lever.T
        mass = b["mass"] * ca.DM.eye(3)
        moment = b["mass"] * lever
        inertia[i] = ca.sparsify(ca.SX(ca.blockcat([[about_joint, moment], [moment.T, mass]])))
        bias[i] = -motion_cross(velocity[i]).T @ (inertia[i] @ velocity[i])
    U, d, u = [None] * n, [None] * n, [None] * n
    for i in reversed(range(n)):
        U[i] = inertia[i] @ S[i]
        d[i] = S[i].T @ U[i]
        u[i] = tau[i] - S[i].T @ bias[i]
        parent = m["bodies"][i]["parent"]
        if parent >= 0:
            seen = symmetric(inertia[i] - U[i] @ (U[i].T / d[i]))
            force = bias[i] + seen @ c[i] + U[i] * (u[i] / d[i])
            inertia[parent] = inertia[parent] + symmetric(X[i].T @ seen @ X[i])
            bias[parent] = bias[parent] + X[i].T @ force
    acceleration, a = [None] * n, []
    for i, b in enumerate(m["bodies"]):
        above = ca.DM([0, 0, 0, 0, 0, m["gravity"]]) if b["parent"] < 0 else acceleration[b["parent"]]
        without = X[i] @ above + c[i]
        a.append((u[i] - U[i].T @ without) / d[i])
        acceleration[i] = without + S[i] * a[i]
    return ca.vertcat(*a)


def main(name, path, methods):
    m = mechanisms.named(name)
    n = len(m["q0"])
    q, v, tau, h = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("u", n), ca.SX.sym("h")
    a = accelerations(m, q, v, tau)
    v_next = v + h * a
    q_next = q + h * v_next
    functions = [ca.Function("accelerations", [q, v, tau], [a], {"cse": True})]
    functions.append(ca.Function("euler", [q, v, tau, h], [q_next, v_next], {"cse": True}))
    if "euler-ab" in methods:
        after = ca.vertcat(q_next, v_next)
        outputs = [q_next, v_next, ca.jacobian(after, ca.vertcat(q, v)), ca.jacobian(after, tau)]
        functions.append(ca.Function("euler_ab", [q, v, tau, h], outputs, {"cse": True}))
    path = pathlib.Path(path)
    # A name of C.
    generator = ca.CodeGenerator(path.stem.replace("-", "_"))
    for function in functions:
        generator.add(function)
        print(f"{name} {function.name()}: {function.n_instructions()} instructions")
    pathlib.Path(generator.generate(f"{path.parent}/")).rename(path)
    lists = {"start": m["q0"] + m["v0"], "rough": m.get("rough", [0.0] * n)}
    with path.open("a") as file:
        file.write(f"\nconst int mechanism_size = {n};\n")
        for what, numbers in lists.items():
            file.write(f"const double mechanism_{what}[] = {{{', '.join(map(repr, numbers))}}};\n")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3:])
