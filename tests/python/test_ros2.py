"""Tests ros2/graspd_ros: the node as a process, with rclpy and Fast DDS on this machine, against graspd.

`make test-ros2` runs them; the head of tests/ros2/run.py, which builds the packages, has the command for a single test.
"""

import array
import contextlib
import io
import json
import math
import os
import re
import signal
import subprocess
import tempfile
import threading
import time
import unittest
from dataclasses import fields
from pathlib import Path

import numpy as np

# Before rclpy reads them: apart from other programs, and only on this machine.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import graspd
import rclpy
import yaml
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Pose, PoseArray, Quaternion, Transform, TransformStamped, Vector3
from graspd_msgs import action, msg, srv
from graspd import wire
from graspd_ros import camera, markers, messages, moveit, parameters
from graspd_ros.refusal import Refusal
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.action import ActionClient
from rclpy.executors import MultiThreadedExecutor
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from server import Server
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

ROOT = Path(__file__).resolve().parents[2]
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
OPTICAL = "camera_depth_optical_frame"
PERIOD = 0.1
# Far more than anything takes: only a lost message runs into it.
LIMIT = 60


class Scene:
    """A simulated table, seen by one camera."""

    def __init__(self):
        with tempfile.TemporaryDirectory() as folder:
            label = [os.environ["GRASP_SIM"], "label", "--scenes", "1", "--points", "5", "--format", "raw"]
            label += ["--views", "circle", "--noise", "0", "--out", folder]
            subprocess.run(label, check=True, stdout=subprocess.DEVNULL)
            seen = np.load(Path(folder, "scenes/s00000000.npz"))
            setup = json.loads(Path(folder, "setup.json").read_text())
            self.depth = np.rint(seen["depth_imgs"][0] * 1000).astype(np.uint16)
            *turn, x, y, z = seen["extrinsics"][0].tolist()
        self.k = np.reshape(setup["intrinsic"]["K"], (3, 3))
        self.corner = graspd.Pose((0.3, -0.05, -0.03)).matrix()  # T_base_task
        self.camera = self.corner @ np.linalg.inv(graspd.Pose((x, y, z), tuple(turn)).matrix())  # T_base_camera
        v, u = np.indices(self.depth.shape)
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(self.k).T
        self.points = (rays * (self.depth / 1000)[..., None]).astype(np.float32)
        task_from_camera = np.linalg.inv(self.corner) @ self.camera
        height = self.points @ task_from_camera[2, :3] + task_from_camera[2, 3]
        self.labels = np.where(height > 0.06, 7, 0).astype(np.uint16)

    def view(self, pose, **fields):
        return graspd.DepthView(self.depth, self.k, frame_from_camera=pose, **fields)


class Robot(rclpy.node.Node):
    """The camera, the joints, and what calls the node."""

    def __init__(self, scene):
        super().__init__("robot")
        self.scene = scene
        self.stamps = set()
        self._last = None
        self._topics = {}
        self.depth_message = image(scene.depth, "16UC1")
        self.info = camera_info(scene.k, scene.depth.shape)
        # Every second point of the rows and columns, for a server that is not optimised.
        self.cloud = cloud(scene.points[::2, ::2])
        self.cloud_labels = image(scene.labels[::2, ::2], "16UC1")
        self.labels = image(scene.labels, "16UC1")
        self.on("/tf_static", TFMessage, LATCHED).publish(
            TFMessage(transforms=[
                transform("flange", OPTICAL, FLANGE_FROM_CAMERA, Time()),
                transform("base", "workspace", scene.corner, Time()),
            ])
        )
        self.create_timer(PERIOD, self._see)

    def on(self, topic, kind, qos=QoSProfile(depth=5)):
        if topic not in self._topics:
            self._topics[topic] = self.create_publisher(kind, topic, qos)
        return self._topics[topic]

    def _see(self):
        now = self.get_clock().now()
        # After a delay the timer may fire twice, and the motions of two images would overlap.
        if self._last is not None and (now - self._last).nanoseconds < 0.6e9 * PERIOD:
            return
        self._last = now
        stamp = now.to_msg()
        self.stamps.add((stamp.sec, stamp.nanosec))
        # The arm moves. At the time of the image it is in the middle between two messages.
        for share in (-1, 1):
            flange = self.scene.camera @ np.linalg.inv(FLANGE_FROM_CAMERA) @ step(share)
            at = (now + rclpy.duration.Duration(seconds=share * PERIOD / 4)).to_msg()
            self.on("/tf", TFMessage).publish(TFMessage(transforms=[transform("base", "flange", flange, at)]))
        header = Header(stamp=stamp, frame_id=OPTICAL)
        for topic, message in [
            ("/camera/depth", self.depth_message),
            ("/camera/info", self.info),
            ("/camera/points", self.cloud),
            ("/camera/cloud_labels", self.cloud_labels),
            ("/camera/labels", self.labels),
        ]:
            message.header = header
            publisher = self.on(topic, type(message))
            if publisher.get_subscription_count():
                publisher.publish(message)
        rgb = Image(header=header, width=2, height=1, step=6, encoding="rgb8", data=[0] * 6)
        self.on("/camera/color", Image).publish(rgb)


