"""Files of tensors that a run writes for itself and for other runs."""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import torch

from see2act.files import damaged, replacing

STATES = ("state_dict", "network")
"""Keys under which there are a network's parameters."""


def save_checkpoint(path: Path, content: Mapping[str, Any]) -> None:
    """Write tensors and plain containers, atomically.

    Raises:
        OSError: It cannot be written.
    """
    buffer = io.BytesIO()  # by itself, torch tells of a full disk only that a position in a file is unexpected
    torch.save(dict(content), buffer)
    with replacing(path) as partial:
        partial.write_bytes(buffer.getbuffer())


def load_checkpoint(path: Path, keys: Collection[str], device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read what :func:`save_checkpoint` or Lightning wrote. Nothing in the file is executed.

    Args:
        path: The file.
        keys: What must be in it.
        device: Where its tensors go.

    Raises:
        DamagedFile: It is no such file.
    """
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # a damaged file makes torch.load raise anything
        raise damaged(path, error) from None
    if not isinstance(content, dict) or not {*keys} <= content.keys():
        raise damaged(path, ValueError(f"it lacks {' or '.join(keys)}"))
    for key in {*keys} & {*STATES}:
        if not isinstance(content[key], Mapping) or not all(isinstance(value, torch.Tensor) for value in content[key].values()):
            raise damaged(path, ValueError(f"its {key} is not of tensors"))
    return content
