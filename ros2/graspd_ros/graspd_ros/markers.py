"""Grasps as markers for RViz."""

from __future__ import annotations

import graspd
import numpy as np
from geometry_msgs.msg import Point, Vector3
from graspd_msgs.msg import Detection
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from graspd_ros.messages import pose

PANDA_FINGERS = 0.05
"""Length of the fingers without a `Gripper`, metres."""
HAND, BEST, TABLE = range(3)


def markers(detection: Detection, options: graspd.Options) -> MarkerArray:
    """The hands, red to green by quality; an arrow from the pre-grasp to the best grasp; the workspace that was found."""
    return MarkerArray(markers=[hands(detection, options), best(detection), table(detection)])


def hands(detection: Detection, options: graspd.Options) -> Marker:
    depth = options.gripper.finger_depth if options.gripper else PANDA_FINGERS
    lines, colors = [], []
    for grasp in detection.grasps:
        base = pose(grasp.pose).matrix() @ finger_base(options.convention, depth)
        lines += placed(base, hand(grasp.width, depth))
        colors += [ColorRGBA(r=1.0 - grasp.quality, g=grasp.quality, b=0.0, a=1.0)] * 8
    return marker(detection, HAND, Marker.LINE_LIST, lines, 0.002, colors=colors)


def hand(width: float, depth: float) -> list[tuple[float, float, float]]:
    """Pairs of points in the grasp frame: two fingers, the bar between them, and the wrist."""
    y = width / 2
    return [
        *[(0.0, -y, 0.0), (0.0, -y, depth), (0.0, y, 0.0), (0.0, y, depth)],
        *[(0.0, -y, 0.0), (0.0, y, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, -0.04)],
    ]


def finger_base(convention: graspd.Convention | None, depth: float) -> NDArray[np.float64]:
    """The pose of the finger base, closing along y, in the frame of the hand that grasps refer to."""
    convention = convention or graspd.Convention()
    base = np.eye(4)
    if convention.origin == "tcp":
        base[2, 3] = -depth
    if convention.origin == "parent" and convention.parent_from_grasp is not None:
        base = convention.parent_from_grasp.matrix()
    if convention.closing_axis == "x":
        # y of the hand is x of this frame.
        base = base @ np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return base


def best(detection: Detection) -> Marker:
    ends = [each.position for grasp in detection.grasps[:1] for each in (grasp.pregrasp, grasp.pose)]
    arrow = marker(detection, BEST, Marker.ARROW, ends, 0.004, color=ColorRGBA(r=0.2, g=0.6, b=1.0, a=1.0))
    arrow.scale.y = 0.012  # of its head
    return arrow


def table(detection: Detection) -> Marker:
    """The border of the workspace at the height of the table."""
    lines = []
    for each in detection.table:
        (x, y), z = each.extent, 0.05
        corners = [(0.0, 0.0, z), (x, 0.0, z), (x, y, z), (0.0, y, z), (0.0, 0.0, z)]
        lines = placed(pose(each.workspace).matrix(), corners)
    return marker(detection, TABLE, Marker.LINE_STRIP, lines, 0.003, color=ColorRGBA(r=1.0, g=0.6, b=0.0, a=1.0))


def placed(frame: NDArray[np.float64], points: list[tuple[float, float, float]]) -> list[Point]:
    moved = [(frame @ [*point, 1.0]).tolist() for point in points]
    return [Point(x=x, y=y, z=z) for x, y, z, _ in moved]


def marker(detection: Detection, number: int, kind: int, points: list[Point], width: float, **fields) -> Marker:
    """Replaces the marker of the previous detection; without points it removes it."""
    return Marker(
        header=detection.header,
        ns="graspd",
        id=number,
        type=kind,
        action=Marker.ADD if points else Marker.DELETE,
        points=points,
        scale=Vector3(x=width, y=0.0, z=0.0),
        **fields,
    )