FLANGE_FROM_CAMERA = graspd.Pose((0.05, 0.0, 0.08), (0.0, 0.0, math.sin(0.4), math.cos(0.4))).matrix()


def step(share):
    """The motion of the arm, forwards or backwards."""
    return graspd.Pose((0.0, 0.0, 0.0), (0.0, 0.0, math.sin(0.01 * share), math.cos(0.01 * share))).matrix()


def transform(parent, child, matrix, stamp):
    pose = graspd.Pose.from_matrix(matrix)
    moved = Transform(
        translation=Vector3(**dict(zip("xyz", pose.position))), rotation=Quaternion(**dict(zip("xyzw", pose.quaternion)))
    )
    return TransformStamped(header=Header(frame_id=parent, stamp=stamp), child_frame_id=child, transform=moved)


def image(pixels, encoding):
    height, width = pixels.shape
    data = array.array("B", pixels.tobytes())
    return Image(width=width, height=height, step=width * pixels.itemsize, encoding=encoding, data=data)


def camera_info(k, shape):
    p = np.hstack([k, np.zeros((3, 1))])
    return CameraInfo(width=shape[1], height=shape[0], k=k.ravel().tolist(), p=p.ravel().tolist())


def cloud(points):
    """With a colour behind each point, as from RealSense."""
    height, width, _ = points.shape
    names = ["x", "y", "z", "rgb"]
    fields = [PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, name in enumerate(names)]
    data = np.append(points, np.zeros((height, width, 1), np.float32), axis=-1)
    return PointCloud2(
        width=width, height=height, fields=fields, point_step=16, row_step=16 * width, data=array.array("B", data.tobytes())
    )


class GraspNode:
    """The node as a process. `topics` remaps, `parameters` are those of the command line."""

    def __init__(self, name, address, topics=None, file=None, **parameters):
        self.name = name
        topics = topics or {"depth/image": "/camera/depth", "depth/camera_info": "/camera/info"}
        topics = {"points": "/camera/points", "labels": "/camera/labels", **topics}
        remaps = [f"{name}:={topic}" for name, topic in {"__node": name, **topics}.items()]
        # Longer than anything takes on a busy machine.
        parameters = {"address": address, "image_timeout": 20.0, "transform_timeout": 5.0, **parameters}
        values = [f"{key.replace('__', '.')}:={json.dumps(value)}" for key, value in parameters.items()]
        [program] = [
            path for prefix in os.environ["AMENT_PREFIX_PATH"].split(":")
            if (path := Path(prefix, "lib/graspd_ros/graspd_node")).exists()
        ]
        arguments = [word for flag, words in [("-r", remaps), ("-p", values)] for each in words for word in (flag, each)]
        if file:
            arguments += ["--params-file", file]
        self.log = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen([program, "--ros-args", *arguments], stderr=self.log, stdout=self.log)
        self.action = ActionClient(ROBOT, action.DetectGrasps, f"/{name}/detect_grasps")
        self.service = ROBOT.create_client(srv.DetectGrasps, f"/{name}/detect_grasps")
        self.settings = {
            kind: ROBOT.create_client(kind, f"/{name}/{topic}")
            for kind, topic in [
                (DescribeParameters, "describe_parameters"), (GetParameters, "get_parameters"),
                (ListParameters, "list_parameters"), (SetParameters, "set_parameters"),
            ]
        }

    def printed(self):
        self.log.seek(0)
        return self.log.read()

    def __enter__(self):
        while not (self.action.wait_for_server(1.0) and self.service.wait_for_service(1.0)):
            if self.process.poll() is not None:
                raise AssertionError(f"{self.name} does not start: {self.printed()}")
        # A server whose discovery of a new client is late sends its response to none: a limit of ROS 2. The first that is
        # received shows that the node has discovered the clients above.
        while True:
            first = self.settings[SetParameters].call_async(SetParameters.Request())
            if done(first, 1.0):
                return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait()
        self.log.close()
        # Its clients stay: rclpy does not support their destruction while another thread spins.

    def send(self, feedback=None, **fields):
        """The handle of an accepted goal."""
        on_feedback = (lambda message: feedback(message.feedback.stage)) if feedback else None
        handle = wait(self.action.send_goal_async(action.DetectGrasps.Goal(**fields), on_feedback))
        assert handle.accepted
        return handle

    def detect(self, **fields):
        """Status and result of a goal."""
        return ended(self.send(**fields))

    def call(self, **fields):
        return wait(self.service.call_async(srv.DetectGrasps.Request(**fields)))

    def call_with_transforms(self, **fields):
        """Like `call`. A node that has just started may receive images before the transforms of their time."""
        while (answer := self.call(**fields)).error == "NO_TRANSFORM":
            pass
        return answer

    def ask(self, kind, **fields):
        """Calls one of the services of parameters."""
        return wait(self.settings[kind].call_async(kind.Request(**fields)))

    def set(self, name, value):
        [answer] = self.ask(SetParameters, parameters=[Parameter(name, value=value).to_parameter_msg()]).results
        return answer


def ended(handle):
    answer = wait(handle.get_result_async())
    return answer.status, answer.result


