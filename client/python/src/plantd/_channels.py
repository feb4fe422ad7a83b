"""Sensors, actuators and faults of plants."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from plantd.v1 import channel_service_pb2, common_pb2

from ._arrays import Array, array
from ._calls import Calls
from ._check import build


@dataclass(frozen=True, eq=False)
class Outputs:
    """What the output channels of a plant deliver."""

    #: Their numbers, in the order of ``Channels.names``.
    y: Array
    #: Indices of the channels whose numbers stand for lost ones.
    lost: tuple[int, ...] = ()

    @classmethod
    def _from(cls, m: common_pb2.Outputs) -> Outputs:
        return cls(array(m.y), tuple(m.lost))


@dataclass(frozen=True, eq=False)
class Channels:
    """The sensors and actuators of a plant."""

    #: Names of the numbers of the outputs.
    names: tuple[str, ...]
    #: What they deliver.
    outputs: Outputs
    #: As declared, with times in whole steps.
    declared: channel_service_pb2.Channels

    @classmethod
    def _from(cls, m: channel_service_pb2.ChannelsInfo, outputs: common_pb2.Outputs) -> Channels:
        return cls(tuple(m.names), Outputs._from(outputs), m.channels)


class ChannelCalls(Calls):
    """Calls of the service of channels."""

    def set_channels(
        self,
        id: str,
        outputs: Iterable[Mapping[str, Any]] = (),
        inputs: Iterable[Mapping[str, Any]] = (),
        *,
        seed: int = 0,
    ) -> Channels:
        """Declares the sensors and actuators of a plant, in place of those before.

        Each is a mapping with the fields of ``OutputChannel`` or ``InputChannel`` of the contract:
        ``dict(name="encoder", coordinate="theta", noise=0.001, latency_s=0.02)``,
        ``dict(input="tau", delay_s=0.01, max=5.0)``. Times become whole steps.
        """
        channels = build(
            channel_service_pb2.Channels,
            outputs=list(outputs),
            inputs=list(inputs),
            seed=seed,
        )
        request = build(channel_service_pb2.SetChannelsRequest, id=id, channels=channels)
        answer = self._call(self.channels.SetChannels, request)
        return Channels._from(answer.info, build(common_pb2.Outputs, y=answer.y))

    def get_channels(self, id: str) -> Channels:
        """The channels of a plant, with what they deliver now."""
        request = build(channel_service_pb2.GetChannelsRequest, id=id)
        answer = self._call(self.channels.GetChannels, request)
        return Channels._from(answer.info, build(common_pb2.Outputs, y=answer.y, lost=answer.lost))

    def inject_fault(self, id: str, **fault: Any) -> channel_service_pb2.FaultInfo:
        """Lets something go wrong: the fields of ``FaultSpec`` of the contract.

            client.inject_fault("p1", input="tau", stuck=True, start_s=2.0, duration_s=0.5)
            client.inject_fault("p1", push=dict(point=dict(frame="rod"), force=[5, 0, 0]), duration_s=0.1)
        """
        spec = build(channel_service_pb2.FaultSpec, **fault)
        request = build(channel_service_pb2.InjectFaultRequest, id=id, fault=spec)
        answer: channel_service_pb2.InjectFaultResponse
        answer = self._call(self.channels.InjectFault, request)
        return answer.fault

    def clear_fault(self, id: str, fault_id: int = 0) -> int:
        """Ends a fault, or all; how many."""
        request = build(channel_service_pb2.ClearFaultRequest, id=id, fault_id=fault_id)
        answer: channel_service_pb2.ClearFaultResponse = self._call(self.channels.ClearFault, request)
        return answer.cleared

    def list_faults(self, id: str) -> list[channel_service_pb2.FaultInfo]:
        """The faults of a plant, in the order in which they were injected."""
        request = build(channel_service_pb2.ListFaultsRequest, id=id)
        return list(self._call(self.channels.ListFaults, request).faults)
