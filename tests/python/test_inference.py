"""Tests graspd's Open Inference Protocol with NVIDIA's unmodified Triton client.

    GRASPD=target/release/graspd GRASPD_MODELS=models/zoo ORT_DYLIB_PATH=$(python3 deploy/native.py onnxruntime) \\
    $(python3 tests/tools.py python) -m unittest discover --start-directory tests/python --pattern test_inference.py
"""

import unittest
from queue import SimpleQueue

import numpy as np
import scene
from server import Server
from tritonclient.grpc import InferenceServerClient, InferInput, InferRequestedOutput
from tritonclient.utils import InferenceServerException

MODEL = "vgn-packed"
EDGE = [scene.RESOLUTION] * 3
CHANNELS = {"quality": 1, "rotation": 4, "width": 1}
VOLUMES = np.stack([[scene.volume(scene.camera(30, -90))], [scene.volume(scene.camera(40, 90))]])


class InferenceTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        server = cls.enterClassContext(Server())
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
        self.assertEqual((server.name, list(server.extensions)), ("graspd", ["model_configuration"]))
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
            (lambda: self.client.get_model_metadata("missing"), "NOT_FOUND", "model_name"),
            (lambda: self.client.get_model_config("missing"), "NOT_FOUND", "model_name"),
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


if __name__ == "__main__":
    unittest.main()
