"""A plain Python implementation of graspd's service, with grpcio, onnxruntime and scipy, for comparison.

    GRASPD_PROTO=proto/proto python tests/peers/plain_grpc.py --model models/zoo/vgn-packed.onnx --threads 2

Prints its address to stdout, then `ready`. SIGTERM terminates it.
"""

import argparse
import json
import os
import signal
import sys
import tempfile
import uuid
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from threading import Lock
from time import perf_counter
from types import ModuleType
from typing import Any, Optional

import grpc
import numpy as np
import onnxruntime as ort
from grpc_tools import protoc
from scipy.ndimage import binary_dilation, gaussian_filter, maximum_filter
from scipy.spatial.transform import Rotation

INPUT, OUTPUTS = "tsdf", ["quality", "rotation", "width"]

# Constants of the decoding, as in grasp/src/decode.rs; lengths in voxels.
SIGMA = 1.0
OUTSIDE_ABOVE, INSIDE_ABOVE = 0.5, 1e-3
DILATIONS = 2
MIN_WIDTH, MAX_WIDTH = 1.33, 9.33
THRESHOLD = 0.9
NMS_SIZE = 4


def arguments(description: str) -> argparse.Namespace:
    """Parses the command line, which all servers here share."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", required=True, type=Path)
    parser.add_argument("--threads", default=1, type=int)
    parser.add_argument("--provider", default="cpu", choices=["cpu", "openvino"])
    parser.add_argument("--precision", default="fp32", choices=["fp32", "bf16"])
    chosen = parser.parse_args()
    if (chosen.provider, chosen.precision) == ("cpu", "bf16"):
        parser.error("provider cpu supports fp32 only")
    return chosen


def open_session(chosen: argparse.Namespace, batch: int | None = None) -> ort.InferenceSession:
    """Opens a session with the options of graspd's own sessions (models/src/runtime)."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = chosen.threads
    options.inter_op_num_threads = 1
    if batch:
        options.add_free_dimension_override_by_name("batch", batch)
    if chosen.provider == "cpu":
        return ort.InferenceSession(chosen.model, options, ["CPUExecutionProvider"])
    # Without this, operators that OpenVINO does not support would run on the CPU provider unnoticed.
    options.add_session_config_entry("session.disable_cpu_ep_fallback", "1")
    cpu = {
        "INFERENCE_PRECISION_HINT": {"fp32": "f32", "bf16": "bf16"}[chosen.precision],
        "INFERENCE_NUM_THREADS": str(chosen.threads),
        "NUM_STREAMS": "1",
    }
    openvino = {"device_type": "CPU", "precision": "ACCURACY", "load_config": json.dumps({"CPU": cpu})}
    return ort.InferenceSession(chosen.model, options, [("OpenVINOExecutionProvider", openvino)])


