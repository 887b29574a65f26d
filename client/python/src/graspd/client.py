"""The client that asks and waits."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import grpc
from grpc_health.v1.health_pb2 import HealthCheckRequest
from numpy.typing import NDArray

from graspd import grasp_pb2 as pb
from graspd import methods, wire
from graspd.connection import OPTIONS, Connection
from graspd.detection import Detection, Model
from graspd.errors import Error, from_status
from graspd.methods import Answer, Method, Request, Response
from graspd.options import Options
from graspd.seen import CloudView, DepthView, Volume, Workspace
from graspd.streams import Adding, Detecting

if TYPE_CHECKING:
    from grpc import _CallIterator as Replies


class Client(Connection[grpc.Channel]):
    """A connection to graspd. Threads may share it.

    What the server, or the connection to it, refuses is an `Error`; what cannot even be asked, such as a volume that is
    no cube, a `ValueError`. `options` that are None leave everything to the server. `request_id`, at most 256 bytes,
    names the request in the answer and the server's log.
    """

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends what is still going on."""
        self._channel.close()

    def detect(
        self, volume: Volume | NDArray[Any], options: Options | None = None, *, request_id: str = ""
    ) -> Detection:
        """The grasps in a volume; an array alone is a `Volume` of a cube of 0.3 m."""
        return self._ask(methods.DETECT, wire.detect_request(volume, options, request_id))

    def detect_from_depth(
        self,
        views: Iterable[DepthView],
        workspace: Workspace = Workspace(),
        options: Options | None = None,
        *,
        request_id: str = "",
    ) -> Detection:
        """The grasps in what depth cameras see, from 1 to 64 images."""
        return self._ask(methods.DETECT_FROM_DEPTH, wire.depth_request(views, workspace, options, request_id))

    def detect_from_cloud(
        self,
        views: Iterable[CloudView],
        workspace: Workspace = Workspace(),
        options: Options | None = None,
        *,
        request_id: str = "",
    ) -> Detection:
        """The grasps in point clouds, from 1 to 64, each of one camera."""
        return self._ask(methods.DETECT_FROM_CLOUD, wire.cloud_request(views, workspace, options, request_id))

    def detect_stream(
        self, volumes: Iterable[Volume | NDArray[Any]], options: Options | None = None
    ) -> Iterator[Detection | Error]:
        """The grasps in each of the volumes, in their order, while further ones are read by another thread. One that is
        refused gives its `Error` instead, and the stream goes on; what ends it is raised."""
        detecting = Detecting(options)

        def requests() -> Iterator[pb.DetectGraspsRequest]:
            with detecting.asking():
                for volume in volumes:
                    yield detecting.request(volume)

        replies = self._stream(methods.DETECT_STREAM, requests())
        try:
            for reply in replies:
                yield detecting.answer(reply)
        except grpc.RpcError as status:
            raise from_status(status) from None
        finally:
            replies.cancel()
        detecting.end()

    def track(self, workspace: Workspace = Workspace()) -> Tracking:
        """Has the server keep a volume for a camera that moves."""
        return Tracking(lambda requests: self._stream(methods.TRACK, requests), workspace)

    def models(self) -> tuple[Model, ...]:
        """What can be asked for by name, the default first."""
        return self._ask(methods.LIST_MODELS, pb.ListModelsRequest())

    def health(self) -> bool:
        """Whether the server answers; it does not while it is warming up or shutting down."""
        return self._ask(methods.CHECK, HealthCheckRequest())

    def _open(self, target: str, credentials: grpc.ChannelCredentials | None) -> grpc.Channel:
        if credentials is None:
            return grpc.insecure_channel(target, OPTIONS)
        return grpc.secure_channel(target, credentials, OPTIONS)

    def _ask(self, method: Method[Request, Response, Answer], request: Request) -> Answer:
        ask = self._channel.unary_unary(method.path, method.serialize, method.parse)
        attempts = 0
        while True:
            try:
                return method.answer(ask(request, self._timeout, self._metadata))
            except grpc.RpcError as status:
                error = from_status(status)
            attempts += 1
            pause = self._retry.after(attempts, error)
            if pause is None:
                raise error
            time.sleep(pause)

    def _stream(self, method: Method[Request, Response, Any], requests: Iterator[Request]) -> Replies[Response]:
        stream = self._channel.stream_stream(method.path, method.serialize, method.parse)
        return stream(requests, metadata=self._metadata)


class Tracking:
    """A volume that the server keeps until this is closed, and the grasps in it."""

    def __init__(
        self,
        stream: Callable[[Iterator[pb.TrackGraspsRequest]], Replies[pb.DetectGraspsStreamResponse]],
        workspace: Workspace,
    ) -> None:
        self._adding = Adding(workspace)
        self._requests: SimpleQueue[pb.TrackGraspsRequest | None] = SimpleQueue()
        self._replies = stream(iter(self._requests.get, None))

    def __enter__(self) -> Tracking:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Has the server forget the volume."""
        self._requests.put(None)
        self._replies.cancel()

    def add(
        self, views: Iterable[DepthView] = (), options: Options | None = None, *, request_id: str = ""
    ) -> Detection:
        """Adds views to the volume: the grasps in all that was seen so far. Without views it looks once more. `options`
        that are None are those of the last call that had some.

        What is wrong with a view does not end the tracking. `Aborted` does, and at the first call `ResourceExhausted`,
        where the server tracks as many volumes as it may; nothing is asked twice.
        """
        self._requests.put(self._adding.request(views, options, request_id))
        try:
            reply = next(self._replies, None)
        except grpc.RpcError as status:
            raise from_status(status) from None
        return self._adding.answer(reply)