def wait(future):
    if not done(future, LIMIT):
        raise AssertionError("no answer")
    return future.result()


def done(future, seconds):
    event = threading.Event()
    future.add_done_callback(lambda _: event.set())
    return event.wait(seconds)


class Listener:
    """Collects the messages of a topic."""

    def __init__(self, kind, topic, qos=LATCHED):
        self.messages = []
        self._changed = threading.Condition()
        self._subscription = ROBOT.create_subscription(kind, topic, self._add, qos)

    def _add(self, message):
        with self._changed:
            self.messages.append(message)
            self._changed.notify_all()

    def first(self, condition=lambda message: True):
        """The first message for which the condition holds."""
        with self._changed:
            found = self._changed.wait_for(lambda: [each for each in self.messages if condition(each)], LIMIT)
        if not found:
            raise AssertionError("no such message")
        return found[0]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        ROBOT.destroy_subscription(self._subscription)


def setUpModule():
    global SCENE, SERVER, CLIENT, ROBOT, NODE
    SCENE = Scene()
    SERVER = unittest.enterModuleContext(Server(log=subprocess.DEVNULL))
    CLIENT = unittest.enterModuleContext(graspd.Client(SERVER.grpc))
    rclpy.init()
    unittest.addModuleCleanup(rclpy.try_shutdown)
    ROBOT = Robot(SCENE)
    executor = MultiThreadedExecutor(4)
    executor.add_node(ROBOT)
    spinning = threading.Thread(target=executor.spin)
    spinning.start()
    unittest.addModuleCleanup(spinning.join)
    unittest.addModuleCleanup(executor.shutdown)
    NODE = unittest.enterModuleContext(GraspNode("graspd", SERVER.grpc, transform_timeout=0.5))


def low(**fields):
    return msg.Options(threshold=[0.5], **fields)


LOW = graspd.Options(threshold=0.5)


class RosTest(unittest.TestCase):
    def assert_same_grasps(self, detection, expected):
        self.assertGreater(len(expected.grasps), 0)
        self.assertEqual(len(detection.grasps), len(expected.grasps))
        for own, other in zip(detection.grasps, expected.grasps):
            for name in ["pose", "pregrasp", "retreat"]:
                own_pose, other_pose = messages.pose(getattr(own, name)), getattr(other, name)
                np.testing.assert_allclose(own_pose.position, other_pose.position, atol=2e-3)
                self.assertGreater(abs(np.dot(own_pose.quaternion, other_pose.quaternion)), 0.999)
            self.assertAlmostEqual(own.quality, other.quality, delta=0.02)
            self.assertAlmostEqual(own.width, other.width, delta=2e-3)

    def assert_of_an_image(self, header, frame):
        self.assertEqual(header.frame_id, frame)
        self.assertIn((header.stamp.sec, header.stamp.nanosec), ROBOT.stamps)

    def assert_error(self, answer, error, *words):
        self.assertEqual(answer.error, error, answer.message)
        for word in words:
            self.assertIn(word, answer.message)
        self.assertEqual(len(answer.detection.grasps), 0)


