"""Makes kalman.json: filters with independent solutions.

    python3 -m venv venv && venv/bin/pip install numpy scipy mpmath control
    venv/bin/python kalman.py > kalman.json

Steady-state filters: scipy (QZ), polished by Newton's method in 60 digits; python-control's dlqe must
agree. Filters along a trajectory: the covariance of a state given all measurements up to it, from the
inverse of the information matrix of all states at once, in 60 digits.
"""

import json
import sys

import control
import mpmath as mp
import numpy as np
import scipy.linalg as sl

rng = np.random.default_rng(1960)
mp.mp.dps = 60


def rounded(m, digits=3):
    return np.round(np.asarray(m, float), digits)


def to_mp(m):
    return mp.matrix(np.asarray(m, float).tolist())


def to_np(m):
    return np.array(m.tolist(), float)


def random_map(n, radius):
    a = rng.normal(size=(n, n))
    return rounded(a * (radius / max(abs(np.linalg.eigvals(a)))))


def covariance(n, rank=None):
    root = rounded(rng.normal(size=(n, rank or n)), 2)
    return rounded(root @ root.T, 4)


def steady(name, a, b, c, process, inputs, v):
    w = (process if process is not None else 0.0) + (b @ inputs @ b.T if inputs is not None else 0.0)
    w = (w + w.T) / 2
    p = sl.solve_discrete_are(a.T, c.T, w, v)
    predictor = np.asarray(control.dlqe(a, np.eye(len(a)), c, w, v)[0])
    innovation = c @ p @ c.T + v
    assert np.allclose(predictor, a @ p @ c.T @ np.linalg.inv(innovation), rtol=1e-6, atol=0), name
    am, cm, wm, vm = map(to_mp, (a, c, w, v))
    if process is not None or inputs is not None:
        wm = to_mp(process) if process is not None else mp.zeros(len(a))
        if inputs is not None:
            wm = wm + to_mp(b) * to_mp(inputs) * to_mp(b).T
    k = to_mp(predictor)
    for _ in range(6):
        f = am - k * cm
        pm = wm + k * vm * k.T
        for _ in range(60):
            d = f * pm * f.T
            pm, f = pm + d, f * f
            if mp.norm(d) < mp.mpf(10) ** -50 * mp.norm(pm):
                break
        k = am * pm * cm.T * mp.inverse(cm * pm * cm.T + vm)
    gain = pm * cm.T * mp.inverse(cm * pm * cm.T + vm)
    filtered = pm - gain * cm * pm
    modes = np.linalg.eigvals(to_np(am - k * cm))
    optional = lambda m: None if m is None else m.tolist()  # noqa: E731
    return {"name": name, "a": a.tolist(), "b": b.tolist(), "c": c.tolist(), "process": optional(process),
            "input": optional(inputs), "measurement": v.tolist(), "gain": to_np(gain).tolist(),
            "predicted": to_np(pm).tolist(), "filtered": to_np(filtered).tolist(),
            "radius": float(max(abs(modes)))}


def steady_cases():
    for n, r, radius in [(2, 1, 1.1), (5, 2, 1.3), (9, 3, 0.95)]:
        yield steady(f"random-{n}", random_map(n, radius), rounded(rng.normal(size=(n, 2)), 2),
                     rounded(rng.normal(size=(r, n)), 2), covariance(n), None, covariance(r))
    # Noise of the inputs alone, which does not move all states at once.
    yield steady("inputs-alone", random_map(6, 1.2), rounded(rng.normal(size=(6, 2)), 2),
                 rounded(rng.normal(size=(2, 6)), 2), None, covariance(2), covariance(2))
    yield steady("both", random_map(6, 1.1), rounded(rng.normal(size=(6, 1)), 2),
                 rounded(rng.normal(size=(1, 6)), 2), 1e-4 * np.eye(6), 0.5 * np.eye(1), np.eye(1))
    # Units that span ten orders of magnitude; a sensor that is a thousand times as good as the other.
    a, c = random_map(6, 1.1), rounded(rng.normal(size=(2, 6)), 2)
    units = 10.0 ** np.array([-5, -3, 0, 1, 4, 5])
    yield steady("badly-scaled", units[:, None] * a / units, rounded(rng.normal(size=(6, 1)), 2),
                 c / units, np.diag(units**2), None, np.diag([1.0, 1e-6]))
    # Singular map: what was is forgotten at once in two states.
    a = random_map(6, 1.2)
    a[:, 4:] = 0.0
    yield steady("singular-map", a, np.zeros((6, 1)), rounded(rng.normal(size=(2, 6)), 2), covariance(6),
                 None, covariance(2))


def trajectory():
    """Six steps of three states; outputs and noise of each state their own."""
    n, r, m, steps = 3, 2, 1, 6
    a = [random_map(n, 1.2) for _ in range(steps)]
    b = [rounded(rng.normal(size=(n, m)), 2) for _ in range(steps)]
    c = [rounded(rng.normal(size=(r, n)), 2) for _ in range(steps + 1)]
    process = [rounded(covariance(n) + 0.1 * np.eye(n), 4) for _ in range(steps + 1)]
    inputs = [covariance(m) for _ in range(steps + 1)]
    v = [rounded(covariance(r) + 0.1 * np.eye(r), 4) for _ in range(steps + 1)]
    initial = rounded(covariance(n) + 0.1 * np.eye(n), 4)

    def information(states, measured):
        """Of (x[0], .., x[states - 1]) from `measured` measurements."""
        total = mp.zeros(n * states)

        def add(rows, weight):
            nonlocal total
            total = total + rows.T * mp.inverse(weight) * rows

        def row(height, blocks):
            out = mp.zeros(height, n * states)
            for state, block in blocks:
                for i in range(height):
                    for j in range(n):
                        out[i, n * state + j] = block[i, j]
            return out

        add(row(n, [(0, mp.eye(n))]), to_mp(initial))
        for k in range(states - 1):
            weight = to_mp(process[k]) + to_mp(b[k]) * to_mp(inputs[k]) * to_mp(b[k]).T
            add(row(n, [(k, -to_mp(a[k])), (k + 1, mp.eye(n))]), weight)
        for k in range(measured):
            add(row(r, [(k, to_mp(c[k]))]), to_mp(v[k]))
        return total

    def last_block(m):
        inverse = mp.inverse(m)
        size = m.rows
        return inverse[size - n:size, size - n:size]

    predicted = [last_block(information(k + 1, k)) for k in range(steps + 1)]
    filtered = [last_block(information(k + 1, k + 1)) for k in range(steps + 1)]
    gains = [filtered[k] * to_mp(c[k]).T * mp.inverse(to_mp(v[k])) for k in range(steps + 1)]
    lists = lambda ms: [np.asarray(m).tolist() for m in ms]  # noqa: E731
    return {"a": lists(a), "b": lists(b), "c": lists(c), "process": lists(process), "input": lists(inputs),
            "measurement": lists(v), "initial": initial.tolist(), "gains": lists(map(to_np, gains)),
            "predicted": lists(map(to_np, predicted)), "filtered": lists(map(to_np, filtered))}


json.dump({"steady": list(steady_cases()), "trajectory": trajectory()}, sys.stdout)
print()
