"""Tests the package client/python, installed into an empty folder, against graspd.

    GRASPD=target/release/graspd GRASPD_MODELS=models/zoo ORT_DYLIB_PATH=$(python3 deploy/native.py onnxruntime) \\
    $(python3 tests/tools.py python) -m unittest discover --start-directory tests/python --pattern test_package.py
"""

import asyncio
import atexit
import base64
import itertools
import json
import os
import pickle
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import time
import types
import unittest
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import patch
from xml.etree import ElementTree

import grpc
import numpy as np
import people_files
import scene
from scipy.spatial.transform import Rotation
from server import Server

PACKAGE = Path(__file__).resolve().parents[2] / "client/python"
INSTALLED = tempfile.TemporaryDirectory()
atexit.register(INSTALLED.cleanup)
# Installs the package, with the dependencies that are already installed.
PIP = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--target"]
subprocess.run([*PIP, INSTALLED.name, PACKAGE], check=True)
sys.path.insert(0, INSTALLED.name)

import graspd
import graspd.aio
from graspd import grasp_pb2, wire
from graspd.connection import proxied, with_port

CAMERAS = [scene.camera(30, -90), scene.camera(40, 90)]
LOW = graspd.Options(threshold=0.5)
OPTIONS = ["Options", "Box", "Cone", "Gripper", "CollisionCheck", "Convention", "Retreat"]


def views(cameras=CAMERAS):
    return [graspd.DepthView(scene.depth(pose), scene.K, camera_from_task=pose) for pose in cameras]


def positions(detection):
    return np.array([grasp.pose.position for grasp in detection.grasps])


def readme():
    """The example in the README."""
    (example,) = re.findall(r"```python\n(.*?)```", (PACKAGE / "README.md").read_text(), re.DOTALL)
    return example


class ServerTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.server = cls.enterClassContext(Server("--max-tracked", 1))
        cls.client = cls.enterClassContext(graspd.Client(cls.server.grpc))


