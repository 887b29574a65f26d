"""When to ask again."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import ClassVar

from graspd.errors import Error, ResourceExhausted, Unavailable


@dataclass(frozen=True)
class Retry:
    """When to ask again, where that can help: nobody was there, the connection broke, or the server was busy. Asking
    for grasps twice does no harm."""

    attempts: int
    """How often to ask, the first time included."""
    pause: float
    """The first pause, seconds; each further one is twice as long. Half of it is left to chance, so that many who were
    refused together do not come back together. Where the server says when to come back, it is not sooner."""
    longest: float
    """The longest pause, seconds."""

    NONE: ClassVar[Retry]
    """A single attempt."""
    RECOMMENDED: ClassVar[Retry]
    """For a robot that wants its grasp: over a lost replica, or a full queue, in half a second or so."""

    def after(self, attempts: int, error: Error) -> float | None:
        """How many seconds to wait after so many attempts, the latest of which ended with `error`; None: no more."""
        if attempts >= self.attempts or not isinstance(error, (ResourceExhausted, Unavailable)):
            return None
        pause = min(self.pause * 2.0 ** min(attempts - 1, 20), self.longest)
        return max(pause * random.uniform(0.5, 1.0), error.retry_after or 0.0)


Retry.NONE = Retry(attempts=1, pause=0.0, longest=0.0)
Retry.RECOMMENDED = Retry(attempts=6, pause=0.02, longest=0.5)
