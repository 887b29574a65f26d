"""Reads the files of people_files.py with the command line and compares the grasps with the block in the scene.

    GRASPD=target/release/graspd GRASP=target/release/grasp GRASPD_MODELS=models/zoo \\
    ORT_DYLIB_PATH=$(python3 deploy/native.py onnxruntime) \\
    $(python3 tests/tools.py python) -m unittest discover --start-directory tests/python --pattern test_files.py
"""

import json
import os
import subprocess
import tempfile
import unittest
from pathlib import Path

import numpy as np
import people_files as files
import scene
from server import Server

WORKSPACE = "--workspace=0,0,0"
# First bytes of files, by the words that name them.
NAMED = {
    "a JPEG file": b"\xff\xd8\xff\xe0\0\x10JFIF", "an HDF5 file": b"\x89HDF\r\n\x1a\n", "a BMP file": b"BM\0\0", "a PGM file": b"P5\n2 2\n",
    "a PFM file": b"Pf\n2 2\n", "a Radiance HDR file": b"#?RADIANCE\n", "a HEIC": b"\0\0\0\x18ftypheic", "a MATLAB file": b"MATLAB 5.0",
    "a pickle": b"\x80\x04\x95", "a gzip file": b"\x1f\x8b\x08", "a ZIP file without arrays": b"PK\x05\x06" + bytes(18),
    "not a file of a known format": b"plain text", "the file is empty": b"",
}


