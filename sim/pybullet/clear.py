"""Clears tables with a planner and reports its success rates: `grasp-sim bench` in PyBullet.

The scene of a round depends on its seed and its number alone. The last line that is printed is a JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from benchmark import Benchmark, BenchmarkConfig, Round
from camera import Array, circle, side
from graspd import CollisionCheck, Error, Options
from score import spread, summary
from world import HAND


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--scene", choices=["packed", "pile"], default="packed")
    parser.add_argument("--objects", type=Path, required=True, metavar="DIR", help="folder of URDF files")
    parser.add_argument(
        "--part",
        choices=["all", "train", "validation"],
        default="all",
        help="of the folder's files by name, validation is every fifth, train the others",
    )
    parser.add_argument("--count", type=positive, default=5, metavar="N", help="objects a scene")
    parser.add_argument("--planner", type=planner, default="random", help="random, or grpc:HOST:PORT, a running graspd")
    parser.add_argument("--model", default="", metavar="NAME", help="name of a model of the server, instead of its default model")
    parser.add_argument("--threshold", type=share, default=0.9, metavar="T", help="smallest quality of a grasp")
    parser.add_argument(
        "--force",
        type=lambda text: None if text == "none" else share(text),
        default=0.5,
        metavar="T",
        help="if no grasp reaches the threshold, take the best one down to this quality; none disables it",
    )
    parser.add_argument("--clear", action="store_true", help="drop grasps whose open hand would collide with the observed surface")
    parser.add_argument(
        "--views", type=cameras, default="side", help="side[:DEGREES], one side view; or N, so many on VGN's circle"
    )
    parser.add_argument("--noise", choices=["none", "dex"], default="dex", help="depth noise; the benchmark uses dex")
    parser.add_argument("--rounds", type=positive, default=100, metavar="N", help="scenes for each seed")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="the first seed")
    parser.add_argument("--seeds", type=positive, default=1, metavar="K", help="number of consecutive seeds")
    parser.add_argument("--hand", type=Path, default=HAND, metavar="URDF", help="a hand with the frames and joints of sim/hand/hand.urdf")
    parser.add_argument("--jobs", type=positive, default=1, metavar="J", help="parallel processes; more make each planning slower")
    parser.add_argument("--attempts", type=Path, metavar="FILE", help="also write one JSON line for each attempt")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="also draw each attempt, the fingers closed")
    parser.add_argument("--out", type=Path, metavar="FILE", help="also write the report to this file")
    return parser.parse_args()


def positive(text: str) -> int:
    """A count."""
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"is {text!r}, must be an integer greater than 0")
    return int(text)


def share(text: str) -> float:
    """A quality."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f"is {text!r}, must be greater than 0 and at most 1")
    return value


def planner(text: str) -> str:
    """`random`, or the address of a server."""
    if text != "random" and not text.startswith("grpc:"):
        raise argparse.ArgumentTypeError(f"is {text!r}, must be random or grpc:HOST:PORT")
    return text


def cameras(text: str) -> list[Array]:
    """Camera poses."""
    kind, _, angle = text.partition(":")
    try:
        if kind == "side":
            return side(math.radians(float(angle or 0)))
        if 1 <= int(text) <= 64:
            return circle(int(text))
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"is {text!r}, must be side, side:DEGREES, or a number of views from 1 to 64")


def part_of(folder: Path, part: str) -> list[Path]:
    """The URDFs of a folder, or of a part of it."""
    urdfs = sorted(folder.glob("*.urdf"))
    kept = [urdf for index, urdf in enumerate(urdfs) if part == "all" or (index % 5 == 4) == (part == "validation")]
    if not kept:
        raise FileNotFoundError(f"--objects is {folder}: it has no .urdf file for --part {part}")
    return kept


def played(config: BenchmarkConfig, numbers: list[tuple[int, int]], jobs: int) -> Iterator[Round]:
    """Plays rounds, each a seed and a number, in order."""
    if jobs == 1:
        start(config)
        yield from map(play, numbers)
        return
    # Bullet and gRPC do not survive a fork.
    with multiprocessing.get_context("spawn").Pool(jobs, start, [config]) as pool:
        yield from pool.imap(play, numbers)


# One for each process.
benchmark: Benchmark


def start(config: BenchmarkConfig) -> None:
    """Prepares a process."""
    global benchmark
    benchmark = Benchmark(config)


def play(number: tuple[int, int]) -> Round:
    """Plays a round."""
    return benchmark.play(*number)


def attempts(planner: str, rounds: Iterable[Round]) -> Iterator[dict[str, Any]]:
    """A record of each attempt, with the names of `grasp-sim bench --attempts`."""
    for played in rounds:
        for number, executed in enumerate(played.executed):
            grasp, attempt = executed.grasp, executed.attempt
            yield {
                "planner": planner,
                "seed": played.seed,
                "round": played.number,
                "attempt": number,
                "outcome": attempt.outcome,
                "success": attempt.success,
                "rose": attempt.rose,
                "short_by": attempt.short_by,
                "opening": attempt.opening,
                "rise": attempt.rise,
                "object": attempt.object,
                "position": grasp.pose.position,
                "quaternion_xyzw": grasp.pose.quaternion,
                "width": grasp.width,
                "quality": grasp.quality,
                "proposals": executed.proposals,
                "objects": executed.objects,
            }


def main() -> None:
    """Runs the benchmark and prints the report."""
    asked = arguments()
    collision = CollisionCheck("filter") if asked.clear else None
    if asked.pictures:
        asked.pictures.mkdir(parents=True, exist_ok=True)
    config = BenchmarkConfig(
        scene=asked.scene,
        urdfs=part_of(asked.objects, asked.part),
        count=asked.count,
        planner=asked.planner,
        options=Options(asked.model, threshold=asked.threshold, force=asked.force, collision=collision),
        cameras=asked.views,
        noise=asked.noise == "dex",
        hand=asked.hand,
        pictures=asked.pictures,
    )
    seeds = range(asked.seed, asked.seed + asked.seeds)
    numbers = [(seed, number) for seed in seeds for number in range(asked.rounds)]
    rounds = []
    for done, latest in enumerate(played(config, numbers, asked.jobs), 1):
        rounds.append(latest)
        if sys.stderr.isatty():
            print(f"\r{done} of {len(numbers)} rounds", end="", file=sys.stderr, flush=True)
    if sys.stderr.isatty():
        print(file=sys.stderr)
    each = [summary([one for one in rounds if one.seed == seed]) for seed in seeds]
    report = summary(rounds) | {
        "seeds": {figure: spread([whole[figure] for whole in each]) for figure in ["gsr", "dr"]},
        "planner": asked.planner,
        "decoding": {
            "model": asked.model,
            "threshold": asked.threshold,
            "force": asked.force,
            "clear": asked.clear,
        },
        "setup": f"PyBullet, {asked.scene}, {len(config.urdfs)} objects of {asked.objects} ({asked.part}), "
        f"{len(config.cameras)} views, noise {asked.noise}, {asked.count} objects a scene, {asked.rounds} rounds, "
        f"seed {asked.seed}, hand {asked.hand}",
    }
    if asked.attempts:
        asked.attempts.write_text("".join(f"{json.dumps(line)}\n" for line in attempts(asked.planner, rounds)))
    if asked.out:
        asked.out.write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(report))


if __name__ == "__main__":
    try:
        main()
    except (FileNotFoundError, ValueError, Error) as mistake:
        sys.exit(f"clear.py: {mistake}")
