"""What this processor computes networks in fastest: measured once, kept, and said."""

from __future__ import annotations

import logging
import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

from see2act.experiment.cache import once
from see2act.files import damaged, read_json, write_json

log = logging.getLogger("see2act")
GAIN = 1.1
"""How many times faster bf16 must be to be taken: less may be chance, and fp32 is the more exact."""
REPEATS = 3


def fastest_precision(folder: str, accelerator: str = "cpu") -> str:
    """``bf16`` or ``fp32``, for ``precision=auto``.

    A processor that does not compute in bfloat16 is not measured. Of another, what was measured is in ``precision/`` of the
    cache, a file for each kind of processor and version of torch; delete it to measure again.

    Args:
        folder: The cache.
        accelerator: Lightning's word; whatever is no processor computes in bfloat16.
    """
    if accelerator not in ("cpu", "auto"):
        return "bf16"
    if not computes_bf16():
        return "fp32"
    path = Path(folder).absolute() / "precision" / f"{_words(processor())}-torch-{version('torch')}.json"
    kept, made = once(path, lambda: write_json(path, compared(_attempt_s_work)), _read)
    if made:
        log.info(
            "precision=auto: the network's work of an attempt takes %.2f s in fp32 and %.2f s in bf16 on this processor, so "
            "%s; kept in %s",
            *(kept["fp32"], kept["bf16"], kept["fastest"], path),
        )
    return str(kept["fastest"])


def _read(path: Path) -> dict[str, Any]:
    kept: dict[str, Any] = read_json(path)
    try:
        if kept["fastest"] not in ("bf16", "fp32"):
            raise ValueError(f"fastest is {kept['fastest']}")
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(path, error) from None
    return kept


def compared(work: Callable[[str], Callable[[], object]]) -> dict[str, Any]:
    """Median seconds of work in each precision, taken in turns after a warm-up, and the faster one.

    Args:
        work: From a precision to what is to be timed.
    """
    todo = {precision: work(precision) for precision in ("fp32", "bf16")}
    times: dict[str, list[float]] = {precision: [] for precision in todo}
    for repeat in range(REPEATS + 1):
        for precision, each in todo.items():
            start = process_time()
            each()
            if repeat:
                times[precision].append(process_time() - start)
    seconds = {precision: round(median(taken), 4) for precision, taken in times.items()}
    return {**seconds, "fastest": "bf16" if seconds["bf16"] * GAIN < seconds["fp32"] else "fp32", "processor": processor()}


def _attempt_s_work(precision: str) -> Callable[[], object]:
    """A decision over 16 rotations, whose canvases have 188 x 188 px in the mean, and four learning steps of FCN7."""
    import torch

    from see2act.modules.fcn7 import FCN7

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = FCN7().eval()
    network.set_precision(precision)
    turned, windows = torch.zeros(network.together, 4, 188, 188), torch.zeros(8, 4, 100, 100)
    middle = torch.full((8,), 50)

    def work() -> None:
        with torch.no_grad():
            for _ in range(16 // len(turned)):
                network(turned)
        for _ in range(4):
            network.logits_at(windows, middle, middle).sum().backward()

    return work


def computes_bf16() -> bool:
    """Whether the processor has instructions for bfloat16; whether they are of use is another matter."""
    return bool({"avx512_bf16", "amx_bf16"} & {*_cpuinfo().split()})


def processor() -> str:
    """Its name."""
    names = [line.partition(":")[2].strip() for line in _cpuinfo().splitlines() if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _cpuinfo() -> str:
    try:
        return Path("/proc/cpuinfo").read_text()
    except OSError:
        return ""


def _words(name: str) -> str:
    return "-".join("".join(c if c.isalnum() else " " for c in name).split())
