"""Pictures of grasps over the depth image in which they were found."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspd.camera import Camera, intrinsic_matrix
from graspd.geometry import Pose, PoseLike
from graspd.png import png_file
from graspd.seen import DepthView

COLOURS = np.array([[205.0, 40.0, 40.0], [245.0, 195.0, 50.0], [40.0, 165.0, 75.0]])
"""Red, green and blue of the qualities 0, 0.5 and 1."""


@dataclass(frozen=True)
class Picture:
    """A picture that notebooks show."""

    svg: str
    """The picture as SVG."""

    def _repr_svg_(self) -> str:
        return self.svg

    def save(self, path: str | PathLike[str]) -> None:
        """Writes an SVG file, which browsers show."""
        if Path(path).suffix.lower() not in (".svg", ""):
            raise ValueError(f"{path}: the picture is SVG; give a name that ends with .svg, and convert it to other formats")
        Path(path).write_text(self.svg)


def draw(hands: Iterable[tuple[Pose, float, float]], view: DepthView, frame_from_task: PoseLike | None, depth: float) -> Picture:
    """Draws hands over a depth image, each with its pose, its width and its quality; the last is in front. `depth` is the
    length of the fingers, metres."""
    if not isinstance(view, DepthView):
        raise TypeError(f"view is {view!r}, must be the graspd.DepthView in which the grasps were found")
    image = np.ma.filled(view.depth, 0) if np.ma.isMA(view.depth) else np.asarray(view.depth)
    height, width = image.shape[:2]
    image = image.reshape(height, width)
    image = view.k.rectified(image) if isinstance(view.k, Camera) else image
    k, camera_from_frame = intrinsic_matrix(view.k), extrinsics(view, frame_from_task)
    lines = []
    for pose, opening, quality in hands:
        ends = hand(opening, depth) @ (camera_from_frame @ pose.matrix())[:3].T
        if (ends[:, 2] <= 0).any():
            continue
        u, v = ((ends @ k.T)[:, :2] / ends[:, 2:]).T.round(1)
        path = " ".join(f"M{u[i]:g},{v[i]:g}L{u[i + 1]:g},{v[i + 1]:g}" for i in range(0, len(u), 2))
        lines.append(f'<path d="{path}" stroke="{colour(quality)}"><title>quality {quality:.2f}</title></path>')
    pixels = b64encode(png_file(grey(image))).decode()
    return Picture(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="-0.5 -0.5 {width} {height}" width="{width}" height="{height}">'
        f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" href="data:image/png;base64,{pixels}"/>'
        f'<g fill="none" stroke-linecap="round" stroke-width="{width / 320:g}">{"".join(lines)}</g></svg>'
    )


def extrinsics(view: DepthView, frame_from_task: PoseLike | None) -> NDArray[np.floating[Any]]:
    """The matrix that maps points of the grasps' frame into the camera frame."""

    def matrix(pose: PoseLike | None) -> NDArray[np.floating[Any]]:
        if pose is None:
            return np.eye(4)
        return pose.matrix() if isinstance(pose, Pose) else np.asarray(pose, np.float64)

    if view.camera_from_task is not None:
        return matrix(view.camera_from_task) @ np.linalg.inv(matrix(frame_from_task))
    return np.linalg.inv(matrix(view.frame_from_camera))


def hand(opening: float, depth: float) -> NDArray[np.float64]:
    """The lines of a hand in the grasp frame, as pairs of points (x, y, z, 1): two fingers, the bar between them, and the
    wrist."""
    y = opening / 2
    ends = [(-y, 0.0), (-y, depth), (y, 0.0), (y, depth), (-y, 0.0), (y, 0.0), (0.0, 0.0), (0.0, -0.04)]
    return np.array([(0.0, across, along, 1.0) for across, along in ends])


def grey(depth: NDArray[Any]) -> NDArray[np.uint8]:
    """Bright is near, black has no depth. The grey levels span the depths of the image."""
    is_valid = np.isfinite(depth) & (depth > 0)
    near, far = np.quantile(depth[is_valid], [0.01, 0.95]) if is_valid.any() else (0.0, 1.0)
    share = np.clip((far - np.where(is_valid, depth, far)) / max(far - near, 1e-3), 0, 1)
    return np.where(is_valid, 40 + 190 * share, 0).astype(np.uint8)


def colour(quality: float) -> str:
    channels = [np.interp(quality, [0, 0.5, 1], COLOURS[:, channel]) for channel in range(3)]
    return "#" + "".join(f"{int(channel):02x}" for channel in channels)
