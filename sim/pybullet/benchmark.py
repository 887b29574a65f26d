"""The clutter-removal benchmark: executes grasps until the table is empty, no object is visible, no grasp is
proposed, or two grasps fail in a row."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from camera import Array, look_at, observe, render, save_png, sees_anything
from graspd import Options, Workspace
from planners import Grasp, Planner, Random, Served
from world import Attempt, World

MAX_FAILURES = 2
"""Number of consecutive failures that ends a round."""


@dataclass(frozen=True)
class BenchmarkConfig:
    """Configuration of scenes, planner and cameras."""

    scene: str
    """Scenario: `packed` or `pile`."""
    urdfs: list[Path]
    count: int
    """Initial number of objects per scene."""
    planner: str
    """`random` or `grpc:HOST:PORT`."""
    options: Options
    """Options of each request."""
    workspace: Workspace
    """Workspace of each request."""
    cameras: list[Array]
    noise: bool
    hand: Path
    pictures: Path | None
    """Folder for a picture of each attempt with the fingers closed; None: no pictures."""


@dataclass(frozen=True)
class Executed:
    """An executed grasp."""

    grasp: Grasp
    proposals: int
    """Number of grasps that the planner proposed."""
    objects: int
    """Number of objects on the table before the attempt."""
    attempt: Attempt


@dataclass
class Round:
    """One scene, cleared as far as the planner can."""

    seed: int
    number: int
    objects: int
    """Number of objects on the table at the start."""
    executed: list[Executed] = field(default_factory=list)
    ending: str = "cleared"
    """Why the round ended: `cleared`, `nothing_seen`, `nothing_proposed` or `gave_up`."""
    fusion: list[float] = field(default_factory=list)
    """Duration of the fusion of each observation, seconds; 0 if the planner does not report it."""
    planning: list[float] = field(default_factory=list)
    """Duration of each planning without the fusion, seconds."""


class Benchmark:
    """A world and a planner, used for any number of rounds."""

    def __init__(self, config: BenchmarkConfig) -> None:
        self.config = config
        self.world = World(config.hand)
        self.served = None
        if config.planner != "random":
            self.served = Served(config.planner.removeprefix("grpc:"), config.options, config.workspace)

    def play(self, seed: int, number: int) -> Round:
        """Clears the scene of a round as far as the planner can."""
        config, world = self.config, self.world
        # Separate generators, so that the scene does not depend on the random numbers of the planner and the camera.
        scene_rng, noise_rng, planner_rng = (np.random.default_rng([seed, number, use]) for use in range(3))
        planner: Planner = self.served or Random(planner_rng)
        make = world.packed if config.scene == "packed" else world.pile
        make(config.urdfs, config.count, scene_rng)
        round_ = Round(seed, number, len(world.objects))
        failures = 0
        while world.objects:
            views = observe(world, config.cameras, noise_rng if config.noise else None)
            if not sees_anything(views):
                round_.ending = "nothing_seen"
                break
            start = time.perf_counter()
            plan = planner.plan(views)
            round_.planning.append(time.perf_counter() - start - plan.fusion)
            round_.fusion.append(plan.fusion)
            if not plan.grasps:
                round_.ending = "nothing_proposed"
                break
            best, objects = plan.grasps[0], len(world.objects)
            attempt = world.execute(best.pose, closed=self.draws(round_, best))
            round_.executed.append(Executed(best, len(plan.grasps), objects, attempt))
            failures = 0 if attempt.success else failures + 1
            if failures == MAX_FAILURES:
                round_.ending = "gave_up"
                break
        return round_

    def draws(self, round_: Round, grasp: Grasp) -> Callable[[], None] | None:
        """Returns a function that draws the next attempt of a round; None without pictures."""
        folder = self.config.pictures
        if folder is None:
            return None
        path = folder / f"{self.config.scene}-{round_.seed}-{round_.number:04}-{len(round_.executed):02}.png"

        def draw() -> None:
            # The camera looks along the hand's x axis, so that the fingers are side by side in the picture.
            x, y, _ = grasp.pose.matrix()[:3, 0]
            picture, _ = render(self.world, look_at(grasp.pose.position, 0.45, 1.2, math.atan2(y, x)))
            save_png(path, picture)

        return draw
