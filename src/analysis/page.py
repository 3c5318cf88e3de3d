"""The report as one HTML file that needs nothing but itself."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
from jinja2 import Environment, StrictUndefined

from see2act.analysis import paper
from see2act.analysis.commands import command
from see2act.analysis.contrasts import aggregates, contrasts, findings
from see2act.analysis.groups import Comparison, Found, Group
from see2act.analysis.plots import Picture
from see2act.analysis.reaching import TARGET
from see2act.analysis.runs import Run
from see2act.analysis.summary import Row
from see2act.experiment.results import SPLITS
from see2act.files import replacing

GALLERY = {
    "heatmaps": "heatmaps of the models, before and after, each panel on a colour scale of its own",
    "picks": "a pick on seen and on unseen objects",
    "failures": "failed picks of the last evaluation, by cause",
}
"""Pictures of a run, and what they show: .png, or .jpg in runs that were kept."""
OUTCOMES = {"zero_shot": "zero-shot", "eval": "after fine-tuning"}
WIDEST = 1000
"""Pixels of a picture in the gallery."""


@dataclass(frozen=True)
class Specimen:
    """One run of a group, in pictures."""

    group: Group
    run: Run
    pictures: list[dict[str, str]]
    video: str | None
    """From the report's folder."""
    outcome: str


def write(found: Found, rows: list[Row], steps: list[Row], pictures: dict[str, list[Picture]], folder: Path) -> Path:
    """Make ``report.html`` in ``folder``.

    Args:
        found: What it is about.
        rows: Of ``table.csv``.
        steps: Of ``progress.csv``.
        pictures: By comparison's slug.
        folder: Which was searched.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"data_uri": lambda path: _uri(path.read_bytes(), "image/png"), "command": command}
    template = environment.from_string(resources.files("see2act.analysis").joinpath("page.html.j2").read_text())
    page = template.render(
        found=found,
        title=folder.resolve().name,
        rows=rows,
        primitives=list(dict.fromkeys(row["primitive"] for row in rows)),
        comparisons=[
            _comparison(comparison, rows, steps, pictures[comparison.slug], folder) for comparison in found.comparisons
        ],
        versions=_versions(found),
        paper=paper,
        target=TARGET,
        hours=sum(map(seconds, found.runs)) / 3600,
        seconds=seconds,
    )
    path = folder / "report.html"
    with replacing(path) as partial:
        partial.write_text(page, encoding="utf-8")
    return path


def _comparison(
    comparison: Comparison, rows: list[Row], steps: list[Row], pictures: list[Picture], folder: Path
) -> dict[str, Any]:
    progress = []
    for group in comparison.groups:
        mine = [step for step in steps if _of(step, comparison, group) and step["split"] == "unseen"]
        progress.append(
            (group, {int(step["step"]): step for step in mine}, next(row for row in rows if _of(row, comparison, group)))
        )
    return {
        "comparison": comparison,
        "pictures": pictures,
        "steps": sorted({step for _, cells, _ in progress for step in cells}),
        "progress": progress,
        "findings": findings(comparison),
        "contrasts": [*contrasts(comparison, "after_unseen"), *contrasts(comparison, "learning")],
        "aggregates": aggregates(comparison),
        "specimens": [_specimen(group, folder) for group in comparison.groups],
    }


def _of(row: Row, comparison: Comparison, group: Group) -> bool:
    """Whether a row is a group's."""
    return (row["primitive"], row["protocol"], row["config_hash"]) == (
        comparison.primitive,
        str(comparison.number or ""),
        group.hash,
    )


def _specimen(group: Group, folder: Path) -> Specimen:
    run = shown(group)
    pictures = []
    for name, image in thumbnails(run).items():
        words = GALLERY[name]
        alt = f"{group.primitive}, {group.name}, seed {run.seed}: {words}"
        pictures.append({"uri": _uri(image, "image/jpeg"), "alt": alt, "caption": words})
    video = run.folder / "video.mp4"
    return Specimen(group, run, pictures, _link(video, folder) if video.is_file() else None, _outcome(run))


def shown(group: Group) -> Run:
    """The run with the lowest seed that has pictures: nobody chose it for its looks."""
    return next((run for run in group.runs if any(_picture(run, name) for name in GALLERY)), group.runs[0])


def thumbnails(run: Run) -> dict[str, bytes]:
    """The pictures of a run that are whole, made small enough to embed: names without endings, and JPEG files."""
    images = {name: cv2.imread(str(path)) for name in GALLERY if (path := _picture(run, name))}
    return {name: _small(image) for name, image in images.items() if image is not None}


def _picture(run: Run, name: str) -> Path | None:
    paths = (run.folder / "figures" / f"{name}{suffix}" for suffix in (".png", ".jpg"))
    return next((path for path in paths if path.is_file()), None)


def _small(image: np.ndarray) -> bytes:
    scale = min(1.0, WIDEST / image.shape[1])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 82])[1])


def _outcome(run: Run) -> str:
    """In words."""
    told = []
    phases = {"zero_shot": "zero-shot"} if run.result.eval.repeated else OUTCOMES
    for phase, words in phases.items():
        if run.result.phase(phase) is None:
            continue
        counts = (f"{'/'.join(map(str, run.counts(phase, split)))} {split}" for split in SPLITS)
        told.append(f"{words} {', '.join(counts)}")
    return "; ".join(told)


def seconds(run: Run) -> float:
    """Of wall time, all stages together."""
    return float(sum(run.result.seconds.values()))


def _versions(found: Found) -> list[dict[str, Any]]:
    """Every set of versions, with the runs it made."""
    sets: dict[tuple[tuple[str, str], ...], int] = {}
    for run in found.runs:
        commit = run.result.commit or "unknown"
        key = (*((name, str(version)) for name, version in run.result.versions.items()), ("commit", commit))
        sets[key] = sets.get(key, 0) + 1
    return [{"versions": dict(key), "runs": count} for key, count in sets.items()]


def _link(path: Path, folder: Path) -> str:
    return quote(path.relative_to(folder).as_posix())


def _uri(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
