"""Gains for poles that nobody has weighed, by CMA-ES: each generation is one batch of noisy closed loops.

    python3 gains_cma.py                            # by a server that is started for it
    python3 gains_cma.py http://a:50051,http://b:50051

Needs `pip install cma`. The search begins at the regulator of the nominal pole.
"""

import sys

import cma
import numpy as np
import plantd
from plantd import Gain, batch

GENERATIONS, STEPS = 15, 500
MASSES = (0.3, 1.0, 3.0)
COST = dict(q=[1, 100, 0, 0], r=[0.001], x_reference=[0, np.pi, 0, 0])

with plantd.launch() as client:
    law = client.solve_lqr("cart-pole", at="upright", q=[1, 100, 1, 1], r=[0.01])


def case(k, mass):
    """A closed loop with the gain k, a pole of that mass, and a noisy input."""
    gain = Gain.from_matrix([k], law.x_reference, law.u_reference)
    noise = dict(input="force", noise=dict(deviation=0.5))
    changed = {"frames[pole].body.mass": mass}
    return batch.case(parameters=changed, feedback=dict(gain=gain, mode="replace"), faults=[noise], seed=1)


def costs(gains):
    """What each gain costs on average; those that lose the pole, or fail, cost most."""
    common = batch.case(steps=STEPS, q=[0.0, np.pi + 0.2])
    cases = [case(k, mass) for k in gains for mass in MASSES]
    done = batch.rollout("cart-pole", cases, *sys.argv[1:], common=common, cost=COST)
    return np.nan_to_num(np.minimum(done.cost, 1e6), nan=1e6).reshape(-1, len(MASSES)).mean(axis=1)


search = cma.CMAEvolutionStrategy(np.ones(4), 0.3, dict(seed=1, verbose=-9, popsize=16))
for _ in range(GENERATIONS):
    scales = search.ask()
    search.tell(scales, costs([scale * law.k[0] for scale in scales]).tolist())
print(f"the regulator of the nominal pole costs {costs([law.k[0]])[0]:.1f}, the best gain {search.result.fbest:.1f}")
