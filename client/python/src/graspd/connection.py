"""How both clients get in."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Generic, TypeAlias, TypeVar

import grpc

from graspd.retry import Retry

Channel = TypeVar("Channel")
File: TypeAlias = "str | PathLike[str]"

OPTIONS = (
    # A reply holds grasps, never volumes, but with a low threshold there may be tens of thousands of them.
    ("grpc.max_receive_message_length", -1),
    # Who is lost is looked for again within the pauses of `Retry`, not after seconds.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 500),
    # Who vanished without a word is missed.
    ("grpc.keepalive_time_ms", 30_000),
    ("grpc.keepalive_timeout_ms", 10_000),
)


class Connection(Generic[Channel]):
    """What the two clients have in common."""

    def __init__(
        self,
        address: str,
        *,
        token: str | None = None,
        tls_ca: File | None = None,
        tls_cert: File | None = None,
        tls_key: File | None = None,
        timeout: float | None = 10.0,
        retry: Retry = Retry.RECOMMENDED,
    ) -> None:
        """A connection to the graspd at `address`, such as ``127.0.0.1:50051`` or ``https://robot:50051``; the first
        call makes it.

        TLS is spoken where the address says so or one of its files, PEM, is given: `tls_ca`, the CA that signed the
        server's certificate (without one, those that gRPC trusts), `tls_cert` and `tls_key`, which the server may want
        to see of this client. `token` is the bearer's. `timeout` is how many seconds each attempt of a call may take,
        as the server is told, too; streams and tracking may take as long as they want.
        """
        if (tls_cert is None) != (tls_key is None):
            raise ValueError("tls_cert and tls_key belong together")
        ca, cert, key = (None if file is None else Path(file).read_bytes() for file in (tls_ca, tls_cert, tls_key))
        credentials = None
        if ca or cert or address.startswith("https://"):
            credentials = grpc.ssl_channel_credentials(ca, key, cert)
        self._channel = self._open(address.removeprefix("http://").removeprefix("https://"), credentials)
        self._metadata = () if token is None else (("authorization", bearer(token)),)
        self._timeout = timeout
        self._retry = retry

    def _open(self, target: str, credentials: grpc.ChannelCredentials | None) -> Channel:
        raise NotImplementedError


def bearer(token: str) -> str:
    token = token.strip()
    # What gRPC says of such a header would show it.
    if not (token and token.isascii() and token.isprintable()):
        raise ValueError("the token is empty or has characters that a header cannot carry")
    return f"Bearer {token}"
