"""SLURM jobs of a sweep, as the queue tells of them."""

from __future__ import annotations

import time

from submitit import SlurmJob
from submitit.slurm.slurm import SlurmInfoWatcher


class Queue(SlurmInfoWatcher):
    """Tells which jobs have ended: those that ``squeue`` no longer lists.

    submitit's own watcher asks ``sacct``. Without SLURM's accounting database that fails, and a sweep would wait for ever for
    a job that was killed.
    """

    def wait_for_all(self) -> None:
        """Return when no job of this sweep waits or runs any more."""
        while not all([self.is_done(job) for job in self._registered]):
            time.sleep(1)

    def _make_command(self) -> list[str] | None:
        return ["squeue", "--me", "--noheader", "--array", "--format=%i"] if self._registered - self._finished else None

    def read_info(self, string: bytes | str) -> dict[str, dict[str, str]]:
        listed = (string if isinstance(string, str) else string.decode()).split()
        return {job: {"State": "RUNNING" if job in listed else "ENDED"} for job in self._registered}


def watch_queue() -> Queue:
    """From now on, jobs of this process are looked for in the queue, twice a minute at least."""
    SlurmJob.watcher = Queue(delay_s=30)
    return SlurmJob.watcher
