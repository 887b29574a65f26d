"""Replays the trials of `grasp-sim label --export`, and reports how many successes and failures have the same result.

A trial succeeds here if the object rose. Scenes in which an object moves by more than 3 mm when they are placed are
skipped. Of each other scene at most 12 successes and 12 failures are tried. The last line that is printed is a JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import statistics
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from clear import positive
from graspd import Pose
from score import share, wilson
from world import HAND, World

MOST_MOVED = 0.003
"""Metres; a scene in which an object moves further is skipped."""
SETTLING_TIME = 0.5
TRIALS = 12
"""Of each label in a scene."""


@dataclass(frozen=True)
class Settings:
    """How trials are run."""

    folders: list[Path]
    hand: Path
    allow_contact: bool
    shake: tuple[float, float]
    """By how much each grasp is moved at first, the root of the mean square, metres and radians."""
    seed: int


@dataclass(frozen=True)
class Replay:
    """A scene that was placed."""

    moved: list[float]
    """How far each object moved, metres."""
    records: list[dict[str, Any]] | None
    """The result of each trial; None if the objects moved."""


class Replayer:
    """A world for any number of scenes."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.world = World(settings.hand)

    def replay(self, scene: dict[str, Any]) -> Replay:
        """Places a scene and tries its grasps."""
        world, settings = self.world, self.settings
        rng = np.random.default_rng([settings.seed, scene["scene"]])
        objects = [(self.urdf(each["object"]), each["scale"], pose(each["pose"])) for each in scene["objects"]]
        bodies = world.place(objects)
        before = [world.position(body) for body in bodies]
        world.wait_for_rest(SETTLING_TIME)
        moved = [math.dist(world.position(body), start) for body, start in zip(bodies, before)]
        if max(moved, default=0.0) > MOST_MOVED:
            return Replay(moved, None)
        state = world.save()
        records = []
        for success in (1, 0):
            trials = [(i, trial) for i, trial in enumerate(scene["trials"]) if self.expected(trial) == success]
            for index, trial in trials[:TRIALS]:
                grasp = shaken(pose(trial["pose"]), settings.shake, rng)
                attempt = world.execute(grasp, allow_contact=settings.allow_contact, remove=False)
                world.restore(state)
                there = {key: trial[key] for key in ["pose", "label", "executed", "width", "yaws"] if key in trial}
                source = trial.get("object")
                records.append(
                    {
                        "scene": scene["scene"],
                        "trial": index,
                        **there,
                        "drawn_from": None if source is None else scene["objects"][source]["object"],
                        "expected": success,
                        "success": attempt.success,
                        "rose": attempt.rose,
                        **asdict(attempt),
                    }
                )
        world.forget(state)
        return Replay(moved, records)

    def expected(self, trial: dict[str, Any]) -> int:
        """The exported result: with contacts allowed if that was tried, else without contacts."""
        executed = trial.get("executed") if self.settings.allow_contact else None
        return int(trial["label"] if executed is None else executed)

    def urdf(self, name: str) -> Path:
        """The file of an object."""
        for folder in self.settings.folders:
            path = folder / f"{name}.urdf"
            if path.is_file():
                return path
        searched = ", ".join(map(str, self.settings.folders))
        raise FileNotFoundError(f"{name}.urdf not found in {searched}; pass its folder with --objects")


def pose(numbers: list[float]) -> Pose:
    """From x, y, z and a quaternion."""
    x, y, z, qx, qy, qz, qw = numbers
    return Pose((x, y, z), (qx, qy, qz, qw))


