"""Channel options, TLS and authentication of both clients."""

from __future__ import annotations

import os
import re
from functools import cached_property
from ipaddress import ip_address, ip_network
from os import PathLike
from pathlib import Path
from typing import Generic, TypeAlias, TypeVar

import grpc

from graspd.errors import Error, from_status
from graspd.retry import Retry

Channel = TypeVar("Channel")
File: TypeAlias = "str | PathLike[str]"
ChannelOptions: TypeAlias = "tuple[tuple[str, int | str], ...]"

OPTIONS: ChannelOptions = (
    # A low threshold can return tens of thousands of grasps.
    ("grpc.max_receive_message_length", -1),
    # Reconnect within the pauses of `Retry`. By default gRPC waits for seconds.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 500),
    # Detect servers that disappear without closing the connection.
    ("grpc.keepalive_time_ms", 30_000),
    ("grpc.keepalive_timeout_ms", 10_000),
)


class Connection(Generic[Channel]):
    """Base class of both clients."""

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
        """Creates a client of the graspd at `address`, such as ``127.0.0.1:50051``, ``https://robot:50051``,
        ``unix:/run/graspd.sock``, or replicas such as ``ipv4:10.0.0.1:50051,10.0.0.2:50051``. The first call connects.

        TLS is used if the address begins with ``https://`` or a PEM file is given: `tls_ca`, the CA that signed the
        server's certificate (default: gRPC's root CAs), or `tls_cert` and `tls_key`, the client certificate for mutual
        TLS. `token` is a bearer token. `timeout` limits each attempt of a call, seconds, and is sent to the server as
        the deadline; it does not apply to streams and tracking.
        """
        if not isinstance(address, str):
            raise TypeError(f"address is {address!r}, must be a text such as '127.0.0.1:50051'")
        if not isinstance(retry, Retry):
            raise TypeError(f"retry is {retry!r}, must be a graspd.Retry, such as Retry.RECOMMENDED")
        if (tls_cert is None) != (tls_key is None):
            raise ValueError("tls_cert and tls_key must be given together")
        ca = pem("tls_ca", tls_ca, "CERTIFICATE")
        cert = pem("tls_cert", tls_cert, "CERTIFICATE")
        key = pem("tls_key", tls_key, "PRIVATE KEY")
        credentials = None
        if ca or cert or address.startswith("https://"):
            credentials = grpc.ssl_channel_credentials(ca, key, cert)
        target = with_port(address.removeprefix("http://").removeprefix("https://"))
        self._destination = (target, credentials, OPTIONS + replicas(target) + without_proxy(target))
        self._metadata = () if token is None else (("authorization", bearer(token)),)
        self._timeout = None if timeout is None else positive("timeout", timeout)
        self._is_closed = False
        self._retry = retry

    @cached_property
    def _channel(self) -> Channel:
        """Opened by the first call: a channel of asyncio belongs to the running event loop."""
        return self._open(*self._destination)

    def _opened(self) -> Channel:
        if self._is_closed:
            raise ValueError("the client is closed; make a new one")
        return self._channel

    def _failure(self, status: grpc.RpcError) -> Error:
        return from_status(status, proxied(self._destination[0]))

    def _open(self, target: str, credentials: grpc.ChannelCredentials | None, options: ChannelOptions) -> Channel:
        raise NotImplementedError


def pem(name: str, file: File | None, label: str) -> bytes | None:
    """The content of a PEM file; with another file, gRPC only says that the connection fails."""
    if file is None:
        return None
    content = Path(file).read_bytes()
    if not re.search(rb"^-----BEGIN [A-Z ]*" + label.encode(), content, re.MULTILINE):
        raise ValueError(f"{name} {file} has no {label.lower()} in PEM")
    return content


def positive(name: str, value: float) -> float:
    """Checks a number of seconds."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{name} is {value!r}, must be a number of seconds")
    if value == float("inf"):
        raise ValueError(f"{name} is {value!r}, must be finite")
    if not value > 0:
        raise ValueError(f"{name} is {value!r}, must be greater than 0 seconds")
    return value


def with_port(target: str) -> str:
    """The target with the port of graspd, if it is a host without a port. Others than 1 to 65535 are refused: gRPC takes them
    modulo 65536."""
    if target.startswith("unix:"):
        return target
    if "://" in target and not target.startswith("dns://"):
        scheme = target.split("://")[0]
        raise ValueError(f"the address begins with {scheme}://, must begin with http://, https:// or unix:")
    scheme = re.match(r"(dns:/*|ipv[46]:/*)?", target)[0]  # type: ignore[index]
    return scheme + ",".join(map(host_with_port, target[len(scheme) :].split(",")))


def host_with_port(host: str) -> str:
    has_port = ":" in host.rpartition("]")[2] and host.rpartition("]")[2].count(":") == 1
    name, _, port = host.rpartition(":") if has_port else (host, "", "")
    if not port:
        return f"{name}:50051"
    if not (port.isdigit() and 0 < int(port) < 65536):
        raise ValueError(f"the port of the address is {port}, must be from 1 to 65535")
    return host


def replicas(target: str) -> ChannelOptions:
    """The options for a target with several addresses: calls are distributed to all of them."""
    scheme, _, addresses = target.partition(":")
    if scheme not in ("ipv4", "ipv6") or "," not in addresses:
        return ()
    # gRPC sends the whole list as the authority of a call, which is not valid in HTTP/2.
    return (("grpc.lb_policy_name", "round_robin"), ("grpc.default_authority", addresses.split(",")[0]))


def without_proxy(target: str) -> ChannelOptions:
    """The options for a server on this machine: gRPC would send its calls to the proxy of `http_proxy` too."""
    return (("grpc.enable_http_proxy", 0),) if is_here(target) else ()


def is_here(target: str) -> bool:
    return host_of(target).startswith(("localhost:", "127.", "0.0.0.0:", "[::1]", "[::]"))


def host_of(target: str) -> str:
    """The host of a target with its port."""
    return target.lower().removeprefix("dns:").removeprefix("ipv4:").removeprefix("ipv6:").lstrip("/")


def proxied(target: str) -> str:
    """Advice if gRPC sends calls to a proxy; it reads these variables in this order, in lower case only."""
    variable = next((name for name in ("grpc_proxy", "https_proxy", "http_proxy") if os.environ.get(name)), None)
    host = host_of(target).rpartition(":")[0].strip("[]")
    excluded = os.environ.get("no_grpc_proxy") or os.environ.get("no_proxy") or ""
    if variable is None or target.startswith("unix:") or is_here(target) or any(covers(part, host) for part in excluded.split(",")):
        return ""
    # Without a user and a password.
    proxy = os.environ[variable].rpartition("@")[2]
    return f"the call went to the proxy {proxy} of the variable {variable}: if the server is reachable without it, set no_proxy={host}"


def covers(part: str, host: str) -> bool:
    """Whether an entry of `no_proxy` covers a host: the end of its name, or a network."""
    part = part.strip().lower()
    try:
        return ip_address(host) in ip_network(part)
    except ValueError:
        return bool(part) and host.endswith(part)


def bearer(token: str) -> str:
    if not isinstance(token, str):
        raise TypeError(f"token is {token!r}, must be a text")
    token = token.strip()
    # Checked here, because gRPC's error message would contain the token.
    if not (token and token.isascii() and token.isprintable()):
        raise ValueError("token is empty or contains characters that are not printable ASCII")
    return f"Bearer {token}"
