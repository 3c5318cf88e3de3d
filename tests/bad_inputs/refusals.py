"""What every bad input must come to: one line that a user can act on, and nothing begun."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import settings
from hypothesis import strategies as st

from see2act.errors import UserError

refused = [0]
"""Bad inputs that were refused in the present test."""


def examples(count: int) -> settings:
    """Settings of a test with so many examples, the same ones each time; ten times as many by ``--hypothesis-profile=long``."""
    times = settings().max_examples / settings.get_profile("default").max_examples
    return settings(max_examples=round(count * times), derandomize=True, deadline=None, database=None)


def is_refused(action: Callable[[], object], *folders: Path) -> str:
    """Check that an action ends with one line for the user, and leaves folders as they are.

    Args:
        action: Is given something bad.
        folders: Where it might have begun its work.

    Returns:
        The line.
    """
    before = _listing(folders)
    with pytest.raises(UserError) as told:
        action()
    check_line(str(told.value))
    assert _listing(folders) == before, f"something was begun: {told.value}"
    refused[0] += 1
    return str(told.value)


def is_refused_or_done(action: Callable[[], object], *folders: Path) -> bool:
    """The same for something that may be harmless after all: nothing but a line for the user may be raised.

    Returns:
        Whether it was refused.
    """
    before = _listing(folders)
    try:
        action()
    except UserError as error:
        check_line(str(error))
        refused[0] += 1
        return True
    finally:
        assert _listing(folders) == before, "something was begun"
    return False


def command_is_refused(main: Callable[[list[str]], object], arguments: list[str], *folders: Path) -> str:
    """The same for a command, which prints the line and exits with a status other than 0."""
    before = _listing(folders)
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code not in (None, 0)
    if ended.value.code != 2:  # argparse prints its line itself
        assert str(ended.value.code).startswith("see2act: ")
        check_line(str(ended.value.code))
    assert _listing(folders) == before, f"something was begun: {ended.value}"
    refused[0] += 1
    return str(ended.value.code)


@contextmanager
def scratch() -> Iterator[Path]:
    """An empty folder, for one input."""
    with TemporaryDirectory() as folder:
        yield Path(folder)


def damaged(content: bytes) -> st.SearchStrategy[bytes]:
    """Some bytes of a file changed, lost or added."""
    places = st.integers(0, max(len(content) - 1, 0))
    head = st.integers(0, min(len(content), 200) - 1)  # where most of the structure is
    at = st.one_of(places, head)
    changed = st.builds(lambda k, new: content[:k] + new + content[k + len(new) :], at, st.binary(min_size=1, max_size=8))
    lost = st.builds(lambda k, n: content[:k] + content[k + n :], at, st.integers(1, 40))
    added = st.builds(lambda k, new: content[:k] + new + content[k:], at, st.binary(min_size=1, max_size=8))
    return st.one_of(changed, lost, added)


def check_line(text: str) -> None:
    """Whether a message is one line of words."""
    assert len(text.splitlines()) == 1, text
    assert len(text.split()) > 3, text
    assert "Traceback" not in text, text


def _listing(folders: Iterable[Path]) -> dict[str, float]:
    """Everything in folders, with the time of its last change."""
    return {
        os.path.join(root, name): os.lstat(os.path.join(root, name)).st_mtime_ns
        for folder in folders
        for root, inner, files in os.walk(folder)
        for name in (*inner, *files)
    }
