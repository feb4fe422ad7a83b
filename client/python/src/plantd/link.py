"""A driver over shared memory, for processes on the server's machine.

    from plantd.link import LinkDriver

    with LinkDriver("pendulum") as plant:
        for _ in range(1000):
            state = plant.step([-3.0 * plant.state.q[0] - plant.state.p[0]])

Needs the package ``iceoryx2`` (``pip install "plantd[link]"``), on Linux.
The layout and the conversation are described in ``client/c/plantd_link.h``.
"""

from __future__ import annotations

import ctypes
import os
import secrets
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Optional, Sequence

import iceoryx2 as iox2

LAYOUT_VERSION = 1
MAGIC = int.from_bytes(b"plnt", "little")
POLL_FOREVER_NS = 2**64 - 1

ATTACH, INPUT, DETACH = 1, 2, 3
ATTACHED, STATE, FAILURE, CLOSED = 16, 17, 18, 19

(
    CODE_LAYOUT,
    CODE_KIND,
    CODE_LEASE_HELD,
    CODE_NOT_ATTACHED,
    CODE_SEQUENCE,
    CODE_DIMENSION,
    CODE_INPUT_NOT_FINITE,
    CODE_NOT_CONVERGED,
    CODE_NOT_FINITE,
    CODE_SINGULAR,
    CODE_PLANT_DELETED,
    CODE_LINK_CLOSED,
    CODE_TOO_FAST,
) = range(1, 14)

_HOLDERS = {1: "a call of Step", 2: "a Drive stream", 3: "a driver over shared memory"}
_INPUT_LEN_USUAL = 64
_CHECK_PERIOD_NS = 100_000_000
_ATTACH_PERIOD_NS = 50_000_000
_LOOK_PERIOD_S = 0.02
# Python has no memory barrier: a little before the server falls asleep it is notified as well.
_NOTIFY_MARGIN_NS = 10_000
_SHARED_MEMORY = Path("/dev/shm")


