"""Poses and vectors."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from graspd.document import short

Vector: TypeAlias = Sequence[float] | NDArray[np.floating[Any]]
"""x, y, z."""


CORRECTED = 1e-2
"""Largest deviation of a rotation from an orthonormal matrix that is corrected: room for three decimals, as in `grasp`."""
EXACT = 1e-3
"""Deviations that are not reported."""


@dataclass(frozen=True)
class Pose:
    """``T_a_b``: maps points of frame b into frame a."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of b's origin in a, metres."""
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Unit quaternion x, y, z, w."""

    @classmethod
    def from_matrix(cls, matrix: NDArray[np.floating[Any]]) -> Pose:
        """From the 4 × 4 matrix that maps points (x, y, z, 1). A rotation with few decimals is orthonormalised; raises
        `ValueError` if it is further from a rigid transform."""
        given = matrix
        try:
            matrix = np.asarray(given, np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"a pose is {short(given)}, must be a graspd.Pose or a 4 × 4 matrix") from None
        if matrix.shape != (4, 4):
            raise ValueError(f"a pose must be a 4 × 4 matrix, got shape {matrix.shape}")
        rotation = matrix[:3, :3]
        deviation = float(np.linalg.norm(rotation @ rotation.T - np.eye(3)))
        # Written so that NaN fails.
        is_rotation = deviation < CORRECTED and np.linalg.det(rotation) > 0
        if not (is_rotation and np.isfinite(matrix).all() and is_last_row(matrix[3])):
            mirrors = ", its determinant is negative: it mirrors" if np.linalg.det(rotation) < 0 else ""
            by_columns = ", send the matrix row by row" if is_last_row(matrix[:, 3]) and not is_last_row(matrix[3]) else ""
            raise ValueError(
                f"a pose must be a rotation and a translation (R·Rᵀ deviates from the identity by {deviation:.3f}, at most "
                f"{CORRECTED} is corrected{mirrors}; the last row must be 0 0 0 1{by_columns}), got\n{matrix}"
            )
        warn_of(deviation)
        # The quaternion is the eigenvector of the largest eigenvalue of a symmetric matrix, whose lower half this is
        # (Bar-Itzhack 2000). The method is stable at every angle.
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
        half = [
            [xx - yy - zz, 0, 0, 0],
            [xy + yx, yy - xx - zz, 0, 0],
            [xz + zx, yz + zy, zz - xx - yy, 0],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
        x, y, z, w = np.linalg.eigh(half)[1][:, -1].tolist()
        px, py, pz = matrix[:3, 3].tolist()
        return cls((px, py, pz), (x, y, z, w))

    def normalised(self) -> Pose:
        """With a quaternion of length 1, if its length is close to it: the server refuses one with few decimals."""
        norm = float(np.linalg.norm(self.quaternion))
        # Written so that NaN is sent, and refused there.
        if not 1e-6 < abs(norm - 1) <= CORRECTED:
            return self
        warn_of(abs(norm - 1))
        x, y, z, w = (value / norm for value in self.quaternion)
        return Pose(self.position, (x, y, z, w))

    def matrix(self) -> NDArray[np.float64]:
        """The 4 × 4 matrix that maps points (x, y, z, 1) of b into a."""
        x, y, z, w = self.quaternion
        matrix = np.eye(4)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, 3] = self.position
        return matrix


def is_last_row(row: NDArray[np.floating[Any]]) -> bool:
    return bool(np.allclose(row, [0, 0, 0, 1], atol=1e-6))


def warn_of(deviation: float) -> None:
    if deviation > EXACT:
        warnings.warn(f"the rotation of a pose has few decimals; it was orthonormalised ({deviation:.4f} off)", stacklevel=3)


PoseLike: TypeAlias = Pose | NDArray[np.floating[Any]]
"""A pose, or the equivalent 4 × 4 matrix."""
