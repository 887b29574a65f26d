"""Serves the same ONNX file with NVIDIA Triton: model `grasp`, input `tsdf`, outputs `quality`, `rotation` and `width`.

    python tests/peers/triton.py --model models/zoo/vgn-packed.onnx --threads 2

Triton's package on PyPI contains its Python backend only, so that onnxruntime computes the network. Prints the address
of `inference.GRPCInferenceService` to stdout, then `ready`. SIGTERM terminates it and Triton's processes.
"""

import os
import signal
import socket
import sys
from pathlib import Path
from threading import Timer

import numpy as np
from plain_grpc import INPUT, OUTPUTS, arguments, end_at_sigterm, open_session, say
from pytriton.client import ModelClient
from pytriton.decorators import batch
from pytriton.model_config import ModelConfig, Tensor
from pytriton.triton import Triton, TritonConfig

MODEL = "grasp"
MAX_BATCH = 8


def free_port() -> int:
    """A free port, because Triton does not support port 0."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def kill_triton() -> None:
    for child in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split():
        os.kill(int(child), signal.SIGKILL)


def main() -> None:
    chosen = arguments(__doc__)
    end_at_sigterm()
    session = open_session(chosen)

    @batch
    def infer(tsdf: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(OUTPUTS, session.run(OUTPUTS, {INPUT: tsdf})))

    def tensors(values: list) -> list[Tensor]:
        return [Tensor(name=value.name, dtype=np.float32, shape=tuple(value.shape[1:])) for value in values]

    port = free_port()
    # No requests are pending at the end, so that Triton need not drain.
    config = TritonConfig(
        grpc_address="127.0.0.1", grpc_port=port, allow_http=False, allow_metrics=False, exit_timeout_secs=0
    )
    # Triton logs with print(); stdout is reserved for the address and `ready`.
    sys.stdout = sys.stderr
    with Triton(config=config) as triton:
        inputs, outputs = tensors(session.get_inputs()), tensors(session.get_outputs())
        triton.bind(MODEL, infer, inputs, outputs, config=ModelConfig(max_batch_size=MAX_BATCH))
        with ModelClient(f"grpc://127.0.0.1:{port}", MODEL) as client:
            client.infer_sample(np.full(inputs[0].shape, 0.5, np.float32))
        say(f"grpc listening on 127.0.0.1:{port}")
        say("ready")
        try:
            signal.pause()
        finally:
            # Triton shuts down within two seconds, but its gRPC server sometimes takes eight more.
            killer = Timer(2.5, kill_triton)
            killer.daemon = True
            killer.start()


if __name__ == "__main__":
    main()