class DetectTest(RosTest):
    def test_an_action_finds_the_table_and_grasps_in_the_frame_of_the_image(self):
        stages = []
        status, result = ended(NODE.send(stages.append, options=low()))
        self.assertEqual((status, result.error), (GoalStatus.STATUS_SUCCEEDED, ""), result.message)
        feedback = action.DetectGrasps.Feedback
        self.assertEqual(stages, [feedback.WAITING_FOR_IMAGE, feedback.LOOKING_UP_TRANSFORM, feedback.DETECTING])
        found = result.detection
        self.assert_of_an_image(found.header, OPTICAL)
        expected = CLIENT.detect_from_depth(SCENE.view(np.eye(4)), graspd.Workspace(find_table=True), LOW)
        self.assert_same_grasps(found, expected)
        self.assertEqual((found.model, found.version), (expected.model, expected.version))
        self.assertTrue(found.latency.total > found.latency.inference > 0)
        [table] = found.table
        self.assertAlmostEqual(table.distance, expected.table.distance, places=3)
        self.assertEqual(table.objects, expected.table.objects)

    def test_the_service_uses_the_pose_of_a_moving_camera(self):
        workspace = msg.Workspace(frame_id="workspace")
        answer = NODE.call_with_transforms(frame_id="base", workspace=workspace, options=low(max_grasps=5))
        self.assertEqual(answer.error, "", answer.message)
        self.assert_of_an_image(answer.detection.header, "base")
        options = graspd.Options(threshold=0.5, max_grasps=5)
        expected = CLIENT.detect_from_depth(SCENE.view(SCENE.camera), graspd.Workspace(SCENE.corner), options)
        self.assert_same_grasps(answer.detection, expected)
        self.assertFalse(answer.detection.table)
        # The corner as a pose, and the table that is found in the frame of the robot.
        corner = messages.pose_message(graspd.Pose.from_matrix(SCENE.corner))
        answer = NODE.call(frame_id="base", workspace=msg.Workspace(pose=[corner]), options=low(max_grasps=5))
        self.assert_same_grasps(answer.detection, expected)
        answer = NODE.call(frame_id="base", options=low())
        expected = CLIENT.detect_from_depth(SCENE.view(SCENE.camera), graspd.Workspace(find_table=True), LOW)
        self.assert_same_grasps(answer.detection, expected)

    def test_results_are_published_also_for_subscribers_that_come_later(self):
        config = yaml.safe_load((ROOT / "ros2/graspd_ros/rviz/graspd.rviz").read_text())
        displays = {each["Name"]: each for each in config["Visualization Manager"]["Displays"]}
        answer = NODE.call(options=low())
        with (
            Listener(msg.Detection, "/graspd/detection") as detections,
            Listener(PoseArray, displays["Grasps"]["Topic"]["Value"]) as poses,
            Listener(MarkerArray, displays["Hands"]["Topic"]["Value"]) as drawn,
        ):
            self.assertEqual(str(detections.first()), str(answer.detection))  # NaN is not equal to itself
            self.assertEqual(poses.first().header, answer.detection.header)
            self.assertEqual(list(poses.first().poses), [grasp.pose for grasp in answer.detection.grasps])
            hands, best, table = drawn.first().markers
        self.assertEqual({marker.header.frame_id for marker in (hands, best, table)}, {OPTICAL})
        self.assertEqual((len(hands.points), len(hands.colors)), (8 * len(answer.detection.grasps),) * 2)
        self.assertEqual(best.points[1], answer.detection.grasps[0].pose.position)
        self.assertEqual((len(table.points), table.action), (5, Marker.ADD))
        # The second point is a fingertip.
        first = answer.detection.grasps[0]
        tip = messages.pose(first.pose).matrix() @ [0, -first.width / 2, 0.05, 1]
        np.testing.assert_allclose([hands.points[1].x, hands.points[1].y, hands.points[1].z], tip[:3], atol=1e-9)

    def test_options_of_the_request_replace_parameters(self):
        with GraspNode("careful", SERVER.grpc, threshold=0.5, max_grasps=3, convention__origin="tcp") as node:
            three, one = node.call().detection, node.call(options=msg.Options(max_grasps=1)).detection
            self.assertEqual((len(three.grasps), len(one.grasps)), (3, 1))
            for name, value in [("frame_id", "base"), ("workspace.frame_id", "workspace")]:
                self.assertTrue(NODE.set(name, value).successful)
                self.addCleanup(NODE.set, name, "")
            placed, found = NODE.call().detection, NODE.call(workspace=msg.Workspace(find_table=True)).detection
            self.assertEqual((placed.header.frame_id, len(placed.table), len(found.table)), ("base", 0, 1))
            expected = CLIENT.detect_from_depth(
                SCENE.view(np.eye(4)), graspd.Workspace(find_table=True),
                graspd.Options(threshold=0.5, max_grasps=3, convention=graspd.Convention("tcp")),
            )
            self.assert_same_grasps(three, expected)
            # Hands are drawn where they are in any convention.
            with Listener(MarkerArray, "/careful/markers") as drawn:
                hands = drawn.first(lambda array: len(array.markers[0].points) == 8).markers[0]
            tips = [np.array([hands.points[i].x, hands.points[i].y, hands.points[i].z]) for i in (1, 3)]
            np.testing.assert_allclose(np.mean(tips, axis=0), expected.grasps[0].pose.position, atol=2e-3)

    def test_a_point_cloud_and_labels(self):
        # Of large messages UDP loses parts on a busy machine.
        own = {"qos_overrides./camera/points.subscription.reliability": "reliable", "input": "points", "labels": True}
        with GraspNode("cloud", SERVER.grpc, {"labels": "/camera/cloud_labels"}, **own) as node:
            workspace = msg.Workspace(frame_id="workspace")
            answer = node.call_with_transforms(frame_id="base", workspace=workspace, options=low(objects=[7]))
            self.assertEqual(answer.error, "", answer.message)
            self.assert_of_an_image(answer.detection.header, "base")
            points, labels = SCENE.points[::2, ::2], SCENE.labels[::2, ::2]
            view = graspd.CloudView(points, (0, 0, 0), frame_from_cloud=SCENE.camera, labels=labels)
            options = graspd.Options(threshold=0.5, objects=[7])
            expected = CLIENT.detect_from_cloud(view, graspd.Workspace(SCENE.corner), options)
            self.assert_same_grasps(answer.detection, expected)
            self.assertEqual({grasp.object for grasp in answer.detection.grasps}, {7})
            other = node.call(frame_id="base", workspace=workspace, options=low(objects=[8]))
            self.assert_error(other, "INVALID_ARGUMENT", "objects")

    def test_a_depth_image_with_labels(self):
        with GraspNode("labelled", SERVER.grpc, labels=True) as node:
            workspace = msg.Workspace(frame_id="workspace")
            answer = node.call_with_transforms(frame_id="base", workspace=workspace, options=low(objects=[7]))
            self.assertEqual((answer.error, {grasp.object for grasp in answer.detection.grasps}), ("", {7}), answer.message)


