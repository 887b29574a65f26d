"""What the streams of both clients have in common."""

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
    """A stream of volumes and its answers."""

    def __init__(self, options: Options | None) -> None:
        self._options = options
        self._unanswered = 0
        self._is_over = False
        self._mistake: Exception | None = None

    @contextmanager
    def asking(self) -> Iterator[None]:
        """For as long as volumes come. Should they end with an exception, it waits for the answers to those before it:
        gRPC would only log it."""
        try:
            yield
        except Exception as mistake:
            self._mistake = mistake
        self._is_over = True

    def request(self, volume: Volume | NDArray[Any]) -> pb.DetectGraspsRequest:
        request = wire.detect_request(volume, self._options, "")
        self._unanswered += 1
        return request

    def answer(self, reply: pb.DetectGraspsStreamResponse) -> Detection | Error:
        self._unanswered -= 1
        return methods.DETECT_STREAM.answer(reply)

    def end(self) -> None:
        """After the last answer."""
        if self._mistake is not None:
            raise self._mistake
        if self._unanswered or not self._is_over:
            raise ended()


# These are met only after the views were added: another workspace would start another volume.
WAS_ADDED = (StatusCode.RESOURCE_EXHAUSTED, StatusCode.INTERNAL)


class Adding:
    """The views of a volume that is tracked."""

    def __init__(self, workspace: Workspace) -> None:
        # Until it has been taken.
        self._workspace: Workspace | None = workspace

    def request(self, views: Iterable[DepthView], options: Options | None, request_id: str) -> pb.TrackGraspsRequest:
        return wire.track_request(views, self._workspace, options, request_id)

    def answer(self, reply: pb.DetectGraspsStreamResponse | None) -> Detection:
        if reply is None:
            raise ended()
        outcome = methods.TRACK.answer(reply)
        if not isinstance(outcome, Error) or outcome.code in WAS_ADDED:
            self._workspace = None
        if isinstance(outcome, Error):
            raise outcome
        return outcome


def ended() -> Unavailable:
    return Unavailable(StatusCode.UNAVAILABLE, "the server has ended the stream")
