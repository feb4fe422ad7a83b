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

from . import batch
from ._batch import Rollout, Rollouts, Stepped
from ._channels import Channels, Outputs
from ._client import Client, connect
from ._drive import Driver, Hold, ReconnectingDriver
from ._errors import PlantdError, RolledBack, StepError, SteppedByOthers, Violation
from ._feedback import Feedback, Follower, GainSchedule, WatchedGain
from ._gains import Gain, Regulator, TrajectoryGain
from ._handle import PlantHandle
from ._kalman import Kalman, KalmanStep, TrajectoryKalman
from ._launch import Server, launch
from ._linearize import Analysis, Contraction, Linearization, Mode, SecondOrder
from ._local import local
from ._mechanics import (
    CenterOfMass,
    Dynamics,
    EquationOfMotion,
    ForwardDynamics,
    FrameMotion,
    InverseDynamics,
    Kinematics,
    PointMotion,
)
from ._models import Settled
from ._optimize import Checkpoint, Optimum, Progress, ProjectedReference, Search
from ._plants import Accuracy, Diagnostics, Plant, Poles, Poses, Watched
from ._realtime import Event, StepTiming
from ._recordings import Recording
from ._requests import Stepping
from ._rotation import compose, difference, rotations
from ._servers import Adopted, ServerInfo
from ._states import Energy, State, StepReport, Trajectory
from ._tables import read_recording

__all__ = [
    "Adopted",
    "Accuracy",
    "Analysis",
    "CenterOfMass",
    "Channels",
    "Checkpoint",
    "Client",
    "Contraction",
    "Diagnostics",
    "Driver",
    "Dynamics",
    "Energy",
    "EquationOfMotion",
    "Event",
    "Feedback",
    "Follower",
    "ForwardDynamics",
    "FrameMotion",
    "Gain",
    "GainSchedule",
    "Hold",
    "InverseDynamics",
    "Kalman",
    "KalmanStep",
    "Kinematics",
    "Linearization",
    "Mode",
    "Optimum",
    "Outputs",
    "Plant",
    "PlantHandle",
    "PlantdError",
    "PointMotion",
    "Poles",
    "Poses",
    "Progress",
    "ProjectedReference",
    "ReconnectingDriver",
    "Recording",
    "Regulator",
    "RolledBack",
    "Rollout",
    "Rollouts",
    "Search",
    "SecondOrder",
    "Server",
    "ServerInfo",
    "Settled",
    "State",
    "StepError",
    "StepReport",
    "StepTiming",
    "Stepped",
    "SteppedByOthers",
    "Stepping",
    "Trajectory",
    "TrajectoryGain",
    "TrajectoryKalman",
    "Violation",
    "Watched",
    "WatchedGain",
    "batch",
    "compose",
    "connect",
    "difference",
    "launch",
    "local",
    "read_recording",
    "rotations",
]
