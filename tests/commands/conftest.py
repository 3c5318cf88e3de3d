"""What the commands' tests share."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache of a module's own, which its jobs share."""
    return tmp_path_factory.mktemp("cache")
