"""Tests graspd's Open Inference Protocol with NVIDIA's unmodified Triton client and load generator, and over HTTP.

    GRASPD=target/release/graspd GRASPD_MODELS=models/zoo ORT_DYLIB_PATH=$(python3 deploy/native.py onnxruntime) \\
    GRASPD_PERF_ANALYZER=$(python3 tests/tools.py perf-analyzer) $(python3 tests/tools.py python) -m unittest discover --start-directory tests/python --pattern test_inference.py
"""

import base64
import gzip
import json
import os
import re
import subprocess
import unittest
import zlib
from queue import SimpleQueue
from pathlib import Path
from tempfile import NamedTemporaryFile
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import scene
from people_files import CAMERA_FROM_TASK, MILLIMETRES, png, quaternion
from server import Server
from tritonclient.grpc import InferenceServerClient, InferInput, InferRequestedOutput
from tritonclient.utils import InferenceServerException

MODEL = "vgn-packed"
EDGE = [scene.RESOLUTION] * 3
CHANNELS = {"quality": 1, "rotation": 4, "width": 1}
EXTENSIONS = ["binary_tensor_data", "model_configuration", "model_repository", "statistics"]
VOLUMES = np.stack([[scene.volume(scene.camera(30, -90))], [scene.volume(scene.camera(40, 90))]])


class InferenceTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        server = cls.enterClassContext(Server("--rest", "127.0.0.1:0"))
        cls.server = server
        cls.client = cls.enterClassContext(InferenceServerClient(server.grpc))

    def tensor(self, values, name="tsdf", datatype="FP32"):
        tensor = InferInput(name, values.shape, datatype)
        tensor.set_data_from_numpy(values)
        return tensor

    def infer(self, values, model=MODEL, **more):
        return self.client.infer(model, [self.tensor(values)], **more)

    def maps(self, values):
        result = self.infer(values)
        return {name: result.as_numpy(name) for name in CHANNELS}

    def version(self):
        """The only version."""
        (version,) = self.client.get_model_metadata(MODEL).versions
        return version

    def test_the_server_and_its_model_are_ready(self):
        self.assertTrue(self.client.is_server_live())
        self.assertTrue(self.client.is_server_ready())
        self.assertTrue(self.client.is_model_ready(MODEL))
        self.assertTrue(self.client.is_model_ready(MODEL, self.version()))
        # shaf has no network.
        for name, version in [("missing", ""), (MODEL, "7"), ("shaf", "")]:
            self.assertFalse(self.client.is_model_ready(name, version))

    def test_server_and_model_metadata(self):
        server = self.client.get_server_metadata()
        self.assertEqual((server.name, list(server.extensions)), ("graspd", EXTENSIONS))
        model = self.client.get_model_metadata(MODEL)
        (version,) = model.versions
        self.assertRegex(version, r"^[0-9.]+$")
        self.assertEqual((model.name, model.platform), (MODEL, "onnxruntime_onnx"))
        tensors = {tensor.name: (tensor.datatype, list(tensor.shape)) for tensor in [*model.inputs, *model.outputs]}
        expected = {name: ("FP32", [-1, channels, *EDGE]) for name, channels in {"tsdf": 1, **CHANNELS}.items()}
        self.assertEqual(tensors, expected)
        config = self.client.get_model_config(MODEL, as_json=True)["config"]
        # The default length of the queue.
        self.assertEqual((config["name"], config["max_batch_size"], config["backend"]), (MODEL, 32, "onnxruntime"))
        dims = {one["name"]: (one["data_type"], one["dims"]) for one in [*config["input"], *config["output"]]}
        expected = {name: ("TYPE_FP32", [str(edge) for edge in shape[1:]]) for name, (_, shape) in expected.items()}
        self.assertEqual(dims, expected)

    def test_the_maps_are_valid(self):
        maps = self.maps(VOLUMES)
        for name, channels in CHANNELS.items():
            self.assertEqual((maps[name].shape, maps[name].dtype), ((2, channels, *EDGE), np.float32))
            self.assertTrue(np.isfinite(maps[name]).all(), name)
        self.assertTrue(0 <= maps["quality"].min() < 0.5 < maps["quality"].max() <= 1)
        np.testing.assert_allclose(np.linalg.norm(maps["rotation"], axis=1), 1, atol=1e-3)

    def test_results_do_not_depend_on_the_batch(self):
        both = self.maps(VOLUMES)
        for index in range(2):
            alone = self.maps(VOLUMES[index : index + 1])
            for name in CHANNELS:
                np.testing.assert_array_equal(both[name][index], alone[name][0], name)

    def test_replies_have_id_model_and_latency(self):
        version = self.version()
        response = self.infer(VOLUMES, request_id="from triton", model_version=version).get_response()
        self.assertEqual((response.id, response.model_name, response.model_version), ("from triton", MODEL, version))
        seconds = {name: parameter.double_param for name, parameter in response.parameters.items()}
        stages = {"queue", "preprocessing", "inference", "postprocessing"}
        self.assertLessEqual({f"{stage}_seconds" for stage in stages}, set(seconds))
        self.assertTrue(0 < seconds["inference_seconds"] < seconds["total_seconds"])

    def test_only_requested_outputs_are_returned(self):
        result = self.infer(VOLUMES, outputs=[InferRequestedOutput("width")])
        self.assertEqual([output.name for output in result.get_response().outputs], ["width"])
        np.testing.assert_array_equal(result.as_numpy("width"), self.maps(VOLUMES)["width"])
        self.assertIsNone(result.as_numpy("quality"))

    def test_calls_run_at_the_same_time(self):
        tensor, answers = self.tensor(VOLUMES), SimpleQueue()

        def callback(result, error):
            answers.put((result, error))

        for number in range(8):
            self.client.async_infer(MODEL, [tensor], callback, request_id=str(number))
        numbers, expected = set(), self.maps(VOLUMES)["quality"]
        for _ in range(8):
            result, error = answers.get(timeout=60)
            self.assertIsNone(error)
            numbers.add(int(result.get_response().id))
            np.testing.assert_array_equal(result.as_numpy("quality"), expected)
        self.assertEqual(numbers, set(range(8)))

    def test_errors_have_their_status_code(self):
        other = self.tensor(VOLUMES, "input")
        double = self.tensor(VOLUMES.astype(np.float64), datatype="FP64")
        unknown = [InferRequestedOutput("grip")]
        for call, status, message in [
            (lambda: self.infer(VOLUMES, model="missing"), "NOT_FOUND", "model_name: `missing` not found"),
            (lambda: self.infer(VOLUMES, model="shaf"), "NOT_FOUND", "available: vgn-packed"),
            (lambda: self.infer(VOLUMES, model_version="7"), "NOT_FOUND", "vgn-packed 7"),
            (lambda: self.client.get_model_metadata("missing"), "NOT_FOUND", "name: `missing` not found"),
            (lambda: self.client.get_model_config("missing"), "NOT_FOUND", "name: `missing` not found"),
            (lambda: self.infer(VOLUMES[:, :, 1:]), "INVALID_ARGUMENT", "inputs[0].shape is [2, 1, 39, 40, 40]"),
            (lambda: self.infer(VOLUMES[:0]), "INVALID_ARGUMENT", "inputs[0].shape is [0, 1, 40, 40, 40]"),
            (lambda: self.client.infer(MODEL, [other]), "INVALID_ARGUMENT", "inputs[0].name is `input`"),
            (lambda: self.client.infer(MODEL, [double]), "INVALID_ARGUMENT", "inputs[0].datatype is `FP64`"),
            (lambda: self.infer(2 * VOLUMES), "INVALID_ARGUMENT", "inputs"),
            (lambda: self.infer(VOLUMES * np.float32(np.nan)), "INVALID_ARGUMENT", "NaN"),
            (lambda: self.infer(VOLUMES, outputs=unknown), "INVALID_ARGUMENT", "outputs is `grip`"),
        ]:
            with self.subTest(message), self.assertRaises(InferenceServerException) as caught:
                call()
            self.assertEqual(caught.exception.status(), f"StatusCode.{status}")
            self.assertIn(message, caught.exception.message())

    def rest(self, path, body=None, **headers):
        """Status, headers and body of a response of the REST listener."""
        body = json.dumps(body).encode() if isinstance(body, dict) else body
        request = Request(f"http://{self.server.rest}/v2{path}", body, {k.replace("_", "-"): v for k, v in headers.items()})
        try:
            with urlopen(request) as response:
                return response.status, response.headers, response.read()
        except HTTPError as error:
            with error:
                return error.code, error.headers, error.read()

    def json(self, path, body=None):
        status, _, text = self.rest(path, body)
        self.assertEqual(status, 200, text)
        return json.loads(text)

    def test_rest_has_the_same_metadata(self):
        self.assertEqual(self.rest("/health/live")[0], 200)
        self.assertEqual(self.rest("/health/ready")[0], 200)
        self.assertEqual(self.rest(f"/models/{MODEL}/ready")[0], 200)
        self.assertEqual(self.rest(f"/models/{MODEL}/versions/{self.version()}/ready")[0], 200)
        self.assertEqual(self.rest(f"/models/{MODEL}/versions/0/ready")[0], 503)
        self.assertEqual(self.json("")["extensions"], EXTENSIONS)
        model = self.json(f"/models/{MODEL}")
        self.assertEqual((model["name"], model["versions"]), (MODEL, [self.version()]))
        self.assertEqual(model["inputs"], [{"name": "tsdf", "datatype": "FP32", "shape": [-1, 1, *EDGE]}])
        self.assertEqual(self.json(f"/models/{MODEL}/config")["max_batch_size"], 32)
        (statistics,) = self.json(f"/models/{MODEL}/stats")["model_stats"]
        self.assertEqual((statistics["name"], statistics["version"]), (MODEL, self.version()))
        self.assertEqual(self.json("/models/stats")["model_stats"][0]["name"], MODEL)
        index = self.json("/repository/index", {"ready": True})
        self.assertIn({"name": MODEL, "version": self.version(), "state": "READY", "reason": ""}, index)
        for path in [f"/repository/models/{MODEL}/unload", f"/repository/models/{MODEL}/load"]:
            status, _, text = self.rest(path, b"")
            self.assertEqual((status, "--allow-model-control" in json.loads(text)["error"]), (403, True))

    def test_rest_returns_the_same_maps_as_json_and_binary(self):
        expected = self.maps(VOLUMES)
        tensor = {"name": "tsdf", "datatype": "FP32", "shape": VOLUMES.shape}
        nested = {"id": "json", "inputs": [{**tensor, "data": VOLUMES.tolist()}], "outputs": [{"name": "quality"}]}
        reply = self.json(f"/models/{MODEL}/infer", nested)
        self.assertEqual((reply["id"], reply["model_name"], reply["model_version"]), ("json", MODEL, self.version()))
        self.assertLess(0, reply["parameters"]["inference_seconds"])
        (output,) = reply["outputs"]
        values = np.array(output["data"], np.float32).reshape(output["shape"])
        np.testing.assert_array_equal(values, expected["quality"])

        header = {
            "parameters": {"binary_data_output": True},
            "inputs": [{**tensor, "parameters": {"binary_data_size": VOLUMES.nbytes}}],
        }
        header = json.dumps(header).encode()
        status, headers, body = self.rest(
            f"/models/{MODEL}/infer", header + VOLUMES.tobytes(), Inference_Header_Content_Length=str(len(header))
        )
        self.assertEqual(status, 200, body[:200])
        length = int(headers["Inference-Header-Content-Length"])
        reply, at = json.loads(body[:length]), length
        self.assertEqual([output["name"] for output in reply["outputs"]], list(CHANNELS))
        for output in reply["outputs"]:
            size = output["parameters"]["binary_data_size"]
            values = np.frombuffer(body[at : at + size], np.float32).reshape(output["shape"])
            np.testing.assert_array_equal(values, expected[output["name"]])
            at += size
        self.assertEqual(at, len(body))

    def test_rest_reads_compressed_bodies(self):
        body = json.dumps({"inputs": [{"name": "tsdf", "datatype": "FP32", "shape": [1, 1, *EDGE], "data": VOLUMES[0].tolist()}]})
        plain, gzipped = body.encode(), gzip.compress(body.encode())
        _, _, expected = self.rest(f"/models/{MODEL}/infer", plain)
        in_two = gzip.compress(plain[:1000]) + gzip.compress(plain[1000:])
        bodies = {"gzip": gzipped, "GZIP": gzipped, "x-gzip": in_two, "deflate": zlib.compress(plain), "identity": plain}
        for encoding, data in bodies.items():
            with self.subTest(encoding):
                status, _, text = self.rest(f"/models/{MODEL}/infer", data, Content_Encoding=encoding)
                self.assertEqual(status, 200, text)
                self.assertEqual(json.loads(text)["outputs"], json.loads(expected)["outputs"])
        for data, message in [
            (gzipped[: len(gzipped) // 2], "the body is not valid"),
            (plain, "the body is not valid"),
            # 20 kB that are 20 MB.
            (gzip.compress(bytes(20 << 20)), "--max-message-bytes"),
        ]:
            with self.subTest(message):
                status, _, text = self.rest(f"/models/{MODEL}/infer", data, Content_Encoding="gzip")
                self.assertEqual((status, message in json.loads(text)["error"]), (400, True), text)

    def detect(self, **changes):
        """The status and the response of `POST /v1/detect` with a depth image of the block."""
        pose = np.linalg.inv(CAMERA_FROM_TASK)
        x, y, z, w = quaternion(pose)
        position = dict(zip("xyz", pose[:3, 3].tolist()))
        with NamedTemporaryFile() as image:
            png(Path(image.name), MILLIMETRES)
            data = base64.b64encode(Path(image.name).read_bytes()).decode()
        view = {
            "data": data,
            "unit": "DEPTH_UNIT_PNG_MILLIMETRES",
            "camera": {"width": scene.WIDTH, "height": scene.HEIGHT, "k": scene.K.flatten().tolist()},
            "frameFromCamera": {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}},
        }
        body = {"views": [view], "options": {"maxGrasps": 3, "convention": {"origin": "ORIGIN_TCP"}}} | changes
        request = Request(f"http://{self.server.rest}/v1/detect", json.dumps(body).encode())
        try:
            with urlopen(request) as response:
                return response.status, json.load(response)
        except HTTPError as refusal:
            return refusal.code, json.load(refusal)

    def test_grasps_in_a_depth_image_as_json(self):
        status, reply = self.detect()
        self.assertEqual(status, 200, reply)
        self.assertTrue(1 <= len(reply["grasps"]) <= 3)
        tips = reply["grasps"][0]["pose"]["position"]
        self.assertLess(abs(tips["x"] - 0.15), 0.012)
        self.assertEqual(reply["model"], MODEL)
        for change, expected in [
            ({"view": []}, "unrecognized field name 'view'"),
            ({"views": []}, "views has 0 entries, must have from 1 to 64"),
            ({"options": {"threshold": 2}}, "options.threshold is 2"),
        ]:
            status, reply = self.detect(**change)
            self.assertEqual(status, 400)
            self.assertIn(expected, reply["error"])

    def test_rest_errors_say_what_is_wrong(self):
        tensor = {"name": "tsdf", "datatype": "FP32", "shape": [1, 1, *EDGE], "data": [0.5]}
        timeout = {"inputs": [tensor], "parameters": {"timeout": 5}}
        infer = f"/models/{MODEL}/infer"
        for path, body, status, message in [
            ("/models/missing/infer", {"inputs": [tensor]}, 404, "model_name: `missing` not found"),
            ("/models/missing", None, 404, "name: `missing` not found"),
            (infer, {"inputs": [tensor]}, 400, "inputs[0] is 1 values, must be 64000 values"),
            (infer, {"inputs": []}, 400, "inputs has 0 entries"),
            (infer, timeout, 400, "parameters is `timeout`"),
            (infer, b"text", 400, "the request is not valid"),
            (infer, b"0" * (16 << 20) + b"0", 400, "--max-message-bytes"),
        ]:
            with self.subTest(message):
                code, headers, text = self.rest(path, body)
                self.assertEqual((code, headers["Content-Type"]), (status, "application/json"))
                self.assertIn(message, json.loads(text)["error"])

    def test_perf_analyzer_measures_the_server(self):
        # NVIDIA's load generator reads the metadata, the configuration and the statistics of the model. Its own random
        # numbers are no volume.
        tensor = {"content": VOLUMES[0].ravel().tolist(), "shape": VOLUMES[0].shape}
        file = self.enterContext(NamedTemporaryFile("w", suffix=".json"))
        json.dump({"data": [{"tsdf": tensor}]}, file)
        file.flush()
        for protocol, address in [("grpc", self.server.grpc), ("http", self.server.rest)]:
            with self.subTest(protocol):
                command = [os.environ["GRASPD_PERF_ANALYZER"], "-m", MODEL, "-i", protocol, "-u", address]
                # Until two windows of ten requests differ by less than this percentage, or after a minute.
                command += ["--measurement-mode", "count_windows", "--measurement-request-count", "10", "-s", "999"]
                command += ["--input-data", file.name]
                done = subprocess.run(command, capture_output=True, text=True, timeout=600)
                self.assertEqual(done.returncode, 0, done.stdout + done.stderr)
                throughput = re.search(r"throughput: ([\d.]+) infer/sec", done.stdout)
                self.assertGreater(float(throughput[1]), 0)
                self.assertRegex(done.stdout, r"Inference count: [1-9]")


if __name__ == "__main__":
    unittest.main()
