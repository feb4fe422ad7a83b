"""Many simulations over many servers, processes or machines, with the bits of one server.

    from plantd import batch

    cases = [batch.case(q=[0.01 * k, 0.0], steps=1000) for k in range(10_000)]
    done = batch.rollout("cart-pole", cases)                                # a server of this process
    done = batch.rollout("cart-pole", cases, over="http://a:50051,http://b:50051")
    done = batch.rollout("cart-pole", cases, over=ray)                      # tasks of a Ray cluster
    done.x[7], done.errors

A batch is cut into pieces: plain values that hold all that a server needs for them. `run` does one by a server
that belongs to the process, so that any engine that calls functions elsewhere does a batch::

    dask.distributed.Client(...).map(batch.run, list(batch.pieces("cart-pole", cases)))

A piece has the same result wherever and however often it is done. So a piece whose worker or server was lost is done
again elsewhere, and nothing else changes.
"""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from os import PathLike
from types import ModuleType
from typing import TYPE_CHECKING, Any, Union

import numpy as np
import numpy.typing as npt

from plantd.v1 import channel_service_pb2, control_service_pb2, plant_service_pb2, realtime_pb2

from ._arrays import Array, Vector, matrix, matrix_message, numbers, vector, weight
from ._batch import shift_cases
from ._check import build, mapping, shown
from ._client import Client, connect
from ._errors import PlantdError, from_failure, is_lost
from ._feedback import feedback_request
from ._launch import launch
from ._models import scene_text
from ._requests import Stepping, initial_state, settings

if TYPE_CHECKING:
    from typing_extensions import Unpack

__all__ = ["Case", "Done", "Piece", "case", "pieces", "rollout", "run", "together"]

Case = control_service_pb2.RolloutCase

#: What does pieces: an executor, the module ``ray``, servers by their addresses or clients; None is this process.
Engine = Union[Executor, ModuleType, str, Client, Sequence[Union[str, Client]], None]

#: Bytes of the cases of a piece: well below what a server takes in one message.
_PIECE_BYTES = 4 << 20

#: How often a piece is tried that is lost each time: perhaps it is what ends its servers.
_ATTEMPTS = 8

#: Pieces that wait or are done at a time, for each worker of an engine.
_WAITING = 4

#: How long servers are waited for of which none answers, s.
_PATIENCE_SECONDS = 30.0

#: The first pause before a server that was lost is asked again, and the longest one, s.
_PAUSE_SECONDS = (0.01, 0.5)

#: A piece that takes longer is done by an idle server as well, s: its own may hang.
_SLOW_SECONDS = 10.0

#: Pieces under way on a server, so that it computes one while the answers of another are read.
_AT_A_TIME = 2


@dataclass(frozen=True)
class Piece:
    """Some cases of a batch, with all that a server needs for them. It can be pickled."""

    #: Index of its first case.
    first: int
    #: Number of its cases.
    count: int
    #: A serialized ``RolloutRequest`` of the contract.
    request: bytes
    #: Threads of the server that `run` does it by; 0 means one for each processor.
    workers: int


#: How the names of columns begin that say whether an expectation came true.
_EXPECT = "expect: "


