"""Publishes detections: as they are, as poses, and as markers for RViz."""

from __future__ import annotations

import graspd
from geometry_msgs.msg import PoseArray
from graspd_msgs.msg import Detection
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from visualization_msgs.msg import MarkerArray

from graspd_ros.markers import markers

# Subscribers that come later receive the newest detection.
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Results:
    def __init__(self, node: Node) -> None:
        self._detection = node.create_publisher(Detection, "~/detection", LATCHED)
        self._grasps = node.create_publisher(PoseArray, "~/grasps", LATCHED)
        self._markers = node.create_publisher(MarkerArray, "~/markers", LATCHED)

    def publish(self, detection: Detection, options: graspd.Options) -> None:
        self._detection.publish(detection)
        self._grasps.publish(PoseArray(header=detection.header, poses=[grasp.pose for grasp in detection.grasps]))
        self._markers.publish(markers(detection, options))
