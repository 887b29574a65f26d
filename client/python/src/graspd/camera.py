"""Cameras as ROS and calibration files describe them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspd.calibration import FISHEYE, POLYNOMIAL, find, whole
from graspd.document import number, numbers, plain, read, short

COUNTS = (4, 5, 8, 12)
"""Numbers of the coefficients of `plumb_bob`, `rational_polynomial` and its form with thin prisms, in OpenCV's order."""


@dataclass(frozen=True, eq=False)
class Camera:
    """The intrinsics of a camera, the size of its images and the distortion of its lens: `DepthView.k` in place of a matrix.
    Images of another size are refused. If there is a distortion, images are rectified before they are sent: for images that
    are rectified already, give `rectified` to `read` or `from_info`."""

    k: NDArray[np.floating[Any]]
    """The 3 × 3 intrinsic matrix, pixels, or a 3 × 4 projection matrix without a translation."""
    _: KW_ONLY
    size: tuple[int | None, int | None] | None = None
    """Width and height of the images, pixels; None: any."""
    distortion: Sequence[float] = ()
    """Coefficients in the order of OpenCV and ROS: 4, 5, 8 or 12, or 4 of `equidistant`. Empty or 0: none."""
    distortion_model: str = "plumb_bob"
    """``plumb_bob``, ``rational_polynomial``, or ``equidistant`` for OpenCV's fisheye."""
    depth_scale: float | None = None
    """Unit of integer depths, metres; None: 0.001."""
    binning: tuple[int, int] = (1, 1)
    """How many pixels of the sensor one of the image combines, along x and y. `k` and `size` are those of the image."""

    def __post_init__(self) -> None:
        intrinsic_matrix(self.k)
        # Lists and arrays are accepted.
        coefficients = numbers(self.distortion)
        if coefficients is None or not all(map(np.isfinite, coefficients)):
            raise ValueError(f"distortion is {self.distortion!r}, must be finite numbers")
        object.__setattr__(self, "distortion", tuple(coefficients))
        if self.size is not None:
            edges: Any = self.size
            if np.shape(edges) != (2,) or not all(edge is None or whole(number(edge)) for edge in self.size):
                raise ValueError(f"size is {self.size!r}, must be the width and the height in pixels")
            object.__setattr__(self, "size", tuple(edge if edge is None else int(edge) for edge in self.size))
        is_number = isinstance(self.depth_scale, Real) and not isinstance(self.depth_scale, bool)
        if self.depth_scale is not None and not (is_number and 0 < self.depth_scale <= 1):
            raise ValueError(f"depth_scale is {self.depth_scale!r}, must be the unit of integer depths in metres: 0.001")
        if not self._is_distorted():
            return
        count = len(self.distortion)
        model = plain(self.distortion_model)
        is_known = count in COUNTS if model in POLYNOMIAL else model in FISHEYE and count == 4
        if not is_known:
            raise ValueError(
                f"distortion {self.distortion_model!r} with {count} coefficients is not supported: rectify the image, and "
                "give the intrinsics of the rectified one"
            )

    @classmethod
    def from_info(cls, info: Any, *, rectified: bool = False) -> Camera:
        """From a ``CameraInfo`` of ROS 1 or 2: a message, or a dictionary with its fields or those of a file that `read`
        reads. `rectified`: for images that are rectified already, as those of ``image_rect`` topics: their matrix is `p`
        (of a dictionary without it, `k`), and the distortion is not applied. Without it they would be rectified twice. A
        part of the sensor (`roi`) and combined pixels (`binning`) are taken into account."""

        if isinstance(info, Mapping):
            return cls._found(info, rectified)

        def field(*names: str) -> Any:
            of = info.get if isinstance(info, Mapping) else lambda name: getattr(info, name, None)
            value = next((value for value in map(of, names) if value is not None), None)
            # The files of camera_calibration have matrices with rows, cols and data.
            return value["data"] if isinstance(value, Mapping) and "data" in value else value

        matrix = field("p", "P", "projection_matrix") if rectified else field("k", "K", "camera_matrix")
        if matrix is None:
            raise ValueError(f"a CameraInfo must have {'p' if rectified else 'k'}, got {info!r}")
        k = intrinsic_matrix(matrix).copy()
        if not k[0, 0]:
            raise ValueError("the matrix of the CameraInfo is 0: the camera is not calibrated")
        roi = field("roi")
        x, y, cropped_width, cropped_height = (number_of(roi, name) for name in ["x_offset", "y_offset", "width", "height"])
        binning = np.maximum([int(field(name) or 0) for name in ["binning_x", "binning_y"]], 1)
        # The matrix is that of the whole sensor. Pixel centres are at whole numbers.
        k[[0, 1], [0, 1]] /= binning
        k[:2, 2] = (k[:2, 2] - (x, y) + 0.5) / binning - 0.5
        width = cropped_width or int(field("width", "image_width") or 0)
        height = cropped_height or int(field("height", "image_height") or 0)
        distortion = field("d", "D", "distortion_coefficients")
        return cls(
            k,
            size=(width // int(binning[0]), height // int(binning[1])) if width and height else None,
            distortion=() if rectified or distortion is None else tuple(float(value) for value in distortion),
            distortion_model=str(field("distortion_model") or "plumb_bob"),
            binning=(int(binning[0]), int(binning[1])),
        )

    @classmethod
    def read(cls, path: str | PathLike[str], *, rectified: bool = False) -> Camera:
        """From a file of ROS (``CameraInfo`` as ``ros2 topic echo`` prints it), OpenCV, Open3D, librealsense, kalibr, BOP and
        others: JSON, YAML (needs the package PyYAML), a matrix as text, .npy or .npz. `rectified`: as for `from_info`."""
        document = read(Path(path))
        try:
            return cls._found(document, rectified)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    @classmethod
    def _found(cls, document: Any, rectified: bool) -> Camera:
        found = find(document, rectified)
        return cls(
            np.reshape(found.k, (3, 3)),
            size=found.size,
            distortion=found.distortion,
            distortion_model=found.distortion_model,
            depth_scale=found.depth_scale,
            binning=found.binning,
        )

    def check_size(self, width: int, height: int) -> None:
        """Raises `ValueError` if images of this camera have another size."""
        own = self.size or (None, None)
        image = (width, height)
        differing = [axis for axis in range(2) if own[axis] is not None and own[axis] != image[axis]]
        if not differing:
            return
        scale = image[differing[0]] / (own[differing[0]] or 1)
        is_binned = [edge is None or edge * bins == of_image for edge, bins, of_image in zip(own, self.binning, image)]
        if self.binning != (1, 1) and all(is_binned):
            x, y = self.binning
            advice = f"the file has a binning of {x} × {y}; if the image is not binned, set binning_x and binning_y to 1"
        elif own == (height, width):
            advice = "width and height are exchanged: correct them, or give the image as the camera sees it, not rotated"
        # Rounded sizes of a scaled image differ by a pixel.
        elif all(edge is None or abs(scale * edge - of_image) <= 1 for edge, of_image in zip(own, image)):
            k = (intrinsic_matrix(self.k) * scale).round(4)
            advice = f"if the image was scaled, fx, fy, cx, cy are {k[0, 0]:g}, {k[1, 1]:g}, {k[0, 2]:g}, {k[1, 2]:g}"
        else:
            advice = "if the image was cropped, subtract the left and upper margin from cx and cy"
        raise ValueError(
            f"the intrinsics are of images of {own[0] or '?'} × {own[1] or '?'} pixels, the image has {width} × {height}; {advice}"
        )

    def rectified(self, image: NDArray[Any]) -> NDArray[Any]:
        """The image ``[row][column]`` without the distortion of the lens. Each pixel has the value of the nearest one, so that
        depths are not mixed over edges; 0 outside of the image."""
        if not self._is_distorted():
            return image
        height, width = image.shape
        (fx, _, cx), (_, fy, cy), _ = intrinsic_matrix(self.k)
        v, u = np.mgrid[:height, :width]
        x, y = self._distorted((u - cx) / fx, (v - cy) / fy)
        u, v = np.rint(fx * x + cx), np.rint(fy * y + cy)
        is_inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        seen = np.zeros_like(image)
        seen[is_inside] = image[v[is_inside].astype(int), u[is_inside].astype(int)]
        return seen

    def _is_distorted(self) -> bool:
        return any(self.distortion)

    def _distorted(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where the lens shows the points that a pinhole camera shows at (x, y), both for a focal length of 1, by the
        formulas of OpenCV (modules calib3d and fisheye)."""
        r2 = x * x + y * y
        if plain(self.distortion_model) in FISHEYE:
            r = np.sqrt(r2)
            theta = np.arctan(r)
            powers = np.stack([theta ** (2 * power) for power in range(5)], axis=-1)
            scale = theta * (powers @ [1.0, *self.distortion]) / np.maximum(r, 1e-9)
            scale = np.where(r > 1e-9, scale, 1.0)
            return x * scale, y * scale
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = [*self.distortion, *[0.0] * (12 - len(self.distortion))]
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4),
        )


def number_of(roi: Any, name: str) -> int:
    """A number of a region of interest; 0 if there is none."""
    value = roi.get(name) if isinstance(roi, Mapping) else getattr(roi, name, None)
    return int(value or 0)


def intrinsic_matrix(k: Any) -> NDArray[np.float64]:
    """The 3 × 3 matrix of a 3 × 3 or a 3 × 4 matrix, or of a camera."""
    try:
        matrix: NDArray[np.float64] = np.asarray(k.k if isinstance(k, Camera) else k, np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"k is {short(k)}, must be a 3 × 3 matrix or a graspd.Camera, as Camera.read returns it") from None
    if matrix.size == 12:
        matrix = matrix.reshape(3, 4)
        if matrix[:, 3].any():
            raise ValueError(f"k must be a 3 × 3 matrix; the fourth column is {matrix[:, 3].tolist()}, must be 0")
        matrix = matrix[:, :3]
    if matrix.size != 9:
        raise ValueError(f"k must be a 3 × 3 matrix, got shape {matrix.shape}")
    return matrix.reshape(3, 3)
