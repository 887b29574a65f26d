"""A synthetic scene, a block on a table, with the values of tests/src/scene.rs. Metres, in the task frame."""

import numpy as np

SIZE = 0.3
RESOLUTION = 40
TABLE = 0.05
# The corners of the block's box.
BLOCK = np.array([[0.13, 0.11, TABLE], [0.17, 0.19, 0.15]])

WIDTH, HEIGHT = 160, 120
K = np.array([[135.0, 0.0, 79.5], [0.0, 135.0, 59.5], [0.0, 0.0, 1.0]])


def camera(polar, azimuth):
    """T_camera_task of a camera at 0.6 m from the middle of the scene; angles from and about the vertical, degrees."""
    polar, azimuth = np.radians([polar, azimuth])
    direction = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    up = np.array([-np.cos(polar) * np.cos(azimuth), -np.cos(polar) * np.sin(azimuth), np.sin(polar)])
    task_from_camera = np.eye(4)
    task_from_camera[:3, :3] = np.column_stack([np.cross(up, direction), -up, -direction])
    task_from_camera[:3, 3] = [0.15, 0.15, 0.08] + 0.6 * direction
    return np.linalg.inv(task_from_camera)


def rays():
    """The ray of each pixel, with a length of 1 along the optical axis."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T


def depth(camera_from_task, with_block=True, along=None):
    """The depth image of a camera, [row][column], along its optical axis; 0 without a reading. `along`: other rays."""
    task_from_camera = np.linalg.inv(camera_from_task)
    along = rays() if along is None else along
    eye, directions = task_from_camera[:3, 3], along @ task_from_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        table = (TABLE - eye[2]) / directions[..., 2]
        sides = (BLOCK[:, None, None] - eye) / directions
    enter, leave = sides.min(axis=0).max(axis=-1), sides.max(axis=0).min(axis=-1)
    block = np.where(enter <= leave, enter, np.inf) if with_block else np.inf
    nearest = np.minimum(block, np.where(table > 0, table, np.inf))
    return np.where(np.isfinite(nearest), nearest, 0).astype(np.float32)


def cloud(camera_from_task):
    """The depth image as points in the camera's frame, plus one NaN point."""
    image = depth(camera_from_task)
    points = rays() * image[..., None]
    return np.vstack([points[image > 0], [[np.nan] * 3]]).astype(np.float32)


def volume(*cameras):
    """The volume fused from the depth images, [x][y][z], as in Open3D and VGN: (tsdf + 1) / 2 near a surface, else 0.
    The distance of a voxel is measured along the ray of its pixel."""
    centres = (np.stack(np.mgrid[:RESOLUTION, :RESOLUTION, :RESOLUTION], axis=-1) + 0.5) * SIZE / RESOLUTION
    truncation = 4 * SIZE / RESOLUTION
    total, seen = np.zeros(centres.shape[:3]), np.zeros(centres.shape[:3])
    for camera_from_task in cameras:
        points = centres @ camera_from_task[:3, :3].T + camera_from_task[:3, 3]
        pixels = points @ K.T / points[..., 2:]
        u, v = np.moveaxis(np.floor(pixels[..., :2] + 0.5).astype(int), -1, 0)
        inside = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
        u, v = np.where(inside, u, 0), np.where(inside, v, 0)
        reading = depth(camera_from_task)[v, u]
        distance = (reading - points[..., 2]) * np.linalg.norm(rays(), axis=-1)[v, u] / truncation
        measured = inside & (reading > 0) & (distance > -1)
        total += np.where(measured, np.minimum(distance, 1), 0)
        seen += measured
    tsdf = total / np.maximum(seen, 1)
    return np.where((seen > 0) & (np.abs(tsdf) < 0.98), (tsdf + 1) / 2, 0).astype(np.float32)


def is_at_the_block(grasp):
    """Whether the point between the fingertips is within 0.03 m of the block."""
    tips = (grasp.pose.matrix() @ [0, 0, 0.05, 1])[:3]
    return bool(np.all(tips > BLOCK[0] - 0.03) and np.all(tips < BLOCK[1] + 0.03))
