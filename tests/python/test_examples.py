"""The examples in Rust, Python and C++ send the same request; what they print is compared.

    GRASPD=target/release/graspd GRASPD_MODELS=models/zoo ORT_DYLIB_PATH=$(python3 deploy/native.py onnxruntime) \\
    GRASP_EXAMPLE=target/release/examples/detect GRASPD_CPP=$(python3 tests/tools.py cpp) \\
    $(python3 tests/tools.py python) -m unittest discover --start-directory tests/python --pattern test_examples.py
"""

import os
import re
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import numpy as np
import test_cpp
from server import Server

PYTHON = Path(__file__).resolve().parents[2] / "client/python"
LINE = r"quality \d\.\d{3} width \d\.\d{3} at .* turned .* from .*"


class ExamplesTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.server = cls.enterClassContext(Server())
        cls.package = cls.enterClassContext(tempfile.TemporaryDirectory())
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
        subprocess.run([*pip, "--target", cls.package, PYTHON], check=True)

    def printed(self, *command, **environment):
        """The first line, and the numbers of each grasp."""
        result = subprocess.run(
            list(map(str, command)), env={**os.environ, **environment}, capture_output=True, text=True, timeout=60
        )
        self.assertEqual(result.returncode, 0, result.stderr)
        first, *lines = result.stdout.splitlines()
        grasps = [[float(number) for number in re.findall(r"-?\d+\.\d+", line)] for line in lines if re.match(LINE, line)]
        return first, np.array(grasps)

    def test_the_examples_print_the_same_grasps(self):
        rust = self.printed(os.environ["GRASP_EXAMPLE"], self.server.grpc)
        python = self.printed(
            sys.executable, PYTHON / "examples/detect.py", self.server.grpc, PYTHONPATH=self.package
        )
        cpp = self.printed(test_cpp.built() / "detect", "--server", self.server.grpc, **test_cpp.environment())
        self.assertRegex(rust[0], r"^vgn-packed \d+: grasps in base: \d$")
        self.assertEqual(rust[1].shape[1], 12)
        self.assertGreater(len(rust[1]), 0)
        for first, grasps in [python, cpp]:
            self.assertEqual(first, rust[0])
            # The images are equal to within the rounding of the ray's computation.
            np.testing.assert_allclose(grasps, rust[1], atol=0.011)


if __name__ == "__main__":
    unittest.main()
