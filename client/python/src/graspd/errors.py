"""Why there is no answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from google.rpc.error_details_pb2 import BadRequest, RequestInfo, RetryInfo
from google.rpc.status_pb2 import Status
from grpc import RpcError, StatusCode

from graspd import grasp_pb2 as pb


@dataclass(eq=False)
class Error(Exception):
    """The server, or the connection to it, refused. Those that one may want to tell apart have a class of their own."""

    code: StatusCode
    message: str
    """What is wrong, with the value, and what is needed."""
    field: str | None = None
    """The path of the field that is not what it must be, such as ``options.region.max.z``."""
    retry_after: float | None = None
    """Seconds after which it is worth coming back, where the server says so."""
    request_id: str | None = None
    """By which the server's log knows the request, where it got that far."""

    def __str__(self) -> str:
        return f"{self.code.name}: {self.message}"


class InvalidArgument(Error):
    """A field of the request is not what it must be."""


class NotFound(Error):
    """No such model or version, as `field` says; the message lists those there are."""


class ResourceExhausted(Error):
    """The model's queue is full, or as many volumes are tracked as may be."""


class DeadlineExceeded(Error):
    """The client's `timeout` passed."""


class Aborted(Error):
    """No view came for too long: the volume that was tracked is gone."""


class Unavailable(Error):
    """Nobody is there, or the server is warming up or shutting down."""


class Unauthenticated(Error):
    """The server wants a token, and not this one."""


class Internal(Error):
    """The model failed on this request; the server's log has more under its id."""


CLASSES = {
    StatusCode.INVALID_ARGUMENT: InvalidArgument,
    StatusCode.NOT_FOUND: NotFound,
    StatusCode.RESOURCE_EXHAUSTED: ResourceExhausted,
    StatusCode.DEADLINE_EXCEEDED: DeadlineExceeded,
    StatusCode.ABORTED: Aborted,
    StatusCode.UNAVAILABLE: Unavailable,
    StatusCode.UNAUTHENTICATED: Unauthenticated,
    StatusCode.INTERNAL: Internal,
}
CODES = {code.value[0]: code for code in StatusCode}


def from_status(status: RpcError) -> Error:
    """Why a call has ended."""
    error = make(status.code(), status.details() or "")
    wrong, pause, request = BadRequest(), RetryInfo(), RequestInfo()
    trailers: Any = status.trailing_metadata() or ()
    for key, value in trailers:
        if key != "grpc-status-details-bin":
            continue
        for detail in Status.FromString(value).details:
            if detail.Unpack(wrong):
                error.field = wrong.field_violations[0].field
            elif detail.Unpack(pause):
                error.retry_after = pause.retry_delay.ToNanoseconds() * 1e-9
            elif detail.Unpack(request):
                error.request_id = request.request_id
    return error


def from_reply(reply: pb.DetectGraspsStreamResponse) -> Error:
    """Why one request of a stream is refused."""
    error = make(CODES[reply.error.code], reply.error.message)
    error.field = reply.error.field or None
    error.request_id = reply.request_id
    if reply.error.HasField("retry_after"):
        error.retry_after = reply.error.retry_after
    return error


def make(code: StatusCode, message: str) -> Error:
    return CLASSES.get(code, Error)(code, message)
