"""Observations. Arrays of a wrong shape raise `ValueError`; the server validates the values."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from graspd.document import listed
from graspd.camera import Camera, intrinsic_matrix
from graspd.geometry import PoseLike, Vector


@dataclass(frozen=True, eq=False)
class Volume:
    """A truncated signed distance field over a cube of N³ voxels."""

    values: NDArray[Any]
    """``[x][y][z]``, or ``[1][x][y][z]`` as in VGN's files. Values in [0, 1], ``(tsdf + 1) / 2``: 0.5 on the surface,
    greater in front of it, smaller behind it, and 0 for voxels that are unobserved or not near a surface, as in Open3D.
    uint8 values mean v / 255."""
    _: KW_ONLY
    voxel_size: float | None = None
    """Edge of a voxel, metres; must be the model's. None: 0.3 m / N."""
    pose: PoseLike | None = None
    """``T_frame_volume``: pose of the volume's corner in `frame_id`; None: identity."""
    frame_id: str = ""
    """Name of the frame of `pose` and of the grasps."""
    stamp: int | None = None
    """Time of the observation, nanoseconds since 1970 (`time.time_ns()`; ROS: ``sec * 10**9 + nanosec``). The server
    returns it unchanged."""
    dtype: DTypeLike | None = None
    """Encoding of the values on the wire: float32, float16 or uint8 (255 steps). None: that of `values`."""

    def __post_init__(self) -> None:
        shape = np.shape(self.values)
        if len(shape[-3:]) != 3 or len(set(shape[-3:])) != 1 or shape[:-3] not in [(), (1,)] or 0 in shape:
            raise ValueError(f"a volume must be a cube [x][y][z], got shape {shape}")


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth image with its camera pose: one of `camera_from_task` and `frame_from_camera`. A single view may
    have neither if the workspace has `find_table`: the frame is then that of the camera."""

    depth: Any
    """``[row][column]`` or ``[row][column][1]``, an array or an image of PIL: distance along the optical axis, floats in
    metres or integers in millimetres. 0, NaN, infinity and masked pixels mean no reading."""
    k: NDArray[np.floating[Any]] | Camera
    """The 3 × 3 intrinsic matrix, pixels, or a 3 × 4 projection matrix without a translation; or a `Camera`, which also knows
    the size of its images and its distortion (ROS: ``Camera.from_info(message)``). Pixel centres have integer
    coordinates."""
    _: KW_ONLY
    camera_from_task: PoseLike | None = None
    """``T_camera_task``: maps points of the task frame into the camera frame (z forward, x right, y down)."""
    frame_from_camera: PoseLike | None = None
    """``T_frame_camera``: the camera's pose in the workspace's `frame_id`, as hand-eye calibration returns it."""
    labels: Any = None
    """``[row][column]``: label of the object that each pixel shows, whole numbers from 0 to 65535, or truth values; 0 is no
    object. None: unknown."""
    png: bool = False
    """Send integer depths as PNG: fewer bytes on a slow network, for a few milliseconds of computation."""

    def __post_init__(self) -> None:
        shape = np.shape(self.depth)
        if len(shape) != 2 and (len(shape) != 3 or shape[2] != 1):
            raise ValueError(f"a depth image must be an array [row][column], got shape {shape}")
        if self.labels is not None and np.shape(self.labels) not in (shape, shape[:2]):
            raise ValueError(f"labels must have the shape of depth, got {np.shape(self.labels)}")
        intrinsic_matrix(self.k)
        if isinstance(self.k, Camera):
            self.k.check_size(shape[1], shape[0])
        if self.camera_from_task is not None and self.frame_from_camera is not None:
            raise ValueError("a depth image has one of camera_from_task and frame_from_camera, got both")


@dataclass(frozen=True, eq=False)
class CloudView:
    """A point cloud observed by one camera."""

    points: NDArray[np.floating[Any]]
    """``[…][3]``: x, y, z, metres; colours or normals may follow. Or a structured array with the fields x, y and z, as from
    ROS's ``PointCloud2``. Points that are masked or have a NaN are ignored."""
    camera_position: Vector
    """Position of the camera in the frame of the points, metres: (0, 0, 0) for points in the camera frame."""
    frame_from_cloud: PoseLike | None = None
    """``T_frame_cloud``: maps the points into the workspace's `frame_id`; None: identity."""
    labels: NDArray[np.integer[Any]] | None = None
    """``[…]``: label of the object of each point, whole numbers from 0 to 65535, or truth values; 0 is no object. None:
    unknown."""
    scale: float | None = None
    """Unit of the points, metres: 0.001 for millimetres; None: 0.001 for integers and 1 for floats. `camera_position` is in
    metres."""

    def __post_init__(self) -> None:
        is_number = isinstance(self.scale, Real) and not isinstance(self.scale, bool)
        if self.scale is not None and not (is_number and 0 < self.scale < np.inf):
            raise ValueError(f"scale is {self.scale!r}, must be a number above 0: 0.001 for points in millimetres")
        if np.shape(self.camera_position) != (3,):
            raise ValueError(f"camera_position is {self.camera_position!r}, must be x, y, z in metres")
        points = coordinates(self.points)
        if self.labels is not None and np.shape(self.labels) != points.shape[:-1]:
            raise ValueError(f"labels must be one for each point, got shape {np.shape(self.labels)}")


