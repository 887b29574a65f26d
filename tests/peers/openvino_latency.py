"""Latency of OpenVINO's own runtime, as measured by `benchmark_app -hint latency -niter N`.

    python tests/peers/openvino_latency.py --model models/zoo/vgn-packed.onnx --threads 2 --precision bf16 --calls 500

Prints one line of JSON.
"""

import argparse
import json

import numpy as np
import openvino


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", required=True)
    parser.add_argument("--threads", default=1, type=int)
    parser.add_argument("--precision", default="fp32", choices=["fp32", "bf16"])
    parser.add_argument("--calls", default=500, type=int)
    chosen = parser.parse_args()

    core = openvino.Core()
    model = core.read_model(chosen.model)
    # A fixed batch size of 1: the fastest case, and the only one that benchmark_app runs synchronously.
    model.reshape([1, *list(model.input().partial_shape)[1:]])
    compiled = core.compile_model(
        model,
        "CPU",
        {
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_PRECISION_HINT": {"fp32": "f32", "bf16": "bf16"}[chosen.precision],
            "INFERENCE_NUM_THREADS": chosen.threads,
        },
    )
    request = compiled.create_infer_request()
    # The input is written once, into the tensor that the network reads.
    tsdf = request.get_input_tensor().data
    tsdf[:] = np.random.default_rng(0).random(tsdf.shape, np.float32)
    request.infer()
    times = np.empty(chosen.calls)
    for call in range(chosen.calls):
        request.infer()
        # Milliseconds, of the inference only.
        times[call] = request.latency

    p50, p99 = np.percentile(times, [50, 99])
    figures = {"p50_ms": p50, "p99_ms": p99, "mean_ms": times.mean()}
    rounded = {name: round(float(value), 4) for name, value in figures.items()}
    print(json.dumps({**rounded, "calls": chosen.calls, "version": openvino.get_version()}))


if __name__ == "__main__":
    main()
