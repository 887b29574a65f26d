"""Runs the clutter-removal benchmark of `grasp-sim bench` in PyBullet.

The initial scene of a round is the same for every planner. The last line of the output is a JSON object.
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
from graspd import CollisionCheck, Error, Options, Workspace
from score import spread, summary
from world import HAND


def arguments() -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument(
        "--scene",
        choices=["packed", "pile"],
        default="packed",
        help="scenario: objects upright (packed) or dropped (pile)",
    )
    parser.add_argument("--objects", type=Path, required=True, metavar="DIR", help="folder of URDF files")
    parser.add_argument(
        "--part",
        choices=["all", "train", "validation"],
        default="all",
        help="part of the folder's files in the order of their names: validation is every fifth file, train the others",
    )
    parser.add_argument("--count", type=positive, default=5, metavar="N", help="initial number of objects per scene")
    parser.add_argument(
        "--planner", type=planner, default="random", help="planner: random, or grpc:HOST:PORT for a running graspd"
    )
    parser.add_argument(
        "--model", default="", metavar="NAME", help="model of the server; if not set, the server's default model"
    )
    parser.add_argument("--threshold", type=share, default=0.9, metavar="T", help="smallest quality of a grasp")
    parser.add_argument(
        "--force",
        type=lambda text: None if text == "none" else share(text),
        default=0.5,
        metavar="T",
        help="if no grasp reaches the threshold, execute the best grasp if its quality is at least this; none disables "
        "this",
    )
    parser.add_argument(
        "--clear", action="store_true", help="drop grasps whose open hand would collide with the observed surface"
    )
    parser.add_argument(
        "--views",
        type=cameras,
        default="side",
        help="cameras: side[:DEGREES] (the paper's single view, rotated about the vertical), or the number of views on "
        "VGN's circle, 30 degrees from the vertical",
    )
    parser.add_argument("--noise", choices=["none", "dex"], default="dex", help="depth noise; the benchmark uses dex")
    parser.add_argument(
        "--correct-depth-scale",
        action="store_true",
        help="let graspd multiply the depths of each image by one factor, so that the table is at its height",
    )
    parser.add_argument("--rounds", type=positive, default=100, metavar="N", help="rounds (scenes) per seed")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="the first seed")
    parser.add_argument("--seeds", type=positive, default=1, metavar="K", help="number of seeds, starting with --seed")
    parser.add_argument(
        "--hand", type=Path, default=HAND, metavar="URDF", help="hand with the frames and joints of sim/hand/hand.urdf"
    )
    parser.add_argument(
        "--jobs",
        type=positive,
        default=1,
        metavar="J",
        help="number of parallel processes; with more than one the planning times are longer",
    )
    parser.add_argument(
        "--attempts", type=Path, metavar="FILE", help="also write every attempt to this file, as JSON lines"
    )
    parser.add_argument(
        "--pictures", type=Path, metavar="DIR", help="also draw every attempt into this folder, with the fingers closed"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="also write the report to this file")
    return parser.parse_args()


def positive(text: str) -> int:
    """Parses an integer greater than 0."""
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"is {text!r}, must be an integer greater than 0")
    return int(text)


def share(text: str) -> float:
    """Parses a quality, greater than 0 and at most 1."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f"is {text!r}, must be greater than 0 and at most 1")
    return value


def planner(text: str) -> str:
    """Checks the name of a planner."""
    if text != "random" and not text.startswith("grpc:"):
        raise argparse.ArgumentTypeError(f"is {text!r}, must be random or grpc:HOST:PORT")
    return text


def cameras(text: str) -> list[Array]:
    """Parses `--views` into camera poses."""
    kind, _, angle = text.partition(":")
    try:
        if kind == "side":
            degrees = float(angle or 0)
            if math.isfinite(degrees):
                return side(math.radians(degrees))
        elif 1 <= int(text) <= 64:
            return circle(int(text))
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"is {text!r}, must be side, side:DEGREES, or a number of views from 1 to 64")


