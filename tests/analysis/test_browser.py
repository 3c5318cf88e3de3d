"""The page in a real browser, where there is one."""

from __future__ import annotations

import csv
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from test_report import Page

from see2act.commands.report import report

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next((path for path in map(shutil.which, BROWSERS) if path), None)

pytestmark = pytest.mark.skipif(BROWSER is None, reason=f"no browser here: none of {', '.join(BROWSERS)} is on the PATH")


def _opened(page: Path, profile: Path) -> tuple[str, list[str]]:
    """The document as the browser has it, and what it wrote to the console."""
    flags = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}", "--enable-logging=stderr")
    done = subprocess.run(
        [str(BROWSER), *flags, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def test_a_browser_shows_every_figure_and_the_numbers_of_the_table(make_run: Callable[..., Path], tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    for seed in range(3):
        make_run("none-none", seed=seed, config_hash="aaaaaaaaaaaa", pictures=True)
        make_run("normal-full", seed=seed, config_hash="bbbbbbbbbbbb")
    report(runs)
    document, console = _opened(runs / "report.html", tmp_path / "profile")
    assert console == []
    page = Page(document)
    assert page.open == []
    with (runs / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert set(page.cells) == set(range(len(rows)))
    for place, cells in page.cells.items():
        assert {column: rows[place][column] for column in cells} == cells
    figures = len(list((runs / "figures").glob("*.png")))
    assert figures > 4
    assert len(page.images) == figures + 2  # with the gallery's

    measured = runs / "measured.html"
    script = "document.title = Array.from(document.images, image => image.naturalWidth).join(' ')"
    text = (runs / "report.html").read_text()
    measured.write_text(text.replace("</body>", f"<script>window.onload = () => {{ {script} }}</script></body>"))
    document, _ = _opened(measured, tmp_path / "profile")
    widths = [int(word) for word in document.split("<title>")[1].split("</title>")[0].split()]
    assert len(widths) == len(page.images)
    assert min(widths) > 400
