"""What was seen. Arrays of a wrong shape are a `ValueError` here; what they hold is checked by the server."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from graspd.geometry import PoseLike, Vector


@dataclass(frozen=True, eq=False)
class Volume:
    """A truncated signed distance field over a cube of N³ voxels."""

    values: NDArray[Any]
    """``[x][y][z]``, or ``[1][x][y][z]`` as VGN's files have it. In [0, 1]: 0.5 on the surface, above it in front of
    it, below it behind, ``(tsdf + 1) / 2``, and 0 where nothing was observed or no surface is near, as Open3D has it.
    Where they are of uint8: v / 255."""
    _: KW_ONLY
    voxel_size: float | None = None
    """Edge of a voxel, metres; that of a cube of 0.3 m where it is None. Must be the model's."""
    pose: PoseLike | None = None
    """``T_frame_volume``: the volume's corner in `frame_id`; the identity where it is None."""
    frame_id: str = ""
    """The frame in which `pose` is given and the grasps will be."""
    stamp: int | None = None
    """When it was seen, nanoseconds since 1970 (`time.time_ns()`; ROS: ``sec * 10**9 + nanosec``). Comes back."""
    dtype: DTypeLike | None = None
    """How the values travel: float32, float16, or uint8, which keeps 255 steps. As they are, where it is None."""

    def __post_init__(self) -> None:
        shape = np.shape(self.values)
        if len(shape[-3:]) != 3 or len(set(shape[-3:])) != 1 or shape[:-3] not in [(), (1,)] or 0 in shape:
            raise ValueError(f"a volume is a cube [x][y][z], not an array of shape {shape}")


@dataclass(frozen=True, eq=False)
class DepthView:
    """One depth image, rectified. Needs one of `camera_from_task` and `frame_from_camera`."""

    depth: NDArray[Any]
    """``[row][column]``, along the optical axis: metres where it is of floats, millimetres where it is of uint16. 0,
    NaN and infinity are no reading."""
    k: NDArray[np.floating[Any]]
    """The intrinsic matrix, 3 × 3, pixels (ROS: ``CameraInfo.k``). Pixel centres are at whole numbers."""
    _: KW_ONLY
    camera_from_task: PoseLike | None = None
    """``T_camera_task``: maps points of the workspace's cube into the camera (z forward, x right, y down)."""
    frame_from_camera: PoseLike | None = None
    """``T_frame_camera``: where the camera stands in the workspace's `frame_id`, as hand-eye calibration gives it."""

    def __post_init__(self) -> None:
        if np.ndim(self.depth) != 2:
            raise ValueError(f"a depth image is an array [row][column], not one of shape {np.shape(self.depth)}")
        if (self.camera_from_task is None) == (self.frame_from_camera is None):
            raise ValueError("a depth image needs one of camera_from_task and frame_from_camera")


@dataclass(frozen=True, eq=False)
class CloudView:
    """Points that one camera saw."""

    points: NDArray[np.floating[Any]]
    """``[…][3]``: x, y, z, metres. Points with a NaN are left out."""
    camera_position: Vector
    """Where the camera stood, in the frame of the points: (0, 0, 0) where they are in the camera's own."""
    frame_from_cloud: PoseLike | None = None
    """``T_frame_cloud``: the points in the workspace's `frame_id`; the identity where it is None."""

    def __post_init__(self) -> None:
        if np.shape(self.points)[-1:] != (3,):
            raise ValueError(f"a cloud is an array of x, y, z, not one of shape {np.shape(self.points)}")


@dataclass(frozen=True, eq=False)
class Workspace:
    """The cube in which grasps are looked for. Its frame, the task frame, has its origin at a corner, z up."""

    pose: PoseLike | None = None
    """``T_frame_task``: the cube's corner in `frame_id`; the identity where it is None."""
    size: float | None = None
    """Edge, metres; what the model was trained for, where it is None."""
    frame_id: str = ""
    """The frame in which `pose` is given and the grasps will be."""
    stamp: int | None = None
    """When the views were taken, nanoseconds since 1970. Comes back."""
