"""Conversion between the messages of graspd_msgs and the values of graspd."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import graspd
from geometry_msgs.msg import Point, Quaternion, Vector3
from geometry_msgs.msg import Pose as PoseMessage
from graspd_msgs import msg
from std_msgs.msg import Header


def options(message: msg.Options) -> dict[str, Any]:
    """The options that are set."""
    plain = {
        "model": message.model,
        "version": message.version,
        "max_grasps": message.max_grasps,
        "max_grasps_per_object": message.max_grasps_per_object,
        "objects": list(message.objects),
        "explain": message.explain,
        "priority": message.priority,
    }
    optional = {
        "threshold": first(message.threshold),
        "force": first(message.force),
        "region": first(message.region, box),
        "region_pose": first(message.region_pose, pose),
        "approach": first(message.approach, lambda cone: graspd.Cone(vector(cone.axis), cone.angle)),
        "min_height": first(message.min_height),
        "margin": first(message.margin),
        "pregrasp_distance": first(message.pregrasp_distance),
        "retreat": first(message.retreat, lambda motion: graspd.Retreat(motion.distance, first(motion.direction, vector))),
        "gripper": first(message.gripper, gripper),
        "collision": first(message.collision, collision),
        "convention": first(message.convention, convention),
    }
    return given(plain, optional)


def workspace(message: msg.Workspace) -> dict[str, Any]:
    """The fields that are set."""
    plain = {"frame_id": message.frame_id, "size": message.size, "extent": tuple(message.extent)}
    optional = {
        "pose": first(message.pose, pose),
        "gravity": first(message.gravity, vector),
        "correct_depth_scale": first(message.correct_depth_scale),
    }
    return given(plain, optional)


def given(plain: dict[str, Any], optional: dict[str, Any]) -> dict[str, Any]:
    return {
        **{name: value for name, value in plain.items() if value},
        **{name: value for name, value in optional.items() if value is not None},
    }


def first(values: Sequence[Any], convert: Callable[[Any], Any] = lambda value: value) -> Any:
    """The value of a field that has at most one."""
    return convert(values[0]) if len(values) else None


def gripper(message: msg.Gripper) -> graspd.Gripper:
    lengths = (message.max_opening, message.finger_depth, message.finger_width, message.finger_breadth)
    return graspd.Gripper(*lengths, palm=first(message.palm, box))


def collision(message: msg.CollisionCheck) -> graspd.CollisionCheck:
    table_height, clearance = first(message.table_height), first(message.clearance)
    return graspd.CollisionCheck(message.mode or None, table_height, clearance, message.hidden)


def convention(message: msg.Convention) -> graspd.Convention:
    parent = first(message.parent_from_grasp, pose)
    return graspd.Convention(message.origin or "finger_base", message.closing_axis or "y", parent)


def box(message: msg.Box) -> graspd.Box:
    return graspd.Box(vector(message.min), vector(message.max))


def vector(message: Vector3) -> tuple[float, float, float]:
    return (message.x, message.y, message.z)


def pose(message: PoseMessage) -> graspd.Pose:
    p, q = message.position, message.orientation
    return graspd.Pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def pose_message(found: graspd.Pose) -> PoseMessage:
    (px, py, pz), (x, y, z, w) = found.position, found.quaternion
    return PoseMessage(position=Point(x=px, y=py, z=pz), orientation=Quaternion(x=x, y=y, z=z, w=w))


def detection_message(header: Header, found: graspd.Detection) -> msg.Detection:
    return msg.Detection(
        header=header,
        grasps=[grasp_message(grasp) for grasp in found.grasps],
        model=found.model,
        version=found.version,
        latency=msg.Latency(**asdict(found.latency)),
        warnings=[msg.Warning(code=warning.code, message=warning.message) for warning in found.warnings],
        dropped=[] if found.dropped is None else [msg.Dropped(**asdict(found.dropped))],
        table=[] if found.table is None else [table_message(found.table)],
        depth_factors=list(found.depth_factors),
        request_id=found.request_id,
    )


def grasp_message(grasp: graspd.Grasp) -> msg.Grasp:
    return msg.Grasp(
        pose=pose_message(grasp.pose),
        width=grasp.width,
        quality=grasp.quality,
        pregrasp=pose_message(grasp.pregrasp),
        retreat=pose_message(grasp.retreat),
        collides=bool(grasp.collides),
        object=grasp.object or 0,
        open_width=math.nan if grasp.open_width is None else grasp.open_width,
    )


def table_message(table: graspd.FoundTable) -> msg.FoundTable:
    return msg.FoundTable(
        workspace=pose_message(table.workspace),
        extent=list(table.extent),
        objects=table.objects,
        distance=table.distance,
        angle=table.angle,
        share=table.share,
        deviation=table.deviation,
        tilt=math.nan if table.tilt is None else table.tilt,
    )