def shaken(grasp: Pose, shake: tuple[float, float], rng: np.random.Generator) -> Pose:
    """The grasp moved and turned about its origin, normally distributed."""
    way, turn = (rng.normal(size=3) * size / math.sqrt(3) for size in shake)
    angle = float(np.linalg.norm(turn))
    if angle == 0.0 and not way.any():
        return grasp
    matrix = grasp.matrix()
    if angle > 0.0:
        half = math.sin(angle / 2) / angle * turn
        rotation = Pose(quaternion=(half[0], half[1], half[2], math.cos(angle / 2))).matrix()
        matrix[:3, :3] = rotation[:3, :3] @ matrix[:3, :3]
    matrix[:3, 3] += way
    return Pose.from_matrix(matrix)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("export", type=Path, help="what grasp-sim label --export wrote")
    parser.add_argument(
        "--objects", type=Path, nargs="+", required=True, metavar="DIR", help="folders of the objects' URDF files"
    )
    parser.add_argument(
        "--contact",
        choices=["allow", "forbid"],
        default="forbid",
        help="what a contact on the way is: allow closes the hand there, as the benchmark does, and compares with what "
        "was executed so; forbid makes it a failure, as labels have it",
    )
    parser.add_argument(
        "--shake",
        type=shake,
        default=(0.0, 0.0),
        metavar="MM,DEG",
        help="move each grasp by so much first, normally distributed",
    )
    parser.add_argument("--limit", type=positive, default=400, metavar="N", help="successes, and failures, at most")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the shaking")
    parser.add_argument("--hand", type=Path, default=HAND, metavar="URDF", help="a hand with the frames and joints of sim/hand/hand.urdf")
    parser.add_argument("--jobs", type=positive, default=1, metavar="J", help="processes")
    parser.add_argument("--records", type=Path, metavar="FILE", help="also write a JSON line a trial")
    return parser.parse_args()


def shake(text: str) -> tuple[float, float]:
    """Metres and radians from millimetres and degrees."""
    try:
        millimetres, degrees = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"is {text!r}, must be MM,DEG, such as 2,3") from None
    return millimetres / 1000, math.radians(degrees)


def scenes(path: Path) -> list[dict[str, Any]]:
    """The scenes of an export."""
    read = []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        try:
            scene = json.loads(line)
        except json.JSONDecodeError as mistake:
            raise ValueError(f"{path}, line {number} is not JSON ({mistake}): export it again") from None
        if not {"scene", "objects", "trials"} <= set(scene):
            raise ValueError(f"{path}, line {number} lacks scene, objects or trials: was it written by --export?")
        read.append(scene)
    return read


def replays(settings: Settings, read: list[dict[str, Any]], jobs: int) -> Iterator[Replay]:
    """Replays scenes in their order."""
    if jobs == 1:
        start(settings)
        yield from map(replay, read)
        return
    with multiprocessing.get_context("spawn").Pool(jobs, start, [settings]) as pool:
        yield from pool.imap(replay, read)


# Of this process.
replayer: Replayer


def start(settings: Settings) -> None:
    """Makes a process ready to replay."""
    global replayer
    replayer = Replayer(settings)


def replay(scene: dict[str, Any]) -> Replay:
    """Replays a scene."""
    return replayer.replay(scene)


def kept(records: list[dict[str, Any]], expected: int) -> dict[str, Any]:
    """How many of one label came out the same, and the 95 % interval."""
    outcomes = [record["rose"] == bool(expected) for record in records if record["expected"] == expected]
    low, high = wilson(sum(outcomes), len(outcomes))
    return {
        "percent": round(100 * share(sum(outcomes), len(outcomes)), 1),
        "interval": [round(100 * low, 1), round(100 * high, 1)],
        "n": len(outcomes),
    }


def main() -> None:
    """Replays and reports."""
    asked = arguments()
    settings = Settings(asked.objects, asked.hand, asked.contact == "allow", asked.shake, asked.seed)
    records: list[dict[str, Any]] = []
    moved: list[float] = []
    laid = skipped = 0
    left = {0: asked.limit, 1: asked.limit}
    for one in replays(settings, scenes(asked.export), asked.jobs):
        laid += 1
        moved += one.moved
        skipped += one.records is None
        for record in one.records or []:
            if left[record["expected"]]:
                left[record["expected"]] -= 1
                records.append(record)
        if not any(left.values()):
            break
    report = {
        "success_kept": kept(records, 1),
        "failure_kept": kept(records, 0),
        "scenes": laid,
        "scenes_skipped": skipped,
        "moved_mm_median": round(1e3 * statistics.median(moved or [0.0]), 2),
        "moved_mm_p95": round(1e3 * float(np.percentile(moved or [0.0], 95)), 2),
    }
    if asked.records:
        asked.records.write_text("".join(f"{json.dumps(record)}\n" for record in records))
    print(json.dumps(report))


if __name__ == "__main__":
    try:
        main()
    except (FileNotFoundError, ValueError) as mistake:
        sys.exit(f"replay.py: {mistake}")
