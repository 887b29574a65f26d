"""Tests the files that `grasp detect` (GRASP) writes for other programs, with parsers like theirs."""

import csv
import json
import os
import subprocess
import tempfile
import unittest
from pathlib import Path

import numpy as np
import scene
import yaml
from server import Server


class ExportTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        server = cls.enterClassContext(Server())
        folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        np.save(folder / "volume.npy", scene.volume(scene.camera(40, -90), scene.camera(40, 90)))
        files = {form: folder / f"grasps.{form}" for form in ["csv", "moveit", "isaac"]}
        command = [os.environ["GRASP"], "detect", folder / "volume.npy", "--threshold", "0.3", "--frame-id", "base", "--json"]
        command += [argument for form, path in files.items() for argument in (f"--{form}", path)]
        environment = {**os.environ, "GRASP_SERVER": server.grpc}
        output = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        cls.grasps = json.loads(output)["grasps"]
        cls.files = {form: path.read_text() for form, path in files.items()}

    def test_there_are_grasps(self):
        self.assertGreater(len(self.grasps), 1)

    def test_csv_files_are_tables(self):
        rows = list(csv.DictReader(self.files["csv"].splitlines()))
        for row, grasp in zip(rows, self.grasps, strict=True):
            self.assertEqual([float(row[axis]) for axis in "xyz"], grasp["position"])
            self.assertEqual([float(row[f"q{axis}"]) for axis in "xyzw"], grasp["orientation_xyzw"])
            self.assertEqual(float(row["width"]), grasp["width"])

    def test_moveit_files_are_lists_of_grasps(self):
        for found, grasp in zip(yaml.safe_load(self.files["moveit"]), self.grasps, strict=True):
            stamped = found["grasp_pose"]
            self.assertEqual(stamped["header"]["frame_id"], "base")
            self.assertEqual([stamped["pose"]["position"][axis] for axis in "xyz"], grasp["position"])
            self.assertEqual([stamped["pose"]["orientation"][axis] for axis in "xyzw"], grasp["orientation_xyzw"])
            self.assertAlmostEqual(found["grasp_quality"], grasp["quality"], places=6)
            at = np.array(grasp["position"])
            ways = {"pre_grasp_approach": at - grasp["pregrasp"]["position"]}
            ways["post_grasp_retreat"] = grasp["retreat"]["position"] - at
            for name, way in ways.items():
                direction, distance = found[name]["direction"], found[name]["desired_distance"]
                self.assertEqual(direction["header"]["frame_id"], "base")
                np.testing.assert_allclose([distance * direction["vector"][axis] for axis in "xyz"], way, atol=1e-7)
                self.assertLess(found[name]["min_distance"], distance)

    def test_isaac_files_have_the_fields_of_the_format(self):
        file = yaml.safe_load(self.files["isaac"])
        self.assertEqual((file["format"], file["format_version"]), ("isaac_grasp", "1.0"))
        self.assertEqual(file["object_frame_link"], "base")
        for found, grasp in zip(file["grasps"].values(), self.grasps, strict=True):
            self.assertAlmostEqual(found["confidence"], grasp["quality"], places=6)
            self.assertEqual(found["position"], grasp["position"])
            orientation = [*found["orientation"]["xyz"], found["orientation"]["w"]]
            self.assertEqual(orientation, grasp["orientation_xyzw"])
            self.assertAlmostEqual(2 * found["cspace_position"]["finger"], grasp["width"])
            self.assertAlmostEqual(2 * found["pregrasp_cspace_position"]["finger"], 0.08)


if __name__ == "__main__":
    unittest.main()
