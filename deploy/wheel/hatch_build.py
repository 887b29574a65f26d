"""Adds the programs in the folder PROGRAMS, and the models, to the wheel.

Hatch and not maturin, because the wheel has no extension module: it packs programs that Cargo has built.
"""

import os
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = ["graspd", "grasp", "grasp-sim"]


class ProgramsHook(BuildHookInterface):
    def initialize(self, version, build_data):
        folder = Path(os.environ["PROGRAMS"])
        build_data["shared_scripts"] = {str(folder / name): name for name in PROGRAMS}
        # Where graspd looks for the models that come with it.
        build_data["shared_data"] = {str(ROOT / "models/zoo"): "share/graspd/models"}
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{os.environ['PLATFORM_TAG']}"