@dataclass(frozen=True, eq=False)
class Done:
    """The ends of cases, a row for each, in the order of the cases. It can be pickled."""

    #: Index of each case.
    cases: npt.NDArray[np.int64]
    #: [case][column]: NaN in a case that was not begun.
    rows: Array
    #: Names of the columns: ``steps``; ``end``; the last x; its least and its largest entries; ``cost``; expectations.
    columns: tuple[str, ...]
    #: Errors by the index of the case.
    errors: dict[int, PlantdError]
    #: Build of the servers, of which the bits are.
    build: str
    _has_extremes: bool = False
    _has_cost: bool = False

    @property
    def steps(self) -> npt.NDArray[np.int64]:
        """Steps that were taken."""
        return self.rows[:, 0].astype(np.int64)

    @property
    def end(self) -> npt.NDArray[np.int64]:
        """0 where all steps were taken, 1 where a bound of ``until`` ended the case, 2 where it failed."""
        return self.rows[:, 1].astype(np.int64)

    @property
    def x(self) -> Array:
        """The last states x = (q, p, v): [case][entry]."""
        return self._part(0)

    @property
    def min(self) -> Array:
        """Least value of each entry of x over the steps, with ``extremes``: [case][entry]."""
        return self._part(1)

    @property
    def max(self) -> Array:
        """Largest value of each entry of x over the steps, with ``extremes``: [case][entry]."""
        return self._part(2)

    @property
    def cost(self) -> Array:
        """Cost of each case, with ``cost``."""
        if not self._has_cost:
            raise ValueError("the batch was not asked for `cost`")
        return self.rows[:, len(self.columns) - len(self.expectations) - 1]

    @property
    def expectations(self) -> tuple[str, ...]:
        """The expectations in words, with ``expect``."""
        marked = (name.partition(_EXPECT) for name in self.columns)
        return tuple(sentence for before, mark, sentence in marked if mark and not before)

    @property
    def came_true(self) -> npt.NDArray[np.bool_]:
        """Whether each expectation came true, with ``expect``; not in a case that never began: [case][expectation]."""
        count = len(self.expectations)
        if not count:
            raise ValueError("the batch was not asked for `expect`")
        return np.asarray(self.rows[:, len(self.columns) - count :] == 1, dtype=np.bool_)

    def _part(self, number: int) -> Array:
        """The last x, its least, or its largest entries."""
        if number and not self._has_extremes:
            raise ValueError("the batch was not asked for `extremes`")
        size = (len(self.columns) - 2 - self._has_cost - len(self.expectations)) // (3 if self._has_extremes else 1)
        start = 2 + number * size
        return self.rows[:, start : start + size]

    def __len__(self) -> int:
        return len(self.cases)

    def raise_errors(self) -> None:
        """Raises the error of the first case that did not come to its end, if there is one."""
        for index in sorted(self.errors):
            raise self.errors[index]


def case(
    u: npt.ArrayLike | None = None,
    *,
    steps: int = 0,
    at: str | None = None,
    q: Vector | None = None,
    velocity: Vector | None = None,
    p: Vector | None = None,
    parameters: Mapping[str, float] | None = None,
    feedback: Mapping[str, Any] | None = None,
    outputs: Iterable[Mapping[str, Any]] = (),
    inputs: Iterable[Mapping[str, Any]] = (),
    seed: int | None = None,
    faults: Iterable[Mapping[str, Any]] = (),
    until: Iterable[Mapping[str, Any]] = (),
) -> Case:
    """One simulation: a plant that is made, steps, and is gone.

    ``u`` has a row for each step; its last row holds for ``steps`` more. It begins at the operating point ``at``, at
    ``q`` with ``velocity`` or momentum ``p``, or where the scene says. What else a plant can have is said as to
    `Client.set_parameters`, `Client.set_feedback` (``dict(gain=gain, mode="replace")``), `Client.set_channels`
    and `Client.inject_fault`; ``seed`` is that of all noise and chance. ``until`` has bounds as those of
    `Client.set_safety`, without an action: the case ends after the step in which one of them is left.
    """
    changed = mapping("parameters", parameters, "{'gravity[1]': -9.81}")
    sensors, actuators = list(outputs), list(inputs)
    channels = build(channel_service_pb2.Channels, outputs=sensors, inputs=actuators)
    law = mapping("feedback", feedback, "{'gain': gain, 'mode': 'replace'}")
    return build(
        Case,
        initial=initial_state(at, q, velocity, None, p, None),
        u=None if u is None else matrix_message(numbers(u, "u"), "u"),
        hold=steps,
        parameters=[build(plant_service_pb2.Parameter, path=path, value=to) for path, to in changed.items()],
        feedback=feedback_request("", **law) if law else None,
        channels=channels if sensors or actuators else None,
        seed=seed,
        faults=[build(channel_service_pb2.FaultSpec, **fault) for fault in faults],
        until=[build(realtime_pb2.Watchdog, **bound) for bound in until],
    )


