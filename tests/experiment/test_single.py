from __future__ import annotations

import signal
import time

import pytest

from see2act.experiment.single import _sigterm_interrupts


class _Last:
    """Its finalizer is where a signal arrives. Python drops what is raised there."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


def _interrupted() -> None:
    with _sigterm_interrupts():
        _Last()
        time.sleep(5)


def test_an_interrupt_that_python_drops_is_sent_again(capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGALRM)
    with pytest.raises(KeyboardInterrupt):
        _interrupted()
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGALRM)) == before
    assert not capsys.readouterr().err
