"""Runs the code blocks of each document in docs/ in order, in a folder with models/zoo. A server on a free port replaces
the one on port 50051. The output of a block must match the `text` block below it. grpcurl is emulated.

    GRASPD=target/release/graspd GRASP=target/release/grasp GRASP_SIM=target/release/grasp-sim GRASPD_MODELS=models/zoo \\
    ORT_DYLIB_PATH=$(python3 deploy/native.py onnxruntime) \\
    $(python3 tests/tools.py python) -m unittest discover --start-directory tests/python --pattern test_docs.py
"""

import argparse
import contextlib
import copy
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path
from types import SimpleNamespace
from unittest import mock
from urllib.request import urlopen

import grpc
import numpy as np
import onnx
from google.protobuf import json_format
from google.protobuf.descriptor_pb2 import DescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase
from server import Server

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PORT = "127.0.0.1:50051"
# Language and content of a code block.
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def setUpModule():
    """Installs the Python package, with the dependencies that are already installed."""
    folder = unittest.enterModuleContext(tempfile.TemporaryDirectory())
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", folder, ROOT / "client/python"], check=True)
    unittest.enterModuleContext(mock.patch.object(sys, "path", [folder, *sys.path]))
    unittest.enterModuleContext(mock.patch.dict(os.environ, {"PYTHONPATH": folder}))


def grpcurl(*arguments):
    """Emulates grpcurl as far as the documents use it, with the message types from the server's reflection."""
    parser = argparse.ArgumentParser("grpcurl")
    parser.add_argument("-plaintext", action="store_true", required=True)
    parser.add_argument("-d", default="{}", metavar="JSON")
    parser.add_argument("address")
    parser.add_argument("verb")
    parser.add_argument("symbol", nargs="?")
    parsed = parser.parse_args(arguments)
    with grpc.insecure_channel(parsed.address) as channel:
        database = ProtoReflectionDescriptorDatabase(channel)
        pool = DescriptorPool(database)
        if parsed.verb == "list":
            print(*sorted(database.get_services()), sep="\n")
        elif parsed.verb == "describe":
            message = DescriptorProto()
            pool.FindMessageTypeByName(parsed.symbol).CopyToProto(message)
            print(message)
        else:
            service, name = parsed.verb.split("/")
            method = pool.FindServiceByName(service).methods_by_name[name]
            kinds = [GetMessageClass(kind) for kind in (method.input_type, method.output_type)]
            request = json_format.Parse(sys.stdin.read() if parsed.d == "@" else parsed.d, kinds[0]())
            call = channel.unary_unary(f"/{parsed.verb}", kinds[0].SerializeToString, kinds[1].FromString)
            print(json_format.MessageToJson(call(request)))


class Page:
    """A document, and the state of its examples."""

    def __init__(self, name, server, folder):
        self.path, self.server, self.http, self.folder = DOCS / name, server.grpc, server.http, folder
        self.text = self.path.read_text()
        self.names = {"__name__": "__main__"}
        self.environment = {
            **os.environ,
            "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}",
            "GRASP_SERVER": server.grpc,
        }

    def blocks(self):
        """Language, text, first line and expected output of each block. The output is None if none is documented."""
        found = list(BLOCK.finditer(self.text))
        for block, following in zip(found, [*found[1:], None]):
            expected = None
            if following and following[1] == "text" and not self.text[block.end() : following.start()].strip():
                expected = following[2]
            yield block[1], block[2], self.text.count("\n", 0, block.start(2)) + 1, expected

    def run(self, language, code, line):
        """Runs a block and returns its output. Python blocks share their variables."""
        code = code.replace(PORT, self.server)
        if language == "sh":
            command = ["sh", "-euc", code]
            result = subprocess.run(command, cwd=self.folder, env=self.environment, capture_output=True, text=True)
            if result.returncode:
                raise AssertionError(f"{self.path}:{line}: {result.stdout}{result.stderr}")
            return result.stdout
        printed = io.StringIO()
        # Line numbers in a traceback are those of the document.
        program = compile("\n" * (line - 1) + code, self.path, "exec")
        with contextlib.chdir(self.folder), contextlib.redirect_stdout(printed):
            exec(program, self.names)
        return printed.getvalue()


def shortened(code):
    """Reduces measurements to one second, and removes commands that need a Docker engine."""
    return re.sub(r"(?m)^docker .*\n", "", re.sub(r"--seconds \d+", "--seconds 1", code))


