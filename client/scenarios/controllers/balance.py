"""Keeps the cart-pole upright over gRPC, for `plantctl test`."""

import os

import plantd

with plantd.connect(os.environ["PLANTD_ADDRESS"]) as client:
    gain = client.solve_lqr("cart-pole", at="upright", q=[10, 100, 1, 1], r=[0.01])
    with client.drive(os.environ["PLANTD_PLANT"]) as driver:
        state = driver.plant.state
        for _ in range(int(os.environ["PLANTD_STEPS"])):
            state = driver.step(gain(state))
