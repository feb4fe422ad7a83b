"""Parts of requests that several calls have, from what a caller gives."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypedDict, Union, get_args

import numpy as np
import numpy.typing as npt

from plantd.v1 import common_pb2, control_service_pb2, plant_service_pb2

from ._arrays import Array, Vector, matrix_message, numbers, vector, weight
from ._check import build, instead, one_of, shown, texts
from ._states import State, Trajectory

#: Bounds by the name of an entry: (lowest, highest), None for no bound; a number fixes the entry.
Bounds = Mapping[str, Union[float, tuple[Union[float, None], Union[float, None]]]]
#: Where the solver of a step stops: at round-off, or at about eleven or seven digits.
Precision = Literal["exact", "fast", "coarse"]


class Stepping(TypedDict, total=False):
    """How a plant is stepped: keywords of every call that makes a plant or looks at the map of a model."""

    #: Time step in seconds, the control period; 0, if not given, is the scene's.
    dt: float
    #: Put all forces at the start of a step, as the paper does.
    paper: bool
    #: Order of accuracy: 2, if not given, or 4, 6, 8, 12 and 16.
    order: int
    #: Steps of the method in a time step, 1 to 256; 1 if not given.
    substeps: int
    #: How often a time step that cannot be solved is halved, 0 to 8; 8 if not given.
    halvings: int
    #: Where the solver stops: at round-off, if not given, or at about eleven or seven digits.
    precision: Precision
    #: Reciprocal condition below which a step is refused as singular; 1e-14 if not given.
    singular_below: float
    #: Newton iterations before a step is given up; 40 if not given.
    newton_iterations: int


def settings(
    *,
    dt: float = 0.0,
    paper: bool = False,
    order: int = 0,
    substeps: int = 0,
    halvings: int | None = None,
    precision: Precision = "exact",
    singular_below: float = 0.0,
    newton_iterations: int = 0,
    **unknown: object,
) -> plant_service_pb2.PlantSettings:
    for argument in unknown:
        known = [*Stepping.__annotations__, *_arguments_of_call()]
        raise TypeError(f"there is no argument `{argument}`{instead(argument, known)}")
    one_of("precision", precision, get_args(Precision))
    split = plant_service_pb2.FORCE_SPLIT_PAPER if paper else plant_service_pb2.FORCE_SPLIT_SYMMETRIC
    return build(
        plant_service_pb2.PlantSettings,
        time_step_s=dt,
        force_split=split,
        order=order,
        substeps=substeps,
        halvings=halvings,
        precision=plant_service_pb2.Precision.Value(f"PRECISION_{precision.upper()}"),
        singular_below=singular_below,
        max_iterations=newton_iterations,
    )


def _arguments_of_call() -> list[str]:
    """Arguments of the call that asked for settings."""
    frame = inspect.currentframe()
    caller = frame and frame.f_back and frame.f_back.f_back
    if caller is None:
        return []
    code = caller.f_code
    names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    return [name for name in names if name != "self"]


def initial_state(
    at: str | None,
    q: Vector | None,
    velocity: Vector | None,
    v: Vector | None,
    p: Vector | None,
    initial: common_pb2.InitialState | None,
) -> common_pb2.InitialState | None:
    if sum(given is not None for given in (at, q, initial)) > 1:
        raise ValueError("give one of `at`, `q` and `initial`")
    rates = [given for given in (velocity, v, p) if given is not None]
    if q is None and rates:
        raise ValueError("`velocity`, `v` and `p` need `q`")
    if len(rates) > 1:
        raise ValueError("give one of `velocity`, `v` and `p`")
    if at is not None:
        return build(common_pb2.InitialState, operating_point=at)
    if q is None:
        return initial
    configuration = vector(q, "q")
    if p is not None:
        momentum = build(common_pb2.InitialState.Momentum, q=configuration, p=vector(p, "p"))
        return build(common_pb2.InitialState, momentum=momentum)
    rate: Array = np.zeros_like(configuration)
    if rates:
        rate = vector(rates[0], "velocity" if velocity is not None else "v")
    moving = build(common_pb2.InitialState.Velocity, q=configuration, v=rate)
    return build(common_pb2.InitialState, velocity=moving)


def point(at: str | None, state: State | None, u: Vector, plant: str = "") -> common_pb2.Point:
    if sum((at is not None, state is not None, bool(plant))) > 1:
        raise ValueError("give one of `at`, `state` and `plant`")
    if state is not None and not isinstance(state, State):
        raise TypeError(f"`state` is {shown(state)}; a `plantd.State` is needed")
    if state is None and len(vector(u, "u")):
        raise ValueError("`u` needs `state`: operating points and plants have inputs of their own")
    if plant:
        return build(common_pb2.Point, plant=plant)
    if state is None:
        return build(common_pb2.Point, operating_point="initial" if at is None else at)
    here = build(common_pb2.StateAndInput, state=state._message(), u=vector(u, "u"))
    return build(common_pb2.Point, state_and_input=here)


def trajectory(initial: State | Trajectory, u: npt.ArrayLike | None) -> common_pb2.Trajectory:
    if isinstance(initial, Trajectory):
        if u is not None:
            raise ValueError("a trajectory already has inputs: `u` is not needed")
        return initial._message()
    if u is None:
        raise ValueError("`u`, the inputs of the trajectory, is needed")
    if initial is not None and not isinstance(initial, State):
        raise TypeError(
            f"the initial state is {shown(initial)}; a `plantd.State` or `plantd.Trajectory` is needed"
        )
    return Trajectory(initial, numbers(u, "u"))._message()


def weights(
    q: npt.ArrayLike,
    r: npt.ArrayLike,
    q_final: npt.ArrayLike | None = None,
    s: npt.ArrayLike | None = None,
    projected_momentum: bool = False,
) -> plant_service_pb2.LqrWeights:
    return build(
        plant_service_pb2.LqrWeights,
        q=weight(q, "q"),
        r=weight(r, "r"),
        q_final=None if q_final is None else weight(q_final, "q_final"),
        s=None if s is None else matrix_message(s, "s"),
        momentum=momentum(projected_momentum),
    )


def momentum(projected: bool) -> plant_service_pb2.Momentum:
    projected_momentum = plant_service_pb2.MOMENTUM_PROJECTED
    return projected_momentum if projected else plant_service_pb2.MOMENTUM_UNSPECIFIED


def stage_weights(stages: Iterable[Mapping[str, npt.ArrayLike]]) -> list[Any]:
    """Weights of each step: mappings with ``q`` and ``r``, and if need be ``s``, ``x_linear`` and
    ``u_linear``."""
    messages = []
    for step, stage in enumerate(stages):
        unknown = set(stage) - {"q", "r", "s", "x_linear", "u_linear"}
        if unknown or "q" not in stage or "r" not in stage:
            raise ValueError(
                f"weights of step {step}: `q` and `r`, perhaps `s`, `x_linear`, `u_linear` are "
                f"needed, not {sorted(stage)}"
            )
        messages.append(
            build(
                plant_service_pb2.StageWeights,
                q=weight(stage["q"]),
                r=weight(stage["r"]),
                s=matrix_message(stage["s"]) if "s" in stage else None,
                x_linear=vector(np.asarray(stage.get("x_linear", ()))),
                u_linear=vector(np.asarray(stage.get("u_linear", ()))),
            )
        )
    return messages


def trajectory_weights(
    q: npt.ArrayLike | None,
    r: npt.ArrayLike | None,
    q_final: npt.ArrayLike | None,
    s: npt.ArrayLike | None,
    projected_momentum: bool,
) -> plant_service_pb2.LqrWeights | None:
    """The weights that go beside those of each step, or stand for them."""
    if q is not None and r is not None:
        return weights(q, r, q_final, s, projected_momentum)
    if q_final is not None:
        return build(
            plant_service_pb2.LqrWeights,
            q_final=weight(q_final, "q_final"), momentum=momentum(projected_momentum)
        )
    return None


def bounds(given: Bounds | None) -> list[common_pb2.Bound]:
    messages = []
    if given is not None and not isinstance(given, Mapping):
        raise TypeError(f"bounds are {shown(given)}; a dict is needed, such as {{'force': (-5, 5)}}")
    for entry, ends in (given or {}).items():
        if isinstance(ends, Sequence) and (isinstance(ends, str) or len(ends) != 2):
            raise TypeError(f"the bounds of `{entry}` are {shown(ends)}; a number or a pair is needed")
        low, high = ends if isinstance(ends, Sequence) else (ends, ends)
        messages.append(build(common_pb2.Bound, entry=entry, min=low, max=high))
    return messages


def measurement(
    outputs: Sequence[str] | npt.ArrayLike, output_u: npt.ArrayLike | None = None
) -> control_service_pb2.Measurement:
    """Outputs by names of entries of x, or by a matrix."""
    names, rows = split_outputs(outputs)
    return build(
        control_service_pb2.Measurement,
        outputs=names,
        output_x=rows,
        output_u=None if output_u is None else matrix_message(output_u, "output_u"),
    )


def split_outputs(
    outputs: Sequence[str] | npt.ArrayLike,
) -> tuple[list[str], common_pb2.Matrix | None]:
    given: Any = outputs
    if not isinstance(given, str) and len(given) and not isinstance(given[0], str):
        return [], matrix_message(given, "outputs")
    return texts("outputs", given), None


def noise(
    process: npt.ArrayLike | None, input: npt.ArrayLike | None, measurement: npt.ArrayLike
) -> control_service_pb2.NoiseCovariances:
    return build(
        control_service_pb2.NoiseCovariances,
        process=None if process is None else weight(process, "process"),
        input=None if input is None else weight(input, "input"),
        measurement=weight(measurement, "measurement"),
    )


def constraints(full: bool) -> Any:
    if full:
        return common_pb2.CONSTRAINT_HANDLING_FULL
    return common_pb2.CONSTRAINT_HANDLING_MANIFOLD
