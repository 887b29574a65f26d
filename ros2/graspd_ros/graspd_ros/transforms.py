"""Poses from TF, by tf2_ros. An rclpy from PyPI has no tf2_ros: then the node reads /tf and /tf_static by itself."""

from __future__ import annotations

import asyncio
import time
from bisect import bisect_left, insort
from threading import Lock
from typing import Protocol

import graspd
import numpy as np
from geometry_msgs.msg import Transform
from numpy.typing import NDArray
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time

from graspd_ros.refusal import Refusal

Matrix = NDArray[np.float64]
Stamped = tuple[int, Transform]
PAUSE = 0.01
"""Pause between two lookups of a transform that has not arrived, seconds."""
HISTORY = 10 * 10**9
"""Nanoseconds, as in tf2."""


class NotKnown(Exception):
    """A transform has not arrived."""


class Source(Protocol):
    def matrix(self, target: str, source: str, stamp: int) -> Matrix:
        """``T_target_source`` at `stamp`, nanoseconds; 0: the newest. Raises `NotKnown`."""


class Transforms:
    def __init__(self, node: Node, group: CallbackGroup) -> None:
        try:
            self._source: Source = Tf2(node)
        except ModuleNotFoundError:
            self._source = TfTopics(node, group)

    async def lookup(self, target: str, source: str, stamp: int, timeout: float) -> Matrix:
        """``T_target_source`` at `stamp`. Transforms often arrive after the image."""
        if target == source:
            return np.eye(4)
        end = time.monotonic() + timeout
        while True:
            try:
                return self._source.matrix(target, source, stamp)
            except NotKnown as cause:
                if time.monotonic() >= end:
                    raise Refusal(
                        "NO_TRANSFORM",
                        f"no transform from {source!r} to {target!r} at the time of the image within {timeout} s: {cause}; "
                        "check that the robot's state and the calibration of the camera are published, and the names of the "
                        "frames",
                    ) from None
            await asyncio.sleep(PAUSE)


class Tf2:
    def __init__(self, node: Node) -> None:
        import tf2_ros

        self._not_known = tf2_ros.TransformException
        self._buffer = tf2_ros.Buffer(node=node)
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def matrix(self, target: str, source: str, stamp: int) -> Matrix:
        try:
            found = self._buffer.lookup_transform(target, source, Time(nanoseconds=stamp))
        except self._not_known as error:
            raise NotKnown(str(error)) from None
        return matrix(found.transform)


class TfTopics:
    """The part of tf2 that the node needs."""

    def __init__(self, node: Node, group: CallbackGroup) -> None:
        from tf2_msgs.msg import TFMessage

        self._lock = Lock()
        self._parents: dict[str, str] = {}
        self._fixed: dict[str, Transform] = {}
        self._moving: dict[str, list[Stamped]] = {}
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TFMessage, "/tf", self._add_moving, QoSProfile(depth=100), callback_group=group)
        node.create_subscription(TFMessage, "/tf_static", self._add_fixed, latched, callback_group=group)

    def matrix(self, target: str, source: str, stamp: int) -> Matrix:
        with self._lock:
            above_target, above_source = self._ancestors(target), self._ancestors(source)
            common = next((frame for frame in above_source if frame in above_target), None)
            if common is None:
                raise NotKnown(f"{source!r} is below {above_source[-1]!r}, and {target!r} below {above_target[-1]!r}")
            common_from_target, common_from_source = (
                self._product(above[: above.index(common)], stamp) for above in (above_target, above_source)
            )
        return np.linalg.inv(common_from_target) @ common_from_source

    def _ancestors(self, frame: str) -> list[str]:
        """The frame, its parent, and so on."""
        known = {*self._parents, *self._parents.values()}
        if frame not in known:
            raise NotKnown(f"{frame!r} is not in TF, which has {', '.join(sorted(known)) or 'no frames'}")
        chain = [frame]
        while chain[-1] in self._parents and len(chain) <= len(known):  # ends also if the frames form a cycle
            chain.append(self._parents[chain[-1]])
        return chain

    def _product(self, frames: list[str], stamp: int) -> Matrix:
        product = np.eye(4)
        for frame in frames:
            product = self._from_parent(frame, stamp) @ product
        return product

    def _from_parent(self, frame: str, stamp: int) -> Matrix:
        """``T_parent_frame``."""
        if frame in self._fixed:
            return matrix(self._fixed[frame])
        history = self._moving[frame]
        oldest, newest = history[0][0], history[-1][0]
        if not stamp:
            return matrix(history[-1][1])
        if not oldest <= stamp <= newest:
            relation = f"{(stamp - newest) * 1e-9:.3f} s after the newest" if stamp > newest else "before the oldest"
            raise NotKnown(f"the image is {relation} transform of {frame!r}")
        after = bisect_left(history, stamp, key=stamp_of)
        return between(history[max(after - 1, 0)], history[after], stamp)

    def _add_fixed(self, message) -> None:
        with self._lock:
            for each in message.transforms:
                self._fixed[each.child_frame_id] = each.transform
                self._parents[each.child_frame_id] = each.header.frame_id

    def _add_moving(self, message) -> None:
        with self._lock:
            for each in message.transforms:
                history = self._moving.setdefault(each.child_frame_id, [])
                insort(history, (nanoseconds(each.header.stamp), each.transform), key=stamp_of)
                del history[: bisect_left(history, history[-1][0] - HISTORY, key=stamp_of)]
                self._parents[each.child_frame_id] = each.header.frame_id


def stamp_of(entry: Stamped) -> int:
    return entry[0]


def between(before: Stamped, after: Stamped, stamp: int) -> Matrix:
    """Interpolates linearly. For the quaternions, normalised, this is accurate enough between two messages."""
    share = (stamp - before[0]) / max(after[0] - before[0], 1)
    (start, turned), (end, turned_to) = (parts(entry[1]) for entry in (before, after))
    quaternion = turned + share * (turned_to * (1 if turned @ turned_to >= 0 else -1) - turned)
    quaternion /= np.linalg.norm(quaternion)
    return graspd.Pose(tuple(start + share * (end - start)), tuple(quaternion)).matrix()


def matrix(transform: Transform) -> Matrix:
    translation, quaternion = parts(transform)
    return graspd.Pose(tuple(translation), tuple(quaternion)).matrix()


def parts(transform: Transform) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    t, q = transform.translation, transform.rotation
    return np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w])


def nanoseconds(stamp) -> int:
    return stamp.sec * 10**9 + stamp.nanosec