def pieces(
    model: str,
    cases: Iterable[Case],
    *,
    size: int = 250,
    scene: str | PathLike[str] | None = None,
    common: Case | None = None,
    extremes: bool = False,
    cost: Mapping[str, npt.ArrayLike] | None = None,
    expect: str = "",
    workers: int = 1,
    **stepping: Unpack[Stepping],
) -> Iterator[Piece]:
    """Cuts a batch of simulations of a model into pieces of at most ``size`` cases and 4 MiB.

    With ``scene``, a text or a file, the pieces are of that scene, which goes with each of them, and ``model`` is
    empty. ``common`` has what all cases have that do not say otherwise; its ``parameters`` and ``faults`` come
    before theirs. ``extremes`` asks for the least and the largest entries of x over the steps. ``cost`` has weights
    ``q``, ``r`` and ``end``, diagonals or matrices, and ``x_reference`` and ``u_reference``: a case costs the sum
    over its steps of e' q e + d' r d, with the differences e and d of x and u from these references, and e' end e
    of its last state. ``expect`` has expectations as scenarios of ``plantctl test`` have them, tables ``[[expect]]`` in
    TOML: see `Done.came_true`. ``workers`` is the number of threads of the server by which `run` does a piece, 0 for one for
    each processor; engines run several pieces side by side.
    """
    if not isinstance(size, int) or size < 1:
        raise ValueError(f"`size` is {shown(size)}; a whole number from 1 on is needed")
    if scene is not None and model:
        raise ValueError(f"`scene` is given, and `model` is {shown(model)}: write '' for it")
    head = build(
        control_service_pb2.RolloutRequest,
        model=model,
        scene=None if scene is None else scene_text(scene),
        settings=settings(**stepping),
        common=common,
        extremes=extremes,
        cost=None if cost is None else _cost(cost),
        expect=expect,
        table=True,
    )
    return _cut(head, cases, size, workers)


def _cost(given: Mapping[str, npt.ArrayLike]) -> control_service_pb2.RolloutCost:
    values = mapping("cost", given, "{'q': [1, 1], 'r': [0.1]}")
    fields = {
        name: (vector(value, name) if name.endswith("_reference") else weight(value, name))
        for name, value in values.items()
    }
    return build(control_service_pb2.RolloutCost, **fields)


def _cut(
    head: control_service_pb2.RolloutRequest, cases: Iterable[Case], size: int, workers: int
) -> Iterator[Piece]:
    piece = control_service_pb2.RolloutRequest()
    piece.CopyFrom(head)
    first = length = 0
    for number, one in enumerate(cases):
        if not isinstance(one, Case):
            raise TypeError(f"`cases[{number}]` is {shown(one)}; a `plantd.batch.case` is needed")
        more = one.ByteSize()
        if piece.cases and (len(piece.cases) == size or length + more > _PIECE_BYTES):
            yield Piece(first, len(piece.cases), piece.SerializeToString(), workers)
            first, length = number, 0
            del piece.cases[:]
        piece.cases.append(one)
        length += more
    if piece.cases:
        yield Piece(first, len(piece.cases), piece.SerializeToString(), workers)


def run(piece: Piece) -> Done:
    """Does a piece by this process's own server, which is started by `plantd.launch` at first use, kept, and ends with
    the process. If it is lost, another one is started."""
    lost: PlantdError | None = None
    for _ in range(_ATTEMPTS):
        client = _own(piece.workers)
        try:
            return _do(client, piece)
        except PlantdError as error:
            if not is_lost(error):
                raise
            lost = error
            _forget(piece.workers, client)
    assert lost is not None
    raise lost


