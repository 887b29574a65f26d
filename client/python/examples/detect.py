"""Detects grasps in one depth image: `python detect.py 127.0.0.1:50051`.

`client/examples/detect.rs` and `client/cpp` send the same request and print the same grasps.
"""

import sys

import graspd
import numpy as np

# Intrinsic matrix, pixels.
K = np.array([[135, 0, 79.5], [0, 135, 59.5], [0, 0, 1]])
# The camera in the robot's base: 30° from the vertical.
CAMERA = graspd.Pose((0.15, -0.15, 0.6), (0.9659258, 0, 0, -0.258819))


def synthetic_image() -> np.ndarray:
    """What that camera sees, metres: a block of 4 × 8 × 10 cm in the middle of the workspace, on a table at z = 0.05 m."""
    eye, low, high = np.array([0.15, -0.15, 0.6]), np.array([0.13, 0.11, 0.05]), np.array([0.17, 0.19, 0.15])
    v, u = np.mgrid[:120, :160]
    x, y = (u - 79.5) / 135, (v - 59.5) / 135
    sine, cosine = 0.5, np.sqrt(0.75)
    rays = np.stack([x, sine - cosine * y, -cosine - sine * y], axis=-1)
    spans = np.sort([(low - eye) / rays, (high - eye) / rays], axis=0)
    enter, leave = spans[0].max(axis=-1), spans[1].min(axis=-1)
    return np.where(enter <= leave, enter, (low[2] - eye[2]) / rays[..., 2]).astype(np.float32)


def main(server: str = "127.0.0.1:50051") -> None:
    view = graspd.DepthView(synthetic_image(), K, frame_from_camera=CAMERA)
    # The workspace: a cube of 0.3 m with the axes of the robot's base.
    workspace = graspd.Workspace(graspd.Pose((0, 0, 0)), frame_id="base")
    options = graspd.Options(
        max_grasps=5,
        # Grasps from above, at most 1 rad from the vertical, without collision of the open hand.
        approach=graspd.Cone((0, 0, -1), 1),
        collision=graspd.CollisionCheck("filter"),
    )
    with graspd.Client(server, timeout=2) as client:
        found = client.detect_from_depth([view], workspace, options)

    print(f"{found.model} {found.version}: grasps in {found.frame_id}: {len(found.grasps)}")
    for grasp in found.grasps:
        at, turned, start = grasp.pose.position, grasp.pose.quaternion, grasp.pregrasp.position
        numbers = " ".join
        print(
            f"quality {grasp.quality:.3f} width {grasp.width:.3f}",
            "at", numbers(f"{x:.3f}" for x in at),
            "turned", numbers(f"{x:.3f}" for x in turned),
            "from", numbers(f"{x:.3f}" for x in start),
        )  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:])
