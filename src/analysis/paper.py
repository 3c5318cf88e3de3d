"""What the paper reports, and the groups that it compares."""

from __future__ import annotations

import os
from pathlib import Path

PRIMITIVES = ("suction", "grasp")
TASKS = ("none", "normal", "center", "corner", "edge", "foreground", "imagenet", "coco")
TRANSFERS = ("none", "full", "backbone", "fixed")

UNSEEN = {
    "suction": {"none": 0.71, "normal": 1.00, "center": 0.83, "corner": 0.83, "edge": 0.90, "foreground": 0.83},
    "grasp": {"none": 0.71, "normal": 0.91, "center": 0.91, "corner": 0.91, "edge": 0.83, "foreground": 0.91},
}
"""Its table of simulated success on unseen objects after fine-tuning, the whole model transferred."""
WHOLE_AND_BACKBONE = (
    "The paper: grasping from foreground, 86 % with the whole model transferred and 71 % with the backbone alone "
    "(caption of a figure; it does not say on which objects)."
)
HEADLINE = (
    "The paper's headline, on a real robot with off-the-shelf weights: about 80 % on novel objects after 10 minutes of "
    "suction or an hour of grasping."
)

OFF_THE_SHELF = {
    ("rpn_r50_fpn", "imagenet"): "resnet50-0676ba61.pth",
    ("rpn_r50_fpn", "coco"): "fasterrcnn_resnet50_fpn_coco-258fb6c6.pth",
    ("nanodet_g", "coco"): "nanodet_g_coco.safetensors",
}
"""Files of the tasks that are not learned here, by model: torchvision's, and that of ``make coco``."""


def expected(primitive: str) -> list[tuple[str, str, str]]:
    """Task, transfer and model of every group that the paper compares for a primitive."""
    simulated = [("none", "none"), *((task, "full") for task in UNSEEN[primitive] if task != "none")]
    if primitive == "grasp":
        simulated.append(("foreground", "backbone"))
    real = [("imagenet", "backbone"), ("coco", "full"), ("coco", "backbone"), ("coco", "fixed")]
    return [(*cell, "fcn7") for cell in simulated] + [(*cell, "rpn_r50_fpn") for cell in real]


def missing_weights(task: str, model: str) -> str | None:
    """The file that an off-the-shelf task needs and that is not on this machine; None if nothing is missing."""
    file = OFF_THE_SHELF.get((model, task))
    if file is None:
        return None
    home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    torchvision = Path(os.environ.get("TORCH_HOME", home / "torch")).expanduser() / "hub" / "checkpoints"
    ours = Path(os.environ.get("SEE2ACT_CACHE", ".cache")) / "weights"
    return None if any((folder / file).is_file() for folder in (torchvision, ours)) else file
