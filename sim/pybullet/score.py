"""The figures of the benchmark, with the names of `grasp-sim bench`."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Sequence
from typing import Any

from benchmark import Round

Z = 1.96
"""Half-width of a 95 % interval, in standard deviations."""


def summary(rounds: Sequence[Round]) -> dict[str, Any]:
    """Figures of all rounds together: attempts are pooled, as in the papers."""
    attempts = [executed.attempt for round_ in rounds for executed in round_.executed]
    outcomes = Counter(attempt.outcome for attempt in attempts)
    endings = Counter(round_.ending for round_ in rounds)
    objects, successes = sum(round_.objects for round_ in rounds), outcomes["lifted"]
    fusion = [seconds for round_ in rounds for seconds in round_.fusion]
    planning = [seconds for round_ in rounds for seconds in round_.planning]
    stopped_short = [
        attempt
        for attempt in attempts
        if attempt.touched and attempt.outcome not in ["lifted", "blocked_at_pregrasp"]
    ]
    return {
        "rounds": len(rounds),
        "objects": objects,
        "attempts": len(attempts),
        "successes": successes,
        "rose": sum(attempt.rose for attempt in attempts),
        "gsr": share(successes, len(attempts)),
        "dr": share(successes, objects),
        "gsr_interval": half_interval(successes, len(attempts)),
        "dr_interval": half_interval(successes, objects),
        "blocked_at_pregrasp": outcomes["blocked_at_pregrasp"],
        "closed_on_nothing": outcomes["closed_on_nothing"],
        "lost_in_lift": outcomes["lost_in_lift"],
        "stopped_short": len(stopped_short),
        "cleared": endings["cleared"],
        "nothing_seen": endings["nothing_seen"],
        "nothing_proposed": endings["nothing_proposed"],
        "gave_up": endings["gave_up"],
        "fusion_p50_ms": percentile_ms(fusion, 0.5),
        "fusion_p95_ms": percentile_ms(fusion, 0.95),
        "planning_p50_ms": percentile_ms(planning, 0.5),
        "planning_p95_ms": percentile_ms(planning, 0.95),
    }


def spread(values: Sequence[float]) -> dict[str, Any]:
    """A figure over several seeds: mean, sample standard deviation (None for one seed), number of seeds, and values."""
    std = statistics.stdev(values) if len(values) > 1 else None
    return {"mean": statistics.fmean(values), "std": std, "n": len(values), "each": list(values)}


def share(part: int, whole: int) -> float:
    """The share part / whole; 0 if the whole is 0."""
    return part / whole if whole else 0.0


def half_interval(part: int, whole: int) -> float:
    """The distance of a share from the farther end of its 95 % interval."""
    low, high = wilson(part, whole)
    return max(share(part, whole) - low, high - share(part, whole))


def wilson(part: int, whole: int) -> tuple[float, float]:
    """The 95 % score interval of a share, which is also valid near 0 and 1 (Wilson 1927)."""
    if not whole:
        return 0.0, 1.0
    p, shrink = part / whole, 1 + Z * Z / whole
    middle = (p + Z * Z / (2 * whole)) / shrink
    half = Z * math.sqrt(p * (1 - p) / whole + Z * Z / (4 * whole * whole)) / shrink
    return max(middle - half, 0.0), min(middle + half, 1.0)


def percentile_ms(seconds: Sequence[float], below: float) -> float:
    """The value that a share `below` of the values lies below, milliseconds; 0 without values."""
    if not seconds:
        return 0.0
    return 1e3 * sorted(seconds)[min(int(below * len(seconds)), len(seconds) - 1)]
