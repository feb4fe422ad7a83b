"""Times the marionette's time-varying regulator in numpy, beside models/control/examples/riccati_speed.rs.

    cargo run --release -p plantd-control --example riccati_speed /tmp/marionette.bin
    OPENBLAS_NUM_THREADS=1 venv/bin/python riccati_speed.py /tmp/marionette.bin

The plain recursion, as one writes it: P = Q + A'PA - (B'PA)'K with K = (R + B'PB)^-1 B'PA, symmetrised.
Prints the least CPU and wall-clock time of several solutions, and the norm of the first gain.
"""

import sys
import time

import numpy as np

numbers = np.fromfile(sys.argv[1], "<f8")
steps, n, m = (int(size) for size in numbers[:3])
q = np.diag(numbers[3:3 + n])
r = np.eye(m)
pairs = numbers[3 + n:].reshape(steps, n * (n + m))
samples = [(pair[:n * n].reshape(n, n).copy(), pair[n * n:].reshape(n, m).copy()) for pair in pairs]


def solve():
    p, gains = q, []
    for a, b in reversed(samples):
        bt_p = b.T @ p
        bt_p_a = bt_p @ a
        k = np.linalg.solve(r + bt_p @ b, bt_p_a)
        p = q + a.T @ p @ a - bt_p_a.T @ k
        p = (p + p.T) / 2
        gains.append(k)
    return gains[::-1]


cpu, wall = [], []
for _ in range(9):
    started = time.process_time(), time.perf_counter()
    gains = solve()
    cpu.append(time.process_time() - started[0])
    wall.append(time.perf_counter() - started[1])
print(f"numpy: {1e3 * min(cpu):.3f} ms of CPU, {1e3 * min(wall):.3f} ms of wall clock, "
      f"{1e6 * min(cpu) / steps:.2f} µs per step")
print(f"  norm of the first gain {np.linalg.norm(gains[0]):.12f}")
