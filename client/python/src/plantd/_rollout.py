"""Many simulations at once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plantd.v1 import control_service_pb2

from ._calls import Calls
from ._errors import PlantdError, from_failure
from ._requests import Stepping, settings
from ._states import State

if TYPE_CHECKING:
    from typing_extensions import Unpack


@dataclass(frozen=True, eq=False)
class Rollout:
    """The end of one simulation of a batch."""

    #: Index of the case.
    case: int
    #: Why it ended early, or was not begun; ``None`` if it came to its end.
    error: PlantdError | None
    _states: list[State]

    @property
    def states(self) -> list[State]:
        """The states that were asked for, up to the last good one. Raises ``error`` where it left none: the
        case's initial state was refused, or no step of it succeeded."""
        if self.error and not self._states:
            raise self.error
        return self._states

    @property
    def failure(self) -> str:
        """Why it ended early; empty if it did not."""
        return f"{self.error.reason}: {self.error.message}" if self.error else ""

    @classmethod
    def _from(cls, m: control_service_pb2.RolloutResponse) -> Rollout:
        error = from_failure(m.failure, PlantdError) if m.HasField("failure") else None
        return cls(m.case_index, error, [State._from(state) for state in m.states])


class RolloutCalls(Calls):
    """The call that runs many simulations."""

    def rollout(
        self,
        model: str,
        cases: Iterable[control_service_pb2.RolloutCase],
        *,
        every: int = 0,
        **stepping: Unpack[Stepping],
    ) -> Iterator[Rollout]:
        """Runs many simulations at once; answers come in the order in which they end.

        A case that cannot be started or stepped does not disturb the others: its ``error`` says why.
        """
        request = control_service_pb2.RolloutRequest(
            model=model, settings=settings(**stepping), cases=cases, every=every
        )
        return self._messages(self.control.Rollout(request), Rollout._from)
