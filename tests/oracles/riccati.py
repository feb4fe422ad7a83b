"""Makes riccati.json: regulator problems with independent solutions.

    python3 -m venv venv && venv/bin/pip install numpy scipy mpmath control
    venv/bin/python riccati.py > riccati.json

Small problems are solved in 60 digits with mpmath, large ones by scipy (QZ).
Gains of python-control must agree before one is kept.
Of the problems with up to 100 states and of those in bad units ("large") the file has a recipe, and
products of solutions that Newton's method polished in extended precision.
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


# Large and badly scaled problems: the matrices follow from a recipe that the test repeats bit by bit,
# and the file has products of the solution with probe vectors alone.


class Recipe:
    """Numbers in (-1, 1) of 32 bits from a linear congruence."""

    def __init__(self, seed):
        self.state = seed

    def matrix(self, rows, cols):
        out = np.empty((rows, cols))
        for i in range(rows):
            for j in range(cols):
                self.state = (self.state * 6364136223846793005 + 1442695040888963407) % 2**64
                out[i, j] = ((self.state >> 32) + 0.5) / 2.0**31 - 1.0
        return out


def large_matrices(spec):
    """A, B, Q, R, S and probes; every entry by the same operations in the same order as in the test."""
    n, m = spec["n"], spec["m"]
    recipe = Recipe(spec["seed"])
    a = spec["scale"] * recipe.matrix(n, n)
    b = recipe.matrix(n, m)
    units = np.array(spec["units"])
    kind = spec["kind"]
    if kind == "singular":
        a[:, : n // 2] = 0.0
    elif kind == "chain":
        a = np.eye(n) + spec["scale"] * np.eye(n, k=1)
        b = np.zeros((n, m))
        for j in range(m):
            b[n - 1 - j, j] = spec["scale"]
    elif kind == "triangular":
        a = np.triu(a, 1) + np.diag(1.0 - np.arange(n) / n)
    elif kind == "out-of-reach":
        # The last third follows its own law, which decays, and no input moves it.
        k = n - n // 3
        a[k:, :] = 0.0
        a[k:, k:] = np.diag(0.9 - 0.5 * np.arange(n - k) / n)
        b[k:, :] = 0.0
    a = units[:, None] * a / units[None, :]
    b = units[:, None] * b
    if spec["weights"] == "units":
        q = np.diag(1.0 / (units * units))
    else:
        q = np.eye(n)
    r = spec["r"] * np.eye(m)
    s = spec["cross"] * (recipe.matrix(n, m) / units[:, None])
    probes = units[:, None] * recipe.matrix(n, 2)
    return a, b, q, r, s, probes


def extended_solve(m, rhs):
    """Gauss with partial pivots in extended precision."""
    m, x = m.copy(), rhs.copy()
    n = len(m)
    for i in range(n):
        p = i + int(np.argmax(abs(m[i:, i])))
        m[[i, p]], x[[i, p]] = m[[p, i]], x[[p, i]]
        f = m[i + 1:, i] / m[i, i]
        m[i + 1:] -= f[:, None] * m[i]
        x[i + 1:] -= f[:, None] * x[i]
    for i in range(n - 1, -1, -1):
        x[i] = (x[i] - m[i, i + 1:] @ x[i + 1:]) / m[i, i]
    return x


def large(name, n, m, seed, scale=1.0, kind="plain", units=None, weights="units", r=1.0, cross=0.0):
    spec = dict(name=name, n=n, m=m, seed=seed, scale=float(scale), kind=kind,
                units=[1.0] * n if units is None else [float(f"{u:.3e}") for u in units],
                weights=weights, r=r, cross=cross)
    a, b, q, r, s, probes = large_matrices(spec)
    units = np.array(spec["units"])
    # Start from scipy in units of one; then Newton-Kleinman in extended precision.
    a1 = a / units[:, None] * units[None, :]
    b1 = b / units[:, None]
    q1 = q * units[:, None] * units[None, :]
    s1 = s * units[:, None]
    p1 = sl.solve_discrete_are(a1, b1, q1, r, s=s1)
    k = np.linalg.solve(r + b1.T @ p1 @ b1, b1.T @ p1 @ a1 + s1.T) / units[None, :]
    x = np.longdouble
    ax, bx, qx, rx, sx, kx = (np.array(v, x) for v in (a, b, q, r, s, k))
    ux = np.array(units, x)
    ax, bx = ax / ux[:, None] * ux[None, :], bx / ux[:, None]
    qx, sx, kx = qx * ux[:, None] * ux[None, :], sx * ux[:, None], kx * ux[None, :]
    change = 1.0
    for step in range(30):
        ac = ax - bx @ kx
        p = qx + kx.T @ rx @ kx - sx @ kx - kx.T @ sx.T
        for _ in range(60):
            d = ac.T @ p @ ac
            p, ac = p + d, ac @ ac
            if np.linalg.norm(d.astype(float)) <= 1e-19 * np.linalg.norm(p.astype(float)):
                break
        p = (p + p.T) / 2
        new = extended_solve(rx + bx.T @ p @ bx, bx.T @ p @ ax + sx.T)
        last, change = change, float(np.max(abs(new - kx)) / np.max(abs(new)))
        kx = new
        if change < 1e-17 or (change < 1e-13 and change >= last):
            break
    assert change < 1e-12, (name, change)
    px = p / ux[:, None] / ux[None, :]
    kx = kx / ux[None, :]
    gain = kx.astype(float)
    probed = (kx @ probes).astype(float)
    weighed = (ux * (px @ probes[:, 0])).astype(float)
    # What scipy and python-control find from the matrices as they stand.
    errors = []
    for solver in (lambda: sl.solve_discrete_are(a, b, q, r, s=s), lambda: control.dare(a, b, q, r, s)[0]):
        try:
            found = np.asarray(solver())
            theirs = np.linalg.solve(r + b.T @ found @ b, b.T @ found @ a + s.T)
            errors.append(float(np.linalg.norm(theirs @ probes - probed) / np.linalg.norm(probed)))
        except np.linalg.LinAlgError:
            errors.append(1.0)
    radius = max(abs(np.linalg.eigvals((a1 - b1 @ (gain * units[None, :])))))
    # Extended precision has the last word; where they are further off than 1e-8 they are at a loss.
    spec.update(gain_probes=probed, value_probe=weighed, spectral_radius=float(radius),
                scipy_and_control_agree=bool(max(errors) < 1e-8))
    return spec


def spread(n, decades, seed):
    return 10.0 ** (decades / 2 * Recipe(seed).matrix(n, 1)[:, 0])


def large_cases():
    gust = lambda n, radius: round(radius / np.sqrt(n / 3), 4)  # noqa: E731
    seed = 100
    for n, m, radius in [(10, 1, 1.05), (20, 3, 1.3), (40, 2, 1.02), (60, 10, 1.1), (100, 5, 0.97), (100, 20, 1.2), (100, 8, 1.05)]:
        seed += 1
        yield large(f"random-{n}-{m}", n, m, seed, gust(n, radius))
    for n, m, decades in [(6, 1, 20), (20, 4, 16), (50, 10, 12), (100, 20, 16)]:
        seed += 1
        yield large(f"units-{n}", n, m, seed, gust(n, 1.1), units=spread(n, decades, seed + 1000))
    for n, m, decades in [(6, 2, 6), (20, 4, 6), (50, 10, 8), (100, 20, 4)]:
        seed += 1
        yield large(f"units-against-weights-{n}", n, m, seed, gust(n, 1.1), units=spread(n, decades, seed + 1000), weights="one")
    for n, m, r in [(10, 2, 1e-12), (50, 5, 1e-8), (100, 10, 1e-10), (10, 2, 1e8), (50, 5, 1e6), (100, 20, 1e10), (30, 30, 1e-14)]:
        seed += 1
        yield large(f"control-{r:.0e}-{n}", n, m, seed, gust(n, 1.05), r=r)
    for n, m in [(12, 2), (100, 10)]:
        seed += 1
        yield large(f"singular-{n}", n, m, seed, gust(n, 1.2), kind="singular")
    for n, m, h in [(4, 1, 0.1), (6, 2, 0.1), (10, 5, 0.03)]:
        yield large(f"chain-{n}", n, m, 0, h, kind="chain")
    for n, m in [(20, 4), (60, 20)]:
        seed += 1
        yield large(f"triangular-{n}", n, m, seed, 0.05, kind="triangular")
    for n, m in [(30, 4), (90, 10)]:
        seed += 1
        yield large(f"out-of-reach-{n}", n, m, seed, gust(n, 1.1), kind="out-of-reach")
    for n, m, cross in [(8, 2, 0.3), (50, 5, 0.1), (100, 10, 0.05)]:
        seed += 1
        yield large(f"cross-{n}", n, m, seed, gust(n, 1.1), cross=cross)
    seed += 1
    yield large("cross-units-20", 20, 3, seed, gust(20, 1.1), units=spread(20, 12, seed), cross=0.15)


def plain(value):
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return float(value) if isinstance(value, np.floating) else value


json.dump(plain({"infinite": list(infinite_cases()), "finite": list(finite_cases()),
                 "large": list(large_cases())}), sys.stdout)
print()
