"""`moveit_msgs/Grasp` from detections. Needs the package moveit_msgs.

MoveIt plans for the link that carries the hand: request grasps with `Convention.PARENT`, and that link's
`parent_from_grasp`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Pose, PoseStamped, Vector3, Vector3Stamped
from graspd_msgs.msg import Detection
from moveit_msgs.msg import Grasp, GripperTranslation
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint


def grasps(
    detection: Detection, joints: Sequence[str] = (), open_position: float = 0.04, per_width: float = 0.5
) -> list[Grasp]:
    """`joints` are those of the fingers, for example ``["panda_finger_joint1", "panda_finger_joint2"]``; without them
    the postures are empty. `open_position` is their position in the open hand. Closed, their position is
    the width of the grasp times `per_width`: half of it for two fingers that move in opposite directions."""
    return [
        Grasp(
            id=f"grasp_{index}",
            grasp_pose=PoseStamped(header=detection.header, pose=grasp.pose),
            grasp_quality=float(grasp.quality),
            pre_grasp_approach=motion(detection.header, grasp.pregrasp, grasp.pose),
            post_grasp_retreat=motion(detection.header, grasp.pose, grasp.retreat),
            pre_grasp_posture=posture(joints, open_position),
            grasp_posture=posture(joints, grasp.width * per_width),
        )
        for index, grasp in enumerate(detection.grasps)
    ]


def motion(header: Header, start: Pose, end: Pose) -> GripperTranslation:
    """MoveIt may shorten the motion to half its length."""
    step = position(end) - position(start)
    distance = float(np.linalg.norm(step))
    x, y, z = (step / distance).tolist() if distance else (0.0, 0.0, 1.0)
    direction = Vector3Stamped(header=header, vector=Vector3(x=x, y=y, z=z))
    return GripperTranslation(direction=direction, desired_distance=distance, min_distance=distance / 2)


def posture(joints: Sequence[str], target: float) -> JointTrajectory:
    if not joints:
        return JointTrajectory()
    point = JointTrajectoryPoint(positions=[target] * len(joints), time_from_start=Duration(sec=1))
    return JointTrajectory(joint_names=list(joints), points=[point])


def position(pose: Pose) -> np.ndarray:
    return np.array([pose.position.x, pose.position.y, pose.position.z])