class DocumentTest(RosTest):
    def blocks(self, language):
        return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / "docs/ros2.md").read_text(), re.MULTILINE | re.DOTALL)

    def test_the_python_example_runs(self):
        [example] = self.blocks("python")
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(example, {"__name__": "__main__"})
        lines = printed.getvalue().splitlines()
        self.assertIn(len(lines), range(1, 6))
        self.assertRegex(lines[0], rf"^grasp_0 0\.\d+ {OPTICAL}$")

    def test_the_goal_of_the_command_line(self):
        [commands] = self.blocks("sh")
        [goal] = re.findall(r'send_goal .* "(.*)"', commands)
        [(name, options)] = yaml.safe_load(goal).items()
        result = NODE.detect(**{name: msg.Options(**options)})[1]
        self.assertEqual(result.error, "", result.message)
        self.assertIn(len(result.detection.grasps), range(1, 11))

    def test_parameter_files(self):
        [documented] = self.blocks("yaml")
        installed = (ROOT / "ros2/graspd_ros/config/graspd.yaml").read_text()
        for text in [documented.replace("base_link", "base"), installed]:
            with self.subTest(text), tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
                file.write(text.replace("graspd:", "filed:"))
                file.flush()
                written = yaml.safe_load(text)["graspd"]["ros__parameters"]
                with GraspNode("filed", SERVER.grpc, file=file.name) as node:
                    self.assertEqual(node.call_with_transforms(options=low()).error, "")
                    values = node.ask(GetParameters, names=list(written)).values
                for value, expected in zip(map(parameter_value_to_python, values), written.values()):
                    self.assertEqual(list(value) if isinstance(expected, list) else value, expected)


class ErrorsTest(RosTest):
    def test_invalid_requests(self):
        for fields, error, words in [
            ({"options": msg.Options(threshold=[2.0])}, "INVALID_ARGUMENT", ["options.threshold", "2"]),
            ({"options": msg.Options(model="missing")}, "NOT_FOUND", ["missing", "vgn-packed"]),
            ({"options": msg.Options(priority="soon")}, "INVALID_ARGUMENT", ["priority", "soon"]),
            ({"frame_id": "moon"}, "NO_TRANSFORM", ["'moon'", "base", OPTICAL]),
            ({"workspace": msg.Workspace(correct_depth_scale=[True])}, "INVALID_ARGUMENT", ["correct_depth_scale"]),
        ]:
            with self.subTest(error=error, words=words):
                self.assert_error(NODE.call(**fields), error, *words)
                status, result = NODE.detect(**fields)
                self.assertEqual(status, GoalStatus.STATUS_ABORTED)
                self.assert_error(result, error, *words)

    def test_topics_that_are_silent_or_have_no_depths(self):
        ROBOT.on("/silent", Image)
        cases = [
            ("/nothing", "/camera/info", "NO_IMAGE", ["no image on /nothing", "publishers: 0"]),
            ("/silent", "/camera/info", "NO_IMAGE", ["no image on /silent", "publishers: 1"]),
            ("/camera/depth", "/nothing", "NO_IMAGE", ["no CameraInfo on /nothing", "publishers: 0"]),
            ("/camera/color", "/camera/info", "INVALID_IMAGE", ["/camera/color", "'rgb8'", "16UC1"]),
        ]
        nodes = [
            GraspNode(f"wrong{number}", SERVER.grpc, {"depth/image": depth, "depth/camera_info": info}, image_timeout=0.5)
            for number, (depth, info, *_) in enumerate(cases)
        ]
        for node, (depth, info, error, words) in zip(nodes, cases):
            with self.subTest(depth=depth, info=info), node:
                # The topics that are not silent need a moment after the start of the node.
                end = time.monotonic() + LIMIT
                while words[0] not in (answer := node.call()).message and time.monotonic() < end:
                    pass
                self.assert_error(answer, error, *words)

    def test_parameters_are_described_and_checked(self):
        names = NODE.ask(ListParameters).result.names
        own = [name for name in names if not name.startswith(("qos_overrides", "use_sim_time", "start_type"))]
        self.assertIn("collision.clearance", own)
        described = NODE.ask(DescribeParameters, names=own).descriptors
        self.assertEqual([each.name for each in described if not each.description], [])
        for name, value, reason in [
            ("region", [0.0, 1.0], "region is [0.0, 1.0], must be numbers, 6: min x, y, z"),
            ("threshold", "high", "threshold is 'high', must be a number"),
            ("convention.origin", "elbow", "'elbow'"),
            ("workspace.correct_depth_scale", "maybe", "auto, always, never"),
            ("address", "localhost:1", "read-only"),
        ]:
            with self.subTest(name=name):
                answer = NODE.set(name, value)
                self.assertFalse(answer.successful)
                self.assertIn(reason, answer.reason)
        # YAML reads 1.0 as a whole number if it is written as 1, and off as false.
        for name, value in [("threshold", 1), ("threshold", math.nan), ("collision.mode", False), ("collision.mode", "")]:
            self.assertTrue(NODE.set(name, value).successful)


