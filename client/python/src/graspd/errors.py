"""Errors of calls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from google.rpc.error_details_pb2 import BadRequest, RequestInfo, RetryInfo
from google.rpc.status_pb2 import Status
from grpc import RpcError, StatusCode

from graspd import grasp_pb2 as pb


@dataclass(eq=False)
class Error(Exception):
    """The server refused the request, or the connection failed. Common status codes have subclasses."""

    code: StatusCode
    message: str
    """What is wrong, with the value, and what to do."""
    field: str | None = None
    """Path of the invalid field of the request, such as ``options.region.max.z``."""
    retry_after: float | None = None
    """The server's retry hint, seconds."""
    request_id: str | None = None
    """Id of the request in the server's log; None if the request did not reach the server."""
    views_added: bool = False
    """Whether the views of a refused `add` of a tracked volume are in the volume: repeat it without them."""

    def __str__(self) -> str:
        return f"{self.code.name}: {self.message}"


class InvalidArgument(Error):
    """A field of the request is invalid."""


class NotFound(Error):
    """The model or version (see `field`) does not exist; the message lists the available ones."""


class ResourceExhausted(Error):
    """The queue of the model is full, or the limit of tracked volumes is reached."""


class DeadlineExceeded(Error):
    """The client's `timeout` passed, or the message arrived too slowly."""


class Aborted(Error):
    """The server deleted the tracked volume, because it received no request for too long."""


class Unavailable(Error):
    """The server is unreachable, warming up or shutting down, or all sessions of the model hang."""


class Unauthenticated(Error):
    """The token is missing or invalid."""


class Internal(Error):
    """The model failed on this request; see the server's log for the request id."""


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


# Parts of gRPC's messages about connections, and what to do.
ADVICE = {
    "Connection refused": "check the address and that graspd runs there",
    "WRONG_VERSION_NUMBER": "the server does not use TLS: give an address without https://, and no PEM files",
    "CERTIFICATE_VERIFY_FAILED": "the server's certificate is not signed by the CA of tls_ca, or is for another name",
    "Socket closed": "if no call succeeds, the address may be the port for HTTP, or need https:// and tls_ca",
}


def from_status(status: RpcError, proxy: str = "") -> Error:
    """The error of a failed call. `proxy` is advice for failures of a connection through a proxy; empty: without one."""
    message = status.details() or ""
    if status.code() is StatusCode.UNAVAILABLE:
        advice = [proxy] if proxy else [advice for part, advice in ADVICE.items() if part in message]
        message = "; ".join([message, *advice])
    error = make(status.code(), message)
    violations, pause, request = BadRequest(), RetryInfo(), RequestInfo()
    trailers: Any = status.trailing_metadata() or ()
    for key, value in trailers:
        if key != "grpc-status-details-bin":
            continue
        for detail in Status.FromString(value).details:
            if detail.Unpack(violations):
                error.field = violations.field_violations[0].field
            elif detail.Unpack(pause):
                error.retry_after = pause.retry_delay.ToNanoseconds() * 1e-9
            elif detail.Unpack(request):
                error.request_id = request.request_id
    return error


def from_reply(reply: pb.DetectGraspsStreamResponse) -> Error:
    """The error of one refused request of a stream."""
    error = make(CODES[reply.error.code], reply.error.message)
    error.field = reply.error.field or None
    error.request_id = reply.request_id
    error.views_added = reply.error.views_added
    if reply.error.HasField("retry_after"):
        error.retry_after = reply.error.retry_after
    return error


def make(code: StatusCode, message: str) -> Error:
    return CLASSES.get(code, Error)(code, message)
