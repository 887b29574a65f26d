"""The clutter-removal benchmark: grasps are executed until the table is empty or two fail in a row."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from camera import Array, look_at, observe, render, save_png, sees_anything
from graspd import Options
from planners import Grasp, Planner, Random, Served
from world import Attempt, World

MAX_FAILURES = 2
"""Failures in a row that end a round."""


@dataclass(frozen=True)
class BenchmarkConfig:
    """Scenes, planner and cameras."""

    scene: str
    """`packed` or `pile`."""
    urdfs: list[Path]
    count: int
    """Objects a scene."""
    planner: str
    """`random` or `grpc:HOST:PORT`."""
    options: Options
    """Options of each request."""
    cameras: list[Array]
    noise: bool
    hand: Path
    pictures: Path | None
    """A folder for a picture of every attempt, the fingers closed."""


@dataclass(frozen=True)
class Executed:
    """A grasp that was executed."""

    grasp: Grasp
    proposals: int
    """How many grasps the planner proposed."""
    objects: int
    """On the table before the attempt."""
    attempt: Attempt


@dataclass
class Round:
    """One scene, cleared as far as the planner can."""

    seed: int
    number: int
    objects: int
    """On the table at the start."""
    executed: list[Executed] = field(default_factory=list)
    ending: str = "cleared"
    """Else `nothing_seen`, `nothing_proposed` or `gave_up`."""
    fusion: list[float] = field(default_factory=list)
    """Seconds to fuse each observation, if the planner reports them."""
    planning: list[float] = field(default_factory=list)
    """Seconds of each planning without fusion."""


class Benchmark:
    """A world and a planner, for any number of rounds."""

    def __init__(self, config: BenchmarkConfig) -> None:
        self.config = config
        self.world = World(config.hand)
        self.served = Served(config.planner.removeprefix("grpc:"), config.options) if config.planner != "random" else None

    def play(self, seed: int, number: int) -> Round:
        """Clears the scene of a round as far as the planner can."""
        config, world = self.config, self.world
        # One generator each, so that the scene does not depend on what the planner and the camera draw.
        scene_rng, noise_rng, planner_rng = (np.random.default_rng([seed, number, use]) for use in range(3))
        planner: Planner = self.served or Random(planner_rng)
        make = world.packed if config.scene == "packed" else world.pile
        make(config.urdfs, config.count, scene_rng)
        played = Round(seed, number, len(world.objects))
        failures = 0
        while world.objects:
            views = observe(world, config.cameras, noise_rng if config.noise else None)
            if not sees_anything(views):
                played.ending = "nothing_seen"
                break
            start = time.perf_counter()
            plan = planner.plan(views)
            played.planning.append(time.perf_counter() - start - plan.fusion)
            played.fusion.append(plan.fusion)
            if not plan.grasps:
                played.ending = "nothing_proposed"
                break
            best, objects = plan.grasps[0], len(world.objects)
            attempt = world.execute(best.pose, closed=self.draws(played, best))
            played.executed.append(Executed(best, len(plan.grasps), objects, attempt))
            failures = 0 if attempt.success else failures + 1
            if failures == MAX_FAILURES:
                played.ending = "gave_up"
                break
        return played

    def draws(self, played: Round, grasp: Grasp) -> Callable[[], None] | None:
        """What draws the next attempt of a round, if pictures are requested."""
        folder = self.config.pictures
        if folder is None:
            return None
        path = folder / f"{self.config.scene}-{played.seed}-{played.number:04}-{len(played.executed):02}.png"

        def draw() -> None:
            # Along the hand's x axis, so that its fingers are side by side.
            x, y, _ = grasp.pose.matrix()[:3, 0]
            picture, _ = render(self.world, look_at(grasp.pose.position, 0.45, 1.2, math.atan2(y, x)))
            save_png(path, picture)

        return draw
