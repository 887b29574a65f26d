"""The synchronous client."""

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
from graspd.connection import ChannelOptions, Connection, positive
from graspd.detection import Detection, FoundTable, Grasp, Model, Scores
from graspd.errors import DeadlineExceeded, Error, Unavailable
from graspd.geometry import PoseLike
from graspd.methods import Answer, Method, Request, Response
from graspd.options import Candidate, Options
from graspd.seen import CloudView, DepthView, Volume, Workspace
from graspd.retry import Waiting
from graspd.streams import Adding, Detecting

if TYPE_CHECKING:
    from grpc import _CallIterator as Replies


class Client(Connection[grpc.Channel]):
    """A connection to graspd. It is thread-safe.

    Methods raise `Error` if the server refuses the request or the connection fails, and `ValueError` for arguments that
    cannot be sent, such as a volume that is not a cube. With `options` of None the server's defaults apply.
    `request_id`, at most 256 bytes, identifies the request in the reply and in the server's log. `timeout` limits each
    attempt of this call, seconds; None: that of the client.
    """

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection and cancels running calls."""
        channel, self._is_closed = self._channel, True
        channel.close()

    def detect(
        self,
        volume: Volume | NDArray[Any],
        options: Options | None = None,
        *,
        request_id: str = "",
        timeout: float | None = None,
    ) -> Detection:
        """Detects grasps in a volume. An array is a `Volume` with an edge of 0.3 m."""
        return self._call(methods.DETECT, wire.detect_request(volume, options, request_id), timeout)

    def detect_from_depth(
        self,
        views: DepthView | Iterable[DepthView],
        workspace: Workspace = Workspace(),
        options: Options | None = None,
        *,
        request_id: str = "",
        timeout: float | None = None,
    ) -> Detection:
        """Detects grasps in 1 to 64 depth images."""
        request = wire.depth_request(views, workspace, options, request_id)
        return self._call(methods.DETECT_FROM_DEPTH, request, timeout)

    def detect_from_cloud(
        self,
        views: CloudView | Iterable[CloudView],
        workspace: Workspace = Workspace(),
        options: Options | None = None,
        *,
        request_id: str = "",
        timeout: float | None = None,
    ) -> Detection:
        """Detects grasps in 1 to 64 point clouds, each observed by one camera."""
        request = wire.cloud_request(views, workspace, options, request_id)
        return self._call(methods.DETECT_FROM_CLOUD, request, timeout)

    def detect_stream(
        self, volumes: Iterable[Volume | NDArray[Any]], options: Options | None = None
    ) -> Iterator[Detection | Error]:
        """Yields the grasps of each volume in the order of the volumes. For a refused volume it yields the `Error`, and
        the stream continues. An error that ends the stream is raised. `volumes` is iterated in another thread."""
        detecting = Detecting(options)

        def requests() -> Iterator[pb.DetectGraspsRequest]:
            with detecting.sending():
                for volume in volumes:
                    yield detecting.request(volume)

        replies = self._stream(methods.DETECT_STREAM, requests())
        try:
            for reply in replies:
                yield detecting.answer(reply)
        except grpc.RpcError as status:
            raise self._failure(status) from None
        finally:
            replies.cancel()
        detecting.end()

    def track(self, workspace: Workspace = Workspace(), *, half_life: float | None = None) -> Tracking:
        """Opens a tracked volume for a moving camera. For a scene that moves: with `half_life` the weight of a measurement
        halves after `half_life` further measurements, and with each one that contradicts it; 10 suits most scenes.
        None: all views have the same weight."""
        return Tracking(lambda requests: self._stream(methods.TRACK, requests), workspace, half_life, self._failure)

    def score(
        self,
        observation: wire.Observation,
        grasps: Iterable[PoseLike | Candidate | Grasp],
        workspace: Workspace = Workspace(),
        options: Options | None = None,
        *,
        request_id: str = "",
        timeout: float | None = None,
    ) -> Scores:
        """Scores the caller's grasps in a volume, depth images or point clouds. `grasps` are ``T_frame_grasp``, in the
        convention of the options, 1 to 1024; a `Candidate` also has a width. `workspace` is that of the images or
        points."""
        return self._call(
            methods.SCORE, wire.score_request(observation, grasps, workspace, options, request_id), timeout
        )

    def find_table(
        self,
        view: DepthView | CloudView,
        workspace: Workspace = Workspace(),
        *,
        table_height: float | None = None,
        request_id: str = "",
        timeout: float | None = None,
    ) -> FoundTable:
        """Finds the table in a depth image or a point cloud, and the workspace over what stands on it. Of `workspace`
        only `size`, `extent`, `gravity`, `frame_id` and `stamp` are used. `table_height` is the height of the table above the
        bottom of the workspace, metres; None: 0.05."""
        request = wire.table_request(view, workspace, table_height, request_id)
        return self._call(methods.FIND_TABLE, request, timeout)

    def models(self) -> tuple[Model, ...]:
        """The models that the server serves; the default model is first."""
        return self._call(methods.LIST_MODELS, pb.ListModelsRequest())

    def health(self) -> bool:
        """Whether the server is ready; False while it is warming up or shutting down, or
        all sessions of a model hang or fail."""
        return self._call(methods.CHECK, HealthCheckRequest())

    def wait_ready(self, timeout: float) -> None:
        """Waits until the server is reachable and ready, for at most `timeout` seconds.

        Raises `Unavailable` with the last failure."""
        waiting = Waiting(timeout)
        while True:
            try:
                if self.health():
                    return
            except (Unavailable, DeadlineExceeded) as failure:
                waiting.failed(failure)
            time.sleep(waiting.pause())

    def _open(
        self, target: str, credentials: grpc.ChannelCredentials | None, options: ChannelOptions
    ) -> grpc.Channel:
        if credentials is None:
            return grpc.insecure_channel(target, options)
        return grpc.secure_channel(target, credentials, options)

    def _call(
        self, method: Method[Request, Response, Answer], request: Request, timeout: float | None = None
    ) -> Answer:
        limit = self._timeout if timeout is None else positive("timeout", timeout)
        call = self._opened().unary_unary(method.path, method.serialize, method.parse)
        attempts = 0
        while True:
            try:
                return method.answer(call(request, limit, self._metadata))
            except grpc.RpcError as status:
                error = self._failure(status)
            attempts += 1
            pause = self._retry.after(attempts, error)
            if pause is None:
                raise error
            time.sleep(pause)

    def _stream(self, method: Method[Request, Response, Any], requests: Iterator[Request]) -> Replies[Response]:
        stream = self._opened().stream_stream(method.path, method.serialize, method.parse)
        return stream(requests, metadata=self._metadata)


class Tracking:
    """A tracked volume. The server keeps it until this object is closed."""

    def __init__(
        self,
        stream: Callable[[Iterator[pb.TrackGraspsRequest]], Replies[pb.DetectGraspsStreamResponse]],
        workspace: Workspace,
        half_life: float | None,
        failure: Callable[[grpc.RpcError], Error],
    ) -> None:
        self._adding = Adding(workspace, half_life)
        self._failure = failure
        self._requests: SimpleQueue[pb.TrackGraspsRequest | None] = SimpleQueue()
        self._replies = stream(iter(self._requests.get, None))

    def __enter__(self) -> Tracking:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the tracking. The server deletes the volume."""
        self._requests.put(None)
        self._replies.cancel()

    def add(
        self,
        views: DepthView | Iterable[DepthView] = (),
        options: Options | None = None,
        *,
        request_id: str = "",
        stamp: int | None = None,
    ) -> Detection:
        """Adds views to the volume and detects grasps in everything observed so far. `views` may be empty. With
        `options` of None the options of the previous call apply. `stamp` is the time of the views, nanoseconds since
        1970; None: that of the previous call, or of the workspace.

        An invalid view does not end the tracking. If the error has `views_added`, repeat the call without the views.
        `Aborted` ends the tracking, and so does `ResourceExhausted` if the server's limit of tracked volumes is reached
        when it starts. Calls are not retried.
        """
        self._requests.put(self._adding.request(views, options, request_id, stamp))
        try:
            reply = next(self._replies, None)
        except grpc.RpcError as status:
            raise self._failure(status) from None
        return self._adding.answer(reply)
