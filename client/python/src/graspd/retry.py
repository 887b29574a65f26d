"""Retries of failed calls."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import ClassVar

from graspd.errors import Error, ResourceExhausted, Unavailable


@dataclass(frozen=True)
class Retry:
    """When a call is retried. Only failures that can pass are retried: the server is unreachable, the connection
    breaks, or the server is busy. Detection is idempotent."""

    attempts: int
    """Maximum number of attempts, including the first."""
    pause: float
    """First pause, seconds; it doubles with each further attempt. The actual pause is drawn uniformly from [0.5, 1] of
    this, so that clients that were refused together do not retry together. It is never shorter than the server's retry
    hint."""
    longest: float
    """Upper limit of the pause, before the server's retry hint, seconds."""

    NONE: ClassVar[Retry]
    """A single attempt."""
    RECOMMENDED: ClassVar[Retry]
    """For robots: bridges a lost replica or a full queue within about half a second."""

    def after(self, attempts: int, error: Error) -> float | None:
        """The pause after this many attempts, seconds; None: no further attempt. `error` is the last attempt's."""
        if attempts >= self.attempts or not isinstance(error, (ResourceExhausted, Unavailable)):
            return None
        pause = min(self.pause * 2.0 ** min(attempts - 1, 20), self.longest)
        return max(pause * random.uniform(0.5, 1.0), error.retry_after or 0.0)


Retry.NONE = Retry(attempts=1, pause=0.0, longest=0.0)
Retry.RECOMMENDED = Retry(attempts=6, pause=0.02, longest=0.5)
