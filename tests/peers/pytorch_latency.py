"""Latency and throughput of a network in PyTorch on a GPU: eager mode and torch.compile.

    python tests/peers/pytorch_latency.py --batches 1,4,16,64 --precision fp16 transformer.onnx

Runs the nodes of the ONNX file as PyTorch functions, so that the network and its weights are the same. The five nodes of
the exact GELU run as one function, as PyTorch users would write it. Times include the copies of the volumes to the GPU
and of the outputs from it. Prints one line of JSON for each mode and batch size. With --go FILE it compiles first, and
measures when the file exists.
"""

import argparse
import json
import math
import os
import time

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from onnx import helper, numpy_helper


class Graph(torch.nn.Module):
    """The network of an ONNX file."""

    def __init__(self, path: str, dtype: torch.dtype):
        super().__init__()
        graph = onnx.load(path).graph
        self.constants, stored = {}, {}
        for tensor in graph.initializer:
            stored[tensor.name] = numpy_helper.to_array(tensor)
        nodes = []
        for node in graph.node:
            attributes = {a.name: helper.get_attribute_value(a) for a in node.attribute}
            if node.op_type == "Constant":
                stored[node.output[0]] = numpy_helper.to_array(attributes["value"])
            elif node.op_type == "Cast" and node.input[0] in stored:
                stored[node.output[0]] = stored.pop(node.input[0]).astype(np.float32)
            else:
                nodes.append((node.op_type, list(node.input), list(node.output), attributes))
        # Sizes and bounds are numbers of the program and not weights.
        numbers = {name for op, inputs, _, _ in nodes if op in ("Resize", "Clip") for name in inputs[1:]}
        for index, (name, array) in enumerate(stored.items()):
            if array.dtype == np.float32 and array.ndim and name not in numbers:
                weight = torch.nn.Parameter(torch.from_numpy(array.copy()).to(dtype), requires_grad=False)
                self.register_parameter(f"weight_{index}", weight)
                self.constants[name] = f"weight_{index}"
            else:
                self.constants[name] = array.tolist()
        self.nodes = with_gelu(nodes, stored)
        self.dtype = dtype
        self.outputs = [output.name for output in graph.output]

    def forward(self, volumes: torch.Tensor) -> list[torch.Tensor]:
        values: dict = {"tsdf": volumes.to(self.dtype)}

        def value(name: str):
            if name in values:
                return values[name]
            constant = self.constants[name]
            return getattr(self, constant) if isinstance(constant, str) else constant

        for op, inputs, outputs, attributes in self.nodes:
            result = run(op, [value(name) for name in inputs if name], attributes)
            if not isinstance(result, (tuple, list)):
                result = [result]
            values.update(zip(outputs, result))
        return [values[name].float() for name in self.outputs]


def with_gelu(nodes: list, stored: dict) -> list:
    """Replaces x · (1 + erf(x / √2)) / 2 by one node."""
    result, skipped = [], set()
    by_output = {node[2][0]: node for node in nodes}
    readers: dict = {}
    for node in nodes:
        for name in node[1]:
            readers.setdefault(name, []).append(node)
    last_to_x = {}
    for node in nodes:
        if node[0] == "Erf":
            div = by_output[node[1][0]]
            chain = [div, node]
            for _ in range(3):
                chain.append(readers[chain[-1][2][0]][0])
            assert [n[0] for n in chain] == ["Div", "Erf", "Add", "Mul", "Mul"]
            assert math.isclose(float(stored[div[1][1]]), math.sqrt(2), rel_tol=1e-6)
            skipped.update(id(n) for n in chain[:4])
            last_to_x[id(chain[4])] = div[1][0]
    for node in nodes:
        if id(node) in last_to_x:
            result.append(("Gelu", [last_to_x[id(node)]], node[2], {}))
        elif id(node) not in skipped:
            result.append(node)
    return result