class EndTest(RosTest):
    """Every goal ends with a result or an error."""

    def test_cancellation_while_the_node_waits_for_an_image(self):
        topics = {"depth/image": "/nothing", "depth/camera_info": "/camera/info"}
        with GraspNode("waiting", SERVER.grpc, topics, image_timeout=1000.0) as node:
            handle = node.send()
            self.assertEqual(len(wait(handle.cancel_goal_async()).goals_canceling), 1)
            status, result = ended(handle)
            self.assertEqual(status, GoalStatus.STATUS_CANCELED)
            self.assert_error(result, "CANCELLED")

    def test_cancellation_while_the_server_works(self):
        with Server(log=subprocess.DEVNULL) as server, GraspNode("working", server.grpc) as node:
            # Not before graspd and the channel to it work.
            self.assertEqual(node.call(options=low()).error, "")
            server.process.send_signal(signal.SIGSTOP)
            try:
                detecting = threading.Event()
                handle = node.send(lambda stage: stage == action.DetectGrasps.Feedback.DETECTING and detecting.set())
                self.assertTrue(detecting.wait(LIMIT))
                wait(handle.cancel_goal_async())
                self.assertEqual(ended(handle)[0], GoalStatus.STATUS_CANCELED)
            finally:
                server.process.send_signal(signal.SIGCONT)
            status, result = node.detect(options=low())
            self.assertEqual(status, GoalStatus.STATUS_SUCCEEDED, result.message)

    def test_requests_beyond_the_limit_are_refused_and_none_is_lost_when_the_server_is_killed(self):
        server = Server(log=subprocess.DEVNULL)
        diagnostics = self.enterContext(Listener(DiagnosticArray, "/diagnostics", 10))
        with GraspNode("patient", server.grpc, max_goals=4) as node:
            self.assertEqual(node.call(options=low()).error, "")
            server.process.send_signal(signal.SIGSTOP)
            goals = [node.send() for _ in range(6)]
            self.assertEqual([outcome for outcome, _ in map(ended, goals[4:])], [GoalStatus.STATUS_ABORTED] * 2)
            self.assert_error(node.call(), "RESOURCE_EXHAUSTED", "4 requests", "max_goals")
            server.process.kill()
            server.process.communicate()
            for outcome, result in map(ended, goals[:4]):
                self.assertEqual(outcome, GoalStatus.STATUS_ABORTED)
                self.assert_error(result, "UNAVAILABLE", server.grpc, "parameter address")
            self.assert_error(node.call(), "UNAVAILABLE", server.grpc)
            diagnostics.first(lambda array: level(array, "patient: server") == DiagnosticStatus.ERROR)
            diagnostics.messages.clear()
            with Server(listen=server.grpc, log=subprocess.DEVNULL):
                outcome, result = node.detect(options=low())
                self.assertEqual(outcome, GoalStatus.STATUS_SUCCEEDED, result.message)
                diagnostics.first(lambda array: level(array, "patient: server") == DiagnosticStatus.OK)
                array = diagnostics.first(lambda array: level(array, "patient: requests") == DiagnosticStatus.OK)
            counts = {each.key: each.value for each in status(array, "patient: requests").values}
            self.assertEqual(counts, {"running": "0", "succeeded": "2", "cancelled": "0", "failed": "8"})

    def test_no_goal_is_lost_while_clients_cancel_and_the_server_restarts(self):
        server = Server(log=subprocess.DEVNULL)
        with GraspNode("busy", server.grpc, max_goals=16, image_timeout=60.0) as node:
            self.assertEqual(node.call(options=low()).error, "")
            goals, calls = [], []
            for number in range(24):
                goals.append(node.send(options=low()))
                if number % 4 == 0:
                    calls.append(node.service.call_async(srv.DetectGrasps.Request(options=low())))
                if number % 3 == 0:
                    goals[-1].cancel_goal_async()
                if number == 12:
                    server.process.kill()
                    server.process.communicate()
            outcomes = [(status, result.error) for status, result in map(ended, goals)]
            answers = [answer.error for answer in map(wait, calls)]
            with Server(listen=server.grpc, log=subprocess.DEVNULL):
                outcomes += [(status, result.error) for status, result in [node.detect(options=low())]]
        self.assertEqual((len(outcomes), len(answers)), (25, 6))
        self.assertEqual(outcomes[-1], (GoalStatus.STATUS_SUCCEEDED, ""))
        self.assertIn((GoalStatus.STATUS_ABORTED, "UNAVAILABLE"), outcomes)
        for status, error in outcomes:
            self.assertEqual(status == GoalStatus.STATUS_SUCCEEDED, error == "")
        errors = {"UNAVAILABLE", "RESOURCE_EXHAUSTED"}
        self.assertLessEqual({error for _, error in outcomes}, errors | {"", "CANCELLED"})
        self.assertLessEqual(set(answers), errors | {""})

    def test_goals_end_when_the_node_stops(self):
        topics = {"depth/image": "/nothing", "depth/camera_info": "/camera/info"}
        with GraspNode("stopping", SERVER.grpc, topics, image_timeout=1000.0) as node:
            goals = [node.send() for _ in range(3)]
            results = [goal.get_result_async() for goal in goals]
            node.send()  # after its acceptance, the node has the requests for the results
            node.process.terminate()
            for answer in map(wait, results):
                self.assertEqual(answer.status, GoalStatus.STATUS_ABORTED)
                self.assert_error(answer.result, "SHUTTING_DOWN")
            self.assertEqual(node.process.wait(LIMIT), 0, node.printed())


