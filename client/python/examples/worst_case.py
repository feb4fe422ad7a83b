"""The worst case of a scenario, by random search: which pole and which start let a regulated cart stray farthest?

    python3 worst_case.py                           # by a server that is started for it
    python3 worst_case.py http://a:50051,http://b:50051

Each generation is one batch, judged on the servers; the next one looks around the worst case so far, ever closer.
"""

import sys

import numpy as np
import plantd
from plantd import batch

EXPECT = """
[[expect]]
never_exceeds = { signal = "|x|", limit = 2.5 }
[[expect]]
settles = { signal = "theta", to = 3.141592653589793, within = 0.05, by_s = 8 }
"""
CASES, GENERATIONS, STEPS = 200, 6, 1000
LEAST, MOST = np.array([0.3, -0.3, -1.0]), np.array([3.0, 0.3, 1.0])

with plantd.launch() as client:
    law = client.solve_lqr("cart-pole", at="upright", q=[1, 100, 1, 1], r=[0.01])
common = batch.case(steps=STEPS, feedback=dict(gain=law, mode="replace"))
random = np.random.default_rng(1)
tries = random.uniform(LEAST, MOST, (CASES, 3))
worst, strayed = tries[0], -np.inf
for generation in range(GENERATIONS):
    cases = [
        batch.case(parameters={"frames[pole].body.mass": mass}, q=[0, np.pi + angle], velocity=[0, rate])
        for mass, angle, rate in tries
    ]
    done = batch.rollout("cart-pole", cases, *sys.argv[1:], common=common, extremes=True, expect=EXPECT)
    farthest = np.maximum(done.max[:, 0], -done.min[:, 0])
    if farthest.max() > strayed:
        worst, strayed = tries[farthest.argmax()], farthest.max()
    kept = " and ".join(f"{share:.0%}" for share in done.came_true.mean(axis=0))
    print(f"generation {generation}: {kept} of the cases keep what is expected; the farthest: {strayed:.3f} m")
    spread = 0.3 * 0.6**generation * (MOST - LEAST)
    tries = np.clip(random.normal(worst, spread, (CASES, 3)), LEAST, MOST)
print("the worst case: a pole of {:.2f} kg at {:.2f} rad and {:.2f} rad/s".format(*worst))
