"""How far a cart-pole strays under one regulator when nobody knows the mass of its pole: a Monte Carlo over Ray.

    python3 monte_carlo_ray.py                      # a cluster of this machine alone, for this once
    python3 monte_carlo_ray.py ray://head:10001     # one whose machines have plantd, and whose token Ray finds

Needs `pip install ray`. Each worker starts a server of its own. Pieces are tasks: what a lost machine was doing is
done elsewhere, with the same bits. Ray listens on all addresses of a machine whatever it is told, and whoever gets
in runs code: so its cluster asks for a token, and its ports belong behind a firewall.
"""

import os
import secrets
import sys

import numpy as np
import plantd
from plantd import batch

# Ray reads them when it is imported.
os.environ["RAY_AUTH_MODE"] = "token"
if len(sys.argv) == 1:
    os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
import ray  # noqa: E402

CASES, STEPS = 2000, 1000

with plantd.launch() as client:
    law = client.solve_lqr("cart-pole", at="upright", q=[1, 100, 1, 1], r=[0.01])
random = np.random.default_rng(1)
cases = [
    batch.case(parameters={"frames[pole].body.mass": mass}, q=[0.0, np.pi + angle])
    for mass, angle in zip(random.uniform(0.3, 3.0, CASES), random.normal(0.0, 0.2, CASES))
]
common = batch.case(steps=STEPS, feedback=dict(gain=law, mode="replace"))
ray.init(*sys.argv[1:], log_to_driver=False)
try:
    done = batch.rollout("cart-pole", cases, ray, common=common, extremes=True)
finally:
    ray.shutdown()
done.raise_errors()
strayed = np.maximum(done.max[:, 0], -done.min[:, 0])
fallen = int((np.abs(done.x[:, 1] - np.pi) > 0.1).sum())
print(f"{len(done)} cases, of which {fallen} have fallen")
print("the cart strays by", " / ".join(f"{m:.3f}" for m in np.percentile(strayed, [50, 95, 99])), "m (50, 95, 99 %)")
