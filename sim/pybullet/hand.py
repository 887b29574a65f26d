"""The free-floating hand of the benchmark. A constraint of limited force holds and moves the hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pybullet  # type: ignore[import-not-found]
from graspd import Pose
from pybullet_utils.bullet_client import BulletClient  # type: ignore[import-untyped]

STEPS_PER_SECOND = 240

MAX_OPENING = 0.08
"""Largest distance between the fingers, metres."""

LINK_TO_GRASP = 0.062
"""Distance from the origin of the hand's base link to the grasp frame, along z, metres."""

HOLDING_FORCE = 300.0
"""Largest force of the constraint that holds the hand, newtons."""
FINGER_FORCE = 20.0
"""Largest force of each finger, newtons."""

STRIDE = 0.002
"""Distance by which the constraint is moved at once, metres."""
SPEED = 0.1
"""Metres per second."""
CLOSING_TIME = 0.5
"""Seconds."""

FINGERS = (0, 1)
"""Finger joints of the URDF: prismatic, from 0 (closed) to 0.04 m each."""


class Hand:
    """A hand, created open with its grasp frame at `pose`. All poses are `T_task_grasp`."""

    def __init__(self, bullet: BulletClient, urdf: Path, pose: Pose) -> None:
        self._bullet = bullet
        self.body: int = bullet.loadURDF(str(urdf))
        # Bullet's pose of a body is that of its centre of mass.
        com = bullet.getDynamicsInfo(self.body, -1)[3:5]
        self._com_from_grasp = bullet.multiplyTransforms(
            *bullet.invertTransform(*com), (0.0, 0.0, LINK_TO_GRASP), (0.0, 0.0, 0.0, 1.0)
        )
        self._grasp_from_com = bullet.invertTransform(*self._com_from_grasp)
        position, quaternion = self._com(pose)
        bullet.resetBasePositionAndOrientation(self.body, position, quaternion)
        self._holder: int = bullet.createConstraint(
            parentBodyUniqueId=self.body,
            parentLinkIndex=-1,
            childBodyUniqueId=-1,
            childLinkIndex=-1,
            jointType=pybullet.JOINT_FIXED,
            jointAxis=(0, 0, 0),
            parentFramePosition=(0, 0, 0),
            childFramePosition=position,
            childFrameOrientation=quaternion,
        )
        self._hold_at(pose)
        # Keeps both fingers at the same distance from the middle.
        self._gear: int = bullet.createConstraint(
            parentBodyUniqueId=self.body,
            parentLinkIndex=FINGERS[0],
            childBodyUniqueId=self.body,
            childLinkIndex=FINGERS[1],
            jointType=pybullet.JOINT_GEAR,
            jointAxis=(1, 0, 0),
            parentFramePosition=(0, 0, 0),
            childFramePosition=(0, 0, 0),
        )
        bullet.changeConstraint(self._gear, gearRatio=-1, erp=0.1, maxForce=50)
        for finger in FINGERS:
            bullet.resetJointState(self.body, finger, MAX_OPENING / 2)
        for link in (-1, *FINGERS):
            bullet.changeVisualShape(self.body, link, rgbaColor=(0.25, 0.45, 0.75, 1.0))
        self._drive_fingers(MAX_OPENING)

    @property
    def pose(self) -> Pose:
        """Pose of the grasp frame. It lags slightly behind the pose of the constraint."""
        com = self._bullet.getBasePositionAndOrientation(self.body)
        return Pose(*self._bullet.multiplyTransforms(*com, *self._com_from_grasp))

    @property
    def opening(self) -> float:
        """Distance between the fingers, metres."""
        return float(sum(self._bullet.getJointState(self.body, finger)[0] for finger in FINGERS))

    def touched(self) -> list[int]:
        """The bodies in contact with the hand in the last step."""
        return [contact[2] for contact in self._bullet.getContactPoints(self.body)]

    def move_to(self, position: tuple[float, float, float], *, until_contact: bool = False) -> int | None:
        """Moves in a straight line without rotation. With `until_contact` the motion stops after the first stride with
        a contact. Returns the number of that stride, or None without a contact."""
        start = self.pose
        way = np.subtract(position, start.position)
        length = float(np.linalg.norm(way))
        strides = max(int(length / STRIDE), 1)
        steps = int(length / strides / SPEED * STEPS_PER_SECOND)
        for stride in range(strides):
            x, y, z = start.position + way * (stride + 1) / strides
            self._hold_at(Pose((x, y, z), start.quaternion))
            self._step(steps)
            if until_contact and self.touched():
                return stride
        return None

    def close(self) -> None:
        """Closes the fingers."""
        self._drive_fingers(0.0)
        self._step(int(CLOSING_TIME * STEPS_PER_SECOND))

    def remove(self) -> None:
        """Removes the hand from the world."""
        self._bullet.removeConstraint(self._gear)
        self._bullet.removeConstraint(self._holder)
        self._bullet.removeBody(self.body)

    def _com(self, pose: Pose) -> tuple[tuple[float, ...], tuple[float, ...]]:
        position, quaternion = self._bullet.multiplyTransforms(pose.position, pose.quaternion, *self._grasp_from_com)
        return position, quaternion

    def _hold_at(self, pose: Pose) -> None:
        position, quaternion = self._com(pose)
        self._bullet.changeConstraint(
            self._holder, jointChildPivot=position, jointChildFrameOrientation=quaternion, maxForce=HOLDING_FORCE
        )

    def _drive_fingers(self, opening: float) -> None:
        for finger in FINGERS:
            self._bullet.setJointMotorControl2(
                self.body, finger, pybullet.POSITION_CONTROL, targetPosition=opening / 2, force=FINGER_FORCE
            )

    def _step(self, count: int) -> None:
        for _ in range(count):
            self._bullet.stepSimulation()
