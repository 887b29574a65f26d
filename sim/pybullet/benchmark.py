"""The clutter-removal benchmark: grasp after grasp until a table is empty, or nothing works any more."""

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
"""In a row, after which a round ends."""


@dataclass(frozen=True)
class Game:
    """What is played, and with what."""

    scene: str
    """`packed` or `pile`."""
    urdfs: list[Path]
    count: int
    """Objects a scene."""
    planner: str
    """`random` or `grpc:HOST:PORT`."""
    options: Options
    """What is asked of a server."""
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
    """Among which it was the best."""
    objects: int
    """On the table before."""
    attempt: Attempt


@dataclass
class Round:
    """One scene, cleared or not."""

    seed: int
    number: int
    objects: int
    """On the table at first."""
    executed: list[Executed] = field(default_factory=list)
    ending: str = "cleared"
    """Else `nothing_seen`, `nothing_proposed` or `gave_up`."""
    fusion: list[float] = field(default_factory=list)
    """Seconds to fuse each observation, where the planner tells."""
    planning: list[float] = field(default_factory=list)
    """Seconds of each planning without that."""


class Player:
    """A world and a planner for any number of rounds."""

    def __init__(self, game: Game) -> None:
        self.game = game
        self.world = World(game.hand)
        self.served = Served(game.planner.removeprefix("grpc:"), game.options) if game.planner != "random" else None

    def play(self, seed: int, number: int) -> Round:
        """Clears the scene of a round as far as the planner can."""
        game, world = self.game, self.world
        # A generator for each use: the scene stays the same, whatever the planner and the camera draw.
        scene_rng, noise_rng, planner_rng = (np.random.default_rng([seed, number, use]) for use in range(3))
        planner: Planner = self.served or Random(planner_rng)
        make = world.packed if game.scene == "packed" else world.pile
        make(game.urdfs, game.count, scene_rng)
        played = Round(seed, number, len(world.objects))
        failures = 0
        while world.objects:
            views = observe(world, game.cameras, noise_rng if game.noise else None)
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
        """Draws the next attempt of a round, where that is wanted."""
        folder = self.game.pictures
        if folder is None:
            return None
        path = folder / f"{self.game.scene}-{played.seed}-{played.number:04}-{len(played.executed):02}.png"

        def draw() -> None:
            # Along the hand's x axis, so that its fingers are side by side.
            x, y, _ = grasp.pose.matrix()[:3, 0]
            picture, _ = render(self.world, look_at(grasp.pose.position, 0.45, 1.2, math.atan2(y, x)))
            save_png(path, picture)

        return draw
