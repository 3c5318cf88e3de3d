"""Weights of TensorFlow.js graph models: a JSON file that lists them, and binary files next to it that contain them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from see2act.errors import TransferError

DTYPES = {"float32": "<f4", "float16": "<f2", "int32": "<i4"}


def read(path: Path) -> dict[str, np.ndarray]:
    """Weights by name, converted to single precision. Kernels are (height, width, in, out).

    Args:
        path: The JSON file.

    Raises:
        TransferError: The file is not such a model, or a weight file is missing, truncated, or of an unsupported type.
    """
    try:
        groups = json.loads(path.read_bytes())["weightsManifest"]
        files = [path.parent / name for group in groups for name in group["paths"]]
        entries = [entry for group in groups for entry in group["weights"]]
        shapes = {str(entry["name"]): tuple(int(n) for n in entry["shape"]) for entry in entries}
        kept = [entry.get("quantization", {}).get("dtype", entry["dtype"]) for entry in entries]
        dtypes = [np.dtype(DTYPES[name]) for name in kept]
        content = b"".join(file.read_bytes() for file in files)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise TransferError(f"{path} is no TensorFlow.js graph model ({reason}): get it again with make coco") from None
    sizes = [dtype.itemsize * int(np.prod(shape)) for dtype, shape in zip(dtypes, shapes.values(), strict=True)]
    if sum(sizes) != len(content):
        raise TransferError(
            f"the weights of {path} have {len(content)} bytes, and its list needs {sum(sizes)}: get it again with make coco"
        )
    weights, start = {}, 0
    for (name, shape), dtype, size in zip(shapes.items(), dtypes, sizes, strict=True):
        weights[name] = np.frombuffer(content[start : start + size], dtype).reshape(shape).astype(np.float32)
        start += size
    return weights
