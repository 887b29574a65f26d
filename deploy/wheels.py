#!/usr/bin/env python3
"""Builds the wheels of the Python client and of the programs into dist/.

    wheels.py             the programs, optimised, for glibc 2.28 and newer
    wheels.py PROGRAMS    programs that are built already, for this machine's glibc

The tools are installed into an environment in the target directory. Zig links against the old glibc.
"""

import os
import platform
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TARGET = Path(os.environ.get("CARGO_TARGET_DIR") or ROOT / "target").absolute()
DIST = ROOT / "dist"
TOOLS = ["hatchling==1.33.0", "grpcio-tools==1.81.1", "cargo-zigbuild==0.24.1", "ziglang==0.17.1", "auditwheel==6.8.2"]
GLIBC = "2.28"
PACKAGES = ["--package", "graspd", "--package", "grasp-client", "--package", "grasp-sim"]


def main(programs=None):
    tools = environment()
    if programs:
        tag = f"linux_{platform.machine()}"
    else:
        programs = build(tools)
        tag = f"manylinux_{GLIBC.replace('.', '_')}_{platform.machine()}"
    pip = [tools / "bin/python", "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", DIST]
    run(*pip, ROOT / "client/python")
    run(*pip, ROOT / "deploy/wheel", PROGRAMS=programs, PLATFORM_TAG=tag)
    for wheel in sorted(DIST.glob("*.whl")):
        print(wheel, flush=True)
        if tag in wheel.name and "manylinux" in tag:
            run(tools / "bin/python", "-m", "auditwheel", "show", wheel)


def environment():
    """The environment with the tools."""
    folder = TARGET / "wheel-tools"
    if not (folder / "bin/cargo-zigbuild").exists():
        venv.create(folder, with_pip=True)
        run(folder / "bin/python", "-m", "pip", "install", "--quiet", *TOOLS)
    return folder


def build(tools):
    """Builds the programs, and returns their folder."""
    triple = f"{platform.machine()}-unknown-linux-gnu"
    path = os.pathsep.join([str(tools / "bin"), os.environ["PATH"]])
    command = ["cargo", "zigbuild", "--release", "--locked", "--target", f"{triple}.{GLIBC}", *PACKAGES]
    run(*command, PATH=path, CARGO_TARGET_DIR=TARGET)
    return TARGET / triple / "release"


def run(*command, **variables):
    environment = os.environ | {name: str(value) for name, value in variables.items()}
    subprocess.run([str(part) for part in command], cwd=ROOT, env=environment, check=True)


if __name__ == "__main__":
    if len(sys.argv) > 2 or sys.argv[1:] in (["-h"], ["--help"]):
        sys.exit(__doc__)
    try:
        main(*[Path(folder).absolute() for folder in sys.argv[1:]])
    except subprocess.CalledProcessError as error:
        sys.exit(f"wheels.py: {error.cmd[0]} failed with exit status {error.returncode}")