#: Servers of this process, by process and threads: a process that was forked off has its own.
_servers: dict[tuple[int, int], Client] = {}
_starting = threading.Lock()


def _own(workers: int) -> Client:
    key = (os.getpid(), workers)
    with _starting:
        if key not in _servers:
            _servers[key] = launch(arguments=["--link", "off", "--workers", str(workers)])
        return _servers[key]


def _forget(workers: int, client: Client) -> None:
    """Ends a server that does not answer; the next call starts another one."""
    key = (os.getpid(), workers)
    with _starting:
        if _servers.get(key) is client:
            del _servers[key]
    client.close()


def _do(client: Client, piece: Piece) -> Done:
    """Does a piece by a server."""
    request = control_service_pb2.RolloutRequest.FromString(piece.request)
    of_build = ""
    rows = np.zeros((piece.count, 0))
    columns: tuple[str, ...] = ()
    errors: dict[int, PlantdError] = {}
    count = 0
    for answer in client._rollout(request):
        table = answer.table
        if not columns:
            columns = tuple(table.columns)
            rows = np.full((piece.count, len(columns)), np.nan)
            of_build = table.build
        rows[list(table.case_indices)] = matrix(table.rows)
        count += len(table.case_indices)
        shift_cases(answer, piece.first)
        for failed in table.failures:
            errors[failed.case_index] = from_failure(failed.failure, PlantdError)
    if count != piece.count:
        # The stream has ended in good order, but too early.
        raise PlantdError("UNAVAILABLE", f"{count} of {piece.count} cases were answered")
    cases = np.arange(piece.first, piece.first + piece.count)
    return Done(cases, rows, columns, errors, of_build, request.extremes, request.HasField("cost"))


def together(done: Iterable[Done], *, any_build: bool = False) -> Done:
    """All rows, in the order of the cases.

    Raises `ValueError` where cases are missing or there twice, and where pieces were done by servers of several
    builds, whose bits differ, unless ``any_build`` is set.
    """
    parts = sorted((part for part in done if len(part)), key=lambda part: int(part.cases[0]))
    if not parts:
        return Done(np.zeros(0, np.int64), np.zeros((0, 0)), (), {}, "")
    cases = np.concatenate([part.cases for part in parts])
    wrong = np.flatnonzero(cases != np.arange(len(cases)))
    if wrong.size:
        at = int(wrong[0])
        what = "there twice" if cases[at] < at else "missing"
        raise ValueError(f"case {min(at, int(cases[at]))} is {what}")
    builds = sorted({part.build for part in parts})
    if len(builds) > 1 and not any_build:
        raise ValueError(f"the servers are of several builds, whose bits differ: {', '.join(builds)}")
    if len({part.columns for part in parts}) > 1:
        raise ValueError("the pieces are of several batches: their columns differ")
    errors = {case: error for part in parts for case, error in part.errors.items()}
    rows = np.concatenate([part.rows for part in parts])
    first = parts[0]
    builds_text = ", ".join(builds)
    return Done(cases, rows, first.columns, errors, builds_text, first._has_extremes, first._has_cost)


def rollout(
    model: str,
    cases: Iterable[Case],
    over: Engine = None,
    *,
    size: int = 250,
    scene: str | PathLike[str] | None = None,
    common: Case | None = None,
    extremes: bool = False,
    cost: Mapping[str, npt.ArrayLike] | None = None,
    expect: str = "",
    any_build: bool = False,
    **stepping: Unpack[Stepping],
) -> Done:
    """Simulates cases, and gives their ends in the order of the cases: the same bits, wherever they are simulated.

    ``over`` says by what:

    - None: a server of this process, on all its processors.
    - An executor of ``concurrent.futures``, or of dask by its ``get_executor``: by `run` in its workers. One that
      has lost a worker and takes no more leaves the rest to this process.
    - The module ``ray``: by `run` in tasks, which Ray does again when it loses a machine.
    - One address, several in a text with commas between them, or a list of addresses and clients: by these servers,
      two pieces at a time on each. Addresses are connected to by `connect`, with the credentials of its variables.
      One behind which there are several servers may stand there as many times.

    A piece whose worker or server was lost is done again elsewhere. When none of the servers has answered for 30 s,
    and when a piece was lost eight times, that error is raised.

    All else is as of `pieces` and `together`.
    """
    workers = 0 if over is None else 1
    cut = pieces(
        model,
        cases,
        size=size,
        scene=scene,
        common=common,
        extremes=extremes,
        cost=cost,
        expect=expect,
        workers=workers,
        **stepping,
    )
    return together(_engine(over)(cut), any_build=any_build)


