"""The date, for people: nothing that is computed depends on it."""

from __future__ import annotations

from time import strftime


def today() -> str:
    """Such as 2026-01-31."""
    return strftime("%Y-%m-%d")


def now() -> str:
    """Such as 2026-01-31-143000, for names of files."""
    return strftime("%Y-%m-%d-%H%M%S")
