"""Builds the packages of ros2/ with colcon, and runs tests/python/test_ros2.py in their environment.

    $(python3 tests/tools.py ros2) tests/ros2/run.py [-k NAME]

Needs GRASPD, GRASP_SIM and ORT_DYLIB_PATH; `make test-ros2` sets them. The messages, whose compilation takes a minute or
two, are kept in the cache.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path.insert(0, str(ROOT / "deploy"))

import native  # noqa: E402


def messages() -> Path:
    """An install space with graspd_msgs and with the messages that PyPI lacks, built once per state of their sources."""
    folders = [ROOT / "ros2/graspd_msgs", HERE / "interfaces"]
    sources = sorted(path for folder in folders for path in folder.rglob("*") if path.is_file())
    contents = [sys.prefix.encode(), *(part for path in sources for part in (path.name.encode(), path.read_bytes()))]
    name = hashlib.sha256(b"\0".join(contents)).hexdigest()[:12]

    def build(part: Path) -> None:
        native.say("compiling the messages of ros2/")
        colcon(folders, part, dict(os.environ))

    return native.built_once(native.CACHE / f"ros2-messages-{name}", build)


def colcon(folders, install: Path, environment) -> None:
    with tempfile.TemporaryDirectory() as build:
        spaces = ["--build-base", build, "--install-base", install, "--merge-install", "--base-paths", *folders]
        command = [sys.executable, "-m", "colcon", "--log-base", f"{build}/log", "build", *spaces]
        command += ["--cmake-args", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={sys.executable}"]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        output = subprocess.run(list(map(str, command)), env=environment, text=True, **pipes)
    if output.returncode:
        sys.exit(f"colcon failed:\n{output.stdout}")


def sourced(install: Path, environment):
    """The variables after `. local_setup.sh`."""
    script = '. "$COLCON_CURRENT_PREFIX/local_setup.sh" && env -0'
    environment = {**environment, "COLCON_CURRENT_PREFIX": str(install)}
    lines = subprocess.run(["sh", "-c", script], env=environment, stdout=subprocess.PIPE, check=True).stdout.decode()
    return dict(line.split("=", 1) for line in lines.split("\0") if line)


def main() -> int:
    # What the wheels have in the place of /opt/ros/jazzy/setup.sh, and CMake's program.
    from cmake import CMAKE_BIN_DIR

    environment = {**os.environ, "AMENT_PREFIX_PATH": sys.prefix, "CMAKE_PREFIX_PATH": sys.prefix}
    environment["PATH"] = os.pathsep.join([CMAKE_BIN_DIR, f"{sys.prefix}/bin", os.environ["PATH"]])
    os.environ.update(environment)
    environment = sourced(messages(), environment)
    with tempfile.TemporaryDirectory() as folder:
        install, client, models = (Path(folder, name) for name in ["install", "client", "models"])
        colcon([ROOT / "ros2/graspd_ros"], install, environment)
        environment = sourced(install, environment)
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
        subprocess.run([*pip, "--target", client, ROOT / "client/python"], check=True)
        environment["PYTHONPATH"] = os.pathsep.join([str(client), environment["PYTHONPATH"]])
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        models.mkdir()
        (models / "vgn-packed.onnx").symlink_to(ROOT / "models/zoo/vgn-packed.onnx")
        environment["GRASPD_MODELS"] = str(models)
        command = [sys.executable, "-m", "unittest", "discover", "--verbose", "--pattern", "test_ros2.py"]
        command += ["--start-directory", str(ROOT / "tests/python"), *sys.argv[1:]]
        return subprocess.run(command, env=environment).returncode


if __name__ == "__main__":
    sys.exit(main())
