"""Generates the Python modules of the .proto file with protoc when a wheel is built. They are not in the repository."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from grpc_tools import protoc
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FILE = "grasp/v1/grasp.proto"


class ProtoHook(BuildHookInterface):
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        root = Path(self.root)
        self.folder = TemporaryDirectory()
        out = Path(self.folder.name)
        [proto] = [folder for folder in (root / "proto", root / "../../proto/proto") if (folder / FILE).exists()]
        well_known = Path(protoc.__file__).with_name("_proto")
        if protoc.main(["protoc", f"-I{proto}", f"-I{well_known}", f"--python_out={out}", f"--pyi_out={out}", FILE]):
            raise RuntimeError(f"protoc failed for {proto / FILE}; see its output above")
        for module in (out / FILE).parent.iterdir():
            if version == "editable":
                shutil.copy(module, root / "src/graspd")
            else:
                build_data["force_include"][str(module)] = f"graspd/{module.name}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        self.folder.cleanup()
