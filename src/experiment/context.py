"""What the stages of one run share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from omegaconf import DictConfig

from see2act.datamodules.records import Records
from see2act.experiment.attempts import AttemptsCsv
from see2act.experiment.attended import attended
from see2act.experiment.dashboard import Dashboard
from see2act.experiment.progress import Progress


@dataclass
class RunContext:
    """The folder of a run, and what is written into it on the way.

    Args:
        cfg: A validated configuration.
        folder: Where everything goes.
        dashboard: Curves, figures and attempts for people.
    """

    cfg: DictConfig
    folder: Path
    dashboard: Dashboard = field(default_factory=Dashboard)

    def __post_init__(self) -> None:
        self.checkpoints.mkdir(parents=True, exist_ok=True)
        self.progress = Progress.load(self.folder / "progress.json")
        self.log = AttemptsCsv(self.folder / "attempts.csv")

    @property
    def checkpoints(self) -> Path:
        """Folder of models."""
        return self.folder / "checkpoints"

    @property
    def records(self) -> Records:
        """Attempts of an attended robot."""
        return Records(self.folder / "attempts")

    @property
    def figures(self) -> Path:
        """Folder of pictures."""
        return self.folder / "figures"

    @property
    def attempts(self) -> int:
        """Fine-tuning attempts that the run makes."""
        return int(self.cfg.finetune.attempts) if self.cfg.transfer.finetune else 0

    @property
    def evaluated_at(self) -> list[int]:
        """Fine-tuning attempts after which the model is evaluated; a person does not fill the bin before the first unasked."""
        asked = {step for step in self.cfg.evaluate.at if step <= self.attempts}
        return sorted({self.attempts, *asked} if attended(self.cfg) else {0, self.attempts, *asked})

    @property
    def title(self) -> str:
        """Of figures and dashboards."""
        cfg = self.cfg
        return f"{cfg.primitive.name} {cfg.task.name} {cfg.transfer.name} seed {cfg.seed}"