def _engine(over: Engine) -> Callable[[Iterator[Piece]], Iterable[Done]]:
    """What does pieces, in any order."""
    if over is None:
        return _here
    if isinstance(over, ModuleType) and over.__name__ == "ray":
        return lambda cut: _by_ray(over, cut)
    if isinstance(over, Executor):
        return lambda cut: _by_executor(over, cut)
    servers: list[Any] = []
    if isinstance(over, str):
        servers = [address.strip() for address in over.split(",") if address.strip()]
    elif isinstance(over, Client):
        servers = [over]
    elif isinstance(over, Sequence):
        servers = list(over)
    if not servers or not all(isinstance(server, (str, Client)) for server in servers):
        raise TypeError(
            f"`over` is {shown(over)}; an executor, the module `ray`, or addresses of servers are needed, or None"
        )
    return lambda cut: _Servers(servers, cut).done()


def _here(cut: Iterator[Piece]) -> Iterator[Done]:
    with ThreadPoolExecutor(_AT_A_TIME) as threads:
        yield from _by_executor(threads, cut)


def _by_executor(executor: Executor, cut: Iterator[Piece]) -> Iterator[Done]:
    most = _WAITING * int(getattr(executor, "_max_workers", 0) or 64)
    waiting: dict[Future[Done], Piece] = {}
    left: list[Piece] = []
    try:
        while True:
            while len(waiting) < most and not left:
                piece = next(cut, None)
                if piece is None:
                    break
                try:
                    waiting[executor.submit(run, piece)] = piece
                except BrokenExecutor:
                    left.append(piece)
            if not waiting:
                break
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                piece = waiting.pop(future)
                try:
                    done = future.result()
                except BrokenExecutor:
                    left.append(piece)
                else:
                    yield done
    finally:
        for future in waiting:
            future.cancel()
    if left:
        warnings.warn("the executor has lost a worker and takes no more: the rest is done here", stacklevel=4)
        for rest in (left, cut):
            yield from map(run, rest)


def _by_ray(ray: Any, cut: Iterator[Piece]) -> Iterator[Done]:
    # Actors would wait for ever for the processor of a machine that is gone; tasks are done elsewhere.
    task = ray.remote(num_cpus=1, max_retries=-1, scheduling_strategy="SPREAD")(run)
    most = _WAITING * max(1, int(ray.cluster_resources().get("CPU", 1)))
    waiting: list[Any] = []
    for piece in cut:
        if len(waiting) >= most:
            ready, waiting = ray.wait(waiting)
            yield from ray.get(ready)
        waiting.append(task.remote(piece))
    while waiting:
        ready, waiting = ray.wait(waiting)
        yield from ray.get(ready)


@dataclass
class _UnderWay:
    """A piece that servers are doing."""

    piece: Piece
    #: When it was begun last.
    since: float
    #: How often it was lost.
    losses: int = 0
    #: Servers that are doing it now.
    doing: int = 0


