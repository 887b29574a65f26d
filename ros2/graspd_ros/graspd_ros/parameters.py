"""The parameters of the node. Those of options and of the workspace apply to requests that do not set them.

NaN, also in an array, means that the parameter is not set: ROS has no other value for this that tools can store.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import graspd
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from graspd_ros.refusal import Refusal

NOT_SET = math.nan


class Declaration(NamedTuple):
    name: str
    default: Any
    description: str


# Read once, when the node starts.
FIXED = [
    Declaration("address", "127.0.0.1:50051", "Address of graspd: host:port, https://host:port or unix:/path"),
    Declaration("token_file", "", "File with the bearer token of graspd; empty: none"),
    Declaration("tls_ca", "", "PEM file of the CA that signed graspd's certificate; empty: gRPC's root CAs"),
    Declaration("tls_cert", "", "PEM file of the client certificate; empty: none"),
    Declaration("tls_key", "", "PEM file of its key"),
    Declaration("timeout", 10.0, "Time limit of each attempt of a request to graspd, seconds"),
    Declaration("input", "depth", "What to subscribe to: depth (depth/image, depth/camera_info) or points"),
    Declaration("labels", False, "Subscribe to labels, an image with the label of each pixel and the stamp of the input"),
    Declaration("max_goals", 8, "Number of goals and calls at the same time; further ones are refused"),
]
WHILE_RUNNING = [
    Declaration("frame_id", "", "Frame of TF in which grasps are reported; empty: that of the image"),
    Declaration("camera_frame_id", "", "Optical frame of the camera, z forward; empty: that of the image or cloud"),
    Declaration("image_timeout", 2.0, "Longest wait for an image, seconds"),
    Declaration("image_age", 0.0, "How long before the request the image may have arrived, seconds"),
    Declaration("transform_timeout", 0.5, "Longest wait for a transform at the time of the image, seconds"),
    Declaration("track", False, "Add each image to a tracked volume, and publish its grasps"),
    Declaration("half_life", NOT_SET, "Tracking of scenes that move: measurements after which the weight of one halves"),
]
WORKSPACE = [
    Declaration("workspace.frame_id", "", "Frame of the workspace's corner; empty, and no pose: find the table"),
    Declaration("workspace.pose", [NOT_SET], "Pose of the corner in that frame: x, y, z, and a quaternion x, y, z, w"),
    Declaration("workspace.size", NOT_SET, "Edge of the cube, metres; only for planners without a network"),
    Declaration("workspace.extent", [NOT_SET], "Lengths along x and y of a larger workspace, metres"),
    Declaration("workspace.gravity", [NOT_SET], "To find the table: direction of gravity in the frame of the grasps"),
    Declaration("workspace.correct_depth_scale", "auto", "Correct the depths by the table: auto, always or never"),
]
OPTIONS = [
    Declaration("model", "", "Name of the model; empty: the server's default"),
    Declaration("version", "", "Version of the model; empty: the newest"),
    Declaration("threshold", NOT_SET, "Smallest quality of a grasp; not set: the model's"),
    Declaration("force", NOT_SET, "If no grasp reaches the threshold: the best one, if its quality is at least this"),
    Declaration("max_grasps", 0, "Largest number of grasps; 0: no limit"),
    Declaration("max_grasps_per_object", 0, "Largest number of grasps on one object; 0: no limit"),
    Declaration("objects", [0], "Only grasps on objects with these labels; 0: on all surfaces"),
    Declaration("explain", False, "Always count the reasons for dropped grasps"),
    Declaration("region", [NOT_SET], "Box for the point between the fingertips: min x, y, z, max x, y, z"),
    Declaration("region_pose", [NOT_SET], "Pose of the frame of the region: x, y, z, and a quaternion x, y, z, w"),
    Declaration("approach", [NOT_SET], "Cone of approach directions: axis x, y, z, and the angle in radians"),
    Declaration("min_height", NOT_SET, "Smallest z of the lowest corner of the open hand, metres"),
    Declaration("margin", NOT_SET, "Smallest distance of grasps from the sides of the workspace, metres"),
    Declaration("pregrasp_distance", NOT_SET, "Distance of the pre-grasp from the grasp, metres; not set: 0.05"),
    Declaration("retreat.distance", NOT_SET, "Motion after the hand has closed, metres; not set: 0.1"),
    Declaration("retreat.direction", [NOT_SET], "Its direction; not set: back along the approach"),
    Declaration("gripper.size", [NOT_SET], "Opening, finger depth, width and breadth, metres; not set: the Panda hand"),
    Declaration("gripper.palm", [NOT_SET], "Box of the palm in the grasp frame: min x, y, z, max x, y, z"),
    Declaration("collision.mode", "", "Collision check: off, flag or filter; empty: filter"),
    Declaration("collision.table_height", NOT_SET, "Height of the table in the workspace, metres; not set: 0.05"),
    Declaration("collision.clearance", NOT_SET, "Smallest distance between hand and obstacles, metres; not set: 0"),
    Declaration("collision.hidden", False, "Hidden space is an obstacle"),
    Declaration("convention.origin", "finger_base", "Frame of the reported poses: finger_base, tcp or parent"),
    Declaration("convention.closing_axis", "y", "Axis along which the fingers close: y or x"),
    Declaration("convention.parent_from_grasp", [NOT_SET], "For parent: pose of the finger base in the link"),
    Declaration("priority", "normal", "normal, or batch: after all waiting normal requests"),
]
DECLARATIONS = [*FIXED, *WHILE_RUNNING, *WORKSPACE, *OPTIONS]


class Parameters:
    """The parameters of a node by name; values that cannot be used are refused when they are set."""

    def __init__(self, node: Node) -> None:
        self._node = node
        for name, default, description in DECLARATIONS:
            # With a dynamic type, a number may be written as 1 instead of 1.0. `number` and `numbers` check it.
            is_number = isinstance(default, (int, float, list)) and not isinstance(default, bool)
            descriptor = ParameterDescriptor(
                description=description,
                dynamic_typing=is_number or name == "collision.mode",
                read_only=any(name == fixed.name for fixed in FIXED),
            )
            node.declare_parameter(name, default, descriptor)
        check(self.values())
        node.add_on_set_parameters_callback(self._check_new)

    def values(self) -> dict[str, Any]:
        return {name: self._node.get_parameter(name).value for name, *_ in DECLARATIONS}

    def _check_new(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            check({**self.values(), **{parameter.name: parameter.value for parameter in parameters}})
        except Refusal as refusal:
            return SetParametersResult(successful=False, reason=refusal.message)
        return SetParametersResult(successful=True)


def check(values: Mapping[str, Any]) -> None:
    for name in ["timeout", "image_timeout", "image_age", "transform_timeout", "max_grasps", "max_grasps_per_object"]:
        if number(values, name, required=True) < 0:
            raise invalid(name, values[name], "at least 0")
    if number(values, "max_goals", required=True) < 1:
        raise invalid("max_goals", values["max_goals"], "at least 1")
    choice(values, "input", depth=None, points=None)
    if values["track"] and values["input"] != "depth":
        raise invalid("track", True, "false for points: graspd tracks depth images only")
    number(values, "half_life")
    workspace(values)
    try:
        graspd.Options(**options(values))
    except ValueError as error:
        raise Refusal("INVALID_ARGUMENT", str(error)) from None


def connection(values: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of `graspd.aio.Client`."""
    token = values["token_file"] and Path(values["token_file"]).expanduser().read_text()
    files = {name: values[name] or None for name in ["tls_ca", "tls_cert", "tls_key"]}
    return {"address": values["address"], "token": token or None, "timeout": values["timeout"], **files}


