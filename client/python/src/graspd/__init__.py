"""A client of graspd: volumes, depth images or point clouds in, 6-DoF grasps for a parallel-jaw hand out.

`Client` asks and waits; `graspd.aio.Client` does the same in asyncio. Everywhere lengths are in metres, angles in
radians, durations in seconds, moments in nanoseconds since 1970, quaternions x, y, z, w; a pose ``T_a_b`` maps points
of frame b into frame a; arrays of voxels are indexed ``[x][y][z]``.
"""

from graspd.client import Client, Tracking
from graspd.detection import Detection, Dropped, Grasp, Latency, Model
from graspd.errors import (
    Aborted,
    DeadlineExceeded,
    Error,
    Internal,
    InvalidArgument,
    NotFound,
    ResourceExhausted,
    Unauthenticated,
    Unavailable,
)
from graspd.geometry import Pose
from graspd.options import Box, CollisionCheck, Cone, Convention, Gripper, Options, Retreat
from graspd.retry import Retry
from graspd.seen import CloudView, DepthView, Volume, Workspace

__all__ = [
    "Aborted",
    "Box",
    "Client",
    "CloudView",
    "CollisionCheck",
    "Cone",
    "Convention",
    "DeadlineExceeded",
    "DepthView",
    "Detection",
    "Dropped",
    "Error",
    "Grasp",
    "Gripper",
    "Internal",
    "InvalidArgument",
    "Latency",
    "Model",
    "NotFound",
    "Options",
    "Pose",
    "ResourceExhausted",
    "Retreat",
    "Retry",
    "Tracking",
    "Unauthenticated",
    "Unavailable",
    "Volume",
    "Workspace",
]
