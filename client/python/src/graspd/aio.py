"""The asyncio client: the same methods as `graspd.Client`, as coroutines."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable, AsyncIterator, Callable, Iterable
from contextlib import suppress
from typing import Any

import grpc
import grpc.aio
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


class Client(Connection[grpc.aio.Channel]):
    """A connection to graspd. Use it in one event loop. Calls may run concurrently.

    Arguments, results and errors are those of `graspd.Client`.
    """

    _loop: asyncio.AbstractEventLoop | None = None

    async def __aenter__(self) -> Client:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes the connection and cancels running calls."""
        channel, self._is_closed = self._channel, True
        await channel.close()

    async def detect(
        self,
        volume: Volume | NDArray[Any],
        options: Options | None = None,
        *,
        request_id: str = "",
        timeout: float | None = None,
    ) -> Detection:
        """Detects grasps in a volume."""
        return await self._call(methods.DETECT, wire.detect_request(volume, options, request_id), timeout)

    async def detect_from_depth(
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
        return await self._call(methods.DETECT_FROM_DEPTH, request, timeout)

    async def detect_from_cloud(
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
        return await self._call(methods.DETECT_FROM_CLOUD, request, timeout)

    async def detect_stream(
        self,
        volumes: AsyncIterable[Volume | NDArray[Any]] | Iterable[Volume | NDArray[Any]],
        options: Options | None = None,
    ) -> AsyncIterator[Detection | Error]:
        """Yields the grasps of each volume in the order of the volumes. For a refused volume it yields the `Error`, and
        the stream continues. An error that ends the stream is raised."""
        detecting = Detecting(options)

        async def requests() -> AsyncIterator[pb.DetectGraspsRequest]:
            with detecting.sending():
                if isinstance(volumes, AsyncIterable):
                    async for volume in volumes:
                        yield detecting.request(volume)
                else:
                    for volume in volumes:
                        yield detecting.request(volume)

        replies = self._stream(methods.DETECT_STREAM, requests())
        try:
            async for reply in replies:
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
        return Tracking(self._stream(methods.TRACK), workspace, half_life, self._failure)

    async def score(
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
        return await self._call(
            methods.SCORE, wire.score_request(observation, grasps, workspace, options, request_id), timeout
        )

    async def find_table(
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
        return await self._call(methods.FIND_TABLE, request, timeout)

    async def models(self) -> tuple[Model, ...]:
        """The models that the server serves; the default model is first."""
        return await self._call(methods.LIST_MODELS, pb.ListModelsRequest())

    async def health(self) -> bool:
        """Whether the server is ready; False while it is warming up or shutting down, or
        all sessions of a model hang or fail."""
        return await self._call(methods.CHECK, HealthCheckRequest())

    async def wait_ready(self, timeout: float) -> None:
        """Waits until the server is reachable and ready, for at most `timeout` seconds.

        Raises `Unavailable` with the last failure."""
        waiting = Waiting(timeout)
        while True:
            try:
                if await self.health():
                    return
            except (Unavailable, DeadlineExceeded) as failure:
                waiting.failed(failure)
            await asyncio.sleep(waiting.pause())

    def _opened(self) -> grpc.aio.Channel:
        loop = asyncio.get_running_loop()
        if self._loop not in (None, loop):
            raise RuntimeError("the client was used in another event loop; make a new one in each asyncio.run")
        self._loop = loop
        return super()._opened()

    def _open(
        self, target: str, credentials: grpc.ChannelCredentials | None, options: ChannelOptions
    ) -> grpc.aio.Channel:
        if credentials is None:
            return grpc.aio.insecure_channel(target, options)
        return grpc.aio.secure_channel(target, credentials, options)

    async def _call(
        self, method: Method[Request, Response, Answer], request: Request, timeout: float | None = None
    ) -> Answer:
        limit = self._timeout if timeout is None else positive("timeout", timeout)
        call = self._opened().unary_unary(method.path, method.serialize, method.parse)
        attempts = 0
        while True:
            try:
                return method.answer(await call(request, timeout=limit, metadata=self._metadata))
            except grpc.RpcError as status:
                error = self._failure(status)
            attempts += 1
            pause = self._retry.after(attempts, error)
            if pause is None:
                raise error
            await asyncio.sleep(pause)

    def _stream(
        self, method: Method[Request, Response, Any], requests: AsyncIterator[Request] | None = None
    ) -> grpc.aio.StreamStreamCall[Request, Response]:
        stream = self._opened().stream_stream(method.path, method.serialize, method.parse)
        return stream(requests, metadata=self._metadata)


class Tracking:
    """A tracked volume. The server keeps it until this object is closed."""

    def __init__(
        self,
        stream: grpc.aio.StreamStreamCall[pb.TrackGraspsRequest, pb.DetectGraspsStreamResponse],
        workspace: Workspace,
        half_life: float | None,
        failure: Callable[[grpc.RpcError], Error],
    ) -> None:
        self._adding = Adding(workspace, half_life)
        self._failure = failure
        self._stream = stream

    async def __aenter__(self) -> Tracking:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the tracking. The server deletes the volume."""
        self._stream.cancel()

    async def add(
        self,
        views: DepthView | Iterable[DepthView] = (),
        options: Options | None = None,
        *,
        request_id: str = "",
        stamp: int | None = None,
    ) -> Detection:
        """Adds views to the volume and detects grasps in everything observed so far. Calls must not overlap. For the
        rest see `graspd.Tracking.add`."""
        request = self._adding.request(views, options, request_id, stamp)
        try:
            # If the server has closed the stream, `read` returns or raises the reason.
            with suppress(asyncio.InvalidStateError):
                await self._stream.write(request)
            reply = await self._stream.read()
        except grpc.RpcError as status:
            raise self._failure(status) from None
        return self._adding.answer(reply if isinstance(reply, pb.DetectGraspsStreamResponse) else None)