def workspace(values: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a `graspd.Workspace` that are set."""
    extent = numbers(values, "workspace.extent", "2: x, y")
    return set_ones(
        frame_id=values["workspace.frame_id"] or None,
        pose=pose(values, "workspace.pose"),
        size=number(values, "workspace.size"),
        extent=None if extent is None else tuple(extent),
        gravity=numbers(values, "workspace.gravity", "3: x, y, z"),
        correct_depth_scale=choice(values, "workspace.correct_depth_scale", auto=None, always=True, never=False),
    )


def options(values: Mapping[str, Any]) -> dict[str, Any]:
    """The options of `graspd.Options` that are set."""
    approach = numbers(values, "approach", "4: x, y, z, angle")
    return set_ones(
        model=values["model"],
        version=values["version"],
        threshold=number(values, "threshold"),
        force=number(values, "force"),
        max_grasps=number(values, "max_grasps", required=True),
        max_grasps_per_object=number(values, "max_grasps_per_object", required=True),
        objects=[label for label in values["objects"] or [] if label],
        explain=values["explain"],
        region=box(values, "region"),
        region_pose=pose(values, "region_pose"),
        approach=None if approach is None else graspd.Cone(approach[:3], approach[3]),
        min_height=number(values, "min_height"),
        margin=number(values, "margin"),
        pregrasp_distance=number(values, "pregrasp_distance"),
        retreat=retreat(values),
        gripper=gripper(values),
        collision=graspd.CollisionCheck(
            # YAML reads `off` as false.
            "off" if values["collision.mode"] is False else values["collision.mode"] or None,
            number(values, "collision.table_height"),
            number(values, "collision.clearance"),
            values["collision.hidden"],
        ),
        convention=graspd.Convention(
            values["convention.origin"],
            values["convention.closing_axis"],
            pose(values, "convention.parent_from_grasp"),
        ),
        priority=values["priority"],
    )


def retreat(values: Mapping[str, Any]) -> graspd.Retreat | None:
    distance = number(values, "retreat.distance")
    direction = numbers(values, "retreat.direction", "3: x, y, z")
    if distance is None and direction is None:
        return None
    return graspd.Retreat(**set_ones(distance=distance, direction=direction))


def gripper(values: Mapping[str, Any]) -> graspd.Gripper | None:
    size = numbers(values, "gripper.size", "4: opening, finger depth, finger width, finger breadth")
    return None if size is None else graspd.Gripper(*size, palm=box(values, "gripper.palm"))


def box(values: Mapping[str, Any], name: str) -> graspd.Box | None:
    corners = numbers(values, name, "6: min x, y, z, max x, y, z")
    return None if corners is None else graspd.Box(corners[:3], corners[3:])


def pose(values: Mapping[str, Any], name: str) -> graspd.Pose | None:
    given = numbers(values, name, "7: x, y, z, qx, qy, qz, qw")
    return None if given is None else graspd.Pose(tuple(given[:3]), tuple(given[3:]))


def choice(values: Mapping[str, Any], name: str, **choices: Any) -> Any:
    if values[name] not in choices:
        raise invalid(name, values[name], f"one of {', '.join(choices)}")
    return choices[values[name]]


def number(values: Mapping[str, Any], name: str, required: bool = False) -> Any:
    value = values[name]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise invalid(name, value, "a number")
    if not math.isnan(value):
        return value
    if required:
        raise invalid(name, value, "a number")
    return None


def numbers(values: Mapping[str, Any], name: str, required: str) -> list[float] | None:
    """`required` begins with the count."""
    value = list(values[name] or [])
    if any(isinstance(each, (str, bytes, bool)) for each in value):
        raise invalid(name, value, f"numbers, {required}")
    if any(map(math.isnan, value)) or not value:
        return None
    if len(value) != int(required.split(":")[0]):
        raise invalid(name, value, f"numbers, {required}")
    return [float(each) for each in value]


def set_ones(**fields: Any) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if value is not None}


def invalid(name: str, value: Any, required: str) -> Refusal:
    return Refusal("INVALID_ARGUMENT", f"parameter {name} is {value!r}, must be {required}")
