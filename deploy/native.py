#!/usr/bin/env python3
"""Downloads the native libraries that cargo cannot download, and prints their paths.

    native.py onnxruntime      the shared library, for ORT_DYLIB_PATH
    native.py onnxruntime-gpu  the same for NVIDIA GPUs; it needs CUDA 13
    native.py libtorch         a folder with lib/ and include/, for LIBTORCH (training only)

Only the path is printed to stdout. If the variable is set, its path is checked and printed. Downloads are kept in
${GRASPD_CACHE:-~/.cache/graspd}, so that a second run does not use the network.
"""

import os
import sys
from fnmatch import fnmatch
from pathlib import Path
from typing import Callable, Dict, List, NamedTuple

# Wheels are the only form in which these libraries are published for every platform with a hash.
# Only C libraries are unpacked, so that the wheels of one CPython version work with every Python.
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
    folder: str  # folder in the cache; contains the version
    result: str  # path in that folder that is printed
    wheels: List[Wheel]


ONNXRUNTIME = {
    # The OpenVINO build, because it includes that provider. It is some versions behind the plain build.
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
    # libtorch_cpu.so is linked against two CUDA libraries even without a GPU.
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

# Unpacked files: folder in the wheel, destination folder, file name patterns.
UNPACKED = [
    ("onnxruntime/capi/", "", ["lib*"]),
    ("torch/include/", "include/", ["*"]),
    ("torch/lib/", "lib/", ["libtorch_cpu.so", "libc10.so", "libgomp.so.1", "libarm_compute*", "libnvpl_*"]),
    ("nvidia/cu13/lib/", "lib/", ["libcudart.so.13", "libcupti.so.13"]),
]

CACHE_HOME = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
CACHE = Path(os.environ.get("GRASPD_CACHE") or f"{CACHE_HOME}/graspd").expanduser().absolute()
WHEELS = CACHE / "wheels"  # for wheels copied from another machine; searched first
PLATFORM = "{0.sysname}-{0.machine}".format(os.uname()) if hasattr(os, "uname") else sys.platform


class Unavailable(Exception):
    """A library is not available. The message says how to provide it."""


def onnxruntime() -> Path:
    return runtime("ONNX Runtime", ONNXRUNTIME)


def onnxruntime_gpu() -> Path:
    return runtime("ONNX Runtime with CUDA", ONNXRUNTIME_GPU)


def runtime(title: str, artefacts: Dict[str, Artefact]) -> Path:
    if os.environ.get("ORT_DYLIB_PATH"):
        return given("ORT_DYLIB_PATH")
    otherwise = "set ORT_DYLIB_PATH to the shared library of an ONNX Runtime, 1.24 or newer"
    if PLATFORM not in artefacts:
        raise Unavailable(f"{title} has no wheel for {PLATFORM}: {otherwise}.")
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


def given(variable: str, *inside: str) -> Path:
    path = Path(os.environ[variable]).absolute()
    for wanted in [path, *map(path.joinpath, inside)]:
        if not wanted.exists():
            raise Unavailable(f"{variable} is {path}, but {wanted} does not exist: correct or unset {variable}.")
    return path


def from_wheels(artefact: Artefact, otherwise: str) -> Path:
    # The name contains the platform, because several machines may share a home directory.
    folder = CACHE / f"{artefact.folder}-{PLATFORM}"

    def build(part: Path) -> None:
        fetch(artefact, part / "wheels", folder, otherwise)
        unpack(part / "wheels", part)
        if (part / "lib/libtorch_cpu.so").exists():
            # torch-sys links against `torch`. In the wheel that is a stub which needs CUDA; here it is a linker script.
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
{artefact.title} could not be downloaded; pip's error is above.
On a machine with network access, run
    python3 -m pip download {' '.join(selection)} --dest wheels {' '.join(names)}
and copy the wheels into {WHEELS}/
or {otherwise}.""")


def pip(arguments: List[str], names: List[str], failure: str) -> None:
    import importlib.util
    import subprocess

    if importlib.util.find_spec("pip") is None:
        raise Unavailable(f"{sys.executable} has no pip (Debian, Ubuntu: apt install python3-pip).\n{failure}")
    WHEELS.mkdir(exist_ok=True)
    # Not in pip's own cache, because the result is kept here.
    manner = ["--no-cache-dir", "--retries", "2", "--disable-pip-version-check", "--find-links", str(WHEELS)]
    if all(any(WHEELS.glob(name.replace("-", "_").replace("==", "-") + "-*.whl")) for name in names):
        manner.append("--no-index")
    if not sys.stderr.isatty():
        manner.append("--quiet")  # no progress bar without a terminal
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
    """Builds `folder` unless it exists. It is created atomically, also with concurrent or killed runs."""
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
            say(f"Waiting for another run that downloads {folder}")
            fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.is_dir():
            shutil.rmtree(part, ignore_errors=True)  # left by an interrupted run
            part.mkdir()
            try:
                build(part)
                part.rename(folder)
            finally:
                shutil.rmtree(part, ignore_errors=True)
    return folder


def say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main(name: str, doc: str, commands: List[Callable[[], Path]]) -> None:
    """Runs the command of the command line."""
    subcommands = {command.__name__.replace("_", "-"): command for command in commands}
    if sys.argv[1:] not in [[subcommand] for subcommand in subcommands]:
        sys.exit(doc)
    try:
        print(subcommands[sys.argv[1]]())
    except Unavailable as missing:
        sys.exit(f"{name}: {missing}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main("native.py", __doc__, [onnxruntime, onnxruntime_gpu, libtorch])
