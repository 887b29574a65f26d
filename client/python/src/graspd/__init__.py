"""Python client of graspd: detects 6-DoF grasps for a parallel-jaw hand in volumes, depth images or point clouds.

`Client` is synchronous; `graspd.aio.Client` is its asyncio counterpart. Lengths are in metres, angles in radians,
durations in seconds, time stamps in nanoseconds since 1970. Quaternions are x, y, z, w. A pose ``T_a_b`` maps points of
frame b into frame a. Arrays of voxels are indexed ``[x][y][z]``.
"""

from importlib.metadata import version

from graspd import aio
from graspd.camera import Camera
from graspd.client import Client, Tracking
from graspd.detection import Detection, Dropped, FoundTable, GeometryWarning, Grasp, Latency, Model, Score, Scores
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
from graspd.options import Box, Candidate, CollisionCheck, Cone, Convention, Gripper, Options, Retreat
from graspd.picture import Picture
from graspd.retry import Retry
from graspd.seen import CloudView, DepthView, Volume, Workspace

__version__ = version("graspd")

__all__ = [
    "Aborted",
    "Box",
    "Camera",
    "Candidate",
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
    "FoundTable",
    "GeometryWarning",
    "Grasp",
    "Gripper",
    "Internal",
    "InvalidArgument",
    "Latency",
    "Model",
    "NotFound",
    "Options",
    "Picture",
    "Pose",
    "ResourceExhausted",
    "Retreat",
    "Retry",
    "Score",
    "Scores",
    "Tracking",
    "Unauthenticated",
    "Unavailable",
    "Volume",
    "Workspace",
    "aio",
]
