"""Client of plantd: simulated plants that step when a controller says so.

    import plantd

    with plantd.connect("http://127.0.0.1:50051") as client:
        gain = client.solve_lqr("pendulum", at="upright", q=[100, 1], r=[1])
        plant = client.create_plant("pendulum", q=[3.0])
        state = plant.state
        with client.drive(plant.id) as driver:
            for _ in range(1000):
                state = driver.step(gain(state))

Vectors and matrices are numpy arrays in SI units and radians. What the server refuses is raised as
`PlantdError`, with the gRPC code, the reason and the faults of the request.
"""

from ._client import Client, connect
from ._drive import Driver
from ._errors import PlantdError, StepError, Violation
from ._rotation import difference, rotations
from ._types import (
    Analysis,
    Contraction,
    Diagnostics,
    Dynamics,
    Energy,
    Gain,
    Linearization,
    Mode,
    Plant,
    Regulator,
    Rollout,
    SecondOrder,
    Settled,
    State,
    StepReport,
    Watched,
)

__all__ = [
    "Analysis",
    "Client",
    "Contraction",
    "Diagnostics",
    "Driver",
    "Dynamics",
    "Energy",
    "Gain",
    "Linearization",
    "Mode",
    "Plant",
    "PlantdError",
    "Regulator",
    "Rollout",
    "SecondOrder",
    "Settled",
    "State",
    "StepError",
    "StepReport",
    "Violation",
    "Watched",
    "connect",
    "difference",
    "rotations",
]
