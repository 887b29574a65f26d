"""Writes the files that people have of one scene: the block on a table of scene.py, seen by a camera of 160 × 120 pixels."""

import json
import struct
import zlib

import numpy as np
import scene
import yaml

CAMERA_FROM_TASK = scene.camera(35, -90)
POSE = np.linalg.inv(CAMERA_FROM_TASK)
K = scene.K
DEPTH = scene.depth(CAMERA_FROM_TASK)
MILLIMETRES = np.rint(DEPTH * 1000).astype(np.uint16)
POINTS = (scene.rays() * DEPTH[..., None]).astype(np.float32)
# Coefficients of distortion, by model.
LENSES = {
    "plumb_bob": [-0.25, 0.08, 0.001, -0.001, 0.0],
    "rational_polynomial": [0.4, -0.1, 0.0005, 0.0005, 0.01, 0.7, -0.1, 0.02],
    "equidistant": [0.02, -0.01, 0.003, -0.001],
}
ON_BLOCK = np.abs(DEPTH - scene.depth(CAMERA_FROM_TASK, with_block=False)) > 1e-3


def png(path, image):
    """A grey PNG with 8 or 16 bits."""
    image = np.asarray(image)
    rows = b"".join(b"\0" + row.tobytes() for row in image.astype(image.dtype.newbyteorder(">")))
    header = struct.pack(">IIBBBBB", image.shape[1], image.shape[0], 8 * image.itemsize, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    body = b"".join(struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def tiff(path, image):
    """A TIFF with one strip of 32-bit floats."""
    data = image.astype("<f4").tobytes()
    height, width = image.shape
    tags = [(256, width), (257, height), (258, 32), (259, 1), (262, 1), (273, 8), (277, 1), (278, height)]
    tags += [(279, len(data)), (339, 3)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    head = b"II*\0" + struct.pack("<I", 8 + len(data))
    path.write_bytes(head + data + struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0))


def exr(path, channels):
    """An uncompressed OpenEXR file with 32-bit floats. `channels` maps the names to images."""
    names = sorted(channels)
    height, width = channels[names[0]].shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    listed = b"".join(name.encode() + b"\0" + struct.pack("<i4x2i", 2, 1, 1) for name in names) + b"\0"
    attributes = [
        (b"channels", b"chlist", listed), (b"compression", b"compression", b"\0"), (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window), (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1)), (b"screenWindowCenter", b"v2f", struct.pack("<2f", 0, 0)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1)),
    ]
    head = b"\x76\x2f\x31\x01\x02\0\0\0"
    head += b"".join(n + b"\0" + t + b"\0" + struct.pack("<i", len(v)) + v for n, t, v in attributes) + b"\0"
    line = 8 + 4 * width * len(names)
    first = len(head) + 8 * height
    body = struct.pack(f"<{height}Q", *(first + row * line for row in range(height)))
    for row in range(height):
        body += struct.pack("<2i", row, line - 8)
        body += b"".join(channels[name][row].astype("<f4").tobytes() for name in names)
    path.write_bytes(head + body)


def camera_info(k=K, size=(scene.WIDTH, scene.HEIGHT), d=(), model="plumb_bob"):
    """A CameraInfo message as `ros2 topic echo` prints it."""
    width, height = size
    p = np.hstack([k, np.zeros((3, 1))])
    values = {"width": width, "height": height, "distortion_model": model, "d": list(map(float, d))}
    return yaml.dump(values | {"k": k.flatten().tolist(), "r": np.eye(3).flatten().tolist(), "p": p.flatten().tolist()})


def opencv(name, matrix):
    """A matrix as OpenCV's FileStorage writes it."""
    rows, cols = matrix.shape
    numbers = ", ".join(f"{value:.17g}" for value in matrix.flatten())
    return f"%YAML:1.0\n---\n{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {numbers} ]\n"


def quaternion(matrix=POSE):
    """The quaternion x, y, z, w of a pose."""
    _, vectors = np.linalg.eigh(quadratic_form(matrix[:3, :3]))
    return vectors[:, -1]


