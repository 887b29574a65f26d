"""Tests the data sets of `grasp-sim` (GRASP_SIM), read and written with pandas and NumPy as in VGN's code."""

import json
import os
import subprocess
import tempfile
import unittest
import uuid
from pathlib import Path

import numpy as np
import pandas as pd

INTRINSIC = {"width": 640, "height": 480, "K": [540.0, 0.0, 320.0, 0.0, 540.0, 240.0, 0.0, 0.0, 1.0]}

# The share of successful repetitions, and the clearance: columns that VGN and GIGA do not have.
MARGINS = ["share", "clearance"]


def sim(*arguments):
    command = [os.environ["GRASP_SIM"], *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode:
        raise RuntimeError(f"{command}: {result.stderr}")
    return result.stdout


class DataTest(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def label(self, form, scenes=4):
        out = self.folder / form
        sim("label", "--scene", "pile", "--scenes", scenes, "--points", 30, "--format", form, "--seed", 5, "--out", out)
        return out

    def test_processed_data_load_with_pandas(self):
        root = self.label("processed")
        grasps = pd.read_csv(root / "grasps.csv")
        self.assertEqual(list(grasps), ["scene_id", "qx", "qy", "qz", "qw", "i", "j", "k", "width", "label", *MARGINS])
        self.assertEqual(len(grasps), 4 * 30)
        self.assertLess(0, grasps["label"].sum())
        self.assertTrue(grasps["label"].isin([0, 1]).all())
        self.assertTrue((grasps.loc[grasps["label"] == 1, "share"].between(0.8, 1)).all())
        self.assertTrue((grasps.loc[grasps["label"] == 0, "share"].between(0, 0.8)).all())
        self.assertTrue(grasps["clearance"].between(0, 0.02).all())
        np.testing.assert_allclose(np.linalg.norm(grasps[["qx", "qy", "qz", "qw"]], axis=1), 1.0, atol=1e-6)
        self.assertTrue((grasps.loc[grasps["label"] == 0, "width"] - 0.08 / 0.0075).abs().max() < 1e-4)
        self.assertTrue(grasps.loc[grasps["label"] == 1, "width"].between(0.008 / 0.0075, 0.08 / 0.0075).all())
        for scene in grasps["scene_id"].unique():
            # As in the code of VGN, which needs names that pandas reads as text.
            with np.load(root / "scenes" / (scene + ".npz")) as archive:
                grid = archive["grid"]
            self.assertEqual((grid.shape, grid.dtype), ((1, 40, 40, 40), np.float32))
            self.assertTrue(0.0 <= grid.min() and grid.max() <= 1.0 and (grid > 0).mean() > 0.02)

    def test_raw_data_load_with_pandas(self):
        root = self.label("raw")
        setup = json.loads((root / "setup.json").read_text())
        self.assertEqual(setup["size"], 0.3)
        self.assertEqual({key: setup["intrinsic"][key] for key in INTRINSIC}, INTRINSIC)
        grasps = pd.read_csv(root / "grasps.csv")
        self.assertEqual(list(grasps), ["scene_id", "qx", "qy", "qz", "qw", "x", "y", "z", "width", "label", *MARGINS])
        self.assertTrue((grasps["width"] <= 0.08).all())
        for scene in grasps["scene_id"].unique():
            with np.load(root / "scenes" / f"{scene}.npz") as archive:
                depth, extrinsics = archive["depth_imgs"], archive["extrinsics"]
            self.assertEqual((depth.dtype, depth.shape), (np.float32, (len(extrinsics), 480, 640)))
            self.assertEqual(extrinsics.shape[1], 7)
            np.testing.assert_allclose(np.linalg.norm(extrinsics[:, :4], axis=1), 1.0, atol=1e-6)

    def test_successful_grasps_are_at_observed_surfaces(self):
        """Index, quaternion and volume are consistent: there is an observed voxel in front of the hand of a success."""
        root = self.label("processed", scenes=8)
        grasps = pd.read_csv(root / "grasps.csv")
        seen = []
        for row in grasps[grasps["label"] == 1].itertuples():
            with np.load(root / "scenes" / f"{row.scene_id}.npz") as archive:
                grid = archive["grid"][0]
            x, y, z, w = row.qx, row.qy, row.qz, row.qw
            approach = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
            tip = np.array([row.i, row.j, row.k]) + approach * 0.05 / 0.0075
            low = np.clip(np.round(tip).astype(int) - 4, 0, 39)
            seen.append((grid[low[0] : low[0] + 9, low[1] : low[1] + 9, low[2] : low[2] + 9] > 0).any())
        self.assertGreater(len(seen), 10)
        self.assertGreater(np.mean(seen), 0.95)

    def test_raw_data_are_converted_to_processed(self):
        raw, fused = self.label("raw"), self.folder / "fused"
        sim("convert", "--from", raw, "--format", "processed", "--out", fused)
        ours = self.label("processed")
        grasps = pd.read_csv(fused / "grasps.csv")
        before = pd.read_csv(raw / "grasps.csv")
        inside = before[["x", "y", "z"]].apply(lambda column: column.between(0.02, 0.28)).all(axis=1)
        np.testing.assert_allclose(grasps[MARGINS], before.loc[inside, MARGINS], atol=1e-6)
        np.testing.assert_allclose(grasps[["i", "j", "k"]], before.loc[inside, ["x", "y", "z"]] / 0.0075, atol=1e-4)
        for scene in grasps["scene_id"].unique():
            with np.load(fused / "scenes" / f"{scene}.npz") as a, np.load(ours / "scenes" / f"{scene}.npz") as b:
                # Poses are f32 in the files, so that a few voxels project to the next pixel.
                self.assertGreater(np.isclose(a["grid"], b["grid"], atol=1e-5).mean(), 0.999)

    def test_data_in_vgns_format_are_converted(self):
        """As written by VGN: no setup.json, compressed archives, scene names that are not numbers, columns by pandas."""
        root, out = self.folder / "vgn", self.folder / "ours"
        (root / "scenes").mkdir(parents=True)
        random, rows, grids = np.random.default_rng(1), [], {}
        for _ in range(3):
            scene = uuid.UUID(bytes=random.bytes(16)).hex
            grids[scene] = random.random((1, 40, 40, 40), dtype=np.float32)
            np.savez_compressed(root / "scenes" / f"{scene}.npz", grid=grids[scene])
            rows += [[scene, 0.0, 0.0, 0.0, 1.0, *random.uniform(3, 37, 3), 5.0, label] for label in (0, 1)]
        columns = ["scene_id", "qx", "qy", "qz", "qw", "i", "j", "k", "width", "label"]
        pd.DataFrame(rows, columns=columns).to_csv(root / "grasps.csv", index=False)

        sim("convert", "--from", root, "--format", "packed", "--out", out)
        back = self.folder / "back"
        sim("convert", "--from", out, "--format", "processed", "--out", back)
        grasps = pd.read_csv(back / "grasps.csv")
        np.testing.assert_allclose(
            grasps[columns[1:]].sort_values("i"), pd.DataFrame(rows, columns=columns)[columns[1:]].sort_values("i"), atol=1e-4
        )
        self.assertTrue((grasps["share"] == grasps["label"]).all() and (grasps["clearance"] == 0).all(), "VGN's data have neither")
        found = sorted(np.load(back / "scenes" / f"{scene}.npz")["grid"].sum() for scene in grasps["scene_id"].unique())
        np.testing.assert_allclose(found, sorted(grid.sum() for grid in grids.values()), rtol=1e-3)


if __name__ == "__main__":
    unittest.main()
