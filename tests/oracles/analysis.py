"""Makes analysis.json: linear maps with their modes, ranks and frequency responses.

    python3 -m venv venv && venv/bin/pip install numpy scipy
    venv/bin/python analysis.py > analysis.json

Eigenvalues are scipy's, frequency responses those of scipy.signal.dfreqresp (through the transfer
function of each input and output), which must agree with a direct solution; ranks are those of the
Kronecker form that the systems were made with.
"""

import json
import sys

import numpy as np
import scipy.linalg as sl
import scipy.signal as ss

rng = np.random.default_rng(20152)


def case(name, a, b, c, d, h, frequencies, controllable, observable, units=1.0):
    """Solved in good units, and written in other ones."""
    eigenvalues = sorted(sl.eigvals(a), key=lambda z: (-round(abs(z), 12), z.real, -z.imag))
    responses = []
    for f in frequencies:
        z = np.exp(2j * np.pi * f * h)
        direct = c @ sl.solve(z * np.eye(len(a)) - a, b.astype(complex)) + d
        for column in range(b.shape[1]):
            system = ss.StateSpace(a, b[:, [column]], c, d[:, [column]], dt=h).to_tf()
            for row, numerator in enumerate(np.atleast_2d(system.num)):
                _, g = ss.dfreqresp((numerator, system.den, h), w=[2 * np.pi * f * h])
                assert abs(g[0] - direct[row, column]) < 1e-5 * np.abs(direct).max(), name
        responses.append({"frequency_hz": f, "real": direct.real.tolist(), "imaginary": direct.imag.tolist()})
    units = units * np.ones(len(a))
    a, b, c = units[:, None] * a / units, units[:, None] * b, c / units
    return {"name": name, "a": a.tolist(), "b": b.tolist(), "c": c.tolist(), "d": d.tolist(),
            "time_step_s": h, "eigenvalues": [[z.real, z.imag] for z in eigenvalues],
            "responses": responses, "controllable": controllable, "observable": observable}


def random_system(n, m, r, radius):
    a = rng.normal(size=(n, n))
    a = np.round(a * radius / max(abs(np.linalg.eigvals(a))), 3)
    return a, *(np.round(rng.normal(size=shape), 2) for shape in [(n, m), (r, n), (r, m)])


def cases():
    frequencies = [0.0, 0.3, 2.0, 4.9, 5.0]
    yield case("random-6", *random_system(6, 2, 3, 0.97), 0.1, frequencies, 6, 6)
    yield case("unstable-5", *random_system(5, 1, 1, 1.3), 0.1, frequencies, 5, 5)
    # Parts that no input reaches, and parts that no output shows, hidden by a rotation.
    a, b, c, d = random_system(7, 2, 2, 0.9)
    a[4:, :4] = 0.0
    b[4:] = 0.0
    a[:, 0] = 0.0
    a[0, 0] = 0.4
    c[:, 0] = 0.0
    q = sl.qr(rng.normal(size=(7, 7)))[0]
    yield case("hidden-parts", q @ a @ q.T, q @ b, c @ q.T, d, 0.1, frequencies, 4, 6)
    # Units that span eight orders of magnitude.
    a, b, c, d = random_system(5, 2, 2, 0.95)
    yield case("badly-scaled", a, b, c, d, 0.1, frequencies, 5, 5, 10.0 ** np.array([-4, -2, 0, 3, 4]))


json.dump({"cases": list(cases())}, sys.stdout)
print()
