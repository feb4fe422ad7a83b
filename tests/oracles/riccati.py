"""Makes riccati.json: regulator problems with independent solutions.

    python3 -m venv venv && venv/bin/pip install numpy scipy mpmath control
    venv/bin/python riccati.py > riccati.json

Small problems are solved in 60 digits with mpmath, large ones by scipy (QZ).
Gains of python-control must agree before one is kept.
"""

import json
import sys

import control
import mpmath as mp
import numpy as np
import scipy.linalg as sl

rng = np.random.default_rng(20151)
mp.mp.dps = 60


def rounded(m, digits=3):
    """Few digits keep the file short, and both sides start from the same numbers."""
    return np.round(np.asarray(m, float), digits)


def stable_scale(a, radius):
    return a * (radius / max(abs(np.linalg.eigvals(a))))


def to_mp(m):
    return mp.matrix(np.asarray(m, float).tolist())


def to_np(m):
    return np.array(m.tolist(), float)


def mp_gain(a, b, r, p):
    bp = b.T * p
    return mp.inverse(r + bp * b) * (bp * a)


def mp_step(a, b, q, r, p):
    k = mp_gain(a, b, r, p)
    p = q + a.T * p * a - (b.T * p * a).T * k
    return k, (p + p.T) / 2


def infinite(name, a, b, q, r):
    """Newton-Kleinman in 60 digits for small problems, scipy and control for large ones."""
    n = len(a)
    p = sl.solve_discrete_are(a, b, q, r)
    k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
    k_control = np.asarray(control.dlqr(a, b, q, r)[0])
    assert np.linalg.norm(k - k_control) < 1e-6 * np.linalg.norm(k), name
    if n <= 12:
        am, bm, qm, rm, km = map(to_mp, (a, b, q, r, k))
        for _ in range(6):
            ac = am - bm * km
            pm = qm + km.T * rm * km
            for _ in range(60):  # doubling for the Lyapunov equation
                d = ac.T * pm * ac
                pm, ac = pm + d, ac * ac
                if mp.norm(d) < mp.mpf(10) ** -50 * mp.norm(pm):
                    break
            km = mp_gain(am, bm, rm, pm)
        p, k = to_np(pm), to_np(km)
    radius = max(abs(np.linalg.eigvals(a - b @ k)))
    return case(name, a, b, q, r, k=k, value_norm=np.linalg.norm(p), value_trace=np.trace(p),
                spectral_radius=radius)


def finite(name, a_list, b_list, q, r, q_final):
    p = to_mp(q_final)
    qm, rm = to_mp(q), to_mp(r)
    gains = []
    for a, b in zip(a_list[::-1], b_list[::-1]):
        k, p = mp_step(to_mp(a), to_mp(b), qm, rm, p)
        gains.append(to_np(k))
    p = to_np(p)
    return {"name": name, "a": [x.tolist() for x in a_list], "b": [x.tolist() for x in b_list],
            "q": q.tolist(), "r": r.tolist(), "q_final": q_final.tolist(),
            "gains": [k.tolist() for k in gains[::-1]], "value": p.tolist(),
            "value_min_eigenvalue": float(np.linalg.eigvalsh(p)[0])}


def case(name, a, b, q, r, **answer):
    out = {"name": name, "a": np.asarray(a).tolist(), "b": np.asarray(b).tolist(),
           "q": np.diag(q).tolist(), "r": np.diag(r).tolist()}
    for key, value in answer.items():
        out[key] = value.tolist() if isinstance(value, np.ndarray) else value
    return out


def random_system(n, m, radius):
    return rounded(stable_scale(rng.normal(size=(n, n)), radius)), rounded(rng.normal(size=(n, m)), 2)


def infinite_cases():
    for n, m, radius in [(2, 1, 1.1), (5, 2, 1.4), (12, 3, 1.05), (40, 4, 1.2), (80, 18, 1.02)]:
        a, b = random_system(n, m, radius)
        yield infinite(f"random-{n}", a, b, np.eye(n), np.eye(m))
    # Singular A: half of the states are copies of the input.
    a, b = random_system(10, 2, 1.2)
    a[:, 5:] = 0.0
    yield infinite("singular-a", a, b, np.eye(10), np.eye(2))
    # The paper's pendulum about the upright equilibrium.
    h, g = 0.1, 9.8
    d11, d21 = 1 / h + g * h / 4, -1 / h + g * h / 4
    a = np.array([[-d11 / d21, -1 / d21], [d11 * (-d11 / d21) + d21, -d11 / d21]])
    b = np.array([[-h / d21], [-d11 * h / d21]])
    yield infinite("upright-pendulum", a, b, np.diag([100.0, 1.0]), np.eye(1))
    # Units that span ten orders of magnitude.
    a, b = random_system(6, 2, 1.1)
    units = 10.0 ** np.array([-5, -3, 0, 1, 4, 5])
    scaled = units[:, None] * a / units[None, :]
    yield infinite("badly-scaled", scaled, units[:, None] * b, np.diag(1 / units**2), np.eye(2))
    # Cheap and dear control.
    a, b = random_system(8, 2, 1.1)
    yield infinite("cheap-control", a, b, np.eye(8), 1e-10 * np.eye(2))
    yield infinite("dear-control", a, b, np.eye(8), 1e6 * np.eye(2))
    # An unstable mode that the state weight does not see: the stabilising solution exists.
    a = np.diag([1.5, 0.9]) + np.array([[0.0, 0.1], [0.0, 0.0]])
    yield infinite("unseen-unstable", a, np.eye(2), np.diag([0.0, 1.0]), np.eye(2))
    # Nearly marginal: needs many doublings.
    yield infinite("nearly-marginal", np.diag([1.0, 0.5]), np.array([[1e-4], [1.0]]),
                   np.diag([1e-4, 1.0]), np.eye(1))


def finite_cases():
    a_list, b_list = zip(*[random_system(6, 2, 1.1) for _ in range(30)])
    yield finite("varying", a_list, b_list, np.eye(6), np.eye(2), 10 * np.eye(6))
    a, b = random_system(8, 1, 1.05)
    q = np.diag(10.0 ** np.linspace(-6, 2, 8))
    yield finite("cheap-control", [a] * 30, [b] * 30, q, 1e-12 * np.eye(1), q)
    yield finite("no-state-weight", [a] * 10, [b] * 10, np.zeros((8, 8)), np.eye(1), np.eye(8))


def plain(value):
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return float(value) if isinstance(value, np.floating) else value


json.dump(plain({"infinite": list(infinite_cases()), "finite": list(finite_cases())}), sys.stdout)
print()
