"""Balances a cart-pole and draws it, on a server of its own: python balance.py."""

import plantd

with plantd.launch() as client, client.plant("cart-pole", q=[0, 3]) as plant:
    law = plant.lqr(at="upright", q=[1, 100, 1, 1], r=[0.1])
    with plant.drive() as driver:
        states = [driver.plant.state]
        for _ in range(500):
            states.append(driver.step(law(states[-1])))
    client.plot(states).savefig("cart-pole.png")