class Header(ctypes.Structure):
    """The header of every message."""

    _fields_ = [
        ("magic", ctypes.c_uint32),
        ("layout_version", ctypes.c_uint32),
        ("schema_hash", ctypes.c_uint64),
        ("server", ctypes.c_uint64),
        ("driver", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("step", ctypes.c_uint64),
        ("time_s", ctypes.c_double),
        ("time_step_s", ctypes.c_double),
        ("model_digest", ctypes.c_uint64),
        ("stamp_ns", ctypes.c_uint64),
        ("poll_ns", ctypes.c_uint64),
        ("process_start", ctypes.c_uint64),
        ("pid", ctypes.c_uint32),
        ("kind", ctypes.c_uint32),
        ("code", ctypes.c_uint32),
        ("dynamic", ctypes.c_uint32),
        ("prescribed", ctypes.c_uint32),
        ("inputs", ctypes.c_uint32),
        ("constraints", ctypes.c_uint32),
        ("iterations", ctypes.c_uint32),
        ("factorizations", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32),
        ("residual", ctypes.c_double),
        ("constraint_residual", ctypes.c_double),
        ("reciprocal_condition", ctypes.c_double),
        ("detail_a", ctypes.c_uint64),
        ("detail_b", ctypes.c_uint64),
        ("detail_value", ctypes.c_double),
    ]

    @staticmethod
    def type_name() -> str:
        """Name under which the service knows the type."""
        return "PlantdLinkHeader1"


def _fnv1a(data: bytes) -> int:
    value = 0xCBF29CE484222325
    for byte in data:
        value = ((value ^ byte) * 0x100000001B3) & (2**64 - 1)
    return value


def _schema_hash() -> int:
    names = {ctypes.c_uint32: "u32", ctypes.c_uint64: "u64", ctypes.c_double: "f64"}
    fields = (f"{n}:{names[t]}@{getattr(Header, n).offset};" for n, t in Header._fields_)
    return _fnv1a("".join(fields).encode())


SCHEMA_HASH = _schema_hash()


class LinkError(Exception):
    """The shared-memory link cannot be used, or iceoryx2 failed."""


class NotOpen(LinkError):
    """The plant has no open link under this root path."""


class LeaseHeld(LinkError):
    """Somebody else drives the plant."""


class Timeout(LinkError):
    """No answer in time. A step may still be taken."""


class ServerGone(LinkError):
    """The server's process is no more."""


class ServerRestarted(LinkError):
    """Another server, or another opening of the link, answers: connect again."""


class Closed(LinkError):
    """The server has closed the link, or the plant was deleted."""


class LeaseLost(LinkError):
    """The server has taken the lease back: connect again."""


class StepError(LinkError):
    """A step failed. The plant is as it was, and the next step goes on from there."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True)
class State:
    """A state of the plant."""

    step: int
    time_s: float
    q: list[float]
    p: list[float]
    v: list[float]
    multipliers: list[float]

    @property
    def x(self) -> list[float]:
        """``q``, ``p`` and ``v`` in one list."""
        return self.q + self.p + self.v


def default_root() -> Path:
    """The server's default root path."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    if os.path.isabs(runtime):
        return Path(runtime) / "plantd"
    return Path(f"/tmp/plantd-{os.getuid()}")


class LinkDriver:
    """A driver of one plant; holds its lease until it is closed."""

    def __init__(
        self,
        plant: str,
        *,
        root: Optional[os.PathLike[str] | str] = None,
        poll_s: Optional[float] = 50e-6,
        timeout_s: float = 1.0,
        connect_timeout_s: float = 1.0,
    ) -> None:
        """Connects to a plant whose link is open, and takes its lease.

        A wait for an answer polls for ``poll_s`` (``None``: all the time), then sleeps.
        """
        self._plant = plant
        self._root = Path(root) if root is not None else default_root()
        self._poll_ns = POLL_FOREVER_NS if poll_s is None else round(poll_s * 1e9)
        self._timeout_s = timeout_s
        self._pid = os.getpid()
        self._process_start = _process_start(self._pid) or 0
        self._is_open = False
        deadline_ns = _after(connect_timeout_s)
        room = _INPUT_LEN_USUAL
        self._connect(room, deadline_ns)
        if self.input_len > room:
            self.close()
            self._connect(self.input_len, deadline_ns)

    def __enter__(self) -> LinkDriver:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def state(self) -> State:
        """The last state: of the last step, or of the time of the connection."""
        return self._state

    @property
    def input_len(self) -> int:
        """Entries of an input: inputs, then prescribed coordinates."""
        return self._last.inputs + self._last.prescribed

    @property
    def time_step_s(self) -> float:
        """Time step of the plant, seconds."""
        return self._last.time_step_s

    def step(self, u: Sequence[float]) -> State:
        """Takes one step with the input ``u`` and returns the state after it."""
        if not self._is_open:
            raise LinkError("the driver is closed")
        if len(u) != self.input_len:
            raise ValueError(f"the input has {len(u)} entries; {self.input_len} are needed")
        self._sequence += 1
        self._send(INPUT, u, self._server_poll_end_ns)
        return self._wait_for_answer(_after(self._timeout_s))

    def close(self) -> None:
        """Gives the lease back and leaves the domain."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._send(DETACH, (), 0)
        finally:
            self._leave()

    def _connect(self, room: int, deadline_ns: int) -> None:
        self._driver = secrets.randbits(63) + 1
        self._server = 0
        self._server_process = (0, 0)
        self._sequence = 0
        self._poll_end_ns = 0
        self._server_poll_end_ns = 0
        self._open_ports(room, deadline_ns)
        try:
            self._attach(deadline_ns)
        except BaseException:
            self._leave()
            raise
        self._is_open = True

    def _open_ports(self, room: int, deadline_ns: int) -> None:
        iox2.set_log_level_from_env_or(iox2.LogLevel.Fatal)
        while True:
            try:
                if not self._root.is_dir():
                    raise NotOpen(f"there is no server under {self._root}")
                self._node = (
                    iox2.NodeBuilder.new()
                    .name(iox2.NodeName.new("plantd-driver-python"))
                    .config(self._config())
                    .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
                    .create(iox2.ServiceType.Ipc)
                )
                inputs, input_bell = self._open_services("input")
                self._states, state_bell = self._open_services("state")
                self._listener = state_bell.listener_builder().create()
                self._subscriber = self._states.subscriber_builder().create()
                self._notifier = input_bell.notifier_builder().create()
                self._publisher = (
                    inputs.publisher_builder()
                    .initial_max_slice_len(room)
                    .max_loaned_samples(1)
                    .backpressure_strategy(iox2.BackpressureStrategy.DiscardData)
                    .create()
                )
                return
            except NotOpen:
                if time.monotonic_ns() >= deadline_ns:
                    raise
                time.sleep(_LOOK_PERIOD_S)

    def _prefix(self) -> str:
        """Start of the name of every file of the domain."""
        digest = _fnv1a(os.fsencode(self._root))
        return f"plantd{LAYOUT_VERSION}_{(digest >> 32) ^ (digest & 0xFFFFFFFF):08x}_"

    def _config(self) -> iox2.config.Config:
        config = iox2.config.default()
        config.global_cfg.root_path = iox2.Path.new(str(self._root))
        config.global_cfg.prefix = iox2.FileName.new(self._prefix())
        return config

    def _open_services(self, direction: str) -> tuple:
        name = iox2.ServiceName.new(f"plantd/{LAYOUT_VERSION}/{self._plant}/{direction}")
        demands = (
            iox2.AttributeVerifier.new()
            .require(_key("plantd.layout"), _value(str(LAYOUT_VERSION)))
            .require(_key("plantd.schema"), _value(f"{SCHEMA_HASH:016x}"))
        )
        try:
            channel = (
                self._node.service_builder(name)
                .publish_subscribe(iox2.Slice[ctypes.c_double])
                .user_header(Header)
                .open_with_attributes(demands)
            )
            bell = self._node.service_builder(name).event().open()
        except (iox2.PublishSubscribeOpenError, iox2.EventOpenError) as error:
            if "DoesNotExist" in str(error) or "MarkedForDestruction" in str(error):
                raise NotOpen(f"plant `{self._plant}` has no open link under {self._root}") from error
            raise LinkError(f"the link of plant `{self._plant}` cannot be opened: {error}") from error
        return channel, bell

    def _leave(self) -> None:
        for port in (self._publisher, self._notifier, self._subscriber, self._listener):
            port.delete()
        del self._publisher, self._notifier, self._subscriber, self._listener
        del self._states, self._node
        # The last one to leave removes the counter that numbers the members.
        if not any((self._root / "nodes").glob("*.node_monitor")):
            for counter in _SHARED_MEMORY.glob(f"{self._prefix()}*.global_mgmt"):
                counter.unlink(missing_ok=True)

    def _send(self, kind: int, u: Sequence[float], peer_poll_end_ns: int) -> None:
        sample = self._publisher.loan_slice_uninit(len(u))
        (ctypes.c_double * len(u)).from_address(sample.payload().as_ptr())[:] = u
        now_ns = time.monotonic_ns()
        header = sample.user_header().contents
        ctypes.memset(ctypes.addressof(header), 0, ctypes.sizeof(header))
        header.magic = MAGIC
        header.layout_version = LAYOUT_VERSION
        header.schema_hash = SCHEMA_HASH
        header.server = self._server
        header.driver = self._driver
        header.sequence = self._sequence if kind == INPUT else 0
        header.stamp_ns = now_ns
        header.poll_ns = self._poll_ns
        header.process_start = self._process_start
        header.pid = self._pid
        header.kind = kind
        self._poll_end_ns = now_ns + self._poll_ns
        sample.assume_init().send()
        if time.monotonic_ns() + _NOTIFY_MARGIN_NS >= peer_poll_end_ns:
            self._notifier.notify()

    def _receive(self, deadline_ns: int) -> Optional[tuple[Header, list[float]]]:
        """The next message, or nothing at the deadline: polls, then sleeps."""
        while True:
            now_ns = time.monotonic_ns()
            sample = self._subscriber.receive()
            if sample is not None:
                try:
                    header = Header.from_buffer_copy(sample.user_header().contents)
                    # The length of `sample.payload()` counts bytes in iceoryx2 0.10, not entries.
                    entries = ctypes.c_double * sample.header.number_of_elements
                    return header, list(entries.from_address(sample.payload_ptr))
                finally:
                    sample.delete()
            if now_ns >= deadline_ns:
                return None
            if now_ns >= self._poll_end_ns:
                self._listener.timed_wait(iox2.Duration.from_nanos(deadline_ns - now_ns))

    def _attach(self, deadline_ns: int) -> None:
        """Asks for the lease until the server answers."""
        while True:
            self._send(ATTACH, (), 0)
            repeat_ns = min(time.monotonic_ns() + _ATTACH_PERIOD_NS, deadline_ns)
            while (message := self._receive(repeat_ns)) is not None:
                header, payload = message
                if header.schema_hash != SCHEMA_HASH:
                    raise LinkError("the server speaks another layout")
                if header.driver != self._driver:
                    continue
                if header.kind != ATTACHED:
                    raise _error(header)
                self._server = header.server
                self._server_process = (header.pid, header.process_start)
                self._is_server_visible = _process_start(header.pid) == header.process_start
                self._note_state(header, payload)
                return
            if time.monotonic_ns() >= deadline_ns:
                raise Timeout("the server does not answer")
            self._node.try_cleanup_dead_nodes()

    def _wait_for_answer(self, deadline_ns: int) -> State:
        while True:
            check_ns = min(time.monotonic_ns() + _CHECK_PERIOD_NS, deadline_ns)
            while (message := self._receive(check_ns)) is not None:
                header, payload = message
                if header.server != self._server:
                    raise ServerRestarted("the server has restarted, or has reopened the link")
                if header.kind == CLOSED:
                    raise _error(header)
                if header.driver != self._driver or header.sequence != self._sequence:
                    continue
                if header.kind != STATE:
                    raise _error(header)
                return self._note_state(header, payload)
            self._check_server()
            if time.monotonic_ns() >= deadline_ns:
                raise Timeout(f"no answer from the server within {self._timeout_s} s")

    def _check_server(self) -> None:
        """Off the fast path: nothing has come for a while."""
        pid, start = self._server_process
        is_dead = self._is_server_visible and _process_start(pid) != start
        self._node.try_cleanup_dead_nodes()
        if is_dead or self._states.dynamic_config.number_of_publishers == 0:
            raise ServerGone(f"the server (process {pid}) is gone")

    def _note_state(self, header: Header, payload: list[float]) -> State:
        nd, nq = header.dynamic, header.dynamic + header.prescribed
        if len(payload) != 2 * nq + header.constraints:
            raise LinkError("the server sent a state of the wrong length")
        self._last = header
        self._server_poll_end_ns = header.stamp_ns + header.poll_ns
        self._state = State(
            step=header.step,
            time_s=header.time_s,
            q=payload[:nq],
            p=payload[nq : nq + nd],
            v=payload[nq + nd : 2 * nq],
            multipliers=payload[2 * nq :],
        )
        return self._state


def _key(text: str) -> iox2.AttributeKey:
    return iox2.AttributeKey.new(text)


def _value(text: str) -> iox2.AttributeValue:
    return iox2.AttributeValue.new(text)


def _after(seconds: float) -> int:
    return time.monotonic_ns() + round(seconds * 1e9)


def _process_start(pid: int) -> Optional[int]:
    """Start time of a live process, clock ticks since boot."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZXx" else int(fields[19])


def _error(header: Header) -> LinkError:
    """The error that a failure message speaks of."""
    code, a, value = header.code, header.detail_a, header.detail_value
    if code == CODE_LEASE_HELD:
        who = _HOLDERS.get(a, "somebody else")
        return LeaseHeld(f"the plant is driven by {who}" + (f" (process {header.detail_b})" if header.detail_b else ""))
    if code == CODE_NOT_ATTACHED:
        return LeaseLost("the server has taken the lease back")
    if code == CODE_PLANT_DELETED:
        return Closed("the plant was deleted")
    if code == CODE_LINK_CLOSED:
        return Closed("the server has closed the link")
    messages = {
        CODE_SEQUENCE: f"an input was lost on the way; number {a} was expected",
        CODE_DIMENSION: f"the input has {header.detail_b} entries; {a} are needed",
        CODE_INPUT_NOT_FINITE: f"input {a} is {value}",
        CODE_NOT_CONVERGED: f"no convergence after {header.iterations} iterations: "
        f"residual is {header.residual:g} times round-off",
        CODE_NOT_FINITE: f"the motion left the finite numbers after {header.iterations} iterations",
        CODE_SINGULAR: f"singular Newton matrix at coordinate {a} (pivot {value:g})",
        CODE_TOO_FAST: f"coordinate {a} turned by {value:.3f} rad in one step",
    }
    if code in messages:
        return StepError(code, messages[code])
    return LinkError(f"the server refused a message (code {code})")