def part_of(folder: Path, part: str) -> list[Path]:
    """The URDF files of a folder, or of a part of it."""
    urdfs = sorted(folder.glob("*.urdf"))
    kept = [urdf for index, urdf in enumerate(urdfs) if part == "all" or (index % 5 == 4) == (part == "validation")]
    if not kept:
        raise FileNotFoundError(f"--objects is {folder}: it has no .urdf file for --part {part}")
    return kept


def create(path: Path) -> None:
    """Creates an output file if it does not exist, so that a wrong path is an error before the run."""
    try:
        path.open("a").close()
    except OSError as mistake:
        raise OSError(f"{path} cannot be written ({mistake.strerror}); use another path") from None


def run(config: BenchmarkConfig, numbers: list[tuple[int, int]], jobs: int) -> Iterator[Round]:
    """Runs rounds in order, each given by its seed and number."""
    if jobs == 1:
        start(config)
        yield from map(run_round, numbers)
        return
    # Bullet and gRPC do not work in forked processes.
    with multiprocessing.get_context("spawn").Pool(jobs, start, [config]) as pool:
        yield from pool.imap(run_round, numbers)


# One instance per process.
benchmark: Benchmark


def start(config: BenchmarkConfig) -> None:
    """Initialises a process."""
    global benchmark
    benchmark = Benchmark(config)


def run_round(number: tuple[int, int]) -> Round:
    """Runs a round."""
    return benchmark.play(*number)


def attempts(planner: str, rounds: Iterable[Round]) -> Iterator[dict[str, Any]]:
    """One record per attempt, with the field names of `grasp-sim bench --attempts`."""
    for round_ in rounds:
        for number, executed in enumerate(round_.executed):
            grasp, attempt = executed.grasp, executed.attempt
            yield {
                "planner": planner,
                "seed": round_.seed,
                "round": round_.number,
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
    args = arguments()
    collision = CollisionCheck("filter" if args.clear else "off")
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
    for path in filter(None, [args.attempts, args.out]):
        create(path)
    config = BenchmarkConfig(
        scene=args.scene,
        urdfs=part_of(args.objects, args.part),
        count=args.count,
        planner=args.planner,
        options=Options(args.model, threshold=args.threshold, force=args.force, collision=collision),
        workspace=Workspace(correct_depth_scale=args.correct_depth_scale),
        cameras=args.views,
        noise=args.noise == "dex",
        hand=args.hand,
        pictures=args.pictures,
    )
    seeds = range(args.seed, args.seed + args.seeds)
    numbers = [(seed, number) for seed in seeds for number in range(args.rounds)]
    rounds = []
    for done, latest in enumerate(run(config, numbers, args.jobs), 1):
        rounds.append(latest)
        if sys.stderr.isatty():
            print(f"\r{done} of {len(numbers)} rounds", end="", file=sys.stderr, flush=True)
    if sys.stderr.isatty():
        print(file=sys.stderr)
    each = [summary([round_ for round_ in rounds if round_.seed == seed]) for seed in seeds]
    report = summary(rounds) | {
        "seeds": {figure: spread([whole[figure] for whole in each]) for figure in ["gsr", "dr"]},
        "planner": args.planner,
        "decoding": {
            "model": args.model,
            "threshold": args.threshold,
            "force": args.force,
            "clear": args.clear,
            "correct_depth_scale": args.correct_depth_scale,
        },
        "setup": f"PyBullet, {args.scene}, {len(config.urdfs)} objects of {args.objects} ({args.part}), "
        f"{len(config.cameras)} views, noise {args.noise}, {args.count} objects a scene, {args.rounds} rounds, "
        f"seed {args.seed}, hand {args.hand}",
    }
    print(json.dumps(report))
    if args.attempts:
        args.attempts.write_text("".join(f"{json.dumps(line)}\n" for line in attempts(args.planner, rounds)))
    if args.out:
        args.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    try:
        main()
    except (OSError, ValueError, Error) as mistake:
        sys.exit(f"clear.py: {mistake}")
