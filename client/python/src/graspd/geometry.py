"""Poses and vectors."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

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
        matrix = np.asarray(matrix, np.float64)
        if matrix.shape != (4, 4):
            raise ValueError(f"a pose must be a 4 × 4 matrix, got shape {matrix.shape}")
        rotation = matrix[:3, :3]
        deviation = float(np.linalg.norm(rotation @ rotation.T - np.eye(3)))
        # Written so that NaN fails.
        is_rotation = deviation < CORRECTED and np.linalg.det(rotation) > 0
        if not (is_rotation and np.isfinite(matrix).all() and np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6)):
            raise ValueError(
                f"a pose must be a rotation and a translation (R·Rᵀ deviates from the identity by {deviation:.3f}, at most "
                f"{CORRECTED} is corrected; the last row must be 0 0 0 1), got\n{matrix}"
            )
        if deviation > EXACT:
            warnings.warn(f"the rotation of a pose has few decimals; it was orthonormalised ({deviation:.4f} off)", stacklevel=2)
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


PoseLike: TypeAlias = Pose | NDArray[np.floating[Any]]
"""A pose, or the equivalent 4 × 4 matrix."""
