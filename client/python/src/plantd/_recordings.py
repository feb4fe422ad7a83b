"""Recordings of plants."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

from plantd.v1 import recording_service_pb2

from ._calls import Calls
from ._check import build
from ._errors import translate
from ._progress import progress_bar


@dataclass(frozen=True)
class Recording:
    """A recording of a plant. What is not known of files of an earlier server is empty."""

    name: str
    plant: str
    #: ``active``, ``done`` or ``failed``.
    status: str
    #: Why it has failed.
    failure: str
    #: Steps written.
    steps: int
    #: Steps lost, because the disk did not follow.
    lost: int
    #: Bytes written.
    bytes: int

    @classmethod
    def _from(cls, m: recording_service_pb2.Recording) -> Recording:
        status = recording_service_pb2.RecordingStatus.Name(m.status)
        status = status.removeprefix("RECORDING_STATUS_").lower()
        return cls(m.name, m.plant, status, m.failure, m.steps, m.lost, m.bytes)


class RecordingCalls(Calls):
    """Calls of the service of recordings."""

    def start_recording(
        self, id: str, name: str = "", *, checkpoint_interval: float = 0.0
    ) -> Recording:
        """Starts to record a plant into a file of the server, until `stop_recording`.

        A replay can begin every ``checkpoint_interval`` seconds; 0 means 5.
        """
        request = build(
            recording_service_pb2.StartRecordingRequest,
            id=id, name=name, checkpoint_interval_s=checkpoint_interval
        )
        return Recording._from(self._call(self.recordings.StartRecording, request).recording)

    def stop_recording(self, name: str) -> Recording:
        """Ends a recording; its file is complete then."""
        request = build(recording_service_pb2.StopRecordingRequest, name=name)
        return Recording._from(self._call(self.recordings.StopRecording, request).recording)

    def list_recordings(self) -> list[Recording]:
        """All recordings of the server, by name."""
        recordings: list[Recording] = []
        token = ""
        while True:
            request = build(recording_service_pb2.ListRecordingsRequest, page_token=token)
            page = self._call(self.recordings.ListRecordings, request)
            recordings.extend(map(Recording._from, page.recordings))
            token = page.next_page_token
            if not token:
                return recordings

    @translate
    def get_recording(self, name: str, path: str | PathLike[str], *, progress: bool | None = None) -> None:
        """Fetches the file of a recording, which is MCAP. ``progress`` shows a bar; by default on a terminal."""
        request = build(recording_service_pb2.GetRecordingRequest, name=name)
        with open(path, "wb") as file, progress_bar("recording, KiB", None, progress) as bar:
            for piece in self.recordings.GetRecording(request):
                file.write(piece.data)
                bar.update(len(piece.data) / 1024)

    def delete_recording(self, name: str) -> None:
        """Deletes a recording that has ended."""
        request = build(recording_service_pb2.DeleteRecordingRequest, name=name)
        self._call(self.recordings.DeleteRecording, request)
