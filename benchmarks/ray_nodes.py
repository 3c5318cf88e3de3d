"""A Ray cluster of two nodes on this machine runs a sweep: a job is killed, and a whole node, and the sweep goes on.

Ray is in an environment of its own (docs/scaling.md). The nodes have files and ports of their own. Both are stopped at the end,
however it ends.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from benchmarks.clusters import Environment, Promises, Sweep, daemon, free_ports, options, run_check, wait_until

FEW = ("primitive=suction", "task=none", "transfer=none", "seed=0,1,2,3")
"""Four short runs of the smoke experiment."""


@contextmanager
def cluster(folder: Path) -> Iterator[tuple[Environment, str, list[subprocess.Popen]]]:
    """Two nodes with one processor each, whose files are in ``folder``, until the end of the block.

    Yields:
        The environment of programs that use it, its address, and the processes of the nodes.
    """
    port, clients = free_ports(2)
    environment = os.environ | {"RAY_TMPDIR": str(folder), "RAY_USAGE_STATS_ENABLED": "0"}
    start = [str(Path(sys.executable).with_name("ray")), "start", "--block", "--num-cpus=1", "--node-ip-address=127.0.0.1"]
    start += ["--min-worker-port=0", "--max-worker-port=0"]
    head = [*start, "--head", f"--port={port}", f"--ray-client-server-port={clients}", "--include-dashboard=false"]
    with ExitStack() as daemons:
        nodes = []
        for number, command in enumerate((head, [*start, f"--address=127.0.0.1:{port}"])):
            log = folder / f"node{number}.log"
            nodes.append(daemons.enter_context(daemon(command, log, environment)))
            wait_until(partial(_runs, log), 120, f"a node of Ray has not started: {log}")
        yield environment, f"127.0.0.1:{port}", nodes


def check(folder: Path, overrides: list[str], promises: Promises) -> None:
    """Run a sweep on two nodes, kill a job on one and then the other node, and give the same command again."""
    with cluster(folder) as (environment, address, nodes):
        promises.tell("two nodes, with a processor each")
        # The launcher sets a size of its object store, which Ray refuses where it finds a cluster.
        own_store = "+hydra.launcher.ray.init.object_store_memory=null"
        launcher = ("hydra/launcher=ray", f"hydra.launcher.ray.init.address={address}", own_store)
        sweep = Sweep(folder / "smoke", environment, *launcher, *(overrides or FEW))
        with sweep.started() as process:

            def both() -> bool:
                assert process.poll() is None, f"the sweep has ended: {sweep.output.read_text()[-2000:]}"
                return len(sweep.at_work()) == 2 and all(map(_jobs, nodes))

            wait_until(both, 300, "no two jobs are at work")
            promises.check(True, "both nodes work at a job")
            (worker,) = _jobs(nodes[0])
            os.kill(worker, signal.SIGKILL)
            promises.tell("the first node's job was killed")
            there = _jobs(nodes[1])
            os.killpg(nodes[1].pid, signal.SIGKILL)
            for each in there:
                os.kill(each, signal.SIGKILL)
            promises.tell("the second node was killed, with its job")
            status = process.wait()
        done = sweep.results()
        promises.check(status == 0, "the sweep goes on and ends with status 0", status)
        promises.check(bool(done) and not sweep.at_work(), "every run is finished", f"{len(done)} results")
        promises.check(sweep.run() == 0, "the same command ends with status 0")
        promises.check(sweep.results() == done, "and runs nothing again")
        promises.check(sweep.report().exists(), "report.py makes the page")


def _runs(log: Path) -> bool:
    return "will now block" in log.read_text()


def _jobs(node: subprocess.Popen) -> list[int]:
    """Processes that work at jobs on a node: children of its raylet, which is of the node's group."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if b"_run_job" in (folder / "cmdline").read_bytes() and os.getpgid(parent) == node.pid:
                found.append(int(folder.name))
    return found


def main() -> None:
    """Run the check."""
    args = options(__doc__).parse_args()
    if not find_spec("ray"):
        sys.exit("ray-check: Ray is not in this environment: docs/scaling.md says how to make one that has it")
    run_check(check, args)


if __name__ == "__main__":
    main()
