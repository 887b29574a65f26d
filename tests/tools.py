#!/usr/bin/env python3
"""Downloads what the tests and benchmarks run, and prints the paths.

    tools.py python      the interpreter of the Python tests, for GRASPD_PYTHON
    tools.py peers       the interpreter of the servers that graspd is compared with, for GRASPD_PEERS
    tools.py haproxy     the load balancer of the tests, for GRASPD_HAPROXY
    tools.py prometheus  for the tests of deploy/prometheus and deploy/grafana, for GRASPD_PROMETHEUS
    tools.py promtool    checks the rules of Prometheus, for GRASPD_PROMTOOL
    tools.py cpp         a prefix with CMake, protoc and gRPC for C++, for GRASPD_CPP
    tools.py chromium    the browser of the page's tests, for GRASPD_CHROMIUM
    tools.py perf-analyzer  NVIDIA's load generator for inference servers, for GRASPD_PERF_ANALYZER
    tools.py ros2        an interpreter with ROS 2 and what builds packages for it, for GRASPD_ROS2

Variables and downloads are handled as in deploy/native.py.
"""

import os
import re
import sys
from functools import lru_cache
from pathlib import Path
from typing import Callable, List, Set, Tuple

TESTS = Path(__file__).resolve().parent
sys.path.insert(0, str(TESTS.parent / "deploy"))

import native  # noqa: E402
from native import CACHE, PLATFORM, Unavailable, built_once, given, pip, say  # noqa: E402


def python() -> Path:
    if os.environ.get("GRASPD_PYTHON"):
        return given("GRASPD_PYTHON")
    if sys.version_info < (3, 11):
        version = "{}.{}".format(*sys.version_info)
        raise Unavailable(f"The Python client's tests need Python 3.11 or newer; {sys.executable} is {version}.")
    return interpreter("python", sys.executable, "The Python packages of the tests", 234, "GRASPD_PYTHON")


def peers() -> Path:
    if os.environ.get("GRASPD_PEERS"):
        return given("GRASPD_PEERS")
    # The system's, which has a shared library beside it for Triton to load, wherever others are first on PATH.
    system = "/usr/bin/python3"
    if PLATFORM != "Linux-x86_64" or not os.path.exists(system):
        raise Unavailable(f"The peers are for Linux on x86-64 with a {system}; this is {PLATFORM}.")
    return interpreter("peers", system, "The Python packages of graspd's peers", 283, "GRASPD_PEERS")


def haproxy() -> Path:
    return from_debian("haproxy", "haproxy", "GRASPD_HAPROXY")


def prometheus() -> Path:
    return from_debian("prometheus", "prometheus", "GRASPD_PROMETHEUS")


def promtool() -> Path:
    return from_debian("prometheus", "promtool", "GRASPD_PROMTOOL")


def chromium() -> Path:
    # The shell without a window: the same engine, and none of GTK.
    return from_debian("chromium-headless-shell", "chromium-headless-shell", "GRASPD_CHROMIUM")


def perf_analyzer() -> Path:
    if os.environ.get("GRASPD_PERF_ANALYZER"):
        return given("GRASPD_PERF_ANALYZER")
    import shutil
    import subprocess
    from zipfile import ZipFile

    title, otherwise = "NVIDIA's perf_analyzer 2.41.0", "set GRASPD_PERF_ANALYZER to its path"
    if PLATFORM != "Linux-x86_64" or not shutil.which("apt-get"):
        raise Unavailable(f"{title} is downloaded for Debian on x86-64 only; {otherwise}.")
    # The last wheel with the program, and what it is linked with.
    wheels = [
        native.Wheel("tritonclient==2.41.0", 13, "cf4ed5df836fa99937678a9fd852f86ba05c7b83656dd0a540e20afdb9ab4629"),
        native.Wheel("nvidia-cuda-runtime-cu12==12.9.79", 4, "25bba2dfb01d48a9b59ca474a1ac43c6ebf7011f1b0b8cc44f54eb6ac48a96c3"),
    ]
    artefact = native.Artefact(title, "perf-analyzer-2.41.0", "perf_analyzer", wheels)
    folder = CACHE / f"{artefact.folder}-{PLATFORM}"

    def build(part: Path) -> None:
        native.fetch(artefact, part / "wheels", folder, otherwise)
        for wheel in (part / "wheels").glob("*.whl"):
            with ZipFile(wheel) as archive:
                for name in archive.namelist():
                    if name.endswith(("/bin/perf_analyzer", "/libcudart.so.12")):
                        archive.extract(name, part)
        if subprocess.run(["apt-get", "download", *NONE_INSTALLED, "libb64-0d"], cwd=part, stdout=sys.stderr).returncode:
            raise Unavailable(f"libb64-0d could not be downloaded; run `apt-get update` as root or {otherwise}.")
        for archive in part.glob("*.deb"):
            subprocess.run(["dpkg-deb", "--extract", archive, part], check=True)
        (program,) = part.rglob("bin/perf_analyzer")
        program.chmod(0o755)
        holding = {path.parent for pattern in ["libb64.so*", "libcudart.so*"] for path in part.rglob(pattern)}
        libraries = os.pathsep.join(str(folder / path.relative_to(part)) for path in sorted(holding))
        script = part / artefact.result
        script.write_text(f'#!/bin/sh\nLD_LIBRARY_PATH="{libraries}" exec "{folder / program.relative_to(part)}" "$@"\n')
        script.chmod(0o755)

    return built_once(folder, build) / artefact.result


