"""Balances the pendulum upright over gRPC: python pendulum_lqr.py [ADDRESS]"""

import math
import sys

import plantd

address = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:50051"
with plantd.connect(address) as client:
    gain = client.solve_lqr("pendulum", at="upright", q=[100, 1], r=[1])
    plant = client.create_plant("pendulum", q=[math.pi - 0.2])
    state = plant.state
    with client.drive(plant.id) as driver:
        for _ in range(50):
            state = driver.step(gain(state))
            print(f"{state.time:5.2f} s  angle from upright {state.q[0] - math.pi:+.6f} rad")
    client.delete_plant(plant.id)