def status(array, name):
    return next((each for each in array.status if each.name == name), None)


def level(array, name):
    found = status(array, name)
    return found and found.level


class TrackingTest(RosTest):
    def test_images_are_tracked_while_the_parameter_is_set(self):
        own = {"frame_id": "base", "workspace__frame_id": "workspace", "threshold": 0.5}
        with GraspNode("tracking", SERVER.grpc, **own) as node, Listener(msg.Detection, "/tracking/detection") as detections:
            self.assertTrue(node.set("track", True).successful)
            detections.first(lambda _: len(detections.messages) >= 3)
            found = detections.messages[:3]
            self.assertEqual(len({(each.header.stamp.sec, each.header.stamp.nanosec) for each in found}), 3)
            for each in found:
                self.assert_of_an_image(each.header, "base")
                self.assertGreater(len(each.grasps), 0)
            self.assertEqual(SERVER.metric("graspd_tracked_volumes"), 1)
            self.assertTrue(node.set("track", False).successful)
            end = time.monotonic() + LIMIT
            while SERVER.metric("graspd_tracked_volumes") and time.monotonic() < end:
                time.sleep(0.05)
            self.assertEqual(SERVER.metric("graspd_tracked_volumes"), 0)

    def test_tracking_without_a_workspace_finds_the_table(self):
        with Listener(msg.Detection, "/graspd/detection") as detections:
            self.assertTrue(NODE.set("threshold", 0.5).successful and NODE.set("track", True).successful)
            self.addCleanup(NODE.set, "threshold", math.nan)
            self.addCleanup(NODE.set, "track", False)
            detections.first(lambda _: len(detections.messages) >= 4)
            for each in detections.messages[1:4]:  # the first may be older
                self.assert_of_an_image(each.header, OPTICAL)
                self.assertTrue(each.table and each.grasps)


