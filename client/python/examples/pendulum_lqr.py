"""Balances the pendulum upright: python pendulum_lqr.py [ADDRESS]; by default on a server of its own."""

import math
import sys

import plantd

client = plantd.connect(sys.argv[1]) if len(sys.argv) > 1 else plantd.launch()
with client, client.plant("pendulum", q=[math.pi - 0.2]) as plant:
    law = plant.lqr(at="upright", q=[100, 1], r=[1])
    with plant.drive() as driver:
        state = driver.plant.state
        for _ in range(50):
            state = driver.step(law(state))
            print(f"{state.time:5.2f} s  angle from upright {state.q[0] - math.pi:+.6f} rad")