class DetectTest(ServerTest):
    def test_the_grasps_are_at_the_block(self):
        found = self.client.detect(scene.volume(*CAMERAS), LOW, request_id="from python")
        self.assertTrue(found.grasps and all(map(scene.is_at_the_block, found.grasps)), found)
        self.assertEqual(list(found.grasps), sorted(found.grasps, key=lambda grasp: -grasp.quality))
        self.assertEqual((found.request_id, found.model, found.stamp), ("from python", "vgn-packed", None))
        self.assertTrue(found.latency.total > found.latency.inference > 0)
        for grasp in found.grasps:
            back = np.linalg.inv(grasp.pose.matrix()) @ grasp.pregrasp.matrix()
            np.testing.assert_allclose(back[:3, 3], [0, 0, -0.05], atol=1e-9)
            self.assertIsNone(grasp.collides)
        best = self.client.detect(scene.volume(*CAMERAS), replace(LOW, max_grasps=1, explain=True))
        self.assertEqual(best.grasps, found.grasps[:1])
        self.assertEqual(best.dropped.over_limit, len(found.grasps) - 1)
        self.assertEqual(sum(vars(best.dropped).values()) + 1, scene.RESOLUTION**3)

    def test_results_are_sequences_with_a_short_repr(self):
        volume = scene.volume(*CAMERAS)
        found = self.client.detect(volume, LOW)
        self.assertEqual((len(found), list(found), found[0]), (len(found.grasps), list(found.grasps), found.grasps[0]))
        self.assertRegex(repr(found), r"^<Detection of \S+ \d: \d+ grasps?, the best with a quality of [01]\.\d\d, \d+ ms>$")
        self.assertEqual(found._repr_html_().count("<tr>"), 1 + min(10, len(found)))
        self.assertFalse(self.client.detect(volume, replace(LOW, threshold=1.0)))
        scores = self.client.score(volume, found)
        self.assertEqual((len(scores), list(scores)), (len(found), list(scores.scores)))
        self.assertRegex(repr(scores), r"^<Scores of \S+ \d: [01]\.\d\d")

    def test_grasps_are_shown_over_the_depth_image(self):
        pose = CAMERAS[0]
        workspace = graspd.Workspace(graspd.Pose((0.1, 0.0, 0.2)))
        frame_from_camera = workspace.pose.matrix() @ np.linalg.inv(pose)
        depth = scene.depth(pose)
        seen = [graspd.DepthView(depth, scene.K, camera_from_task=pose)]
        seen.append(graspd.DepthView(depth, scene.K, frame_from_camera=frame_from_camera))
        found = self.client.detect_from_depth(seen[0], workspace, LOW)
        self.assertGreater(len(found), 1)
        pictures = [found.show(view, workspace.pose, count=1).svg for view in seen]
        ends = []
        for picture in pictures:
            svg = ElementTree.fromstring(picture)
            image, group = svg
            png = base64.b64decode(image.get("href").split(",")[1])
            self.assertEqual(struct.unpack(">IIB", png[16:25]), (scene.WIDTH, scene.HEIGHT, 8))
            self.assertEqual(len(group), 1)
            ends.append(np.array(re.findall(r"[-.\d]+", group[0].get("d")), float).reshape(-1, 2))
        np.testing.assert_allclose(ends[0], ends[1], atol=0.2)
        # The middle of the fingertips is where the depth image shows the block.
        tips = ends[0][[1, 3]].mean(axis=0)
        on_block = np.abs(depth - scene.depth(pose, with_block=False)) > 1e-3
        rows, columns = np.nonzero(on_block)
        self.assertLess(np.hypot(columns - tips[0], rows - tips[1]).min(), 8)
        path = Path(self.enterContext(tempfile.TemporaryDirectory())) / "grasps.svg"
        found.show(seen[0], workspace.pose).save(path)
        self.assertEqual(len(ElementTree.parse(path).getroot()[1]), min(10, len(found)))

    def test_volumes_of_every_dtype_and_memory_order(self):
        values = scene.volume(*CAMERAS)
        steps = np.rint(values * 255).astype(np.uint8)
        for same in [
            [values, values.astype(float), values.astype(">f4"), np.asfortranarray(values), values[None]],
            [values.astype(np.float16), graspd.Volume(values, dtype=np.float16)],
            [steps, graspd.Volume(values, dtype=np.uint8), graspd.Volume(steps / 255, dtype="f4")],
        ]:
            first, *others = [self.client.detect(volume, LOW).grasps for volume in same]
            self.assertTrue(first and all(map(scene.is_at_the_block, first)))
            for other in others:
                self.assertEqual(other, first)

    def test_grasps_are_in_the_volumes_frame_with_its_stamp(self):
        pose = graspd.Pose((0.5, -0.2, 0.1), (0.0, 0.0, 0.6, 0.8))
        own = self.client.detect(scene.volume(*CAMERAS), LOW)
        for given in [pose, pose.matrix()]:
            volume = graspd.Volume(scene.volume(*CAMERAS), pose=given, frame_id="base", stamp=1_700_000_000_123_456_789)
            moved = self.client.detect(volume, LOW)
            self.assertEqual((moved.frame_id, moved.stamp), ("base", volume.stamp))
            for grasp, other in zip(own.grasps, moved.grasps, strict=True):
                np.testing.assert_allclose(other.pose.matrix(), pose.matrix() @ grasp.pose.matrix(), atol=1e-6)

    def test_depth_images_give_the_grasps_of_their_volume(self):
        pose = graspd.Pose((0.4, 0.0, 1.1), (0.0, 0.0, 0.6, 0.8))
        workspace = graspd.Workspace(pose, size=0.3, frame_id="base", stamp=7)
        expected = self.client.detect(graspd.Volume(scene.volume(*CAMERAS), pose=pose), LOW)
        found = self.client.detect_from_depth(views(), workspace, LOW)
        np.testing.assert_allclose(positions(found), positions(expected), atol=1e-6)
        self.assertEqual((found.frame_id, found.stamp), ("base", 7))
        self.assertTrue(found.latency.total > found.latency.fusion > 0)

        # Poses from hand-eye calibration, depth in millimetres.
        millimetres = [
            graspd.DepthView(
                np.rint(scene.depth(camera) * 1e3).astype(np.uint16),
                scene.K,
                frame_from_camera=pose.matrix() @ np.linalg.inv(camera),
            )
            for camera in CAMERAS
        ]
        rounded = self.client.detect_from_depth(millimetres, workspace, LOW)
        np.testing.assert_allclose(positions(rounded)[0], positions(found)[0], atol=0.01)

    def test_the_table_is_found_without_a_camera_pose(self):
        (camera, _), depth = CAMERAS, scene.depth(CAMERAS[0])
        # A single view, as an array of any type.
        view = graspd.DepthView(np.rint(1000 * depth).astype(np.int32), scene.K)
        found = self.client.find_table(view)
        camera_from_task = found.workspace.matrix()
        up = np.linalg.inv(camera)[:3, :3] @ camera_from_task[:3, 2]
        self.assertGreater(up[2], np.cos(np.radians(1)))
        self.assertAlmostEqual(found.angle, np.radians(30), delta=0.02)
        self.assertGreater(found.share, 0.5)
        self.assertIsNone(found.tilt)
        detected = self.client.detect_from_depth(view, graspd.Workspace(find_table=True, frame_id="camera"), LOW)
        self.assertEqual((detected.table, detected.warnings, detected.frame_id), (found, (), "camera"))
        between = positions(detected)[0] + 0.03 * detected.grasps[0].pose.matrix()[:3, 2]
        at = np.linalg.inv(camera) @ [*between, 1]
        self.assertTrue(np.all(at[:3] > scene.BLOCK[0] - 0.04) and np.all(at[:3] < scene.BLOCK[1] + 0.04), at)
        # In the robot's frame, with gravity.
        frame_from_camera = np.linalg.inv(camera)
        view = graspd.DepthView(depth, scene.K, frame_from_camera=frame_from_camera)
        found = self.client.find_table(view, graspd.Workspace(gravity=(0, 0, -9.8)), table_height=0.02)
        self.assertLess(found.tilt, np.radians(1))
        self.assertAlmostEqual(found.workspace.position[2], scene.TABLE - 0.02, delta=0.004)
        with self.assertRaisesRegex(graspd.InvalidArgument, "view.data: the largest level plane"):
            self.client.find_table(view, graspd.Workspace(gravity=(1, 0, 0)))
        with self.assertRaisesRegex(graspd.InvalidArgument, "table_height is -1, must be from 0 to 0.3 m"):
            self.client.find_table(view, table_height=-1)

    def test_the_table_is_found_in_a_point_cloud(self):
        depth = scene.depth(CAMERAS[0])
        v, u = np.indices(depth.shape)
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(scene.K).T
        cloud = graspd.CloudView((rays * depth[..., None])[depth > 0], (0, 0, 0))
        found = self.client.find_table(cloud)
        table = np.linalg.inv(CAMERAS[0]) @ found.workspace.matrix() @ [0.15, 0.15, 0.05, 1]
        self.assertAlmostEqual(table[2], scene.TABLE, delta=0.004)
        detected = self.client.detect_from_cloud(cloud, graspd.Workspace(find_table=True), LOW)
        self.assertEqual(detected.table, found)

    def test_a_png_gives_the_same_grasps(self):
        millimetres = [np.rint(scene.depth(camera) * 1e3).astype(np.uint16) for camera in CAMERAS]
        detections = [
            self.client.detect_from_depth(
                [
                    graspd.DepthView(depth, scene.K, camera_from_task=camera, png=png)
                    for depth, camera in zip(millimetres, CAMERAS, strict=True)
                ],
                options=LOW,
            )
            for png in (False, True)
        ]
        self.assertTrue(detections[0].grasps)
        self.assertEqual(detections[0].grasps, detections[1].grasps)
        with self.assertRaisesRegex(ValueError, "png needs integer depths"):
            self.client.detect_from_depth(replace(views()[0], png=True))

    def test_labels_tell_the_object_of_a_grasp(self):
        def labelled(label):
            # The block is higher than 1 cm above the table in both views.
            for camera, view in zip(CAMERAS, views(), strict=True):
                rows, columns = np.indices(view.depth.shape)
                rays = np.linalg.inv(scene.K) @ np.stack([columns, rows, np.ones_like(rows)]).reshape(3, -1)
                points = np.linalg.inv(camera) @ np.vstack([rays * view.depth.reshape(-1), np.ones(rows.size)])
                height = points[2].reshape(rows.shape)
                yield replace(view, labels=np.where((view.depth > 0) & (height > 0.06), label, 0))

        for label in (7, 700):
            found = self.client.detect_from_depth(labelled(label), options=replace(LOW, objects=[label]))
            self.assertTrue(found.grasps)
            self.assertEqual({grasp.object for grasp in found.grasps}, {label})
            with self.assertRaisesRegex(graspd.InvalidArgument, f"options.objects: no pixel .* the label {label + 1}"):
                self.client.detect_from_depth(labelled(label), options=replace(LOW, objects=[label + 1]))
            one = self.client.detect_from_depth(labelled(label), options=replace(LOW, max_grasps_per_object=1))
            self.assertEqual(one.grasps, found.grasps[:1])
        with self.assertRaisesRegex(graspd.InvalidArgument, "options.objects: object 7 needs views with labels"):
            self.client.detect_from_depth(views(), options=replace(LOW, objects=[7]))
        with self.assertRaisesRegex(ValueError, "labels must have the shape of depth"):
            replace(views()[0], labels=np.zeros(5, int))
        with self.assertRaisesRegex(ValueError, "labels must be from 0 to 65535, got -1 to -1"):
            self.client.detect_from_depth(replace(views()[0], labels=np.full(scene.depth(CAMERAS[0]).shape, -1)))

    def test_a_large_workspace_contains_the_grasps_of_the_block(self):
        workspace = graspd.Workspace(graspd.Pose((-0.2, -0.1, 0.0)), extent=(0.7, 0.5))
        frame_from_camera = [np.linalg.inv(camera) for camera in CAMERAS]
        given = [
            graspd.DepthView(scene.depth(camera), scene.K, frame_from_camera=pose)
            for camera, pose in zip(CAMERAS, frame_from_camera, strict=True)
        ]
        found = self.client.detect_from_depth(given, workspace, LOW)
        self.assertTrue(found.grasps and all(map(scene.is_at_the_block, found.grasps)), found)
        with self.assertRaisesRegex(graspd.InvalidArgument, "workspace.extent.x is 2.5, must be above 0"):
            self.client.detect_from_depth(given, replace(workspace, extent=(2.5, 0.5)), LOW)

    def test_own_grasps_are_scored(self):
        found = self.client.detect_from_depth(views(), options=LOW)
        poses = [graspd.Pose((3.0, 0.0, 0.0)), *(grasp.pose for grasp in found.grasps)]
        check = replace(LOW, collision=graspd.CollisionCheck("flag", clearance=0.001))
        scores = self.client.score(views(), poses, options=check, request_id="mine")
        self.assertEqual((scores.request_id, scores.model, len(scores.scores)), ("mine", found.model, len(poses)))
        self.assertEqual((scores.scores[0].quality, scores.scores[0].violations), (0.0, ("QUALITY", "REGION", "COLLISION")))
        for score, grasp in zip(scores.scores[1:], found.grasps, strict=True):
            self.assertAlmostEqual(score.quality, grasp.quality, places=3)
            self.assertTrue(set(score.violations) <= {"COLLISION"}, score)
        of_volume = self.client.score(scene.volume(*CAMERAS), poses, options=LOW)
        self.assertAlmostEqual(of_volume.scores[1].quality, scores.scores[1].quality, places=3)
        self.assertIsNone(of_volume.scores[1].open_width)
        with self.assertRaisesRegex(graspd.InvalidArgument, "candidates has 0 entries"):
            self.client.score(views(), [])

    def test_arrays_of_other_libraries_are_read(self):
        pose = CAMERAS[0]
        depth = scene.depth(pose)
        mask = np.isfinite(depth) & (depth > 0)
        projection = np.hstack([scene.K, np.zeros((3, 1))])

        def found(depth, k=scene.K, labels=None):
            view = graspd.DepthView(depth, k, camera_from_task=pose, labels=labels)
            return positions(self.client.detect_from_depth(view, options=LOW))

        expected = found(depth, labels=mask.astype(np.uint8))
        self.assertGreater(len(expected), 0)
        for name, again in {
            "H × W × 1, 3 × 4": found(depth[..., None], projection, mask[..., None]),
            "bool": found(depth, labels=mask),
            "float": found(depth, labels=mask.astype(np.float64)),
            "masked": found(np.ma.masked_array(np.where(mask, depth, 0.3), mask=~mask), labels=mask),
        }.items():
            with self.subTest(name):
                np.testing.assert_array_equal(again, expected)
        with self.assertRaisesRegex(ValueError, "whole numbers or truth values, got 0.5"):
            found(depth, labels=mask * 0.5)
        with self.assertRaisesRegex(ValueError, "the fourth column is"):
            found(depth, projection + [0, 0, 0, 1])

    def test_structured_and_coloured_point_clouds_are_read(self):
        pose = graspd.Pose.from_matrix(np.linalg.inv(CAMERAS[0]))
        points = scene.cloud(CAMERAS[0])[:-1]
        structured = np.zeros(len(points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<f4")])
        structured["x"], structured["y"], structured["z"] = points.T

        def found(points):
            view = graspd.CloudView(points, (0, 0, 0), frame_from_cloud=pose)
            return positions(self.client.detect_from_cloud(view, options=LOW))

        expected = found(points)
        self.assertGreater(len(expected), 0)
        far = np.vstack([points, [[0, 0, 0.2]]])
        millimetres = graspd.CloudView(np.rint(points * 1e4).astype(np.int32), (0, 0, 0), frame_from_cloud=pose, scale=1e-4)
        found_in_millimetres = positions(self.client.detect_from_cloud(millimetres, options=LOW))
        np.testing.assert_allclose(found_in_millimetres[0], expected[0], atol=0.005)
        for wrong in [0, -1, np.nan, "mm"]:
            with self.assertRaisesRegex(ValueError, "0.001 for points in millimetres"):
                graspd.CloudView(points, (0, 0, 0), scale=wrong)
        for name, again in {
            "structured": found(structured),
            "coloured": found(np.hstack([points, points])),
            "masked": found(np.ma.masked_array(far, mask=far[:, 2:] == 0.2 * np.ones(3))),
        }.items():
            with self.subTest(name):
                np.testing.assert_array_equal(again, expected)
        with self.assertRaisesRegex(ValueError, "the fields x, y and z, got x, y"):
            found(structured[["x", "y"]])

    def test_a_server_on_this_machine_is_called_without_the_proxy(self):
        code = "import sys, graspd; print(graspd.Client(sys.argv[1]).health(), graspd.aio.__name__, graspd.__version__)"
        environment = os.environ | {"http_proxy": "http://127.0.0.1:9", "PYTHONPATH": INSTALLED.name}
        command = [sys.executable, "-c", code, self.server.grpc]
        run = subprocess.run(command, env=environment, capture_output=True, text=True)
        self.assertEqual(run.stdout.split()[:2], ["True", "graspd.aio"], run.stderr)
        for address in ["LOCALHOST:50051", "0.0.0.0:50051", "127.0.0.1:50051", "unix:/run/graspd.sock"]:
            with self.subTest(address), patch.dict(os.environ, {"http_proxy": "http://127.0.0.1:9"}):
                self.assertEqual(proxied(address), "")
        for variables, expected in [
            ({"http_proxy": "http://user:secret@127.0.0.1:9"}, "proxy 127.0.0.1:9 of the variable http_proxy.* no_proxy=192.0.2.1$"),
            ({"https_proxy": "http://127.0.0.1:9", "no_proxy": "robot,192.0.3.0/24"}, "the variable https_proxy"),
            ({"http_proxy": "http://127.0.0.1:9", "no_proxy": "192.0.2.0/24"}, "^$"),
        ]:
            with self.subTest(variables), patch.dict(os.environ, variables, clear=True):
                self.assertRegex(proxied("192.0.2.1:50051"), expected)
                client = graspd.Client("192.0.2.1:50051", retry=graspd.Retry.NONE, timeout=5)
                with client, self.assertRaisesRegex(graspd.Error, expected.lstrip("^")):
                    client.health()
        self.assertIn(f'version = "{run.stdout.split()[2]}"', (PACKAGE / "pyproject.toml").read_text())

    def test_wrong_geometry_is_reported_and_logged_once(self):
        wire.logged.clear()
        view, height = views()[:1], graspd.Options(collision=graspd.CollisionCheck("off", table_height=0.02))
        self.assertEqual(self.client.detect_from_depth(view, graspd.Workspace()).warnings, ())
        with self.assertLogs("graspd", "WARNING") as logged:
            for _ in range(2):
                (warning,) = self.client.detect_from_depth(view, graspd.Workspace(), height).warnings
        self.assertEqual((warning.code, warning.view), ("TABLE_HEIGHT", None))
        self.assertAlmostEqual(warning.figures["height_m"], scene.TABLE, delta=0.005)
        (line,) = logged.output
        self.assertIn(warning.message, line)

    def test_point_clouds_give_grasps_at_the_block(self):
        clouds = [graspd.CloudView(scene.cloud(pose), (0, 0, 0), np.linalg.inv(pose)) for pose in CAMERAS]
        for model in ["vgn-packed", "gpd", "shaf"]:
            found = self.client.detect_from_cloud(clouds, options=graspd.Options(model=model))
            self.assertTrue(found.grasps and all(map(scene.is_at_the_block, found.grasps)), found)
            self.assertEqual(found.model, model)

    def test_models_are_listed(self):
        network, gpd, shaf = self.client.models()
        self.assertEqual([network.name, gpd.name, shaf.name], ["vgn-packed", "gpd", "shaf"])
        self.assertEqual((network.resolution, network.provider, shaf.resolution), (scene.RESOLUTION, "cpu", 0))
        self.assertAlmostEqual(network.voxel_size, 0.0075)
        self.assertIn(network.voxel_origin, ["corner", "center"])
        self.assertEqual((shaf.voxel_origin, network.camera_azimuth, shaf.camera_azimuth), ("", None, None))
        self.assertTrue(network.sha256 and network.provenance and self.client.health())


class OptionsTest(ServerTest):
    def detect(self, **options):
        options = graspd.Options(**{"model": "shaf", "explain": True, **options})
        return self.client.detect_from_depth(views(), options=options)

    def tips(self, found, finger_depth=0.05):
        return np.array([(grasp.pose.matrix() @ [0, 0, finger_depth, 1])[:3] for grasp in found.grasps])

    def test_region_approach_and_height_are_respected(self):
        every = self.detect()
        inside = self.detect(region=graspd.Box((0.1, 0.0, 0.0), np.array([0.2, 0.15, 0.3])))
        self.assertTrue(0 < len(inside.grasps) < len(every.grasps) and inside.dropped.region > 0)
        self.assertTrue((self.tips(inside)[:, 1] <= 0.15).all())
        steep = self.detect(approach=graspd.Cone((0, 0, -3), 0.3))
        self.assertTrue(0 < len(steep.grasps) < len(every.grasps) and steep.dropped.approach > 0)
        self.assertTrue(all(grasp.pose.matrix()[2, 2] <= -np.cos(0.3) for grasp in steep.grasps))
        high = self.detect(min_height=0.12)
        self.assertTrue(0 < len(high.grasps) < len(every.grasps) and high.dropped.height > 0)
        self.assertTrue((self.tips(high)[:, 2] >= 0.1199).all())

    def test_colliding_grasps_are_flagged_or_dropped(self):
        off, flagged, filtered, buried = (
            self.detect(model="vgn-packed", threshold=0.1, collision=graspd.CollisionCheck(*check))
            for check in [("off",), ("flag",), ("filter",), ("flag", 0.3)]
        )
        free = [grasp for grasp in flagged.grasps if not grasp.collides]
        self.assertTrue(0 < len(free) < len(flagged.grasps))
        self.assertEqual([replace(grasp, collides=None, open_width=None) for grasp in flagged.grasps], list(off.grasps))
        left = {grasp.pose.position for grasp in filtered.grasps}
        self.assertLessEqual({grasp.pose.position for grasp in free}, left, "neighbours of dropped grasps may be added")
        self.assertGreaterEqual(filtered.dropped.collision, len(flagged.grasps) - len(free))
        self.assertTrue(all(grasp.collides for grasp in buried.grasps), "the table is above all grasps")

    def test_poses_have_the_requested_convention(self):
        own = self.detect()
        up = graspd.Retreat(0.2, direction=(0, 0, 1))
        tcp = self.detect(convention=graspd.Convention("tcp", "x"), pregrasp_distance=0.12, retreat=up)
        flange = graspd.Pose((0.0, 0.0, 0.1034))
        parent = self.detect(convention=graspd.Convention("parent", parent_from_grasp=flange))
        rotation = Rotation.from_euler("z", 90, degrees=True).as_matrix()
        for grasp, actual, link in zip(own.grasps, tcp.grasps, parent.grasps, strict=True):
            hand = np.linalg.inv(grasp.pose.matrix())
            offset = hand @ actual.pose.matrix()
            np.testing.assert_allclose(offset[:3, 3], [0, 0, 0.05], atol=1e-6)
            np.testing.assert_allclose(offset[:3, :3], rotation, atol=1e-6)
            np.testing.assert_allclose((hand @ actual.pregrasp.matrix())[:3, 3], [0, 0, 0.05 - 0.12], atol=1e-6)
            lifted = np.subtract(actual.retreat.position, actual.pose.position)
            np.testing.assert_allclose(lifted, [0, 0, 0.2], atol=1e-6)
            np.testing.assert_allclose(hand @ link.pose.matrix() @ flange.matrix(), np.eye(4), atol=1e-6)

    def test_the_fingertips_do_not_depend_on_the_finger_depth(self):
        palm = graspd.Box((-0.02, -0.05, -0.1), (0.02, 0.05, 0.0))
        unchecked = {"model": "vgn-packed", "collision": graspd.CollisionCheck("off")}
        own = self.detect(**unchecked)
        found = self.detect(**unchecked, gripper=graspd.Gripper(0.08, 0.1, 0.01, 0.02, palm))
        np.testing.assert_allclose(self.tips(found, 0.1), self.tips(own), atol=1e-6)
        narrow = self.detect(**unchecked, gripper=graspd.Gripper(0.04, 0.05, 0.01, 0.02))
        self.assertTrue(0 < len(narrow.grasps) < len(own.grasps) and narrow.dropped.width > 0)


class ErrorsTest(ServerTest):
    def test_errors_name_the_field(self):
        volume, view = scene.volume(*CAMERAS), views()[0]
        unseen = volume.copy()
        unseen[1, 2, 3] = np.nan
        detect, from_depth = self.client.detect, self.client.detect_from_depth
        parent = graspd.Convention("parent")
        long = graspd.Pose(quaternion=(0, 0, 0, 2))
        for call, field in [
            (lambda: detect(unseen), "volume.data"),
            (lambda: detect(graspd.Volume(volume, voxel_size=0.01)), "volume.voxel_size"),
            (lambda: detect(graspd.Volume(volume, pose=long)), "volume.pose.orientation"),
            (lambda: detect(volume, graspd.Options(threshold=2.0)), "options.threshold"),
            (lambda: detect(volume, graspd.Options(region=graspd.Box((0, 0, 1), (1, 1, 0)))), "options.region.max.z"),
            (lambda: detect(volume, graspd.Options(convention=parent)), "options.convention.parent_from_grasp"),
            (lambda: from_depth([view, replace(view, k=view.k.T)]), "views[1].camera.k"),
            (lambda: from_depth([]), "views"),
            (lambda: from_depth([view], graspd.Workspace(size=0.5)), "workspace.size"),
        ]:
            with self.subTest(field), self.assertRaises(graspd.InvalidArgument) as caught:
                call()
            error = caught.exception
            self.assertEqual((error.field, error.code), (field, grpc.StatusCode.INVALID_ARGUMENT))
            self.assertTrue(error.message.startswith(field) and error.request_id)
            self.assertEqual(vars(pickle.loads(pickle.dumps(error))), vars(error))

    def test_missing_models(self):
        volume, there_are = scene.volume(*CAMERAS), "NOT_FOUND: .* available: vgn-packed [0-9.]+, .*gpd 1, shaf 1"
        for field, options in [
            ("options.model", graspd.Options(model="missing")),
            ("options.version", graspd.Options(model="shaf", version="0")),
        ]:
            with self.subTest(field), self.assertRaisesRegex(graspd.NotFound, there_are) as caught:
                self.client.detect(volume, options, request_id="mine")
            (in_a_stream,) = self.client.detect_stream([volume], options)
            self.assertIsInstance(in_a_stream, graspd.NotFound)
            for error in [caught.exception, in_a_stream]:
                self.assertEqual(error.field, field)
            self.assertEqual(caught.exception.request_id, "mine")

    def test_invalid_arguments_raise_value_errors(self):
        volume, depth, pose = scene.volume(*CAMERAS), scene.depth(CAMERAS[0]), np.eye(4)
        for call, expected in [
            (lambda: graspd.Volume(volume[:-1]), r"must be a cube .* got shape \(39, 40, 40\)"),
            (lambda: graspd.Volume(np.zeros((0, 0, 0))), "must be a cube"),
            (lambda: graspd.DepthView(depth[None], scene.K, camera_from_task=pose), "row"),
            (lambda: graspd.DepthView(depth, scene.K, camera_from_task=pose, frame_from_camera=pose), "got both"),
            (lambda: graspd.CloudView(depth, (0, 0, 0)), "x, y, z"),
            (lambda: graspd.Pose.from_matrix(2 * pose), "a rotation and a translation"),
            (lambda: graspd.Pose.from_matrix(pose[:3]), "4 × 4"),
            (lambda: self.client.detect(graspd.Volume(volume, dtype=int)), "is int64, must be float32"),
            (lambda: self.client.detect(graspd.Volume(2 * volume, dtype=np.uint8)), r"in \[0, 1\]"),
            (lambda: self.client.detect_from_depth([replace(views()[0], depth=depth > 0)]), "got bool"),
            (lambda: self.client.detect_from_depth([replace(views()[0], depth=depth.astype(int) - 1)]), "from 0 to 65535"),
            (lambda: graspd.CollisionCheck("never"), "mode is 'never', must be one of 'off', 'flag', 'filter'"),
            (lambda: graspd.Convention("wrist"), "origin is 'wrist', must be one of 'finger_base'"),
            (lambda: graspd.Options(priority="high"), "priority is 'high', must be one of 'normal', 'batch'"),
            (lambda: graspd.Options(max_grasps=-1), "Options.max_grasps is -1, must be from 0 to"),
            (lambda: graspd.Options(objects=[3, -7]), "Options.objects is -7, must be from 0 to"),
            (lambda: graspd.Client("127.0.0.1:1", timeout=-1), "timeout is -1, must be greater than 0 seconds"),
            (lambda: self.client.detect(volume, timeout=0), "timeout is 0, must be greater than 0 seconds"),
            (lambda: graspd.Client("127.0.0.1:1", tls_cert="a.pem"), "must be given together"),
            (lambda: graspd.Client("127.0.0.1:1", token=" "), "token is empty"),
            (lambda: graspd.Client("127.0.0.1:1", token="two\nlines"), "token"),
        ]:
            with self.subTest(expected), self.assertRaisesRegex(ValueError, expected):
                call()

    def test_arguments_of_a_wrong_type_raise_type_errors(self):
        for call, expected in [
            (lambda: graspd.Options(collision="filter"), r'collision is .filter., must be a graspd.CollisionCheck, such as'),
            (lambda: graspd.Options(convention="tcp"), r"must be a graspd.Convention"),
            (lambda: graspd.Options(region=((0, 0, 0), (1, 1, 1))), r"must be a graspd.Box"),
            (lambda: graspd.Options(max_grasps=2.5), r"Options.max_grasps is 2.5, must be an integer"),
            (lambda: graspd.Options(threshold="0.5"), r"Options.threshold is '0.5', must be a number"),
            (lambda: graspd.Options(objects=7), r"Options.objects is 7, must be a list of labels"),
            (lambda: graspd.CollisionCheck(clearance=True), r"CollisionCheck.clearance is True, must be a number"),
            (lambda: graspd.Client("127.0.0.1:1", timeout="10"), r"timeout is '10', must be a number of seconds"),
        ]:
            with self.subTest(expected), self.assertRaisesRegex(TypeError, expected):
                call()

    def test_passed_deadlines_and_unreachable_servers(self):
        volume = scene.volume(*CAMERAS)
        with graspd.Client(self.server.grpc, timeout=1e-4) as client, self.assertRaises(graspd.DeadlineExceeded):
            client.detect(volume)
        with self.assertRaises(graspd.DeadlineExceeded):
            self.client.detect(volume, timeout=1e-4)
        with graspd.Client("127.0.0.1:1", retry=graspd.Retry.NONE) as client:
            with self.assertRaisesRegex(graspd.Unavailable, "check the address and that graspd runs there"):
                client.detect(volume)

    def test_something_else_at_the_address_is_named(self):
        for address, expected in [
            (self.server.http, "the address may be the port for HTTP"),
            (f"https://{self.server.grpc}", "the server does not use TLS"),
        ]:
            with self.subTest(address), graspd.Client(address, retry=graspd.Retry.NONE) as client:
                with self.assertRaisesRegex(graspd.Unavailable, expected):
                    client.models()

    def test_a_closed_client_makes_no_calls(self):
        client = graspd.Client(self.server.grpc)
        client.close()
        with self.assertRaisesRegex(ValueError, "the client is closed"):
            client.health()

    def test_the_port_of_an_address_without_one_is_50051(self):
        for address, expected in [
            ("robot", "robot:50051"), ("robot:1", "robot:1"), ("[::1]", "[::1]:50051"), ("unix:/run/graspd.sock", None),
            ("127.0.0.1:", "127.0.0.1:50051"), ("[::1]:7", None), ("dns:///robot:1", None), ("dns:robot", "dns:robot:50051"),
            ("ipv4:10.0.0.1:50051,10.0.0.2", "ipv4:10.0.0.1:50051,10.0.0.2:50051"),
        ]:
            self.assertEqual(with_port(address), expected or address)
        for address, message in [
            ("127.0.0.1:99999", "the port of the address is 99999"), ("robot:x", "the port of the address is x"),
            ("ftp://robot:1", "begins with ftp://"),
        ]:
            with self.assertRaisesRegex(ValueError, message):
                graspd.Client(address)
        for arguments, message in [
            ({"address": None}, "address is None, must be a text"), ({"address": 23001}, "address is 23001, must be a text"),
            ({"retry": 3}, "retry is 3, must be a graspd.Retry"), ({"token": 3}, "token is 3, must be a text"),
        ]:
            with self.assertRaisesRegex(TypeError, message):
                graspd.Client(**{"address": "robot"} | arguments)
        with self.assertRaisesRegex(ValueError, "timeout is inf, must be finite"):
            graspd.Client("robot", timeout=float("inf"))

    def test_arguments_of_another_type_are_named(self):
        view = views()[0]
        cloud = graspd.CloudView(np.ones((5, 3)), (0, 0, 0))
        for call, message in [
            (lambda: self.client.detect_from_depth(view, options={"threshold": 1}), "options is .*, must be a graspd.Options"),
            (lambda: self.client.detect_from_depth(view, options="fast"), "options is 'fast', must be a graspd.Options"),
            (lambda: self.client.detect_from_depth(view, np.eye(4)), "workspace is .*, must be a graspd.Workspace"),
            (lambda: self.client.detect_from_depth(view, workspace=None), "workspace is None, must be a graspd.Workspace"),
            (lambda: self.client.detect_from_depth("view"), "views is 'view', must be a graspd.DepthView"),
            (lambda: self.client.detect_from_depth({"depth": 1}), "views is .*, must be a graspd.DepthView"),
            (lambda: self.client.detect_from_depth(cloud), "views is .*, must be a graspd.DepthView"),
            (lambda: self.client.detect_from_cloud([view]), "views is .*, must be a graspd.CloudView"),
            (lambda: self.client.detect_from_depth(view, request_id=3), "request_id is 3, must be a text"),
            (lambda: graspd.Options(model=3), "Options.model is 3, must be a text"),
            (lambda: graspd.DepthView(view.depth, {"fx": 1}, camera_from_task=CAMERAS[0]), "k is .*, must be a 3 × 3 matrix or"),
            (lambda: self.client.detect_from_depth(replace(view, camera_from_task="c.json")), "camera_from_task: a pose is 'c.json'"),
            (lambda: self.client.detect(graspd.Volume(scene.volume(*CAMERAS), pose=((0, 0, 0), (0, 0, 0, 1)))), "Volume.pose: a pose is"),
            (lambda: graspd.Options(explain="no"), "Options.explain is 'no', must be True or False"),
            (lambda: graspd.CollisionCheck(hidden="yes"), "CollisionCheck.hidden is 'yes', must be True or False"),
        ]:
            with self.subTest(message), self.assertRaisesRegex(TypeError, message):
                call()
        for make, message in [
            (lambda: graspd.Options(threshold=-0.1), "Options.threshold is -0.1, must not be negative"),
            (lambda: graspd.CollisionCheck(clearance=-1), "CollisionCheck.clearance is -1, must not be negative"),
            (lambda: graspd.CloudView(np.ones((5, 3)), None), "camera_position is None, must be x, y, z"),
            (lambda: graspd.Picture("<svg/>").save("p.png"), "p.png: the picture is SVG"),
            (lambda: graspd.Camera(scene.K, size=320), "size is 320, must be the width and the height"),
            (lambda: graspd.Camera(scene.K, depth_scale="mm"), "depth_scale is 'mm', must be the unit"),
        ]:
            with self.subTest(message), self.assertRaisesRegex(ValueError, message):
                make()


class StreamTest(ServerTest):
    def test_replies_are_in_order(self):
        volume = scene.volume(*CAMERAS)
        volumes = [graspd.Volume(volume if i != 3 else 2 * volume, frame_id=str(i)) for i in range(8)]
        answers = list(self.client.detect_stream(iter(volumes), LOW))
        refused = answers.pop(3)
        self.assertIsInstance(refused, graspd.InvalidArgument)
        self.assertTrue(refused.message.startswith("volume.data[") and refused.request_id)
        self.assertEqual(refused.field, "volume.data")
        self.assertEqual([answer.frame_id for answer in answers], [str(i) for i in range(8) if i != 3])
        self.assertTrue(all(answer.grasps == answers[0].grasps for answer in answers))

    def test_an_error_of_the_iterable_is_raised_after_the_replies(self):
        def volumes():
            yield scene.volume(*CAMERAS)
            raise OSError("the camera is unplugged")

        answers = self.client.detect_stream(volumes(), LOW)
        self.assertTrue(next(answers).grasps)
        with self.assertRaisesRegex(OSError, "unplugged"):
            next(answers)

    def test_a_server_that_shuts_down_ends_the_stream_with_an_error(self):
        with Server() as server, graspd.Client(server.grpc) as client:
            answers = client.detect_stream(itertools.repeat(scene.volume(*CAMERAS)))
            next(answers)
            server.process.terminate()
            with self.assertRaises(graspd.Unavailable):
                list(answers)

    def test_a_stream_can_be_abandoned(self):
        for _ in self.client.detect_stream(itertools.repeat(scene.volume(*CAMERAS))):
            break
        self.assertTrue(self.client.detect(scene.volume(*CAMERAS), LOW).grasps)


TRACKED = "graspd_tracked_volumes"


class TrackTest(ServerTest):
    def wait_until_none_is_tracked(self):
        while self.server.metric(TRACKED):
            time.sleep(0.01)

    def test_each_view_is_added_to_those_before_it(self):
        cameras = [scene.camera(40, azimuth) for azimuth in (-90, 0, 90)]
        workspace = graspd.Workspace(np.linalg.inv(scene.camera(40, 0)), frame_id="base", stamp=7)
        with self.client.track(workspace) as tracking:
            for seen, view in enumerate(views(cameras), 1):
                kept = tracking.add([view], LOW if seen == 1 else None, stamp=None if seen == 1 else 10 * seen)
                expected = self.client.detect_from_depth(views(cameras[:seen]), workspace, LOW)
                self.assertTrue(kept.grasps)
                np.testing.assert_allclose(positions(kept), positions(expected), atol=1e-9)
                self.assertEqual((kept.frame_id, self.server.metric(TRACKED)), ("base", 1))
                self.assertEqual(kept.stamp, 7 if seen == 1 else 10 * seen)
            self.assertEqual(tracking.add(options=replace(LOW, max_grasps=1)).grasps, kept.grasps[:1])
        self.wait_until_none_is_tracked()

    def test_a_volume_with_a_half_life_forgets(self):
        nothing = graspd.DepthView(scene.depth(CAMERAS[0], with_block=False), scene.K, camera_from_task=CAMERAS[0])
        for half_life, remains in [(None, True), (4.0, False)]:
            with self.client.track(half_life=half_life) as tracking:
                self.assertTrue(tracking.add(views()[:1] * 6, LOW).grasps)
                self.assertEqual(bool(tracking.add([nothing] * 12, LOW).grasps), remains, half_life)
            self.wait_until_none_is_tracked()
        with (
            self.client.track(half_life=0) as tracking,
            self.assertRaisesRegex(graspd.InvalidArgument, "half_life is 0, must be from 0.5 to 10000 views"),
        ):
            tracking.add(views(), LOW)
        self.wait_until_none_is_tracked()

    def test_an_invalid_view_ends_neither_the_stream_nor_the_volume(self):
        good = views()[0]
        behind = np.eye(4)
        behind[:3, 3] = [-0.15, -0.15, -1.0]
        bad = replace(good, camera_from_task=behind)
        with self.client.track() as tracking:
            for _ in range(2):
                with self.assertRaisesRegex(graspd.InvalidArgument, r"views\[0\]: camera at") as caught:
                    tracking.add([bad], LOW)
                self.assertEqual(caught.exception.field, "views[0]")
                kept = tracking.add([good], LOW)
            self.assertEqual(tracking.add().grasps, kept.grasps)
        self.wait_until_none_is_tracked()

    def test_tracked_volumes_are_limited_and_expire(self):
        with self.client.track() as tracking:
            tracking.add(views(), LOW)
            with self.client.track() as other, self.assertRaisesRegex(graspd.ResourceExhausted, "--max-tracked"):
                other.add(views(), LOW)
        with Server("--track-timeout", 0.3) as server, graspd.Client(server.grpc) as client:
            seen = views()
            with client.track() as tracking:
                tracking.add(seen, LOW)
                time.sleep(0.5)
                for _ in range(2):
                    with self.assertRaisesRegex(graspd.Aborted, "no request for"):
                        tracking.add(seen, LOW)


def refused(server):
    """The number of requests that were refused because the queue was full."""
    with graspd.Client(server.grpc) as client:
        network = client.models()[0]
    return server.metric(f'graspd_requests_total{{code="RESOURCE_EXHAUSTED",model="{network.name} {network.version}"}}')


class RetryTest(unittest.TestCase):
    PATIENT = graspd.Retry(attempts=1000, pause=0.01, longest=0.1)

    def test_refused_requests_are_retried(self):
        volume = scene.volume(*CAMERAS)
        with Server("--queue", 1) as server, ThreadPoolExecutor(8) as threads:
            with graspd.Client(server.grpc, retry=graspd.Retry.NONE) as client:
                calls = [threads.submit(client.detect, volume) for _ in range(64)]
                refusals = [call.exception() for call in calls if call.exception()]
            self.assertTrue(0 < len(refusals) < len(calls))
            for refusal in refusals:
                self.assertIsInstance(refusal, graspd.ResourceExhausted)
                self.assertGreater(refusal.retry_after, 0)
            before = refused(server)
            self.assertEqual(before, len(refusals))
            with graspd.Client(server.grpc, retry=self.PATIENT) as client:
                self.assertTrue(all(found.grasps for found in threads.map(client.detect, [volume] * 64)))
            self.assertGreater(refused(server), before)

    def test_requests_are_retried_while_the_server_restarts(self):
        volume = scene.volume(*CAMERAS)
        with Server() as server:
            client = self.enterContext(graspd.Client(server.grpc, retry=self.PATIENT))
            self.assertTrue(client.detect(volume).grasps)
        with ThreadPoolExecutor(1) as thread:
            call = thread.submit(client.detect, volume)
            # Long enough that gRPC's own reconnection backoff would exceed the limit below.
            time.sleep(3)
            self.assertFalse(call.done())
            with Server(listen=server.grpc):
                started = time.monotonic()
                self.assertTrue(call.result().grasps)
                self.assertLess(time.monotonic() - started, 1.5)

    def test_a_client_waits_until_the_server_is_ready(self):
        with Server() as server:
            client = self.enterContext(graspd.Client(server.grpc))
            client.wait_ready(30)
        with self.assertRaisesRegex(graspd.Unavailable, "not ready within 0.2 s: UNAVAILABLE"):
            client.wait_ready(0.2)
        with ThreadPoolExecutor(1) as thread:
            waiting = thread.submit(client.wait_ready, 60)
            with Server(listen=server.grpc):
                waiting.result()

    def test_pauses_grow_up_to_the_longest_and_attempts_are_limited(self):
        retry = graspd.Retry(attempts=6, pause=0.1, longest=0.4)
        busy = graspd.ResourceExhausted(grpc.StatusCode.RESOURCE_EXHAUSTED, "busy")
        for attempts, most in enumerate([0.1, 0.2, 0.4, 0.4, 0.4], 1):
            self.assertTrue(most / 2 <= retry.after(attempts, busy) <= most)
        self.assertIsNone(retry.after(6, busy))
        self.assertEqual(retry.after(1, replace(busy, retry_after=3.0)), 3.0)
        self.assertIsNone(retry.after(1, graspd.Internal(grpc.StatusCode.INTERNAL, "it failed")))
        self.assertLessEqual(replace(retry, attempts=10**6).after(10**5, busy), 0.4)


class ReplicasTest(unittest.TestCase):
    def test_calls_are_distributed_to_all_replicas_of_a_target(self):
        volume = scene.volume(*CAMERAS)
        with Server() as first, Server() as second:
            target = f"ipv4:{first.grpc},{second.grpc}"
            with graspd.Client(target) as client:
                for _ in range(10):
                    self.assertTrue(client.detect(volume, LOW).grasps)

            async def detect():
                async with graspd.aio.Client(target) as client:
                    for _ in range(10):
                        self.assertTrue((await client.detect(volume, LOW)).grasps)

            asyncio.run(detect())
            model = graspd.Client(first.grpc).models()[0]
            series = f'graspd_requests_total{{code="OK",model="{model.name} {model.version}"}}'
            answered = [server.metric(series) for server in (first, second)]
            self.assertTrue(sum(answered) == 20 and min(answered) >= 5, answered)

    def test_a_malformed_authority_is_logged(self):
        with tempfile.TemporaryFile() as log:
            with Server(log=log) as server:
                options = [("grpc.default_authority", "127.0.0.1:1,127.0.0.1:2")]
                with grpc.insecure_channel(server.grpc, options) as channel:
                    call = channel.unary_unary("/grasp.v1.GraspService/ListModels")
                    with self.assertRaises(grpc.RpcError):
                        call(b"", timeout=10)
            log.seek(0)
            self.assertIn(b"malformed authority", log.read())


class SecurityTest(unittest.TestCase):
    def setUp(self):
        self.folder = Path(self.enterContext(tempfile.TemporaryDirectory()))

    def test_requests_without_a_valid_token_are_refused(self):
        file = self.folder / "tokens"
        file.write_text("good-secret\n")
        with Server("--token-file", file) as server:
            with graspd.Client(server.grpc, token="good-secret\n") as client:
                self.assertEqual(len(client.models()), 3)
                (found,) = client.detect_stream([scene.volume(*CAMERAS)], LOW)
                self.assertTrue(found.grasps)
                with client.track() as tracking:
                    self.assertTrue(tracking.add(views(), LOW).grasps)
            for token in ["bad-secret", None]:
                with graspd.Client(server.grpc, token=token) as client:
                    self.assertTrue(client.health(), "health checks need no token")
                    with self.assertRaises(graspd.Unauthenticated) as caught:
                        client.models()
                    self.assertNotIn("secret", repr(caught.exception))

    def certificate(self, name, signer=None):
        """Writes NAME.pem and NAME.key: a CA, or a certificate for this machine, signed by one."""
        signed = ["-CA", f"{signer}.pem", "-CAkey", f"{signer}.key", "-addext", "basicConstraints=critical,CA:FALSE"]
        subprocess.run(
            ["openssl", "req", "-x509", "-noenc", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"]
            + ["-subj", f"/CN={name}", "-addext", "subjectAltName=IP:127.0.0.1"]
            + ["-out", f"{name}.pem", "-keyout", f"{name}.key"]
            + (signed if signer else []),
            cwd=self.folder,
            check=True,
            capture_output=True,
        )
        return self.folder / f"{name}.pem", self.folder / f"{name}.key"

    @unittest.skipUnless(shutil.which("openssl"), "openssl is not installed")
    def test_mutual_tls(self):
        (ca, _), (stranger, _) = self.certificate("ca"), self.certificate("stranger")
        cert, key = self.certificate("server", "ca")
        client_cert, client_key = self.certificate("client", "ca")
        known = {"tls_ca": ca, "tls_cert": client_cert, "tls_key": str(client_key)}
        with self.assertRaisesRegex(ValueError, "tls_ca .*client.key has no certificate in PEM"):
            graspd.Client("robot:50051", tls_ca=client_key)
        with Server("--tls-cert", cert, "--tls-key", key, "--tls-client-ca", ca) as server:
            with graspd.Client(server.grpc, **known) as client:
                self.assertTrue(client.detect(scene.volume(*CAMERAS), LOW).grasps)
            for other in [{}, {"tls_ca": ca}, known | {"tls_ca": stranger}]:
                client = graspd.Client(f"https://{server.grpc}", retry=graspd.Retry.NONE, **other)
                with client, self.assertRaises(graspd.Unavailable):
                    client.models()


class AsyncioTest(unittest.IsolatedAsyncioTestCase):
    def setUp(self):
        self.server = self.enterContext(Server("--queue", 1, "--track-timeout", 1))

    async def asyncSetUp(self):
        self.client = await self.enterAsyncContext(graspd.aio.Client(self.server.grpc, retry=RetryTest.PATIENT))

    async def test_results_equal_those_of_the_blocking_client(self):
        volume = scene.volume(*CAMERAS)
        clouds = [graspd.CloudView(scene.cloud(pose), (0, 0, 0), np.linalg.inv(pose)) for pose in CAMERAS]
        with graspd.Client(self.server.grpc) as other:
            for call in [
                lambda client: client.detect(volume, LOW),
                lambda client: client.detect_from_depth(views(), options=LOW),
                lambda client: client.detect_from_cloud(clouds, options=LOW),
            ]:
                found = await call(self.client)
                self.assertTrue(found.grasps)
                self.assertEqual(found.grasps, call(other).grasps)
            self.assertEqual(await self.client.models(), other.models())
        self.assertTrue(await self.client.health())
        await self.client.wait_ready(30)

    async def test_calls_run_concurrently_and_are_retried(self):
        volume = scene.volume(*CAMERAS)
        found = await asyncio.gather(*(self.client.detect(volume, LOW) for _ in range(32)))
        self.assertTrue(all(answer.grasps == found[0].grasps for answer in found))
        self.assertGreater(refused(self.server), 0)

    async def test_a_client_is_made_before_the_event_loop_runs(self):
        def health():
            client = graspd.aio.Client(self.server.grpc)
            return asyncio.run(client.health())

        self.assertTrue(await asyncio.to_thread(health))
        await self.client.health()
        with self.assertRaisesRegex(RuntimeError, "used in another event loop; make a new one"):
            await asyncio.to_thread(lambda: asyncio.run(self.client.health()))

    async def test_errors_are_raised(self):
        with self.assertRaises(graspd.InvalidArgument) as caught:
            await self.client.detect(scene.volume(*CAMERAS), graspd.Options(threshold=2.0))
        self.assertEqual(caught.exception.field, "options.threshold")
        async with graspd.aio.Client("127.0.0.1:1", retry=graspd.Retry.NONE) as client:
            with self.assertRaises(graspd.Unavailable):
                await client.models()

    async def test_stream_replies_are_in_order_until_an_error(self):
        volume = scene.volume(*CAMERAS)

        async def volumes():
            for index in range(4):
                yield graspd.Volume(volume if index != 1 else 2 * volume, frame_id=str(index))
            raise OSError("the camera is unplugged")

        answers = []
        with self.assertRaisesRegex(OSError, "unplugged"):
            async for answer in self.client.detect_stream(volumes(), LOW):
                answers.append(answer)
        self.assertIsInstance(answers.pop(1), graspd.InvalidArgument)
        self.assertEqual([answer.frame_id for answer in answers], ["0", "2", "3"])
        named = [graspd.Volume(volume, frame_id=str(index)) for index in range(2)]
        self.assertEqual([answer.frame_id async for answer in self.client.detect_stream(named, LOW)], ["0", "1"])

    async def test_volumes_are_tracked(self):
        async with self.client.track(graspd.Workspace(frame_id="base")) as tracking:
            with self.assertRaisesRegex(graspd.InvalidArgument, "views"):
                await tracking.add([replace(views()[0], k=np.eye(3))])
            one = await tracking.add(views()[:1], LOW)
            both = await tracking.add(views()[1:])
            expected = await self.client.detect_from_depth(views(), options=LOW)
            self.assertEqual((one.frame_id, both.grasps), ("base", expected.grasps))
            await asyncio.sleep(1.2)
            for _ in range(2):
                with self.assertRaises(graspd.Aborted):
                    await tracking.add(views())


class PackageTest(ServerTest):
    def setUp(self):
        self.folder = Path(self.enterContext(tempfile.TemporaryDirectory()))

    def run_python(self, *arguments, **environment):
        command = [sys.executable, *map(str, arguments)]
        environment = {**os.environ, "PYTHONPATH": INSTALLED.name, **environment}
        result = subprocess.run(command, cwd=self.folder, env=environment, capture_output=True, text=True)
        self.assertEqual(result.returncode, 0, result.stdout + result.stderr)
        return result.stdout

    def test_the_example_of_the_readme_runs(self):
        frame_from_camera = np.linalg.inv(CAMERAS[0])
        frame_from_camera[:3, 3] += [0.4, -0.15, 0.0]
        arrays = {"volume": scene.volume(*CAMERAS), "depth": scene.depth(CAMERAS[0]), "k": scene.K}
        for name, array in {**arrays, "camera": frame_from_camera}.items():
            np.save(self.folder / f"{name}.npy", array)
        example = self.folder / "example.py"
        # The port of the README may be in use on this machine.
        example.write_text(readme().replace("127.0.0.1:50051", self.server.grpc))
        output = self.run_python(example)
        self.assertRegex(output, r"^0\.9\d+ 0\.0\d+ \(.*\) \(.*\)\n")
        self.assertIn("workspace.size is wrong: workspace.size is -1, must be above 0", output)
        self.run_python("-m", "mypy", "--strict", "--cache-dir", self.folder / "cache", example)

    def test_mypy_accepts_the_types(self):
        config = ["--config-file", PACKAGE / "pyproject.toml", "--cache-dir", self.folder / "cache"]
        self.run_python("-m", "mypy", *config, Path(INSTALLED.name) / "graspd")

    def test_a_source_distribution_installs_the_same_files(self):
        build = [sys.executable, "-m", "hatchling", "build", "--target", "sdist", "--directory", self.folder]
        subprocess.run(build, cwd=PACKAGE, check=True, capture_output=True)
        (archive,) = self.folder.glob("graspd-*.tar.gz")
        subprocess.run([*PIP, self.folder / "installed", archive], check=True)
        installed, ours = (
            {path.relative_to(root): path.read_bytes() for path in (root / "graspd").glob("*.py*")}
            for root in [self.folder / "installed", Path(INSTALLED.name)]
        )
        self.assertEqual(installed, ours)

    def test_dataclasses_have_all_fields_of_their_messages(self):
        for ours, theirs in [
            *((getattr(graspd, name), getattr(grasp_pb2, name)) for name in OPTIONS),
            (graspd.Detection, grasp_pb2.DetectGraspsResponse),
            (graspd.Grasp, grasp_pb2.Grasp),
            (graspd.Latency, grasp_pb2.Latency),
            (graspd.Dropped, grasp_pb2.Dropped),
            (graspd.Model, grasp_pb2.Model),
            (graspd.GeometryWarning, grasp_pb2.GeometryWarning),
            (graspd.FoundTable, grasp_pb2.FoundTable),
            (graspd.Candidate, grasp_pb2.Candidate),
            (graspd.Score, grasp_pb2.Score),
            (graspd.Scores, grasp_pb2.ScoreGraspsResponse),
            (graspd.Workspace, grasp_pb2.Workspace),
        ]:
            with self.subTest(ours.__name__):
                self.assertEqual({field.name for field in fields(ours)}, set(theirs.DESCRIPTOR.fields_by_name))


class CameraTest(ServerTest):
    """The intrinsics of CameraInfo messages and files."""

    INFO = {"width": scene.WIDTH, "height": scene.HEIGHT, "distortion_model": "plumb_bob", "k": scene.K.ravel().tolist()}

    def test_lenses_are_rectified(self):
        for model, d in people_files.LENSES.items():
            with self.subTest(model):
                info = types.SimpleNamespace(**self.INFO | {"d": d, "distortion_model": model})
                seen = people_files.distorted(d, model)
                straight = graspd.Camera.from_info(info).rectified(seen)
                expected = scene.depth(people_files.CAMERA_FROM_TASK)
                # A pixel of an edge may have the depth of its neighbour.
                near = np.abs(straight - expected) < 0.01
                self.assertGreater(near[5:-5, 5:-5].mean(), 0.97)
                self.assertLess((np.abs(seen - expected) < 0.01).mean(), 0.97)
                options = replace(LOW, convention=graspd.Convention("tcp"))
                view = graspd.DepthView(seen, graspd.Camera.from_info(info), camera_from_task=people_files.CAMERA_FROM_TASK)
                found = self.client.detect_from_depth(view, options=options)
                self.assertLess(abs(found[0].pose.position[0] - 0.15), 0.012)

    def test_messages_and_files_of_either_ros_are_read(self):
        folder = Path(self.enterContext(tempfile.TemporaryDirectory()))
        upper = {"K": self.INFO["k"], "D": [0.0] * 5, "width": scene.WIDTH, "height": scene.HEIGHT}
        calibration = {
            "image_width": scene.WIDTH,
            "image_height": scene.HEIGHT,
            "camera_matrix": {"rows": 3, "cols": 3, "data": self.INFO["k"]},
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
        }
        (folder / "info.yaml").write_text(people_files.camera_info() + "---\n")
        (folder / "info.json").write_text(json.dumps(upper))
        (folder / "calibration.yaml").write_text(json.dumps(calibration))
        cameras = [graspd.Camera.from_info(info) for info in [self.INFO, upper, types.SimpleNamespace(**self.INFO)]]
        cameras += [graspd.Camera.read(folder / name) for name in ["info.yaml", "info.json", "calibration.yaml"]]
        for camera in cameras:
            np.testing.assert_array_equal(camera.k, scene.K)
            self.assertEqual(camera.size, (scene.WIDTH, scene.HEIGHT))

    def test_files_of_other_tools_are_read_whole(self):
        """The names are those of the tests of `grasp`."""
        fx = {"fx": 540, "fy": 541, "cx": 320, "cy": 240}
        k, d = [540, 0, 320, 0, 541, 240, 0, 0, 1], [-0.28, 0.09, 0, 0, 0]
        named = dict(zip(["k1", "k2", "p1", "p2"], d))
        sizes = [{"w": 848, "h": 480}, {"image_size": [848, 480]}, {"resolution": {"width": 848, "height": 480}}]
        sizes += [{"rows": 480, "cols": 848}, {"image_shape": [480, 848, 3]}, {"frame_size": [848, 480]}, {"width_px": 848, "height_px": 480}]
        sizes += [{"width": "848", "height": "480"}, {"image_Width": 848, "image_Height": 480}, {"image": {"width": 848, "height": 480}}]
        names = "d dist distCoeffs dist_coefs distortion distortion_coeff Distortion_Coefficients coeffs kc".split()
        lenses = [{name: [d]} for name in names] + [named, {"distortion": named}, {"coeffs": named}, {"d": list(map(str, d))}]
        lenses += [{"lens_distortion": d}, {"RadialDistortion": d[:2], "TangentialDistortion": [0, 0]}]
        units = [{"depth_scale": "0.0005"}, {"depthScale": 0.0005}, {"factor_depth": [[2000]]}, {"DepthMapFactor": 2000}]
        for part in [*sizes, *lenses, *units]:
            for document in [fx | part, {"K": k} | part, part | {"intrinsics": fx}]:
                with self.subTest(document):
                    camera = graspd.Camera.from_info(document)
                    np.testing.assert_array_equal(camera.k, np.reshape(k, (3, 3)))
                    self.assertEqual(camera.size, (848, 480) if part in sizes else None)
                    self.assertEqual(camera.distortion[:2], (-0.28, 0.09) if part in lenses else ())
                    self.assertEqual(camera.depth_scale, 0.0005 if part in units else None)
        fisheye = fx | {"distortion_type": "equidistant", "d": [0.02, -0.01, 0.003, -0.0005]}
        self.assertEqual(graspd.Camera.from_info(fisheye).distortion_model, "equidistant")
        depth = graspd.Camera.from_info({"color": fx | {"fx": 250}, "depth": fx})
        self.assertEqual(depth.k[0, 0], 540)
        for document, message in [
            ({"cam0": fx, "cam1": fx | {"fx": 250}}, "several cameras in the file: cam0, cam1"),
            (fx | {"model": 2, "coeffs": d}, "inverse_brown_conrady"),
            (fx | {"d": "<sequence>"}, "`d` is '<sequence>', must be the numbers of the distortion"),
            (fx | {"distortion": {"a": 1}}, "`distortion` is .*, must be the numbers"),
            (fx | {"depth_scale": 0}, "`depth_scale` is 0, must be the unit of the depths"),
            (fx | {"rad_dist": [0.1, 0.2]}, r"`rad_dist` is \[0.1, 0.2\], which may be the distortion"),
            ({"K": str(k)}, "`K` is the text"),
            ({}, "no intrinsics found: the file has no keys"),
            (fx | {"k1": 1, "k2": 1, "k3": 1, "k4": 1}, "name its `distortion_model`"),
            ({"focal": 540}, "no intrinsics found; keys in the file: focal$"),
        ]:
            with self.subTest(document), self.assertRaisesRegex(ValueError, message):
                graspd.Camera.from_info(document)

    def test_the_files_of_the_command_line_are_read(self):
        folder = Path(self.enterContext(tempfile.TemporaryDirectory()))
        for name in people_files.intrinsics(folder):
            with self.subTest(name):
                np.testing.assert_allclose(graspd.Camera.read(folder / name).k, scene.K)
        np.savez(folder / "lens.npz", mtx=scene.K, dist=[[0.1, 0, 0, 0, 0]], width=160, height=120, depth_scale=0.0005)
        camera = graspd.Camera.read(folder / "lens.npz")
        self.assertEqual((camera.distortion[0], camera.size, camera.depth_scale), (0.1, (160, 120), 0.0005))
        np.save(folder / "dict.npy", {"K": scene.K}, allow_pickle=True)
        (folder / "empty.json").write_text("")
        for name, message in [("dict.npy", "dict.npy: a pickled Python object"), ("empty.json", "empty.json: the file is empty")]:
            with self.assertRaisesRegex(ValueError, message):
                graspd.Camera.read(folder / name)

    def test_the_unit_of_a_camera_and_of_integer_points_is_used(self):
        camera = graspd.Camera(scene.K, depth_scale=0.0005)
        depth = scene.depth(CAMERAS[0])
        view = graspd.DepthView(np.rint(depth / 0.0005).astype(np.uint16), camera, camera_from_task=CAMERAS[0])
        sent = np.frombuffer(wire.depth_message(view).data, "<f4").reshape(depth.shape)
        np.testing.assert_allclose(sent, depth, atol=3e-4)
        points = np.array([[100, 200, 300]])
        for dtype, scale, expected in [("i4", None, 0.1), ("f4", None, 100), ("i4", 1e-4, 0.01), ("f8", 1e-3, 0.1)]:
            message = wire.cloud_message(graspd.CloudView(points.astype(dtype), (0, 0, 0), scale=scale))
            self.assertAlmostEqual(np.frombuffer(message.points, "<f4")[0], expected, places=5)

    def test_a_camera_takes_lists_and_arrays(self):
        camera = graspd.Camera(scene.K, size=[160, 120], distortion=np.zeros((1, 5)))
        graspd.DepthView(np.ones((120, 160)), camera)
        with self.assertRaisesRegex(ValueError, "must be finite numbers"):
            graspd.Camera(scene.K, distortion=[np.nan] * 5)

    def test_parts_of_the_sensor_and_rectified_images(self):
        part = {"roi": {"x_offset": 20, "y_offset": 40, "width": 120, "height": 80}, "binning_x": 2, "binning_y": 2}
        camera = graspd.Camera.from_info(self.INFO | part)
        self.assertEqual(camera.size, (60, 40))
        np.testing.assert_allclose(camera.k, [[67.5, 0, 29.5], [0, 67.5, 9.5], [0, 0, 1]])
        info = self.INFO | {"d": [0.1] * 5, "p": [100.0, 0, 80, 0, 0, 100, 60, 0, 0, 0, 1, 0]}
        rectified = graspd.Camera.from_info(info, rectified=True)
        self.assertEqual((rectified.k[0, 0], tuple(rectified.distortion)), (100.0, ()))
        without = graspd.Camera.from_info(self.INFO | {"d": [0.1] * 5}, rectified=True)
        self.assertEqual((without.k[0, 0], tuple(without.distortion)), (scene.K[0, 0], ()))

    def test_contradictions_are_refused(self):
        camera = graspd.Camera.from_info(self.INFO)
        with self.assertRaisesRegex(ValueError, r"of 160 × 120 pixels, the image has 80 × 60; .* 67.5, 67.5, 39.75, 29.75"):
            graspd.DepthView(np.ones((60, 80)), camera)
        with self.assertRaisesRegex(ValueError, "width and height are exchanged"):
            graspd.DepthView(np.ones((160, 120)), camera)
        with self.assertRaisesRegex(ValueError, "has a binning of 2 × 2; if the image is not binned"):
            graspd.DepthView(np.ones((120, 160)), graspd.Camera.from_info(self.INFO | {"binning_x": 2, "binning_y": 2}))
        with self.assertRaisesRegex(ValueError, "has 160 × 100; if the image was cropped"):
            graspd.DepthView(np.ones((100, 160)), camera)
        for wrong, message in [
            ({"d": [0.1] * 4, "distortion_model": "double_sphere"}, "'double_sphere' with 4 coefficients"),
            ({"d": [0.1] * 6}, "'plumb_bob' with 6 coefficients"),
            ({"k": [0.0] * 9}, "not calibrated"),
            ({"k": None}, "no intrinsics found; keys in the file: width, height"),
            ({"d": [float("nan")] * 5}, "must be finite"),
            ({"width": "wide"}, "`width` is .wide., must be a number of pixels"),
        ]:
            with self.assertRaisesRegex(ValueError, message):
                graspd.Camera.from_info(self.INFO | wrong)


class WireTest(unittest.TestCase):
    def test_absent_values_are_none_and_zero_is_not(self):
        for azimuth in [None, 0.0, -90.0]:
            self.assertEqual(wire.model(grasp_pb2.Model(camera_azimuth=azimuth)).camera_azimuth, azimuth)

    def test_values_that_only_a_newer_server_knows_are_numbers(self):
        self.assertEqual(wire.score(grasp_pb2.Score(violations=[99])).violations, ("99",))
        self.assertEqual(wire.warning(grasp_pb2.GeometryWarning(code=99)).code, "99")

    def test_errors_in_streams_name_the_field(self):
        for field in [None, "options.model"]:
            error = grasp_pb2.Error(code=grpc.StatusCode.NOT_FOUND.value[0], message="not found", field=field)
            actual = wire.outcome(grasp_pb2.DetectGraspsStreamResponse(request_id="mine", error=error))
            expected = graspd.NotFound(grpc.StatusCode.NOT_FOUND, error.message, field, request_id="mine")
            self.assertEqual((type(actual), vars(actual)), (type(expected), vars(expected)))


class PoseTest(unittest.TestCase):
    def test_matrices_round_trip(self):
        rotations = Rotation.random(1000, rng=1).as_matrix().tolist()
        rotations += Rotation.from_rotvec(np.pi * np.vstack([np.eye(3), [0.6, 0.8, 0.0]])).as_matrix().tolist()
        for rotation in [np.eye(3), *rotations]:
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = rotation, (0.1, -0.2, 3.0)
            pose = graspd.Pose.from_matrix(matrix)
            np.testing.assert_allclose(pose.matrix(), matrix, atol=1e-12)
            np.testing.assert_allclose(Rotation.from_quat(pose.quaternion).as_matrix(), rotation, atol=1e-12)

    def test_rotations_with_three_decimals_are_orthonormalised(self):
        for rotation in Rotation.random(200, rng=1):
            matrix = np.eye(4)
            matrix[:3, :3] = rotation.as_matrix().round(3)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                pose = graspd.Pose.from_matrix(matrix)
            self.assertLess((Rotation.from_quat(pose.quaternion) * rotation.inv()).magnitude(), 2e-3)
        with self.assertWarnsRegex(UserWarning, "few decimals"):
            sent = wire.pose_message(graspd.Pose(quaternion=(0, 0, 0.991, 0)))
        self.assertEqual(sent.orientation.z, 1)
        coarse = np.eye(4)
        coarse[0, 0] = 1.002
        with self.assertWarnsRegex(UserWarning, "few decimals"):
            graspd.Pose.from_matrix(coarse)

    def test_invalid_matrices_are_rejected(self):
        pose = Rotation.from_euler("xyz", [0.1, 0.2, 0.3])
        for break_matrix, reason in [
            (lambda matrix: 2 * matrix, ""),
            (lambda matrix: matrix * np.nan, ""),
            (lambda matrix: matrix[[1, 0, 2, 3]], ".*it mirrors"),
            (lambda matrix: matrix + np.eye(4)[:, [1, 2, 0, 3]], ""),
            (lambda matrix: matrix.T + np.outer(np.eye(4)[3], [1, 2, 3, 0]), ".*row by row"),
        ]:
            matrix = np.eye(4)
            matrix[:3, :3] = pose.as_matrix()
            with self.assertRaisesRegex(ValueError, "a rotation and a translation" + reason):
                graspd.Pose.from_matrix(break_matrix(matrix))


if __name__ == "__main__":
    unittest.main()
