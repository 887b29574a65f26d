"""Tests the second simulator, sim/pybullet, and the commands in its documents.

    GRASPD=target/release/graspd GRASP_SIM=target/release/grasp-sim GRASPD_MODELS=models/zoo \\
    ORT_DYLIB_PATH=$(python3 deploy/native.py onnxruntime) \\
    $(python3 tests/tools.py python) -m unittest discover --start-directory tests/python --pattern test_pybullet.py
"""

import atexit
import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import numpy as np
from server import Server

ROOT = Path(__file__).resolve().parents[2]
SIMULATOR = ROOT / "sim/pybullet"
PORT = "127.0.0.1:50051"
HAS_PYBULLET = importlib.util.find_spec("pybullet") is not None
without_pybullet = unittest.skipUnless(
    HAS_PYBULLET, "pybullet has wheels only for Python 3.11 on Linux x86-64"
)

if HAS_PYBULLET:
    INSTALLED = tempfile.TemporaryDirectory()
    atexit.register(INSTALLED.cleanup)
    # As in the documents, with the dependencies that are already installed.
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", INSTALLED.name, ROOT / "client/python"], check=True)
    sys.path[:0] = [INSTALLED.name, str(SIMULATOR)]

    import camera
    import replay
    import score
    from graspd import Pose
    from planners import Random
    from world import World

CUBE = """<robot name="cube"><link name="cube">
  <contact><lateral_friction value="1"/></contact>
  <inertial><mass value="0.05"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  <visual><geometry><box size="0.04 0.04 0.04"/></geometry></visual>
  <collision><geometry><box size="0.04 0.04 0.04"/></geometry></collision>
</link></robot>"""
DOWN = (1.0, 0.0, 0.0, 0.0)


@without_pybullet
class CubeTest(unittest.TestCase):
    """A cube of 4 cm in the middle of the table."""

    def setUp(self):
        self.urdf = Path(self.enterContext(tempfile.TemporaryDirectory())) / "cube.urdf"
        self.urdf.write_text(CUBE)
        self.world = World()
        self.addCleanup(self.world.close)
        (self.cube,) = self.world.place([(self.urdf, 1.0, Pose((0.15, 0.15, 0.07)))])
        self.world.settle()

    def test_a_cube_is_lifted(self):
        attempt = self.world.execute(Pose((0.15, 0.15, 0.12), DOWN))
        self.assertEqual((attempt.outcome, attempt.object, attempt.short_by), ("lifted", "cube", 0.0))
        self.assertTrue(attempt.success and attempt.rose and not attempt.touched)
        # Bullet adds collision margins to the cube and the fingers.
        self.assertAlmostEqual(attempt.opening, 0.04, delta=0.003)
        self.assertAlmostEqual(attempt.rise, 0.1, delta=0.005)
        self.assertEqual(self.world.objects, {})

    def test_contact_on_the_approach_fails_only_if_forbidden(self):
        on_the_cube = Pose((0.15, 0.195, 0.12), DOWN)
        state = self.world.save()
        forbidden = self.world.execute(on_the_cube, allow_contact=False, remove=False)
        self.assertEqual((forbidden.outcome, forbidden.success), ("blocked_on_approach", False))
        # The top of the cube is 2 cm above the fingertips of the grasp.
        self.assertAlmostEqual(forbidden.short_by, 0.02, delta=0.004)
        self.world.restore(state)
        allowed = self.world.execute(on_the_cube, remove=False)
        self.assertEqual((allowed.outcome, allowed.short_by), ("closed_on_nothing", forbidden.short_by))

    def test_failed_grasps_have_their_outcome(self):
        state = self.world.save()
        for pose, outcome in [
            (Pose((0.25, 0.25, 0.12), DOWN), "closed_on_nothing"),
            (Pose((0.15, 0.15, 0.06), DOWN), "blocked_on_approach"),
            (Pose((0.15, 0.195, 0.08), DOWN), "blocked_at_pregrasp"),
        ]:
            attempt = self.world.execute(pose, allow_contact=False, remove=False)
            self.assertEqual((attempt.outcome, attempt.rose), (outcome, False))
            self.world.restore(state)

    def test_a_restored_state_gives_the_same_attempt(self):
        state = self.world.save()
        attempts = []
        for _ in range(2):
            attempts.append(self.world.execute(Pose((0.15, 0.16, 0.13), DOWN), remove=False))
            self.world.restore(state)
        self.assertEqual(*attempts)
        self.assertTrue(attempts[0].rose)

    def test_the_cube_is_observed_at_its_position(self):
        for views in [camera.side(), camera.side(np.pi / 2), camera.circle(2)]:
            for view in camera.observe(self.world, views):
                seen = camera.points(view)[camera.is_within_reach(camera.points(view))]
                np.testing.assert_allclose(seen.max(axis=0)[2], 0.09, atol=2e-3)
                self.assertTrue(np.all(np.abs(seen[:, :2] - 0.15) < 0.023))
        views = camera.observe(self.world, camera.side())
        (noisy,) = camera.observe(self.world, camera.side(), np.random.default_rng(2))
        self.assertTrue(0.001 < np.std(noisy.depth - views[0].depth) < 0.1)
        self.assertTrue(camera.sees_anything(views))
        self.world.clear()
        self.assertFalse(camera.sees_anything(camera.observe(self.world, camera.side())))

    def test_random_grasps_are_near_observed_points(self):
        views = camera.observe(self.world, camera.side())
        planner = Random(np.random.default_rng(1))
        for _ in range(20):
            (grasp,) = planner.plan(views).grasps
            tips = (grasp.pose.matrix() @ [0, 0, 0.05, 1])[:3]
            self.assertLess(np.linalg.norm(tips - (0.15, 0.15, 0.07)), 0.1)
        self.world.clear()
        self.assertEqual(planner.plan(camera.observe(self.world, camera.side())).grasps, [])

    def test_invalid_urdf_files_raise_errors(self):
        with self.assertRaisesRegex(FileNotFoundError, "nowhere.urdf not found"):
            self.world.add("nowhere.urdf", Pose())
        wrong = self.urdf.with_name("wrong.urdf")
        wrong.write_text("cube")
        with self.assertRaisesRegex(ValueError, "wrong.urdf is not a URDF"):
            self.world.add(wrong, Pose())