class _Servers:
    """Pieces spread over servers: threads of each take the next one when they have done one."""

    def __init__(self, servers: Sequence[str | Client], cut: Iterator[Piece]):
        self._cut = cut
        self._changed = threading.Condition()
        #: Pieces that were begun and are not done, by their first cases.
        self._under_way: dict[int, _UnderWay] = {}
        #: Those of them that nobody is doing.
        self._again: deque[_UnderWay] = deque()
        self._done: deque[Done] = deque()
        self._is_cut = False
        self._error: BaseException | None = None
        self._is_over = False
        #: When a server has answered last.
        self._answered = time.monotonic()
        self._own: list[Client] = []
        for server in servers:
            place = _Place(server, self._own)
            for _ in range(_AT_A_TIME):
                threading.Thread(target=self._work, args=(place,), daemon=True).start()

    def done(self) -> Iterator[Done]:
        """Done pieces, as they end."""
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._done or self._error or self._is_finished)
                    if self._error is not None:
                        raise self._error
                    if not self._done:
                        return
                    done = self._done.popleft()
                yield done
        finally:
            with self._changed:
                self._is_over = True
                self._changed.notify_all()
                own = list(self._own)
            for client in own:
                client.close()

    @property
    def _is_finished(self) -> bool:
        return self._is_cut and not self._under_way

    def _work(self, place: _Place) -> None:
        try:
            while (work := self._take()) is not None:
                try:
                    done = _do(place.client(), work.piece)
                except PlantdError as error:
                    if not is_lost(error):
                        raise
                    self._lose(work, error)
                    self._wait_for(place, error)
                else:
                    self._note(work, done)
        except BaseException as error:
            with self._changed:
                if self._error is None and not self._is_over:
                    self._error = error
                self._changed.notify_all()

    def _take(self) -> _UnderWay | None:
        """The next piece to do; None when there is none any more."""
        with self._changed:
            while not (self._is_over or self._error or self._is_finished):
                work = self._next()
                if work is not None:
                    work.since = time.monotonic()
                    work.doing += 1
                    return work
                self._changed.wait(_SLOW_SECONDS / 4)
            return None

    def _next(self) -> _UnderWay | None:
        if self._again:
            return self._again.popleft()
        if not self._is_cut:
            piece = next(self._cut, None)
            if piece is not None:
                work = self._under_way[piece.first] = _UnderWay(piece, 0.0)
                return work
            self._is_cut = True
            self._changed.notify_all()
        now = time.monotonic()
        slow = [work for work in self._under_way.values() if now - work.since > _SLOW_SECONDS]
        return min(slow, key=lambda work: work.doing, default=None)

    def _note(self, work: _UnderWay, done: Done) -> None:
        with self._changed:
            work.doing -= 1
            self._answered = time.monotonic()
            # Another server may have been faster.
            if self._under_way.pop(work.piece.first, None) is not None:
                self._done.append(done)
            self._changed.notify_all()

    def _lose(self, work: _UnderWay, error: PlantdError) -> None:
        with self._changed:
            work.doing -= 1
            work.losses += 1
            if work.losses == _ATTEMPTS:
                raise error
            if not work.doing and work.piece.first in self._under_way:
                self._again.append(work)
            self._changed.notify_all()

    def _wait_for(self, place: _Place, error: PlantdError) -> None:
        """Waits until a server that was lost takes pieces again."""
        pause, longest = _PAUSE_SECONDS
        while True:
            with self._changed:
                if self._is_over or self._error or self._is_finished:
                    return
                is_idle = not any(work.doing for work in self._under_way.values())
                if is_idle and time.monotonic() - self._answered > _PATIENCE_SECONDS:
                    raise error
                self._changed.wait(pause)
            pause = min(2 * pause, longest)
            try:
                if not place.client().get_server().draining:
                    break
            except PlantdError as refusal:
                if not is_lost(refusal):
                    raise
        with self._changed:
            self._answered = time.monotonic()


class _Place:
    """A server of a batch, connected to when it is needed."""

    def __init__(self, server: str | Client, own: list[Client]):
        self._server, self._own = server, own
        self._connecting = threading.Lock()

    def client(self) -> Client:
        with self._connecting:
            if isinstance(self._server, str):
                self._server = connect(self._server)
                self._own.append(self._server)
            return self._server
