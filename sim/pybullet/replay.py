"""Repeats the trials of `grasp-sim label --export` in PyBullet, and reports how many have the same result.

A trial is a success if the object rose. A scene is skipped if an object moves by more than 3 mm after placement. In
each other scene at most 12 successes and 12 failures are repeated. The last line of the output is a JSON object.
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
from clear import create, positive
from graspd import Pose
from score import share, wilson
from world import HAND, World

MOST_MOVED = 0.003
"""Metres; a scene is skipped if an object moves further."""
SETTLING_TIME = 0.5
"""Seconds."""
TRIALS = 12
"""Largest number of successes, and of failures, per scene."""


@dataclass(frozen=True)
class Settings:
    """Settings of the trials."""

    folders: list[Path]
    hand: Path
    allow_contact: bool
    """Whether the hand closes on contact during the approach; otherwise a contact is a failure."""
    shake: tuple[float, float]
    """Random error of each grasp's pose: root mean square, metres and radians."""
    seed: int


@dataclass(frozen=True)
class Replay:
    """The result of one scene."""

    moved: list[float]
    """Distance by which each object moved after placement, metres."""
    records: list[dict[str, Any]] | None
    """One record per trial; None if the scene was skipped."""


class Replayer:
    """A world, used for any number of scenes."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.world = World(settings.hand)

    def replay(self, scene: dict[str, Any]) -> Replay:
        """Places the objects of a scene and executes its grasps."""
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
                fields = {key: trial[key] for key in ["pose", "label", "executed", "width", "yaws"] if key in trial}
                source = trial.get("object")
                records.append(
                    {
                        "scene": scene["scene"],
                        "trial": index,
                        **fields,
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
        """The exported result: `executed` if contacts are allowed and the export has it, otherwise `label`."""
        executed = trial.get("executed") if self.settings.allow_contact else None
        return int(trial["label"] if executed is None else executed)

    def urdf(self, name: str) -> Path:
        """The URDF file of an object."""
        for folder in self.settings.folders:
            path = folder / f"{name}.urdf"
            if path.is_file():
                return path
        searched = ", ".join(map(str, self.settings.folders))
        raise FileNotFoundError(f"{name}.urdf not found in {searched}; pass its folder with --objects")


def pose(numbers: list[float]) -> Pose:
    """A pose from x, y, z and a quaternion x, y, z, w."""
    x, y, z, qx, qy, qz, qw = numbers
    return Pose((x, y, z), (qx, qy, qz, qw))


def shaken(grasp: Pose, shake: tuple[float, float], rng: np.random.Generator) -> Pose:
    """The grasp with a normally distributed error of its position and of its rotation about its origin."""
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
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("export", type=Path, help="file written by grasp-sim label --export")
    parser.add_argument(
        "--objects", type=Path, nargs="+", required=True, metavar="DIR", help="folders of the objects' URDF files"
    )
    parser.add_argument(
        "--contact",
        choices=["allow", "forbid"],
        default="forbid",
        help="effect of a contact on the approach. allow: the hand closes there, as in the benchmark; the result is "
        "compared with `executed` if the file has it. forbid: the trial fails, as in labels; the result is compared "
        "with `label`",
    )
    parser.add_argument(
        "--shake",
        type=shake,
        default=(0.0, 0.0),
        metavar="MM,DEG",
        help="root mean square of a random error of each grasp's pose, millimetres and degrees",
    )
    parser.add_argument(
        "--limit", type=positive, default=400, metavar="N", help="largest number of successes, and of failures"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="seed of the pose errors")
    parser.add_argument(
        "--hand", type=Path, default=HAND, metavar="URDF", help="hand with the frames and joints of sim/hand/hand.urdf"
    )
    parser.add_argument("--jobs", type=positive, default=1, metavar="J", help="number of parallel processes")
    parser.add_argument(
        "--records", type=Path, metavar="FILE", help="also write every trial to this file, as JSON lines"
    )
    return parser.parse_args()


def shake(text: str) -> tuple[float, float]:
    """Parses millimetres and degrees into metres and radians."""
    try:
        millimetres, degrees = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"is {text!r}, must be MM,DEG, such as 2,3") from None
    return millimetres / 1000, math.radians(degrees)


def scenes(path: Path) -> list[dict[str, Any]]:
    """Reads the scenes of an export."""
    read = []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        try:
            scene = json.loads(line)
        except json.JSONDecodeError as mistake:
            raise ValueError(f"{path}, line {number} is not JSON ({mistake}); export the scenes again") from None
        if not {"scene", "objects", "trials"} <= set(scene):
            raise ValueError(f"{path}, line {number} lacks scene, objects or trials; use grasp-sim label --export")
        read.append(scene)
    return read


def replays(settings: Settings, read: list[dict[str, Any]], jobs: int) -> Iterator[Replay]:
    """Repeats the trials of the scenes, in their order."""
    if jobs == 1:
        start(settings)
        yield from map(replay, read)
        return
    with multiprocessing.get_context("spawn").Pool(jobs, start, [settings]) as pool:
        yield from pool.imap(replay, read)


# One instance per process.
replayer: Replayer


def start(settings: Settings) -> None:
    """Initialises a process."""
    global replayer
    replayer = Replayer(settings)


def replay(scene: dict[str, Any]) -> Replay:
    """Repeats the trials of a scene."""
    return replayer.replay(scene)


def kept(records: list[dict[str, Any]], expected: int) -> dict[str, Any]:
    """Percentage of the trials with this expected result that have it here too, with its 95 % interval."""
    outcomes = [record["rose"] == bool(expected) for record in records if record["expected"] == expected]
    low, high = wilson(sum(outcomes), len(outcomes))
    return {
        "percent": round(100 * share(sum(outcomes), len(outcomes)), 1),
        "interval": [round(100 * low, 1), round(100 * high, 1)],
        "n": len(outcomes),
    }


def main() -> None:
    """Repeats the trials and prints the report."""
    args = arguments()
    if args.records:
        create(args.records)
    settings = Settings(args.objects, args.hand, args.contact == "allow", args.shake, args.seed)
    records: list[dict[str, Any]] = []
    moved: list[float] = []
    placed = skipped = 0
    remaining = {0: args.limit, 1: args.limit}
    for result in replays(settings, scenes(args.export), args.jobs):
        placed += 1
        moved += result.moved
        skipped += result.records is None
        for record in result.records or []:
            if remaining[record["expected"]]:
                remaining[record["expected"]] -= 1
                records.append(record)
        if not any(remaining.values()):
            break
    report = {
        "success_kept": kept(records, 1),
        "failure_kept": kept(records, 0),
        "scenes": placed,
        "scenes_skipped": skipped,
        "moved_mm_median": round(1e3 * statistics.median(moved or [0.0]), 2),
        "moved_mm_p95": round(1e3 * float(np.percentile(moved or [0.0], 95)), 2),
    }
    print(json.dumps(report))
    if args.records:
        args.records.write_text("".join(f"{json.dumps(record)}\n" for record in records))


if __name__ == "__main__":
    try:
        main()
    except (OSError, ValueError) as mistake:
        sys.exit(f"replay.py: {mistake}")
