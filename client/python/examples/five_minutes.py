"""From nothing to a regulated robot with a plot: python five_minutes.py [launch|local]; prints the time of each step."""

import sys
import time

import numpy as np

BEGUN = [time.monotonic()]

import plantd  # noqa: E402  (its time is measured)

ARM = """<robot name="arm"><link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="2"/>
    <inertia ixx="0.03" iyy="0.03" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="fore"><inertial><origin xyz="0 0 0.15"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/>
    <axis xyz="0 1 0"/></joint>
</robot>"""


def done(what: str) -> None:
    BEGUN.append(time.monotonic())
    print(f"{BEGUN[-1] - BEGUN[-2]:6.2f} s  {what}", flush=True)


done("plantd imported")
client = plantd.local() if sys.argv[1:] == ["local"] else plantd.launch()
done("a server, in this process or beside it")
model = client.create_model(ARM)
done(f"a robot imported: {', '.join(c.name for c in model.coordinates)}")
# Upright, where it falls over without a regulator.
with client, client.plant(model.name, q=[0.3, -0.2], dt=0.01) as plant:
    law = plant.lqr(q=[100, 100, 1, 1], r=[0.01, 0.01])
    done("a regulator solved for")
    with plant.drive() as driver:
        states = [driver.plant.state]
        for _ in range(300):
            states.append(driver.step(law(states[-1])))
    done("3 s of the closed loop")
    client.plot(states).savefig("five_minutes.png")
    done("plotted into five_minutes.png")
assert np.all(np.abs(states[-1].q) < 1e-3), states[-1]