class FilesTest(unittest.TestCase):
    """A camera 0.6 m from the block. Each file gives the grasps of the reference, or an error that says what is wrong."""

    @classmethod
    def setUpClass(cls):
        cls.server = cls.enterClassContext(Server())
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.depths, cls.poses = files.depths(cls.folder), files.poses(cls.folder)
        cls.intrinsics, cls.clouds = files.intrinsics(cls.folder), files.clouds(cls.folder)

    def grasp(self, *arguments):
        """Runs the command in the folder with the files."""
        command = [os.environ["GRASP"], *map(str, arguments)]
        environment = os.environ | {"GRASP_SERVER": self.server.grpc}
        return subprocess.run(command, cwd=self.folder, env=environment, capture_output=True, text=True)

    def detect(self, image, *more, k="cam_k.json", pose="rows.json", workspace=WORKSPACE):
        """Detects in a depth image."""
        placed = ["--frame-from-camera", pose, workspace]
        return self.grasp("detect", image, "--intrinsics", k, *placed, "--origin", "tcp", "--json", *more)

    def assert_right(self, result, within=0.012):
        """The best grasp closes around the block, whose middle is at x = 0.15 m."""
        self.assertEqual(result.returncode, 0, result.stderr)
        reply = json.loads(result.stdout)
        self.assertTrue(reply["grasps"], reply)
        tips = np.array(reply["grasps"][0]["position"])
        lower, upper = scene.BLOCK
        self.assertLess(abs(tips[0] - 0.15), within, tips)
        self.assertTrue(np.all(tips[1:] > lower[1:] - 0.01) and np.all(tips[1:] < upper[1:] + 0.01), tips)
        return reply

    def assert_refused(self, result, *parts):
        """The command fails with an error that has all parts."""
        self.assertNotEqual(result.returncode, 0, result.stdout)
        for part in parts:
            self.assertIn(part, result.stderr)

    def test_depth_images(self):
        for name, scale in self.depths:
            with self.subTest(name):
                self.assert_right(self.detect(name, *scale))
        # The unit in the file of the intrinsics: that of BOP is in millimetres.
        camera = {"cam_K": files.K.flatten().tolist(), "depth_scale": 0.1}
        (self.folder / "tenths.json").write_text(json.dumps(camera))
        self.assert_right(self.detect("tenths.png", k="tenths.json"))

    def test_poses(self):
        for name in self.poses:
            with self.subTest(name):
                self.assert_right(self.detect("depth.png", pose=name))

    def test_intrinsics(self):
        for name in self.intrinsics:
            with self.subTest(name):
                self.assert_right(self.detect("depth.png", k=name))

    def test_point_clouds(self):
        for name, scale in self.clouds:
            with self.subTest(name):
                placed = ["--camera-position", "0,0,0", "--frame-from-cloud", "rows.json", WORKSPACE]
                self.assert_right(self.grasp("detect", name, *placed, *scale, "--origin", "tcp", "--json"))
        placed = ["--camera-position", "0,0,0", "--frame-from-cloud", "rows.json", WORKSPACE]
        self.assert_refused(self.grasp("detect", "float_mm.ply", *placed), "look like millimetres", "(here: --cloud-scale 0.001)")
        self.assert_refused(self.grasp("table", "float_mm.ply", *placed[:2]), "check the depth unit (here: --cloud-scale")
        np.save(self.folder / "micrometres_xyz.npy", np.rint(files.POINTS * 1e6).astype(np.int32))
        micrometres = self.grasp("detect", "micrometres_xyz.npy", *placed)
        self.assert_refused(micrometres, "read as millimetres most are beyond 100 m; give --cloud-scale")
        given = self.grasp("detect", "float_mm.ply", *placed, "--cloud-scale", "0.1")
        self.assert_refused(given, "check the depth unit", "(here: --cloud-scale is 0.1)")

    def test_lenses(self):
        """The depth image of a lens with distortion gives the grasps of one without."""
        for model, d in files.LENSES.items():
            with self.subTest(model):
                np.save(self.folder / "seen.npy", files.distorted(d, model))
                (self.folder / "lens.yaml").write_text(files.camera_info(d=d, model=model))
                self.assert_right(self.detect("seen.npy", k="lens.yaml"))
        # The image is rectified already.
        self.assertIn("add --rectified", self.detect("depth.png", k="lens.yaml").stderr)
        result = self.detect("depth.png", "--rectified", k="lens.yaml")
        self.assert_right(result)
        self.assertEqual(result.stderr, "")
        (self.folder / "lens.yaml").write_text(files.camera_info(d=[0.1] * 4, model="double_sphere"))
        self.assert_refused(self.detect("depth.png", k="lens.yaml"), "double_sphere")

    def test_intrinsics_of_another_resolution_are_refused(self):
        (fx, _, cx), (_, fy, cy), _ = files.K.tolist()
        numbers, size = files.K.flatten().tolist(), {"width": 320, "height": 240}
        texts = {
            "camera_info.yaml": files.camera_info(size=(320, 240)),
            "calibration.yaml": f"image_width: 320\nimage_height: 240\ncamera_matrix: {{rows: 3, cols: 3, data: {numbers}}}\n",
            "open3d.json": json.dumps(size | {"intrinsic_matrix": files.K.T.flatten().tolist()}),
            "librealsense.json": json.dumps(size | {"fx": fx, "fy": fy, "ppx": cx, "ppy": cy}),
        }
        for name, text in texts.items():
            with self.subTest(name):
                (self.folder / f"other_{name}").write_text(text)
                result = self.detect("depth.png", k=f"other_{name}")
                self.assert_refused(result, "320 × 240", "160 × 120", "if the image was scaled")
        (self.folder / "wide.json").write_text(json.dumps({"width": 320, "height": 180, "K": numbers}))
        result = self.detect("depth.png", k="wide.json")
        self.assert_refused(result, "320 × 180", "160 × 120")
        self.assertNotIn("if the image was scaled", result.stderr)

    def test_what_is_in_doubt_is_refused(self):
        (fx, _, cx), (_, fy, cy), _ = files.K.tolist()
        k, one = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}, files.POSE.tolist()
        other = np.linalg.inv(files.POSE).tolist()
        for intrinsics, part in [
            ({"w": 848, "h": 480, **k}, "of 848 × 480 pixels"),
            ({"width": 848, "height": 480, "intrinsics": k}, "of 848 × 480 pixels"),
            ({"cam0": k, "cam1": k | {"fx": 2 * fx}}, "several cameras in the file: cam0, cam1"),
            ({"model": 2, "coeffs": [0.1, 0, 0, 0, 0], **k}, "inverse_brown_conrady"),
            ({"undistortion": [0.1, 0.2], **k}, "`undistortion` is [0.1,0.2], which may be the distortion"),
            ({"image_shape": [480, 640], **k}, "of 640 × 480 pixels"),
            ({"width": 120, "height": 160, **k}, "width and height are exchanged"),
            ({"K": str(files.K.flatten().tolist())}, "`K` is the text"),
            ({}, "no intrinsics found: the file has no keys"),
        ]:
            with self.subTest(intrinsics):
                (self.folder / "doubt.json").write_text(json.dumps(intrinsics))
                self.assert_refused(self.detect("depth.png", k="doubt.json"), part)
        (self.folder / "poses.json").write_text(json.dumps({"T_base_cam": one, "T_cam_base": other}))
        self.assert_refused(self.detect("depth.png", pose="poses.json"), "several poses in the file: T_base_cam, T_cam_base")
        files.exr(self.folder / "two.exr", {"A.Depth.Z": files.DEPTH, "B.Depth.Z": files.DEPTH * 2})
        self.assert_refused(self.detect("two.exr"), "several channels with depths: A.Depth.Z, B.Depth.Z")

    def test_distortions_are_found_wherever_they_are(self):
        d, k = files.LENSES["plumb_bob"], files.K.tolist()
        np.save(self.folder / "seen.npy", files.distorted(d, "plumb_bob"))
        documents = [{"camera_matrix": k, "distCoeffs": [d]}, {"K": k, "k1": d[0], "k2": d[1], "p1": d[2], "p2": d[3]}]
        documents += [{"K": k, "distortion": {"k1": d[0], "k2": d[1], "p1": d[2], "p2": d[3]}}]
        documents += [{"distortion": d, "intrinsics": {"K": k}}, {"K": k, "d": list(map(str, d))}]
        documents += [{"K": k, "RadialDistortion": d[:2], "TangentialDistortion": d[2:4]}, {"K": k, "lens_distortion": d}]
        for document in documents:
            with self.subTest(document):
                (self.folder / "named.json").write_text(json.dumps(document))
                self.assert_right(self.detect("seen.npy", k="named.json"))
        np.savez(self.folder / "lens.npz", mtx=files.K, dist=[d])
        self.assert_right(self.detect("seen.npy", k="lens.npz"))

    def test_depth_scales_that_are_wrong_are_refused(self):
        for scale, advice in [("10000", "did you mean 0.0001?"), ("0", "--depth-scale"), ("nan", "--depth-scale")]:
            with self.subTest(scale):
                self.assert_refused(self.detect("tenths.png", "--depth-scale", scale), advice)
        self.assert_refused(self.detect("tenths.png"), "9.6 × the ", "check the depth unit")
        camera = {"cam_K": files.K.flatten().tolist(), "depth_scale": 0.1}
        (self.folder / "tenths.json").write_text(json.dumps(camera))
        self.assert_refused(self.detect("tenths.png", "--depth-scale", "0.001", k="tenths.json"), "0.001", "0.0001")

    def test_masks(self):
        kinds = ["f2", "f4", "i1", "i2", "u4", "u8"]
        masks = [("bool", files.ON_BLOCK), *((kind, files.ON_BLOCK.astype(kind)) for kind in kinds)]
        for name, mask in [*masks, ("channel", files.ON_BLOCK[..., None])]:
            with self.subTest(name):
                np.save(self.folder / "mask.npy", mask)
                reply = self.assert_right(self.detect("depth.png", "--labels", "mask.npy", "--objects", "1"))
                self.assertEqual({grasp["object"] for grasp in reply["grasps"]}, {1})
        np.save(self.folder / "mask.npy", files.ON_BLOCK[:60])
        self.assert_refused(self.detect("depth.png", "--labels", "mask.npy", "--objects", "1"), "[60, 160]", "120 × 160")

    def test_other_files_are_named(self):
        whole = (self.folder / "channel.npy").read_bytes()
        (self.folder / "cut.npy").write_bytes(whole[: len(whole) // 2])
        self.assert_refused(self.detect("cut.npy"), "cut.npy: the file is cut short")
        files.pickled(self.folder / "dict.npy")
        self.assert_refused(self.detect("dict.npy"), "pickled", 'numpy.save(FILE, data["depth"])')
        self.assert_refused(self.detect("depth.png", k="dict.npy"), "pickled", 'numpy.save(FILE, data["K"])')
        for name, content in NAMED.items():
            (self.folder / "file").write_bytes(content)
            with self.subTest(name):
                result = self.detect("file")
                self.assert_refused(result, name)
                self.assertNotIn("magic", result.stderr)


if __name__ == "__main__":
    unittest.main()