def ros2() -> Path:
    if os.environ.get("GRASPD_ROS2"):
        return given("GRASPD_ROS2")
    import sysconfig

    if PLATFORM != "Linux-x86_64" or not (3, 11) <= sys.version_info < (3, 15):
        raise Unavailable("The wheels of ROS 2 are for Linux on x86-64 and Python 3.11 to 3.14; set GRASPD_ROS2 to an "
                          "interpreter with rclpy and colcon.")
    headers = sysconfig.get_path("include")
    if not Path(headers, "Python.h").exists():
        raise Unavailable(f"{headers}/Python.h not found, with which ROS 2 messages are compiled (Debian, Ubuntu: apt install "
                          "python3-dev).")

    def finish(part: Path, folder: Path) -> None:
        # CMake's files in the wheels have the paths of the machine that built them.
        for file in part.glob("share/*/cmake/*.cmake"):
            text = file.read_text()
            built = re.sub(r"/opt/python/cp\d+-cp\d+/include/python[\d.]+", headers, text)
            built = re.sub(r"/opt/python/cp\d+-cp\d+", str(folder), built)
            if built != text:
                file.write_text(built)

    return interpreter("ros2", sys.executable, "ROS 2 Jazzy", 104, "GRASPD_ROS2", finish)


def cpp() -> Path:
    import shutil

    if os.environ.get("GRASPD_CPP"):
        return given("GRASPD_CPP", "include/grpcpp", "include/google/protobuf")
    programs = [shutil.which(name) for name in ["grpc_cpp_plugin", "protoc", "cmake"]]
    if all(programs):
        prefix = Path(programs[0]).resolve().parent.parent
        if (prefix / "include/grpcpp").exists():
            return prefix
    packages = ["cmake", "libgrpc++-dev", "libprotobuf-dev", "protobuf-compiler-grpc"]
    return unpacked("cpp", packages, "prefix with CMake, protoc and gRPC for C++", "GRASPD_CPP") / "usr"