class ConversionTest(unittest.TestCase):
    def test_messages_and_parameters_have_every_option(self):
        for kind, message, prefix in [(graspd.Options, msg.Options, ""), (graspd.Workspace, msg.Workspace, "workspace.")]:
            names = {field.name for field in fields(kind)} - {"stamp"}
            self.assertEqual(names - {*message.get_fields_and_field_types()}, set())
            declared = [declaration.name for declaration in parameters.DECLARATIONS]
            missing = {name for name in names if not any(each.startswith(prefix + name) for each in declared)}
            self.assertEqual(missing - {"find_table"}, set())

    def test_messages_and_parameters_mean_the_same(self):
        corners, seven = [0.0, -0.1, 0.2, 0.3, 0.4, 0.5], [0.1, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8]
        box = msg.Box(min=Vector3(x=0.0, y=-0.1, z=0.2), max=Vector3(x=0.3, y=0.4, z=0.5))
        pose = messages.pose_message(graspd.Pose(tuple(seven[:3]), tuple(seven[3:])))
        options = msg.Options(
            model="vgn-packed", version="1", threshold=[0.5], force=[0.25], max_grasps=3, max_grasps_per_object=2,
            objects=[4, 5], explain=True, region=[box], region_pose=[pose],
            approach=[msg.Cone(axis=Vector3(z=-1.0), angle=0.8)], min_height=[0.0], margin=[0.05], pregrasp_distance=[0.1],
            retreat=[msg.Retreat(distance=0.2, direction=[Vector3(z=1.0)])],
            gripper=[msg.Gripper(max_opening=0.1, finger_depth=0.05, finger_width=0.02, finger_breadth=0.03, palm=[box])],
            collision=[msg.CollisionCheck(mode="flag", table_height=[-1.0], clearance=[0.01], hidden=True)],
            convention=[msg.Convention(origin="parent", closing_axis="x", parent_from_grasp=[pose])], priority="batch",
        )
        defaults = {declaration.name: declaration.default for declaration in parameters.DECLARATIONS}
        values = {
            "model": "vgn-packed", "version": "1", "threshold": 0.5, "force": 0.25, "max_grasps": 3,
            "max_grasps_per_object": 2, "objects": [4, 5], "explain": True, "region": corners, "region_pose": seven,
            "approach": [0, 0, -1, 0.8], "min_height": 0, "margin": 0.05, "pregrasp_distance": 0.1,
            "retreat.distance": 0.2, "retreat.direction": [0, 0, 1], "gripper.size": [0.1, 0.05, 0.02, 0.03],
            "gripper.palm": corners, "collision.mode": "flag", "collision.table_height": -1, "collision.clearance": 0.01,
            "collision.hidden": True, "convention.origin": "parent", "convention.closing_axis": "x",
            "convention.parent_from_grasp": seven, "priority": "batch",
        }
        self.assertEqual({declaration.name for declaration in parameters.OPTIONS}, set(values))
        parameters.check({**defaults, **values})
        own, other = messages.options(options), parameters.options({**defaults, **values})
        self.assertEqual(set(own), {field.name for field in fields(graspd.Options)})
        as_message = lambda values: wire.options_message(graspd.Options(**values))
        self.assertEqual(as_message(own), as_message(other))
        # Nothing is set.
        self.assertEqual(messages.options(msg.Options()), {})
        self.assertEqual(parameters.workspace(defaults), {})

        workspace = msg.Workspace(
            frame_id="corner", pose=[pose], size=0.3, extent=[0.5, 0.4], gravity=[Vector3(z=-1.0)],
            correct_depth_scale=[False],
        )
        values = {
            "workspace.frame_id": "corner", "workspace.pose": seven, "workspace.size": 0.3, "workspace.extent": [0.5, 0.4],
            "workspace.gravity": [0, 0, -1], "workspace.correct_depth_scale": "never",
        }
        self.assertEqual({declaration.name for declaration in parameters.WORKSPACE}, set(values))
        own, other = messages.workspace(workspace), parameters.workspace({**defaults, **values})
        as_message = lambda values: wire.workspace_message(graspd.Workspace(**values))
        self.assertEqual(as_message(own), as_message(other))

    def test_images_of_all_kinds(self):
        depth = np.array([[500, 600, 700], [800, 900, 1000]])
        for encoding, kind, big in [("16UC1", "<u2", 0), ("mono16", ">u2", 1), ("32FC1", "<f4", 0), ("32FC1", ">f4", 1)]:
            with self.subTest(encoding=encoding, big=big):
                message = image(depth.astype(kind), encoding)
                message.is_bigendian = big
                self.assertEqual(camera.depth(message, "/d").tolist(), depth.tolist())
                # Rows with padding.
                padded = np.pad(np.frombuffer(message.data, np.uint8).reshape(2, -1), [(0, 0), (0, 5)])
                message.step, message.data = padded.shape[1], array.array("B", padded.tobytes())
                self.assertEqual(camera.depth(message, "/d").tolist(), depth.tolist())
                message.height = 3
                with self.assertRaisesRegex(Refusal, "/d has .* bytes, must have 3 rows"):
                    camera.depth(message, "/d")

    def test_intrinsics_of_a_part_of_the_sensor(self):
        k = np.array([[540.0, 0, 319.5], [0, 541.0, 239.5], [0, 0, 1]])
        info = camera_info(k, (480, 640))
        whole, half = Image(width=640, height=480), Image(width=320, height=240)
        np.testing.assert_array_equal(camera.intrinsics(info, whole, "/i").k, k)
        with self.assertRaisesRegex(Refusal, "on /i: .* of 640 × 480 pixels, the image has 320 × 240"):
            camera.intrinsics(info, half, "/i")
        info.binning_x = info.binning_y = 2
        np.testing.assert_array_equal(camera.intrinsics(info, half, "/i").k, [[270, 0, 159.5], [0, 270.5, 119.5], [0, 0, 1]])
        info.binning_x = info.binning_y = 1
        info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 100, 50, 320, 240
        np.testing.assert_array_equal(camera.intrinsics(info, half, "/i").k, [[540, 0, 219.5], [0, 541, 189.5], [0, 0, 1]])
        with self.assertRaisesRegex(Refusal, "not calibrated"):
            camera.intrinsics(CameraInfo(width=320, height=240), half, "/i")

    def test_moveit_grasps(self):
        poses = {"pregrasp": at(0, 0, 0.3), "pose": at(0, 0, 0.2), "retreat": at(0.3, 0, 0.2)}
        found = msg.Detection(header=Header(frame_id="base"), grasps=[msg.Grasp(quality=0.75, width=0.05, **poses)])
        [grasp] = moveit.grasps(found, ["left", "right"])
        self.assertEqual((grasp.id, grasp.grasp_pose.header.frame_id, grasp.grasp_quality), ("grasp_0", "base", 0.75))
        approach, retreat = grasp.pre_grasp_approach, grasp.post_grasp_retreat
        self.assertEqual((approach.direction.vector, retreat.direction.vector), (Vector3(z=-1.0), Vector3(x=1.0)))
        np.testing.assert_allclose([approach.desired_distance, retreat.desired_distance], [0.1, 0.3], atol=1e-6)
        self.assertEqual(list(grasp.pre_grasp_posture.points[0].positions), [0.04, 0.04])
        self.assertEqual(list(grasp.grasp_posture.points[0].positions), [0.025, 0.025])

    def test_a_hand_is_drawn_at_its_fingers_in_each_convention(self):
        link = graspd.Pose((0.0, 0.0, 0.06)).matrix()
        turn = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        for convention, expected in [
            (None, np.eye(4)),
            (graspd.Convention("tcp"), graspd.Pose((0, 0, -0.05)).matrix()),
            (graspd.Convention("parent", parent_from_grasp=graspd.Pose((0.0, 0.0, 0.06))), link),
            (graspd.Convention(closing_axis="x"), turn),
        ]:
            np.testing.assert_allclose(markers.finger_base(convention, 0.05), expected, atol=1e-12)


def at(x, y, z):
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = map(float, (x, y, z))
    return pose


if __name__ == "__main__":
    unittest.main()
