"""The depth camera of the benchmark: poses, rendering and noise."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pybullet  # type: ignore[import-not-found]
from graspd import DepthView
from numpy.typing import NDArray
from world import World

Array: TypeAlias = NDArray[np.float64]

WIDTH, HEIGHT = 640, 480
K: Array = np.array([[540.0, 0.0, 320.0], [0.0, 540.0, 240.0], [0.0, 0.0, 1.0]])
NEAR, FAR = 0.1, 2.0

# A point within these bounds counts as a point of an object: above the table, away from the borders (GIGA's code).
LOWEST = (0.02, 0.02, 0.055)
HIGHEST = (0.28, 0.28, 0.3)


def look_at(target: Sequence[float], distance: float, polar: float, azimuth: float) -> Array:
    """T_camera_task of an upright camera that looks at `target` from `distance`, metres. `polar` is its angle from the
    vertical and `azimuth` its angle about the vertical, radians."""
    away = np.array([math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    task_from_camera = np.eye(4)
    task_from_camera[:3, :3] = np.column_stack([right, np.cross(right, away), -away])
    task_from_camera[:3, 3] = target + distance * away
    return np.asarray(np.linalg.inv(task_from_camera), np.float64)


def side(azimuth: float = 0.0) -> list[Array]:
    """The paper's single side view, rotated by `azimuth` about the vertical, radians."""
    return [look_at((0.15, 0.15, 0.1), 0.6, math.pi / 3, azimuth - math.pi / 2)]


def circle(count: int = 6) -> list[Array]:
    """`count` views on VGN's circle, 30° from the vertical."""
    return [look_at((0.15, 0.15, 0.0), 0.6, math.pi / 6, 2 * math.pi * i / count) for i in range(count)]


def render(world: World, camera_from_task: Array) -> tuple[NDArray[np.uint8], Array]:
    """The colour image `[row][column][red, green, blue]` and the depth `[row][column]`, metres, without noise."""
    # OpenGL's camera looks along -z, with y up.
    view = np.diag([1.0, -1.0, -1.0, 1.0]) @ camera_from_task
    fov = math.degrees(2 * math.atan(K[1, 2] / K[1, 1]))
    _, _, colours, buffer, _ = world.bullet.getCameraImage(
        WIDTH,
        HEIGHT,
        view.ravel(order="F").tolist(),
        pybullet.computeProjectionMatrixFOV(fov, WIDTH / HEIGHT, NEAR, FAR),
        renderer=pybullet.ER_TINY_RENDERER,
    )
    picture = np.reshape(np.asarray(colours, np.uint8), (HEIGHT, WIDTH, 4))[..., :3]
    return picture, FAR * NEAR / (FAR - (FAR - NEAR) * np.reshape(np.asarray(buffer, float), (HEIGHT, WIDTH)))


def observe(world: World, cameras: Sequence[Array], noise: np.random.Generator | None = None) -> list[DepthView]:
    """The depth image of each camera. With a generator `noise`, the benchmark's noise is added."""
    views = []
    for camera_from_task in cameras:
        _, depth = render(world, camera_from_task)
        if noise is not None:
            depth = noisy(depth, noise)
        views.append(DepthView(depth.astype(np.float32), K, camera_from_task=camera_from_task))
    return views


def noisy(depth: Array, rng: np.random.Generator) -> Array:
    """Adds the noise of GIGA's evaluation (Dex-Net's model): a Gamma-distributed factor per image, and with probability
    0.5 noise N(0, 5 mm), drawn on a grid of a quarter of the resolution and enlarged bilinearly."""
    depth = depth * rng.gamma(1000.0, 0.001)
    if rng.random() < 0.5:
        coarse = rng.normal(0.0, 0.005, (HEIGHT // 4, WIDTH // 4))
        depth = depth + enlarging(HEIGHT) @ coarse @ enlarging(WIDTH).T
    return depth


def enlarging(pixels: int) -> Array:
    """The weights `[pixel][cell]` that enlarge a row by a factor of four with linear interpolation."""
    cells = np.arange(pixels // 4)
    at = np.clip((np.arange(pixels) + 0.5) / 4 - 0.5, 0, cells[-1])
    return np.maximum(0.0, 1.0 - np.abs(at[:, None] - cells))


def points(view: DepthView) -> Array:
    """x, y, z of each pixel in the task frame, `[row][column][3]`, metres."""
    rows, columns = np.indices(view.depth.shape)
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(np.asarray(view.k)).T
    task_from_camera = np.linalg.inv(np.asarray(view.camera_from_task))
    seen: Array = (rays * view.depth[..., None]) @ task_from_camera[:3, :3].T + task_from_camera[:3, 3]
    return seen


def is_within_reach(positions: Array) -> NDArray[np.bool_]:
    """Whether each position is between `LOWEST` and `HIGHEST`."""
    inside: NDArray[np.bool_] = np.all((positions >= LOWEST) & (positions <= HIGHEST), axis=-1)
    return inside


def sees_anything(views: Sequence[DepthView]) -> bool:
    """Whether any pixel shows a point of an object."""
    return any(bool(is_within_reach(points(view)).any()) for view in views)


def save_png(path: Path, picture: NDArray[np.uint8]) -> None:
    """Writes an image `[row][column][red, green, blue]`. Written by hand, so that no image library is required."""
    height, width, _ = picture.shape
    # Each row begins with its filter type, 0: no filter.
    rows = np.pad(picture.reshape(height, -1), [(0, 0), (1, 0)]).tobytes()
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    file = b"\x89PNG\r\n\x1a\n"
    for kind, data in chunks:
        file += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    path.write_bytes(file)