def pattern(expected):
    """A regular expression in which … matches any text, and a space any white space."""
    return r"\s+".join(".*".join(map(re.escape, word.split("…"))) for word in expected.split()) + r"\s*"


class DocsTest(unittest.TestCase):
    def page(self, name, edited=lambda code: code):
        """Runs all blocks of a document."""
        folder = Path(self.enterContext(tempfile.TemporaryDirectory()))
        shutil.copytree(os.environ["GRASPD_MODELS"], folder / "models/zoo")
        (folder / "bin").mkdir()
        programs = {name.lower().replace("_", "-"): [os.path.abspath(os.environ[name])] for name in ["GRASP", "GRASP_SIM"]}
        programs |= {"python3": [sys.executable], "grpcurl": [sys.executable, __file__, "grpcurl"]}
        for program, command in programs.items():
            script = folder / "bin" / program
            script.write_text(f'#!/bin/sh\nexec {shlex.join(map(str, command))} "$@"\n')
            script.chmod(0o755)
        with mock.patch.dict(os.environ, {"GRASPD_MODELS": str(folder / "models/zoo")}):
            server = self.enterContext(Server("--watch", 0.2, "--record", folder / "recordings"))
        page = Page(name, server, folder)
        for language, code, line, expected in page.blocks():
            if language not in ["sh", "python"]:
                continue
            printed = page.run(language, edited(code), line)
            if expected is not None:
                self.assertRegex(printed, rf"\A{pattern(expected)}\Z", f"{page.path}:{line}")
        # Clients and their channels are closed before the server.
        self.addCleanup(page.names.clear)
        return page

    def test_api(self):
        def call(option):
            """The call that accepts an option: some need views with labels, or belong to another option."""
            if "object" in option:
                labels = "np.where(np.indices(depth.shape)[1] < 320, 3, 7)"
                labelled = f"graspd.DepthView(depth, k, camera_from_task=poses[0], labels={labels})"
                return f"client.detect_from_depth({labelled}, workspace"
            return "client.detect(volume"

        page = self.page("api.md")
        options = re.findall(r"^\| `(\w+=.*?)` \|", page.text, re.MULTILINE)
        self.assertEqual(len(options), 19)
        for option in options:
            with self.subTest(option):
                page.run("python", f"{call(option)}, graspd.Options({option}))", 1)

    def test_operations(self):
        page = self.page("operations.md", shortened)
        flags = subprocess.run([os.environ["GRASPD"], "--help"], capture_output=True, text=True, check=True).stdout
        for flag in re.findall(r"`(--[a-z-]+)", page.text):
            self.assertIn(f"{flag} ", flags.replace("\n", " "))
        with urlopen(f"http://{page.http}/metrics") as metrics:
            served = set(re.findall(r"^# TYPE (graspd_\w+)", metrics.read().decode(), re.MULTILINE))
        table = page.text.partition("## What the metrics mean")[2].partition("## Log")[0]
        documented = set(re.findall(r"`(graspd_\w+)", table))
        # No reload has taken place yet.
        self.assertEqual(served | {"graspd_reloads_total"}, documented)

    def test_conventions(self):
        self.page("conventions.md")

    def test_own_model(self):
        self.page("own-model.md")

    def test_errors_of_own_model(self):
        """Each row of the table of errors has an example."""
        zoo = onnx.load(Path(os.environ["GRASPD_MODELS"], "vgn-packed.onnx"))

        def changed(change):
            model = copy.deepcopy(zoo)
            change(model)
            return [model]

        def with_properties(**properties):
            there = {property.key: property.value for property in zoo.metadata_props}
            there |= {f"graspd.{key}": value for key, value in properties.items()}
            return lambda model: onnx.helper.set_model_props(model, there)

        def rename(model, old, new):
            for node in model.graph.node:
                for names in (node.input, node.output):
                    names[:] = [new if name == old else name for name in names]
            for value in (*model.graph.input, *model.graph.output):
                value.name = new if value.name == old else value.name

        def fix_batch(model):
            [dimension, *_] = model.graph.input[0].type.tensor_type.shape.dim
            dimension.dim_value = 1

        def halve(model):
            model.graph.input[0].type.tensor_type.elem_type = onnx.TensorProto.FLOAT16
            model.graph.input[0].name = "half"
            model.graph.node.insert(0, onnx.helper.make_node("Cast", ["half"], ["tsdf"], to=onnx.TensorProto.FLOAT))
            rename(model, "tsdf", "full")
            rename(model, "half", "tsdf")

        def split(model):
            tensor = next(tensor for tensor in model.graph.initializer if tensor.raw_data)
            onnx.external_data_helper.set_external_data(tensor, "mine.onnx.data")
            tensor.ClearField("raw_data")

        def add(offset):
            def change(model):
                rename(model, "quality", "before")
                model.graph.output[0].name = "quality"
                tensor = onnx.helper.make_tensor("offset", onnx.TensorProto.FLOAT, [], [offset])
                model.graph.initializer.append(tensor)
                model.graph.node.append(onnx.helper.make_node("Add", ["before", "offset"], ["quality"]))

            return change

        mine = with_properties(name="mine", version="1.0")
        examples = [
            changed(lambda model: rename(model, "width", "opening")),
            changed(lambda model: rename(model, "tsdf", "input")),
            changed(fix_batch),
            changed(halve),
            changed(with_properties(resolution="32")),
            changed(with_properties(camera_azimuth="east")),
            2 * changed(mine),
            [b"version https://git-lfs.github.com/spec/v1\n"],
            changed(split),
            changed(lambda model: model.opset_import[0].MergeFrom(onnx.helper.make_opsetid("", 999))),
            changed(add(-2.0)),
            changed(add(np.nan)),
        ]
        table = (DOCS / "own-model.md").read_text().partition("| message | cause or remedy |")[2]
        rows = re.findall(r"^\| `+ ?(.*?) ?`+ \|", table, re.MULTILINE)
        self.assertEqual(len(rows), len(examples))
        for row, files in zip(rows, examples):
            with self.subTest(row), tempfile.TemporaryDirectory() as folder:
                for index, file in enumerate(files):
                    content = file if isinstance(file, bytes) else file.SerializeToString()
                    Path(folder, f"{index}.onnx").write_bytes(content)
                where = ["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"]
                command = [os.environ["GRASPD"], "--models", folder, "--provider", "cpu", "--threads", "1", *where]
                result = subprocess.run(command, capture_output=True, text=True, timeout=30)
                self.assertNotEqual(result.returncode, 0)
                self.assertIn(row, result.stderr[-2000:])

    def test_own_gripper(self):
        self.page("own-gripper.md")

    def test_own_camera(self):
        page = self.page("own-camera.md")
        for encoding, kind, big in [("16UC1", "<u2", 0), ("16UC1", ">u2", 1), ("32FC1", "<f4", 0)]:
            depth = page.names["depths"][0] / (1 if kind.endswith("u2") else 1000)
            height, width = depth.shape
            padded = np.pad(depth.astype(kind), [(0, 0), (0, 6)])
            pose = page.names["graspd"].Pose.from_matrix(page.names["cameras"][0])
            at = [SimpleNamespace(**dict(zip("xyzw", numbers))) for numbers in (pose.position, pose.quaternion)]
            view = page.names["from_ros"](
                SimpleNamespace(encoding=encoding, is_bigendian=big, height=height, width=width, data=padded.tobytes()),
                SimpleNamespace(k=page.names["k"].ravel()),
                SimpleNamespace(transform=SimpleNamespace(translation=at[0], rotation=at[1])),
            )
            client, workspace, options = (page.names[name] for name in ["client", "workspace", "options"])
            found = client.detect_from_depth([view], workspace, options)
            np.testing.assert_allclose(found.grasps[0].pose.position, page.names["one"].grasps[0].pose.position)


class LinksTest(unittest.TestCase):
    def test_links_have_targets(self):
        others = ["*.md", "models/zoo/**/*.md", "client/*/*.md", "sim/*/*.md"]
        for page in [*DOCS.glob("*.md"), *(page for pattern in others for page in DOCS.parent.glob(pattern))]:
            for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
                if link.startswith("http"):
                    continue
                path, _, heading = link.partition("#")
                target = (page.parent / path).resolve() if path else page
                with self.subTest(f"{page.name}: {link}"):
                    self.assertTrue(target.exists())
                    if heading:
                        headings = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE)
                        self.assertIn(heading, [re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in headings])


if __name__ == "__main__":
    if sys.argv[1:2] == ["grpcurl"]:
        grpcurl(*sys.argv[2:])
    else:
        unittest.main()