def quadratic_form(rotation):
    """The symmetric matrix whose eigenvector of the largest eigenvalue is the quaternion of a rotation (Bar-Itzhack)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    return np.array(
        [[a - e - i, d + b, g + c, h - f], [d + b, e - a - i, h + f, c - g], [g + c, h + f, i - a - e, d - b],
         [h - f, c - g, d - b, a + e + i]]
    ) / 3


def poses(folder):
    """Files with the pose of the camera, by name."""
    x, y, z = POSE[:3, 3].tolist()
    qx, qy, qz, qw = quaternion().tolist()
    xyz, xyzw = {"x": x, "y": y, "z": z}, {"x": qx, "y": qy, "z": qz, "w": qw}
    rows = POSE.tolist()
    texts = {
        "rows.json": json.dumps(rows),
        "easy_handeye.yaml": yaml.dump({"parameters": {"eye_on_hand": False}, "transformation": xyz | {f"q{n}": v for n, v in xyzw.items()}}),
        "transform_stamped.yaml": yaml.dump({"header": {"frame_id": "base"}, "child_frame_id": "camera", "transform": {"translation": xyz, "rotation": xyzw}}),
        "pose.yaml": yaml.dump({"position": [x, y, z], "orientation": [qx, qy, qz, qw]}),
        "opencv_pose.yaml": opencv("T_base_camera", POSE),
        "xyz_keys.json": json.dumps({"position": xyz, "orientation": xyzw}),
        "named_matrix.json": json.dumps({"T_base_camera": rows}),
        "upper_keys.json": json.dumps({"position": xyz, "orientation": {k.upper(): v for k, v in xyzw.items()}}),
        "rotation_matrix.json": json.dumps({"R": POSE[:3, :3].tolist(), "t": [x, y, z]}),
        "3x4.json": json.dumps(rows[:3]),
        "tf.yaml": yaml.dump({"transforms": [{"transform": {"translation": xyz, "rotation": xyzw}}]}),
        "two_decimals.json": json.dumps({"position": [x, y, z], "orientation": np.round([qx, qy, qz, qw], 2).tolist()}),
        "row.txt": f"{x} {y} {z} {qx} {qy} {qz} {qw}\n",
        "tum.txt": f"1311867170.4 {x} {y} {z} {qx} {qy} {qz} {qw}\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    np.savez(folder / "pose.npz", pose=POSE)
    np.savez(folder / "named.npz", T_base_camera=POSE, error=0.001)
    np.savetxt(folder / "pose.txt", POSE)
    (folder / "three_decimals.json").write_text(json.dumps(np.round(POSE, 3).tolist()))
    return [*texts, "pose.npz", "named.npz", "pose.txt", "three_decimals.json"]


def intrinsics(folder):
    """Files with the intrinsics, by name."""
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    numbers = K.flatten().tolist()
    setup = {"size": 0.3, "intrinsic": {"width": scene.WIDTH, "height": scene.HEIGHT, "K": numbers}}
    texts = {
        "bop_scene_camera.json": json.dumps({"0": {"cam_K": numbers, "depth_scale": 1.0}}),
        "cam_k.json": json.dumps({"cam_K": numbers}),
        "camera_matrix.json": json.dumps({"camera_matrix": K.tolist()}),
        "kalibr.yaml": yaml.dump({"cam0": {"camera_model": "pinhole", "intrinsics": [fx, fy, cx, cy], "resolution": [scene.WIDTH, scene.HEIGHT]}}),
        "opencv_k.yaml": opencv("camera_matrix", K),
        "vgn_setup.json": json.dumps(setup),
        "camera_info.yaml": camera_info(),
        "texts.json": json.dumps({"FX": str(fx), "FY": str(fy), "CX": str(cx), "CY": str(cy)}),
        "rows_of_intrinsic_matrix.json": json.dumps({"intrinsic_matrix": K.tolist()}),
        "orb_slam.yaml": f"%YAML:1.0\nCamera.fx: {fx}\nCamera.fy: {fy}\nCamera.cx: {cx}\nCamera.cy: {cy}\n",
        "two_cameras.json": json.dumps({"color": {"fx": 2 * fx, "fy": fy, "cx": cx, "cy": cy}, "depth": {"K": numbers}}),
        "fx_fy.json": json.dumps({"fx": fx, "fy": fy, "x_offset": cx, "y_offset": cy}),
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    np.savetxt(folder / "k.txt", K)
    np.savez(folder / "k.npz", K=K)
    np.savez(folder / "opencv.npz", mtx=K, dist=np.zeros((1, 5)), w=scene.WIDTH, h=scene.HEIGHT, rvecs=np.zeros((2, 3)))
    np.save(folder / "p.npy", np.hstack([K, np.zeros((3, 1))]))
    return [*texts, "k.txt", "k.npz", "opencv.npz", "p.npy"]


def clouds(folder):
    """Files with the point cloud in metres, and with their unit in `--cloud-scale` if they have another."""
    points = POINTS.reshape(-1, 3)
    valid = points[points[:, 2] > 0]
    organised = np.where(points[:, 2:] > 0, points, np.nan)
    grey = np.full((len(valid), 3), 128, np.float32)
    millimetres = np.rint(valid * 1000).astype("<i2")
    header = "ply\nformat {}\nelement vertex {}\n{}end_header\n"
    properties = lambda kind: "".join(f"property {kind} {axis}\n" for axis in "xyz")
    rows = "".join(" ".join(f"{c:.6f}" for c in row) + "\n" for row in organised)
    (folder / "nan.ply").write_text(header.format("ascii 1.0", len(organised), properties("float")) + rows)
    of_millimetres = header.format("binary_little_endian 1.0", len(valid), properties("short"))
    (folder / "short_mm.ply").write_bytes(of_millimetres.encode() + millimetres.tobytes())
    of_floats = header.format("binary_little_endian 1.0", len(valid), properties("float"))
    (folder / "float_mm.ply").write_bytes(of_floats.encode() + (valid * 1000).astype("<f4").tobytes())
    pcd = "VERSION .7\nFIELDS x y z{}\nSIZE {}\nTYPE {}\nCOUNT {}\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA binary\n"
    padded = pcd.format(" _", "4 4 4 1", "F F F U", "1 1 1 0", n=len(valid))
    (folder / "count0.pcd").write_bytes(padded.encode() + valid.astype("<f4").tobytes())
    of_millimetres = pcd.format("", "2 2 2", "I I I", "1 1 1", n=len(valid))
    (folder / "short_mm.pcd").write_bytes(of_millimetres.encode() + millimetres.tobytes())
    np.save(folder / "xyzrgb.npy", np.hstack([valid, grey]))
    np.save(folder / "xyz1.npy", np.hstack([valid, np.ones((len(valid), 1), np.float32)]))
    structured = np.zeros(len(valid), [("rgb", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    for axis, values in zip("xyz", valid.T):
        structured[axis] = values
    np.save(folder / "structured.npy", structured)
    np.savez(folder / "xyz_rgb.npz", xyz=valid, rgb=grey)
    np.savetxt(folder / "points.xyz", valid)
    np.save(folder / "five.npy", np.hstack([valid, grey[:, :2]]))
    np.save(folder / "i4_mm.npy", millimetres.astype("<i4"))
    short = np.zeros(len(valid), [("X", "<i2"), ("Y", "<i2"), ("Z", "<i2")])
    for axis, values in zip("XYZ", millimetres.T):
        short[axis] = values
    np.save(folder / "structured_mm.npy", short)
    upper = header.format("ascii 1.0", len(organised), properties("float").upper().replace("PROPERTY FLOAT", "property float"))
    (folder / "minus_nan.ply").write_text(upper + rows.replace("nan", "-nan"))
    (folder / "nan.xyz").write_text(rows.replace("nan", "-nan"))
    (folder / "header.csv").write_text("index,x,y,z\n" + "".join(f"{i},{x},{y},{z}\n" for i, (x, y, z) in enumerate(valid)))
    (folder / "count.pts").write_text(f"{len(organised)}\n" + rows)
    cells = [",,,7" if np.isnan(row).any() else f"{row[0]},{row[1]},{row[2]},7" for row in organised]
    (folder / "empty_cells.csv").write_text("\n".join(["x [m],y [m],z [m],point id", *cells]))
    more = ["empty_cells.csv", "five.npy", "i4_mm.npy", "structured_mm.npy", "minus_nan.ply", "nan.xyz", "header.csv", "count.pts"]
    names = [*more, "nan.ply", "short_mm.ply", "count0.pcd", "short_mm.pcd", "xyzrgb.npy", "xyz1.npy", "structured.npy"]
    return [(name, ()) for name in [*names, "xyz_rgb.npz", "points.xyz"]] + [("float_mm.ply", ("--cloud-scale", "0.001"))]


def depths(folder):
    """Files with the depth image, and their unit if they do not say it."""
    png(folder / "depth.png", MILLIMETRES)
    png(folder / "tenths.png", MILLIMETRES * 10)
    tiff(folder / "float_mm.tiff", DEPTH * 1000)
    exr(folder / "view_layer.exr", {"ViewLayer.Depth.Z": DEPTH, "ViewLayer.Combined.R": DEPTH * 0})
    exr(folder / "rgb_equal.exr", {"R": DEPTH, "G": DEPTH, "B": DEPTH})
    np.save(folder / "channel.npy", DEPTH[..., None])
    exr(folder / "rgba.exr", {"R": DEPTH, "G": DEPTH, "B": DEPTH, "A": DEPTH * 0 + 1})
    for kind in ["f2", "i2", "i4", "u4", "u8"]:
        np.save(folder / f"{kind}.npy", (DEPTH if kind == "f2" else MILLIMETRES).astype(kind))
    np.save(folder / "micrometres.npy", MILLIMETRES.astype(np.int32) * 1000)
    np.savez(folder / "upper.npz", Depth=DEPTH, other=[1, 2])
    (folder / "upper.npz").rename(folder / "UPPER.NPZ")
    names = ["rgba.exr", "f2.npy", "i2.npy", "u4.npy", "u8.npy", "UPPER.NPZ", "depth.png", "view_layer.exr", "rgb_equal.exr", "channel.npy", "i4.npy"]
    scaled = [("micrometres.npy", ("--depth-scale", "0.000001")), ("float_mm.tiff", ("--depth-scale", "0.001")), ("tenths.png", ("--depth-scale", "0.0001"))]
    return [(name, ()) for name in names] + scaled


def pickled(path):
    """A pickled dictionary in a .npy file, as data sets of grasps have it."""
    np.save(path, {"depth": DEPTH, "K": K}, allow_pickle=True)


def distorted(d, model):
    """The depth image that a camera whose lens has these coefficients sees, and its K."""
    k = K.copy()
    v, u = np.mgrid[: scene.HEIGHT, : scene.WIDTH]
    seen = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1]], axis=-1)
    straight = seen.copy()
    for _ in range(50):  # the coefficients are small: a fixed-point iteration converges
        straight = straight + seen - lens(straight, d, model)
    rays = np.concatenate([straight, np.ones((*straight.shape[:2], 1))], axis=-1)
    return scene.depth(CAMERA_FROM_TASK, along=rays)


def lens(points, d, model):
    """Where a lens images normalised points: the models of OpenCV."""
    r2 = (points**2).sum(axis=-1, keepdims=True)
    if model == "equidistant":
        r = np.sqrt(r2)
        theta = np.arctan(r)
        bent = theta * (1 + sum(c * theta ** (2 * i + 2) for i, c in enumerate(d)))
        return points * np.divide(bent, r, out=np.ones_like(r), where=r > 1e-9)
    k1, k2, p1, p2, k3, *rest = [*d, *[0.0] * (8 - len(d))]
    x, y = np.moveaxis(points, -1, 0)
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (rest[0] + r2 * (rest[1] + r2 * rest[2])))
    shift = np.stack([2 * p1 * x * y + p2 * (r2[..., 0] + 2 * x * x), p1 * (r2[..., 0] + 2 * y * y) + 2 * p2 * x * y], -1)
    return points * radial + shift