def end_at_sigterm() -> None:
    """Raises an exception in the main thread at SIGTERM, so that everything is closed on exit."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())


def say(line: str) -> None:
    print(line, file=sys.__stdout__, flush=True)


def messages() -> ModuleType:
    """The module that protoc generates from the .proto file."""
    proto = os.environ["GRASPD_PROTO"]
    # grpcio-tools contains the well-known types.
    well_known = os.path.join(os.path.dirname(protoc.__file__), "_proto")
    with tempfile.TemporaryDirectory() as folder:
        if protoc.main(["protoc", f"-I{proto}", f"-I{well_known}", f"--python_out={folder}", "grasp/v1/grasp.proto"]):
            sys.exit(f"protoc rejects the .proto file in {proto}")
        sys.path.insert(0, folder)
        return import_module("grasp.v1.grasp_pb2")


class GraspService:
    def __init__(self, pb: ModuleType, session: ort.InferenceSession, path: Path) -> None:
        self.pb = pb
        self.session = session
        # One inference at a time, which uses all threads.
        self.free = Lock()
        properties = session.get_modelmeta().custom_metadata_map
        self.name = properties.get("graspd.name", path.stem)
        self.version = properties.get("graspd.version", "1")
        self.resolution = int(properties.get("graspd.resolution", 40))
        self.voxel_size = float(properties.get("graspd.voxel_size", 0.3 / self.resolution))
        # Position of a grasp in its voxel.
        self.origin = {"corner": 0.0, "center": 0.5}[properties.get("graspd.voxel_origin", "corner")]
        self.dtypes = {pb.DATA_TYPE_F32: "<f4", pb.DATA_TYPE_F16: "<f2", pb.DATA_TYPE_U8: "u1"}

    def infer(self, volume: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        quality, rotation, width = self.session.run(OUTPUTS, {INPUT: volume[np.newaxis, np.newaxis]})
        return quality[0, 0], rotation[0], width[0, 0]

    def warm_up(self) -> None:
        self.infer(np.full((self.resolution,) * 3, 0.5, np.float32))

    def detect(self, request: Any, context: grpc.ServicerContext) -> Any:
        started = perf_counter()
        options = request.options
        if options.model not in ["", self.name] or options.version not in ["", self.version]:
            context.abort(grpc.StatusCode.NOT_FOUND, f"model not found; available: {self.name} {self.version}")
        try:
            volume = self.read(request.volume)
        except ValueError as wrong:
            context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(wrong))
        checked = perf_counter()
        with self.free:
            taken = perf_counter()
            quality, rotation, width = self.infer(volume)
            inferred = perf_counter()
        threshold = options.threshold if options.HasField("threshold") else THRESHOLD
        force = options.force if options.HasField("force") else None
        smooth = gaussian_filter(quality, SIGMA, mode="nearest")
        cells, dropped = decode(volume, smooth, width, threshold, force)
        if options.max_grasps:
            dropped["over_limit"] = max(0, len(cells) - options.max_grasps)
            cells = cells[: options.max_grasps]
        grasps = self.grasps(cells, smooth, rotation, width, request.volume.pose)
        decoded = perf_counter()

        response = self.pb.DetectGraspsResponse(
            request_id=request.request_id or str(uuid.uuid4()),
            frame_id=request.volume.frame_id,
            stamp=request.volume.stamp if request.volume.HasField("stamp") else None,
            grasps=grasps,
            model=self.name,
            version=self.version,
            dropped=self.pb.Dropped(**dropped) if options.explain or not grasps else None,
        )
        latency = response.latency
        latency.preprocessing, latency.queue = checked - started, taken - checked
        latency.inference, latency.postprocessing = inferred - taken, decoded - inferred
        latency.total = perf_counter() - started
        return response

    def read(self, volume: Any) -> np.ndarray:
        """The volume's values as an array. Raises ValueError if the volume is invalid."""
        n = self.resolution
        if volume.dtype not in self.dtypes:
            raise ValueError(f"volume.dtype is {volume.dtype}, must be one of {sorted(self.dtypes)}")
        if volume.resolution != n:
            raise ValueError(f"volume.resolution is {volume.resolution}, must be {n}")
        if abs(volume.voxel_size - self.voxel_size) > 1e-3 * self.voxel_size:
            raise ValueError(f"volume.voxel_size is {volume.voxel_size}, must be {self.voxel_size}")
        values = np.frombuffer(volume.data, self.dtypes[volume.dtype])
        if values.size != n**3:
            raise ValueError(f"volume.data has {values.size} values, must have {n**3}")
        values = values.astype(np.float32, copy=False).reshape(n, n, n)
        if volume.dtype == self.pb.DATA_TYPE_U8:
            values = values / np.float32(255)
        # NaN fails both comparisons.
        if not (values.min() >= 0 and 0 < values.max() <= 1):
            raise ValueError("volume.data must be in [0, 1], and not all 0")
        return values

    def grasps(
        self, cells: np.ndarray, smooth: np.ndarray, rotation: np.ndarray, width: np.ndarray, frame: Any
    ) -> list[Any]:
        """The grasps at these voxels, in the frame of the volume's pose."""
        pb = self.pb
        if not len(cells):
            return []
        at, turn = frame.position, frame.orientation
        # An absent pose is the identity.
        orientation = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w if frame.HasField("orientation") else 1.0])
        indices = np.stack(np.unravel_index(cells, smooth.shape), axis=-1)
        positions = orientation.apply((indices + self.origin) * self.voxel_size) + [at.x, at.y, at.z]
        orientations = orientation * Rotation.from_quat(rotation.reshape(4, -1)[:, cells].T)
        widths = width.ravel()[cells] * self.voxel_size
        return [
            pb.Grasp(
                pose=pb.Pose(
                    position=pb.Vector3(x=x, y=y, z=z), orientation=pb.Quaternion(x=qx, y=qy, z=qz, w=qw)
                ),
                width=opening,
                quality=quality,
            )
            for (x, y, z), (qx, qy, qz, qw), opening, quality in zip(
                positions.tolist(), orientations.as_quat().tolist(), widths.tolist(), smooth.ravel()[cells].tolist()
            )
        ]


def decode(
    volume: np.ndarray, smooth: np.ndarray, width: np.ndarray, threshold: float, force: Optional[float]
) -> tuple[np.ndarray, dict[str, int]]:
    """The flat indices of the voxels with a grasp, best first, and the number of dropped voxels by reason."""
    inside = (volume > INSIDE_ABOVE) & (volume < OUTSIDE_ABOVE)
    near_surface = binary_dilation(volume > OUTSIDE_ABOVE, iterations=DILATIONS, mask=~inside)
    valid_width = (width >= MIN_WIDTH) & (width <= MAX_WIDTH)

    cells, dropped = candidates(smooth, near_surface, valid_width, threshold)
    if not len(cells) and force is not None:
        cells, dropped = candidates(smooth, near_surface, valid_width, min(force, threshold))
        dropped["suppressed"] += max(0, len(cells) - 1)
        cells = cells[:1]
    return cells, dropped


def candidates(
    smooth: np.ndarray, near_surface: np.ndarray, valid_width: np.ndarray, threshold: float
) -> tuple[np.ndarray, dict[str, int]]:
    left, dropped = np.ones_like(near_surface), {}
    for reason, passed in [
        ("below_threshold", smooth >= np.float32(threshold)),
        ("mask", near_surface),
        ("width", valid_width),
    ]:
        dropped[reason] = np.count_nonzero(left & ~passed)
        left &= passed
    quality = np.where(left, smooth, 0)
    best = np.flatnonzero(left & (quality == maximum_filter(quality, NMS_SIZE)))
    dropped["suppressed"] = np.count_nonzero(left) - len(best)
    return best[np.argsort(-smooth.ravel()[best], kind="stable")], dropped


def main() -> None:
    chosen = arguments(__doc__)
    end_at_sigterm()
    pb = messages()
    service = GraspService(pb, open_session(chosen, batch=1), chosen.model)
    service.warm_up()
    # While one thread uses the session, the others read, check, decode and write.
    server = grpc.server(ThreadPoolExecutor(max_workers=10))
    detect = grpc.unary_unary_rpc_method_handler(
        service.detect, pb.DetectGraspsRequest.FromString, pb.DetectGraspsResponse.SerializeToString
    )
    server.add_generic_rpc_handlers(
        [grpc.method_handlers_generic_handler("grasp.v1.GraspService", {"DetectGrasps": detect})]
    )
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    say(f"grpc listening on 127.0.0.1:{port}")
    say("ready")
    try:
        signal.pause()
    finally:
        server.stop(grace=None).wait()


if __name__ == "__main__":
    main()
