"""Builds and runs client/cpp as in its README, against a real graspd.

    GRASPD=target/release/graspd GRASPD_MODELS=models/zoo ORT_DYLIB_PATH=$(python3 deploy/native.py onnxruntime) \\
    GRASPD_CPP=$(python3 tests/tools.py cpp) \\
    python -m unittest discover --start-directory tests/python --pattern test_cpp.py
"""

import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import unittest
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
import numpy as np
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "deploy"))
import native  # noqa: E402

CPP = ROOT / "client/cpp"
INSTALL, BUILD, DETECT, DETECT_IMAGE = re.findall(r"```sh\n(.*?)```", (CPP / "README.md").read_text(), re.DOTALL)
# The synthetic scene: the corners of the block, which stands on the table.
LOW, HIGH = np.array([0.13, 0.11, 0.05]), np.array([0.17, 0.19, 0.15])


def environment():
    """The environment in which the packages below GRASPD_CPP are found as if they were installed."""
    prefix = Path(os.environ["GRASPD_CPP"])
    libraries = ":".join(map(str, prefix.glob("lib/*-linux-gnu")))
    return {
        **os.environ,
        "PATH": f"{prefix}/bin:{os.environ['PATH']}",
        "CMAKE_PREFIX_PATH": str(prefix),
        "LIBRARY_PATH": libraries,
        "LD_LIBRARY_PATH": libraries,
    }


def built():
    """The folder with `detect`, which is built once per state of its sources."""
    sources = sorted([*CPP.iterdir(), *ROOT.glob("proto/proto/grasp/**/*.proto")])
    contents = [os.environ["GRASPD_CPP"].encode(), *(path.read_bytes() for path in sources)]
    name = hashlib.sha256(b"\0".join(contents)).hexdigest()[:12]

    def build(part):
        with tempfile.TemporaryDirectory() as folder:
            for needed in ["client", "proto"]:
                Path(folder, needed).symlink_to(ROOT / needed)
            subprocess.run(["sh", "-ec", BUILD], cwd=folder, env=environment(), stdout=sys.stderr, check=True)
            shutil.copy(Path(folder, "build/detect"), part)

    return native.built_once(native.CACHE / f"cpp-{name}", build)


def depth_image():
    """The depth image of the synthetic scene: metres along the optical axis."""
    v, u = np.mgrid[:120, :160]
    eye, turned = np.array([0.15, -0.15, 0.6]), Rotation.from_euler("x", 210, degrees=True).as_matrix()
    rays = np.stack([(u - 79.5) / 135, (v - 59.5) / 135, np.ones(u.shape)], axis=-1) @ turned.T
    spans = np.sort([(LOW - eye) / rays, (HIGH - eye) / rays], axis=0)
    enter, leave = spans[0].max(axis=-1), spans[1].min(axis=-1)
    return np.where(enter <= leave, enter, (LOW[2] - eye[2]) / rays[..., 2])


class CppTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.folder = Path(folder.name)
        (cls.folder / "build").symlink_to(built())
        command = [os.environ["GRASPD"], "--models", os.environ["GRASPD_MODELS"], "--listen", "127.0.0.1:0"]
        log = (cls.folder / "graspd.log").open("w+")
        cls.addClassCleanup(log.close)
        graspd = subprocess.Popen(
            [*command, "--http", "127.0.0.1:0", "--threads", "1"], stdout=subprocess.PIPE, stderr=log, text=True
        )
        cls.addClassCleanup(graspd.communicate)
        cls.addClassCleanup(graspd.terminate)
        output = ""
        while not output.endswith("ready\n"):
            line = graspd.stdout.readline()
            if not line:
                raise AssertionError(Path(log.name).read_text())
            output += line
        cls.server = re.search(r"grpc listening on (\S+)", output)[1]

    def detect(self, *flags, command=DETECT, server=None):
        command = command.replace("build/detect", f'build/detect --server {server or self.server} "$@"')
        run = ["sh", "-ec", command, "detect", *map(str, flags)]
        return subprocess.run(run, cwd=self.folder, env=environment(), capture_output=True, text=True, timeout=60)

    def grasps(self, *flags, **settings):
        """The printed grasps: quality, width, position, quaternion, position of the pre-grasp."""
        result = self.detect(*flags, **settings)
        self.assertEqual(result.returncode, 0, result.stderr)
        numbers = r" (-?\d+\.\d+)"
        line = rf"^quality{numbers} width{numbers} at{numbers * 3} turned{numbers * 4} from{numbers * 3}$"
        grasps = np.array(re.findall(line, result.stdout, re.MULTILINE), dtype=float)
        self.assertRegex(result.stdout, rf"\A\S+ \d+: grasps in base: {len(grasps)}\n")
        self.assertTrue(len(grasps), result.stdout)
        self.latency = re.search(r"^milliseconds: (.*)$", result.stdout, re.MULTILINE)[1]
        return grasps

    def assert_refused(self, result, message):
        self.assertEqual((result.returncode, result.stdout), (1, ""), result.stderr)
        self.assertTrue(result.stderr.startswith(f"detect: {message}"), result.stderr)

    def test_the_grasps_are_at_the_block(self):
        grasps = self.grasps()
        for quality, width, *rest in grasps:
            at, turned, before = np.split(np.array(rest), [3, 7])
            approach = Rotation.from_quat(turned).apply([0, 0, 1])
            between = at + 0.03 * approach
            self.assertTrue((LOW - 0.03 <= between).all() and (between <= HIGH + 0.03).all(), f"{between}")
            self.assertTrue(0 < quality <= 1 and 0 < width <= 0.08)
            np.testing.assert_allclose(before, at - 0.05 * approach, atol=2e-3)
            self.assertGreater(-approach[2], math.cos(1) - 1e-3)
        self.assertTrue((np.diff(grasps[:, 0]) <= 0).all(), "best first")
        stages = dict(re.findall(r"([a-z ]+?) (\d+\.\d+) ?", self.latency))
        parts = ["queue", "preprocessing", "fusion", "inference", "evaluation", "postprocessing"]
        self.assertEqual(list(stages), [*parts, "total", "round trip"])
        *parts, total, round_trip = map(float, stages.values())
        self.assertTrue(0 < sum(parts) <= total + 0.1 <= round_trip + 0.1, self.latency)

    def test_images_in_metres_and_millimetres_are_read(self):
        expected = self.grasps()[0, 2:5]
        for image in [depth_image().astype("<f4"), np.rint(depth_image() * 1e3).astype("<u2")]:
            np.save(self.folder / "depth.npy", image)
            distances = np.linalg.norm(self.grasps(command=DETECT_IMAGE)[:, 2:5] - expected, axis=1)
            self.assertLess(distances.min(), 0.02, "millimetres are rounded")

    def test_grasps_are_in_the_frame_of_the_base(self):
        moved = self.grasps("--camera", "0.55 -0.35 0.7 0.9659258 0 0 -0.258819", "--corner", "0.4 -0.2 0.1")
        np.testing.assert_allclose(moved[:, 2:5] - [0.4, -0.2, 0.1], self.grasps()[:, 2:5], atol=2e-3)

    def test_errors_are_reported(self):
        transposed = self.detect("--k", "135 0 0 0 135 0 79.5 59.5 1")
        self.assert_refused(transposed, "INVALID_ARGUMENT: views[0].camera.k is [135.0")
        self.assert_refused(self.detect("--k", "135 135"), '--k is "135 135", must be 9 numbers')
        self.assert_refused(self.detect("--depth", "none.npy"), "cannot read none.npy")
        np.save(self.folder / "half.npy", np.ones((2, 2), np.float16))
        self.assert_refused(self.detect("--depth", "half.npy"), "half.npy is not a .npy file")
        np.save(self.folder / "bare.npy", depth_image().astype("<f4"))
        self.assert_refused(self.detect("--depth", "bare.npy"), '--corner is "", must be 3 numbers')
        usage = self.detect("--help")
        self.assertEqual(usage.returncode, 2)
        self.assertIn("--camera", usage.stderr)

    def serve(self, answer):
        """Starts a test server, for behaviour that cannot be triggered in a real one."""
        method = grpc.unary_unary_rpc_method_handler(lambda message, context: answer(len(message), context))
        handler = grpc.method_handlers_generic_handler("grasp.v1.GraspService", {"DetectGraspsFromDepth": method})
        server = grpc.server(ThreadPoolExecutor(), [handler])
        self.addCleanup(server.stop, None)
        port = server.add_insecure_port("127.0.0.1:0")
        server.start()
        return f"127.0.0.1:{port}"

    def test_refused_requests_are_retried(self):
        lengths = []

        def answer(length, context):
            lengths.append(length)
            if len(lengths) < 3:
                context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, "full")
            return b""

        np.save(self.folder / "depth.npy", np.ones((480, 640), np.float32))
        result = self.detect(command=DETECT_IMAGE, server=self.serve(answer))
        self.assertEqual(result.returncode, 0, result.stderr)
        self.assertEqual(len(lengths), 3)
        self.assertGreater(min(lengths), 480 * 640 * 4)

    def test_calls_have_a_deadline(self):
        blocked = threading.Event()
        self.addCleanup(blocked.set)
        server = self.serve(lambda length, context: b"" if blocked.wait(60) else b"")
        start = time.monotonic()
        self.assert_refused(self.detect(server=server), "DEADLINE_EXCEEDED")
        self.assertTrue(1.9 < time.monotonic() - start < 30)

    def test_the_retry_policy_is_that_of_the_documentation(self):
        recommended = re.search(r"```json\n(.*?)```", (ROOT / "docs/operations.md").read_text(), re.DOTALL)[1]
        used = re.search(r'SERVICE_CONFIG\[\] = R"\((.*?)\)"', (CPP / "detect.cpp").read_text(), re.DOTALL)[1]
        recommended, used = map(json.loads, [recommended, used])
        recommended["methodConfig"][0].pop("timeout", None)  # the call has a deadline instead
        self.assertEqual(used, recommended)

    def test_the_readme_installs_the_packages_of_the_test_tools(self):
        source = (ROOT / "tests/tools.py").read_text()
        for package in set(INSTALL.split()[3:]) - {"g++"}:
            self.assertIn(f'"{package}"', source)


if __name__ == "__main__":
    unittest.main()
