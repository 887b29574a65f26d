"""State of streams, shared by both clients."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from grpc import StatusCode
from numpy.typing import NDArray

from graspd import grasp_pb2 as pb
from graspd import methods, wire
from graspd.detection import Detection
from graspd.errors import Error, Unavailable
from graspd.options import Options
from graspd.seen import DepthView, Volume, Workspace


class Detecting:
    """The state of a stream of volumes."""

    def __init__(self, options: Options | None) -> None:
        self._options = options
        self._unanswered = 0
        self._all_sent = False
        self._failure: Exception | None = None

    @contextmanager
    def sending(self) -> Iterator[None]:
        """Wraps the iteration over the volumes. An exception of the iteration is stored, and `end` raises it after the
        results of the earlier volumes. gRPC would only log it."""
        try:
            yield
        except Exception as failure:
            self._failure = failure
        self._all_sent = True

    def request(self, volume: Volume | NDArray[Any]) -> pb.DetectGraspsRequest:
        request = wire.detect_request(volume, self._options, "")
        self._unanswered += 1
        return request

    def answer(self, reply: pb.DetectGraspsStreamResponse) -> Detection | Error:
        self._unanswered -= 1
        return methods.DETECT_STREAM.answer(reply)

    def end(self) -> None:
        """Called after the last reply. Raises if the stream is incomplete."""
        if self._failure is not None:
            raise self._failure
        if self._unanswered or not self._all_sent:
            raise ended()


class Adding:
    """The state of a tracked volume."""

    def __init__(self, workspace: Workspace, half_life: float | None) -> None:
        self._half_life = half_life
        # None once the server has accepted it.
        self._workspace: Workspace | None = workspace

    def request(
        self, views: DepthView | Iterable[DepthView], options: Options | None, request_id: str, stamp: int | None
    ) -> pb.TrackGraspsRequest:
        half_life = None if self._workspace is None else self._half_life
        return wire.track_request(views, self._workspace, half_life, options, request_id, stamp)

    def answer(self, reply: pb.DetectGraspsStreamResponse | None) -> Detection:
        if reply is None:
            raise ended()
        outcome = methods.TRACK.answer(reply)
        # Sending the workspace again would start another volume.
        if not isinstance(outcome, Error) or outcome.views_added:
            self._workspace = None
        if isinstance(outcome, Error):
            raise outcome
        return outcome


def ended() -> Unavailable:
    return Unavailable(StatusCode.UNAVAILABLE, "the server closed the stream; open it again")
