"""What a report is made from, small enough for a repository."""

from __future__ import annotations

import gzip
from pathlib import Path

from tqdm import tqdm

from see2act.analysis import page
from see2act.analysis.groups import Found
from see2act.analysis.runs import attempts_of
from see2act.errors import UserError
from see2act.experiment.results import read_result
from see2act.files import replacing

SMALL = ("result.json", ".hydra/config.yaml", ".hydra/overrides.yaml")


def keep(found: Found, folder: Path) -> None:
    """Copy finished runs to ``folder``, so that a report of it has the same tables and figures.

    Of each run: result, configuration and compressed attempts. Of each group: the pictures of the run that the report shows.
    Checkpoints and logs stay behind. Runs that ``folder`` has already are left as they are, so a sweep may be kept again
    as it goes on, and one that was repeated may be compared with what was kept.

    Raises:
        UserError: ``folder`` has a run with other outcomes at the same place.
    """
    for run in found.runs:
        kept = folder / run.place / "result.json"
        if kept.exists() and read_result(kept).outcomes != run.result.outcomes:
            raise UserError(f"{kept.parent} holds another run than {run.folder}: move it away, or give another folder")
    pictured = {page.shown(group).folder for comparison in found.comparisons for group in comparison.groups}
    for run in tqdm(found.runs, desc="keep", disable=None):
        place = folder / run.place
        whole = (place / "result.json").exists()  # if not, files here are of a keep that was cut short, perhaps of an older run
        if run.folder in pictured:
            for name, image in page.thumbnails(run).items():
                _write(place / "figures" / f"{name}.jpg", image, replace=not whole)
        if run.attempts and (path := attempts_of(run.folder)):
            _write(place / "attempts.csv.gz", _packed(path), replace=not whole)
        for name in reversed(SMALL):  # the result last: it means done
            if (run.folder / name).is_file():
                _write(place / name, (run.folder / name).read_bytes(), replace=not whole)


def _packed(path: Path) -> bytes:
    return path.read_bytes() if path.suffix == ".gz" else gzip.compress(path.read_bytes(), mtime=0)


def _write(path: Path, data: bytes, *, replace: bool) -> None:
    if path.exists() and not replace:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        partial.write_bytes(data)
