"""Files of installed packages."""

from __future__ import annotations

from fnmatch import fnmatch
from importlib import metadata
from pathlib import Path

from see2act.robot.types import RobotError


def package_file(distribution: str, pattern: str) -> Path:
    """The first file of an installed package whose path matches a shell pattern. Here ``*`` also matches ``/``.

    Raises:
        RobotError: The package is not installed, or has no such file.
    """
    try:
        files = metadata.files(distribution) or []
    except metadata.PackageNotFoundError:
        files = []
    for file in files:
        if fnmatch(str(file), pattern):
            return Path(str(file.locate())).resolve()
    raise RobotError(f"{pattern} is not in an installed package {distribution}: run `make install`")
