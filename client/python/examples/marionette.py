"""Lifts the marionette's left arm by its string, open loop: python marionette.py [ADDRESS]"""

import math
import sys

import plantd

address = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:50051"
with plantd.connect(address) as client:
    model = client.get_model("marionette")
    names = [c.name for c in model.coordinates if c.prescribed]
    string = names.index("left_arm_string_length")
    plant = client.create_plant("marionette")
    rest = plant.state.q[-len(names) :]
    with client.drive(plant.id) as driver:
        for k in range(200):
            strings = rest.copy()
            strings[string] -= 0.1 * math.sin(math.pi * k / 200) ** 2
            state = driver.step(strings)
            if k % 20 == 0:
                print(f"{state.time:5.2f} s  string {strings[string]:.4f} m  torso z {state.q[2]:+.5f} m")
    client.delete_plant(plant.id)