def from_debian(package: str, name: str, variable: str) -> Path:
    """A program of a Debian package, unless the variable names another."""
    import shutil

    if os.environ.get(variable):
        return given(variable)
    there = shutil.which(name, path=os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin"]))
    return Path(there) if there else unpacked(package, [package], name, variable) / name


def unpacked(name: str, packages: List[str], title: str, variable: str) -> Path:
    """A folder with Debian packages and all that they depend on, unpacked instead of installed: this needs no root, and no
    service starts. The contents do not depend on what is installed on this machine: an installed package may have files
    that an unpacked program looks for beside itself."""
    import shutil
    import subprocess

    if not shutil.which("apt-get"):
        raise Unavailable(f"{title} not found, and no apt-get to download it; set {variable} to its path.")
    folder = CACHE / f"debian-complete-{name}-{PLATFORM}"

    def build(part: Path) -> None:
        wanted = " ".join(packages)
        # The machine has apt, dpkg, a compiler, and what they depend on, such as the C library.
        names = sorted(dependencies(tuple(packages), variable) - dependencies(("apt", "dpkg", "g++", "perl"), variable))
        say(f"Debian's {wanted}, {len(names)} packages -> {folder}")
        if subprocess.run(["apt-get", "download", "--quiet", *NONE_INSTALLED, *names], cwd=part, stdout=subprocess.DEVNULL).returncode:
            raise Unavailable(f"{wanted} could not be downloaded; run `apt-get update` as root or set {variable}.")
        for archive in part.glob("*.deb"):
            subprocess.run(["dpkg-deb", "--extract", archive, part], check=True)
            archive.unlink()
        for link in part.glob("usr/lib/*-linux-gnu/*.so"):
            if not link.exists():  # what is linked with is here, but its library is the system's
                library = Path("/", link.relative_to(part)).with_name(os.readlink(link))
                for name in {library.name, library.resolve().name}:
                    link.with_name(name).symlink_to(library)
        # PulseAudio's library has half of itself in a folder of its own.
        holding = [*part.glob("usr/lib/*-linux-gnu"), *part.glob("usr/lib/*-linux-gnu/pulseaudio")]
        libraries = os.pathsep.join(str(folder / path.relative_to(part)) for path in holding)
        # A script for each program: the package may have several. Chromium's in usr/bin is one that looks in /usr.
        for program in [*part.glob("usr/bin/*"), *part.glob("usr/sbin/*"), *part.glob("usr/lib/chromium/chromium-*")]:
            script = part / program.name
            script.write_text(f'#!/bin/sh\nLD_LIBRARY_PATH="{libraries}" exec "{folder / program.relative_to(part)}" "$@"\n')
            script.chmod(0o755)

    return built_once(folder, build)


# As on a machine without any package. Otherwise apt downloads the version that is installed, which may be gone.
NONE_INSTALLED = ["-o", "Dir::State::status=/dev/null"]


@lru_cache
def dependencies(packages: Tuple[str, ...], variable: str) -> Set[str]:
    """The packages that apt would install on a machine without any."""
    import subprocess

    simulate = ["apt-get", "install", "--simulate", "--no-install-recommends", *NONE_INSTALLED]
    # In English, because the lines are parsed.
    environment = {**os.environ, "LC_ALL": "C"}
    plan = subprocess.run([*simulate, *packages], capture_output=True, text=True, env=environment)
    names = {line.split()[1] for line in plan.stdout.splitlines() if line.startswith("Inst ")}
    if not names:
        cause = plan.stderr.strip().splitlines()[-1:]
        raise Unavailable(f"{' '.join(packages)} not found ({' '.join(cause)}); run `apt-get update` as root or set {variable}.")
    return names


def interpreter(
    name: str, base: str, title: str, megabytes: int, variable: str, finish: Callable[[Path, Path], None] = lambda part, folder: None
) -> Path:
    """A virtual environment of `base` with the packages of `tests/{name}/requirements.txt`. `finish` receives the folder in
    which it is created, and the one that it is moved to."""
    import hashlib
    import subprocess

    requirements = TESTS / name / "requirements.txt"
    ask = [base, "-c", "import sysconfig; print(sysconfig.get_python_version())"]
    version = subprocess.check_output(ask, text=True).strip()
    folder = CACHE / f"{name}-{version}-{hashlib.sha256(requirements.read_bytes()).hexdigest()[:12]}"

    def build(part: Path) -> None:
        say(f"{title}, {megabytes} MB of wheels -> {folder}")
        # Without a pip of its own, since Debian's Python has none to give. Nothing in bin/ but
        # `python` is used, which is what survives the renaming of the folder.
        subprocess.run([base, "-m", "venv", "--without-pip", str(part)], stdout=sys.stderr, check=True)
        names = [word for word in requirements.read_text().split() if "==" in word]
        pip(["--python", f"{part}/bin/python", "install", "--requirement", str(requirements)], names, f"""\
{title} could not be installed; pip says above why.
To bring them from a machine with a network and Python {version}, run this there,
    python3 -m pip download --dest wheels --requirement {requirements}
and copy the wheels into {native.WHEELS}/
or set {variable} to an interpreter that has these packages.""")
        finish(part, folder)

    return built_once(folder, build) / "bin/python"


if __name__ == "__main__":
    native.main("tools.py", __doc__, [python, peers, haproxy, prometheus, promtool, cpp, chromium, perf_analyzer, ros2])