@without_pybullet
class FiguresTest(unittest.TestCase):
    def test_intervals_contain_the_share(self):
        self.assertEqual(score.wilson(0, 0), (0.0, 1.0))
        low, high = score.wilson(50, 100)
        self.assertAlmostEqual(low, 0.404, delta=1e-3)
        self.assertAlmostEqual(high, 0.596, delta=1e-3)

    def test_pose_errors_have_the_requested_size(self):
        rng = np.random.default_rng(1)
        grasp = Pose((0.1, 0.2, 0.3), DOWN)
        self.assertEqual(replay.shaken(grasp, (0.0, 0.0), rng), grasp)
        moved = [replay.shaken(grasp, (0.002, 0.05), rng).matrix() for _ in range(1000)]
        shifts = [pose[:3, 3] - grasp.position for pose in moved]
        cosines = [(np.trace(pose[:3, :3] @ grasp.matrix()[:3, :3].T) - 1) / 2 for pose in moved]
        self.assertAlmostEqual(np.sqrt(np.mean(np.square(shifts)) * 3), 0.002, delta=2e-4)
        self.assertAlmostEqual(np.sqrt(np.mean(np.square(np.arccos(np.clip(cosines, -1, 1))))), 0.05, delta=5e-3)


@without_pybullet
class CommandTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        """A folder like the root of a checkout, with our objects in it, and the programs of the documents."""
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        (cls.folder / "sim").symlink_to(ROOT / "sim")
        (cls.folder / "bin").mkdir()
        # The documents may set PYTHONPATH, so the folder of the package is added to it.
        for name, variable, program in [
            ("grasp-sim", "", os.path.abspath(os.environ["GRASP_SIM"])),
            ("python3", f'PYTHONPATH="$PYTHONPATH:{INSTALLED.name}" ', sys.executable),
        ]:
            script = cls.folder / "bin" / name
            script.write_text(f'#!/bin/sh\n{variable}exec {shlex.quote(program)} "$@"\n')
            script.chmod(0o755)
        cls.run_sh("grasp-sim objects --objects test --out objects")
        cls.urdfs = sorted((cls.folder / "objects").glob("*.urdf"))

    @classmethod
    def run_sh(cls, code):
        """Runs a command and returns its output."""
        path = f"{cls.folder / 'bin'}{os.pathsep}{os.environ['PATH']}"
        environment = {**os.environ, "PATH": path, "PYTHONPATH": "", "PYTHONDONTWRITEBYTECODE": "1"}
        command = ["sh", "-euc", code]
        result = subprocess.run(command, cwd=cls.folder, env=environment, capture_output=True, text=True)
        if result.returncode:
            raise AssertionError(f"{code}: {result.stdout}{result.stderr}")
        return result.stdout

    def last(self, printed):
        return json.loads(printed.splitlines()[-1])

    def blocks(self, path):
        """Language and text of each code block, except those that install packages."""
        for language, code in re.findall(r"^```(\w*)\n(.*?)^```$", path.read_text(), re.MULTILINE | re.DOTALL):
            if not code.startswith("pip install"):
                yield language, code

    def test_scenes_are_the_same_for_the_same_seed(self):
        world = World()
        self.addCleanup(world.close)

        def scene(make, seed):
            make(self.urdfs, 3, np.random.default_rng(seed))
            return [(name, world.position(body)) for body, name in world.objects.items()]

        for make in [world.packed, world.pile]:
            first = scene(make, 1)
            self.assertTrue(first)
            self.assertNotEqual(scene(make, 2), first)
            self.assertEqual(scene(make, 1), first)

    def test_a_served_network_clears_tables(self):
        server = self.enterContext(Server())
        printed = self.run_sh(
            f"python3 sim/pybullet/clear.py --objects objects --planner grpc:{server.grpc} --rounds 2 --seed 3 "
            "--jobs 2 --attempts attempts.jsonl --pictures pictures --out summary.json"
        )
        report = self.last(printed)
        self.assertEqual(report, json.loads((self.folder / "summary.json").read_text()))
        attempts = [json.loads(line) for line in (self.folder / "attempts.jsonl").read_text().splitlines()]
        self.assertEqual((report["rounds"], report["attempts"]), (2, len(attempts)))
        self.assertEqual(report["successes"], sum(attempt["success"] for attempt in attempts))
        self.assertEqual(report["rose"], sum(attempt["rose"] for attempt in attempts))
        self.assertTrue(report["rose"] <= report["successes"] <= report["objects"] <= 10)
        self.assertAlmostEqual(report["gsr"], report["successes"] / max(report["attempts"], 1))
        self.assertAlmostEqual(report["dr"], report["successes"] / report["objects"])
        failures = [report[name] for name in ["blocked_at_pregrasp", "closed_on_nothing", "lost_in_lift"]]
        self.assertEqual(sum(failures) + report["successes"], report["attempts"])
        endings = [report[name] for name in ["cleared", "nothing_seen", "nothing_proposed", "gave_up"]]
        self.assertEqual(sum(endings), 2)
        self.assertEqual(report["seeds"]["gsr"]["each"], [report["gsr"]])
        self.assertEqual(len(list((self.folder / "pictures").glob("packed-3-*.png"))), len(attempts))
        self.assertTrue(all(attempt["quality"] >= 0.5 and attempt["round"] < 2 for attempt in attempts))

    def test_figures_have_the_same_names_as_in_grasp_sim(self):
        flags = "--objects objects --planner random --rounds 1 --attempts"
        first = self.last(self.run_sh(f"grasp-sim bench --json {flags} first.jsonl"))
        second = self.last(self.run_sh(f"python3 sim/pybullet/clear.py {flags} second.jsonl"))
        self.assertEqual(set(first) - {"provider", "by_room"}, set(second) - {"rose"})
        files = [self.folder / "first.jsonl", self.folder / "second.jsonl"]
        ours, theirs = (set(json.loads(file.read_text().splitlines()[0])) for file in files)
        self.assertLessEqual(ours - {"room"}, theirs)

    def test_tables_have_columns_for_pybullet(self):
        (self.folder / "zoo").mkdir()
        (self.folder / "zoo/vgn-packed.onnx").symlink_to(Path(os.environ["GRASPD_MODELS"], "vgn-packed.onnx").resolve())
        python, graspd = self.folder / "bin/python3", os.path.abspath(os.environ["GRASPD"])
        self.run_sh(
            f"grasp-sim tables --models zoo --rounds 1 --seeds 1 --timed 1 --out tables.md --results tables.jsonl "
            f"--pybullet {python} --graspd {shlex.quote(graspd)}"
        )
        runs = [json.loads(line) for line in (self.folder / "tables.jsonl").read_text().splitlines()]
        evaluated = {(run["method"], run["scenario"], run["objects"]) for run in runs if run["simulator"] == "pybullet"}
        planners = [("random", "packed"), ("random", "pile"), ("shaf", "packed"), ("shaf", "pile"), ("vgn", "packed")]
        self.assertEqual(evaluated, {(*planner, "test") for planner in planners})
        text = (self.folder / "tables.md").read_text()
        self.assertIn("| packed GSR %, rapier | packed GSR %, PyBullet | published |", text)
        self.assertIn("| packed, rapier | packed, PyBullet | pile, rapier | pile, PyBullet |", text)

    def test_invalid_arguments_are_errors(self):
        for arguments, expected in [
            ("--objects bin", "--objects is bin: it has no .urdf file"),
            ("--objects objects --views top", "must be side, side:DEGREES"),
            ("--objects objects --planner grpc", "must be random or grpc:HOST:PORT"),
            ("--objects objects --threshold 2", "must be greater than 0 and at most 1"),
            ("--objects objects --hand no.urdf", "no.urdf not found"),
        ]:
            with self.subTest(arguments), self.assertRaisesRegex(AssertionError, re.escape(expected)):
                self.run_sh(f"python3 sim/pybullet/clear.py --rounds 1 {arguments}")

    def test_the_commands_of_the_readme_work(self):
        printed = [self.run_sh(code) for language, code in self.blocks(SIMULATOR / "README.md") if language == "sh"]
        report = self.last(printed[-1])
        for label in ["success_kept", "failure_kept"]:
            self.assertTrue(0 < report[label]["n"] <= 20 and 0 <= report[label]["percent"] <= 100, report)
            low, high = report[label]["interval"]
            self.assertTrue(low <= report[label]["percent"] <= high)
        self.assertEqual(report["scenes"], 2)
        # With allowed contacts, the executed outcome takes precedence over the label.
        scenes = [json.loads(line) for line in (self.folder / "labels.jsonl").read_text().splitlines()]
        for scene in scenes:
            for trial in scene["trials"]:
                trial["executed"] = 1
        (self.folder / "executed.jsonl").write_text("".join(f"{json.dumps(scene)}\n" for scene in scenes[:1]))
        flags = "--objects bin objects --limit 3 --shake 1,1 --records records.jsonl"
        executed = self.run_sh(f"python3 sim/pybullet/replay.py executed.jsonl --contact allow {flags}")
        self.assertEqual([self.last(executed)[label]["n"] for label in ["success_kept", "failure_kept"]], [3, 0])
        self.assertEqual(len((self.folder / "records.jsonl").read_text().splitlines()), 3)

    def test_the_commands_of_own_scene_work(self):
        server = self.enterContext(Server())
        blocks = list(self.blocks(ROOT / "docs/own-scene.md"))
        printed = []
        for language, code in blocks:
            code = code.replace(PORT, server.grpc)
            if language == "python":
                (self.folder / "scene.py").write_text(code)
            elif language == "sh":
                printed.append(self.run_sh(code))
        _, program, cleared = printed
        self.assertRegex(program, r"(?m)^0\.\d\d: (lifted \w+|closed_on_nothing|lost_in_lift|blocked_at_pregrasp) ?$")
        self.assertEqual(self.last(cleared)["rounds"], 2)
        self.assertTrue(list((self.folder / "pictures").glob("packed-1-*.png")))

    def test_mypy_accepts_the_types(self):
        self.run_sh(f"python3 -m mypy --strict --cache-dir {self.folder / 'cache'} sim/pybullet")


if __name__ == "__main__":
    unittest.main()
