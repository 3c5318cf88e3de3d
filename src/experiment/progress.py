"""``progress.json``: what an unfinished run has done, so that it need not be done again."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import BaseModel, ValidationError

from see2act.errors import DamagedFile
from see2act.experiment.results import Evaluation, VisionQuality, first_problem
from see2act.files import read_json, write_json


class Progress(BaseModel):
    """Finished work of a run. Every change is written at once."""

    seconds: dict[str, float] = {}
    """Wall time by stage."""
    vision: VisionQuality | None = None
    evaluations: dict[int, Evaluation] = {}
    """By fine-tuning attempts."""
    argmax: Evaluation | None = None
    """After the last attempt, with the plain argmax policy."""
    finetuned: bool = False

    @classmethod
    def load(cls, path: Path) -> Progress:
        """What is in a file, or the beginning.

        Raises:
            DamagedFile: The file is not what :meth:`save` wrote.
        """
        progress = cls()
        if path.exists():
            try:
                progress = cls.model_validate(read_json(path))
            except ValidationError as error:
                raise DamagedFile(f"{path} is damaged ({first_problem(error)}): delete it and start again") from None
        progress._path = path
        return progress

    _path: Path | None = None
    _nested: float = 0.0
    """Seconds of stages within the present one, which are not its own."""

    def save(self) -> None:
        """Write what is done so far."""
        assert self._path is not None
        write_json(self._path, self.model_dump(mode="json"))

    def forget_evaluations(self, steps: list[int]) -> None:
        """Evaluations that lie beyond the checkpoint from which an interrupted run goes on."""
        self.evaluations = {step: kept for step, kept in self.evaluations.items() if step not in steps}
        self.save()

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Count the seconds of the block as those of a stage, without those of stages within it."""
        start, outer = time.perf_counter(), self._nested
        self._nested = 0.0
        try:
            yield
        finally:  # Ctrl-C too: what a run took before it was interrupted counts
            took = time.perf_counter() - start
            self.seconds[stage] = round(self.seconds.get(stage, 0.0) + took - self._nested, 1)
            self.save()
            self._nested = outer + took
