"""Counts the bad inputs: `pytest tests/bad_inputs` prints how many were refused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import pytest

from tests.bad_inputs.refusals import refused


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Note how many inputs a test has refused."""
    refused[0] = 0
    yield
    item.user_properties.append(("refused", refused[0]))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the number of refused inputs by test file."""
    counts: Counter[str] = Counter()
    for report in terminalreporter.stats.get("passed", []):
        counts[report.location[0]] += dict(getattr(report, "user_properties", [])).get("refused", 0)
    for file, count in counts.items():
        terminalreporter.write_line(f"{count:6} bad inputs refused in {file}")
    terminalreporter.write_line(f"{counts.total():6} bad inputs refused")
