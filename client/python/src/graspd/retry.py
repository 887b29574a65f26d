"""Retries of failed calls."""

from __future__ import annotations

import random
import time
from dataclasses import dataclass
from typing import ClassVar

from grpc import StatusCode

from graspd.errors import Error, ResourceExhausted, Unavailable


@dataclass(frozen=True)
class Retry:
    """When a call is retried. Only transient failures are retried: the server is unreachable, the connection breaks, or
    the server is busy. Retries are safe, because detection is idempotent."""

    attempts: int
    """Maximum number of attempts, including the first."""
    pause: float
    """First pause, seconds; it doubles with each further attempt. The actual pause is drawn uniformly from [0.5, 1] of
    this, so that clients that were refused together do not retry together. It is never shorter than the server's retry
    hint."""
    longest: float
    """Upper limit of the pause, seconds. The server's retry hint can exceed it."""

    NONE: ClassVar[Retry]
    """A single attempt."""
    RECOMMENDED: ClassVar[Retry]
    """For robots: retries for about half a second, for example after the loss of a replica or when a queue is full."""

    def after(self, attempts: int, error: Error) -> float | None:
        """The pause after this many attempts, seconds; None: no further attempt. `error` is the last attempt's."""
        if attempts >= self.attempts or not isinstance(error, (ResourceExhausted, Unavailable)):
            return None
        pause = min(self.pause * 2.0 ** min(attempts - 1, 20), self.longest)
        return max(pause * random.uniform(0.5, 1.0), error.retry_after or 0.0)


Retry.NONE = Retry(attempts=1, pause=0.0, longest=0.0)
Retry.RECOMMENDED = Retry(attempts=6, pause=0.02, longest=0.5)


class Waiting:
    """Waits for a server that is not ready yet."""

    PAUSE: ClassVar[float] = 0.05

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._end = time.monotonic() + timeout
        self._last = "its health status is NOT_SERVING"

    def failed(self, failure: Error) -> None:
        """Notes why the server did not answer."""
        self._last = str(failure)

    def pause(self) -> float:
        """The pause before the next attempt, seconds. Raises after the timeout."""
        if time.monotonic() >= self._end:
            raise Unavailable(
                StatusCode.UNAVAILABLE, f"the server was not ready within {self._timeout} s: {self._last}"
            )
        return self.PAUSE
