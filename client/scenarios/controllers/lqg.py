"""Keeps the cart-pole upright by what its two sensors say, for `plantctl test`."""

import os

import plantd

plant = os.environ["PLANTD_PLANT"]
with plantd.connect(os.environ["PLANTD_ADDRESS"]) as client:
    gain = client.solve_lqr("cart-pole", at="upright", q=[10, 100, 1, 1], r=[0.01])
    kalman = client.solve_kalman(
        "cart-pole",
        at="upright",
        outputs=["x", "theta"],
        measurement_noise=[2.5e-5, 2.5e-5],
        process_noise=[1e-8, 1e-8, 1e-6, 1e-6],
    )
    with client.drive(plant) as driver:
        measured = client.get_channels(plant).outputs.y
        for _ in range(int(os.environ["PLANTD_STEPS"])):
            kalman.correct(measured)
            u = gain(kalman.x)
            kalman.predict(u)
            driver.step(u)
            measured = driver.outputs.y