def coordinates(points: Any) -> NDArray[Any]:
    """x, y and z of each point; NaN for masked points."""
    names = getattr(getattr(points, "dtype", None), "names", None)
    if names is not None:
        axes = {name.lower(): name for name in names}
        if not {"x", "y", "z"} <= set(axes):
            raise ValueError(f"a structured point cloud must have the fields x, y and z, got {listed(names)}")
        points = np.ma.stack([points[axes[axis]] for axis in "xyz"], axis=-1)
    if np.ma.isMA(points):
        is_masked = np.ma.getmaskarray(points).any()
        points = np.ma.filled(points.astype(np.float32), np.nan) if is_masked else np.asarray(points)
    array: NDArray[Any] = np.asarray(points)
    if array.shape[-1:] not in [(count,) for count in range(3, 8)] or not np.issubdtype(array.dtype, np.number):
        raise ValueError(f"a point cloud must be an array […][3] of x, y, z, got shape {array.shape} of {array.dtype}")
    return array[..., :3]


def unit_of(view: CloudView) -> float:
    """The unit of the points, metres. Integers are in millimetres, as in `grasp`."""
    if view.scale is not None:
        return float(view.scale)
    dtype = getattr(view.points, "dtype", None)
    kinds = [dtype[name] for name in dtype.names if name.lower() == "x"] if dtype is not None and dtype.names else [dtype]
    return 1e-3 if kinds[0] is not None and np.issubdtype(kinds[0], np.integer) else 1.0


@dataclass(frozen=True, eq=False)
class Workspace:
    """The cube that views are fused into and in which grasps are detected. The task frame has its origin at a corner of
    the cube, z up."""

    pose: PoseLike | None = None
    """``T_frame_task``: pose of the task frame in `frame_id`; None: identity."""
    size: float | None = None
    """Edge length, metres; None: the size that the model was trained with."""
    frame_id: str = ""
    """Name of the frame of `pose` and of the grasps."""
    stamp: int | None = None
    """Time of the observation, nanoseconds since 1970. The server returns it unchanged."""
    find_table: bool = False
    """Find the table in the first depth image or point cloud, and the objects on it: without an `extent` the workspace covers
    all of them, with at most 12 cubes. With one view without labels, grasps are on these objects only. `pose` must be None;
    what was found is in `Detection.table`."""
    gravity: Vector | None = None
    """For `find_table`: direction of gravity in `frame_id`, of any length above 0. An accelerometer at rest measures the
    opposite. None: unknown; a wall that fills the image is then taken for a table."""
    extent: tuple[float, float] | None = None
    """Lengths along x and y of a larger workspace, metres, at most 2. The server covers it with overlapping cubes. None:
    one cube, or with `find_table` as many as the objects need."""
    correct_depth_scale: bool | None = None
    """Multiply the depths of each view by one factor, so that the table in it is at `CollisionCheck.table_height`. None: in
    depth images whose table is level and at most 3 cm from its height. True is an error with `find_table`. The factors are
    in `Detection.depth_factors`."""