def run(op: str, x: list, a: dict):
    """One node. `x` has its inputs, `a` its attributes."""
    if op in ("Conv", "ConvTranspose"):
        bias = x[2] if len(x) > 2 else None
        strides, pads = a.get("strides", [1, 1, 1]), a.get("pads", [0] * 6)[:3]
        function = F.conv3d if op == "Conv" else F.conv_transpose3d
        return function(x[0], x[1], bias, stride=strides, padding=pads)
    if op == "Reshape":
        return x[0].reshape([x[0].shape[i] if size == 0 else size for i, size in enumerate(x[1])])
    if op == "Resize":
        return F.interpolate(x[0], scale_factor=list(x[-1])[2:], mode="nearest")
    if op == "Clip":
        return torch.clamp(x[0], *x[1:])
    if op == "ReduceL2":
        axes = a.get("axes") or x[1]
        return torch.linalg.vector_norm(x[0].float(), dim=axes, keepdim=bool(a.get("keepdims", 1))).to(x[0].dtype)
    if op == "LayerNormalization":
        return F.layer_norm(x[0], x[1].shape, x[1], x[2], a.get("epsilon", 1e-5))
    if op == "InstanceNormalization":
        return F.instance_norm(x[0], weight=x[1], bias=x[2], eps=a.get("epsilon", 1e-5))
    return {
        "Add": lambda: x[0] + x[1],
        "Concat": lambda: torch.cat(x, a["axis"]),
        "Div": lambda: x[0] / x[1],
        "Gelu": lambda: F.gelu(x[0]),
        "LeakyRelu": lambda: F.leaky_relu(x[0], a.get("alpha", 0.01)),
        "MatMul": lambda: x[0] @ x[1],
        "Mul": lambda: x[0] * x[1],
        "Relu": lambda: F.relu(x[0]),
        "Sigmoid": lambda: torch.sigmoid(x[0]),
        "Softmax": lambda: torch.softmax(x[0], a.get("axis", -1)),
        "Split": lambda: torch.split(x[0], x[1], a.get("axis", 0)),
        "Sub": lambda: x[0] - x[1],
        "Transpose": lambda: x[0].permute(a["perm"]),
    }[op]()


@torch.inference_mode()
def measure(network, batch: int, device: str, seconds: float) -> dict:
    volumes = torch.rand(batch, 1, 40, 40, 40)
    if device == "cuda":
        volumes = volumes.pin_memory()
    times = []

    def once():
        started = time.perf_counter()
        outputs = network(volumes.to(device, non_blocking=True))
        outputs = [output.cpu() for output in outputs]
        times.append(1e3 * (time.perf_counter() - started))
        return outputs

    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(times) < 3:
        once()
    return {"p50_ms": np.percentile(times, 50), "p99_ms": np.percentile(times, 99), "volumes_per_second": batch * 1e3 / np.mean(times)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--precision", default="fp32", choices=["fp32", "fp16"])
    parser.add_argument("--batches", default="1", help="for eager mode [%(default)s]")
    parser.add_argument("--compiled", default="1", help="batch sizes for torch.compile [%(default)s]")
    parser.add_argument("--seconds", default=3.0, type=float)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--go", help="measure when this file exists")
    chosen = parser.parse_args()

    torch.backends.cudnn.benchmark = True
    torch.set_float32_matmul_precision("high")  # TF32, as in ONNX Runtime.
    torch.backends.cudnn.allow_tf32 = True
    network = Graph(chosen.model, {"fp32": torch.float32, "fp16": torch.float16}[chosen.precision]).to(chosen.device).eval()
    sizes = lambda text: [int(size) for size in text.split(",") if size]
    modes = [("eager", lambda: network, sizes(chosen.batches))]
    if sizes(chosen.compiled):
        compiled = torch.compile(network, mode="reduce-overhead", dynamic=False)
        modes.append(("compiled", lambda: compiled, sizes(chosen.compiled)))
    for mode, make, batches in modes:
        for batch in batches:
            started = time.perf_counter()
            measure(make(), batch, chosen.device, 0.0)
            print(f"{mode}, batch {batch}: ready in {time.perf_counter() - started:.1f} s", flush=True)
    while chosen.go and not os.path.exists(chosen.go):
        time.sleep(0.1)
    for mode, make, batches in modes:
        for batch in batches:
            measure(make(), batch, chosen.device, 0.3)
            figures = measure(make(), batch, chosen.device, chosen.seconds)
            figures = {name: round(float(value), 3) for name, value in figures.items()}
            print(json.dumps({"mode": mode, "precision": chosen.precision, "batch": batch, **figures, "torch": torch.__version__}), flush=True)


if __name__ == "__main__":
    main()
