"""Builds the wheels of deploy/wheel and client/python, installs them into a new environment, and uses them there.

    GRASPD=target/release/graspd ORT_DYLIB_PATH=$(python3 deploy/native.py onnxruntime) \\
    $(python3 tests/tools.py python) -m unittest discover --start-directory tests/python --pattern test_wheels.py
"""

import os
import platform
import re
import subprocess
import sys
import sysconfig
import tempfile
import unittest
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PIP = [sys.executable, "-m", "pip"]
OFFLINE = ["--quiet", "--no-index", "--no-deps"]


class WheelsTest(unittest.TestCase):
    """An environment with the wheels, and with ONNX Runtime where its wheel has it."""

    @classmethod
    def setUpClass(cls):
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        wheels, environment = cls.folder / "wheels", cls.folder / "environment"
        programs = Path(os.environ["GRASPD"]).resolve().parent
        variables = {"PROGRAMS": str(programs), "PLATFORM_TAG": f"linux_{platform.machine()}"}
        for package in ["client/python", "deploy/wheel"]:
            command = [*PIP, "wheel", *OFFLINE, "--no-build-isolation", "--wheel-dir", wheels, ROOT / package]
            subprocess.run(command, check=True, env=os.environ | variables)
        venv.create(environment, system_site_packages=False)
        cls.python = environment / "bin/python"
        subprocess.run([*PIP, "--python", cls.python, "install", *OFFLINE, *wheels.glob("*.whl")], check=True)
        (packages,) = environment.glob("lib/python*/site-packages")
        # The dependencies, of which pip would download the same versions.
        (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
        capi = packages / "onnxruntime/capi"
        capi.parent.mkdir()
        capi.symlink_to(Path(os.environ["ORT_DYLIB_PATH"]).resolve().parent)

    def run_there(self, *command):
        """Runs a command with nothing of this checkout and its variables in the environment."""
        path = os.pathsep.join([str(self.python.parent), "/usr/bin", "/bin"])
        variables = {"PATH": path, "HOME": str(self.folder), "GRASPD_CACHE": "/nowhere"}
        return subprocess.run(command, cwd=self.folder, env=variables, capture_output=True, text=True)

    def test_the_programs_are_installed(self):
        for program in ["graspd", "grasp", "grasp-sim"]:
            found = self.run_there(program, "--version")
            self.assertRegex(found.stdout, rf"^{program} \d+\.\d+\.\d+\n$")

    def test_the_demo_needs_no_option(self):
        found = self.run_there("grasp", "demo", "--server", "127.0.0.1:1", "--out", "demo.png")
        self.assertEqual(found.returncode, 0, found.stderr)
        self.assertRegex(found.stdout, r"(?m)^ +1 +0\.[89]")
        self.assertIn("4 objects", found.stdout)
        self.assertIn("the picture is demo.png", found.stderr)
        self.assertTrue((self.folder / "demo.png").read_bytes().startswith(b"\x89PNG"))

    def test_python_calls_the_server_with_the_models_it_came_with(self):
        script = """
import graspd, os, subprocess
server = subprocess.Popen(["graspd", "--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"], stdout=subprocess.PIPE, text=True)
address = server.stdout.readline().split()[-1]
while server.stdout.readline() != "ready\\n":
    pass
with graspd.Client(address) as client:
    print(*sorted(model.name for model in client.models()))
server.terminate()
server.wait()
"""
        found = self.run_there("python", "-c", script)
        self.assertEqual(found.returncode, 0, found.stderr)
        zoo = ROOT / "models/zoo"
        names = [path.stem for folder in [zoo, zoo / "evaluators", zoo / "classifiers"] for path in folder.glob("*.onnx")]
        self.assertEqual(found.stdout.split(), sorted([*names, "shaf"]))
        # The log says which library it took.
        library = re.search(r"library=(\S+)", found.stderr)[1]
        self.assertIn("site-packages/onnxruntime/capi/", library)


if __name__ == "__main__":
    unittest.main()
