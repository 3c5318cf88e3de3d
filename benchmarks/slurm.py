"""A SLURM cluster of one node on this machine runs a sweep: a job is killed, another is requeued, and the sweep goes on.

The cluster is Debian's (``apt-get install slurm-wlm munge``), with daemons, ports and files of its own. All daemons are stopped
at the end, however it ends.
"""

from __future__ import annotations

import getpass
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from omegaconf import OmegaConf

from benchmarks.clusters import Environment, Promises, Sweep, daemon, free_ports, options, run_check, wait_until

CPUS = 2
CONF = """
ClusterName=check
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={node}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=10
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
MailProg=/bin/true
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
ReturnToService=2
NodeName=check NodeHostname=localhost NodeAddr=127.0.0.1 CPUs={cpus} RealMemory={memory} State=UNKNOWN
PartitionName=main Nodes=check Default=YES MaxTime=INFINITE State=UP
"""
"""One job per processor. No accounting: that needs a database."""
PROGRAMS = ("munged", "slurmctld", "slurmd", "sinfo", "squeue", "scancel", "sbatch")


@contextmanager
def cluster(folder: Path) -> Iterator[dict[str, str]]:
    """A cluster whose files are in ``folder``, until the end of the block.

    Yields:
        The environment of programs that use it.
    """
    controller, node = free_ports(2)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
    conf, key = folder / "slurm.conf", folder / "munge.key"
    conf.write_text(
        CONF.format(folder=folder, controller=controller, node=node, user=getpass.getuser(), cpus=CPUS, memory=memory)
    )
    key.write_bytes(os.urandom(128))
    key.chmod(0o600)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    environment = os.environ | {"SLURM_CONF": str(conf)}
    files = {"key-file": key, "socket": folder / "munge.socket", "pid-file": folder / "munged.pid"}
    files |= {"log-file": folder / "munged.log", "seed-file": folder / "munged.seed"}
    munged = ["munged", "--foreground", "--force", *(f"--{name}={path}" for name, path in files.items())]
    log = folder / "daemons.log"
    with ExitStack() as daemons:
        daemons.enter_context(daemon(munged, log, environment))
        wait_until((folder / "munge.socket").exists, 30, "munged has made no socket")
        daemons.enter_context(daemon(["slurmctld", "-D"], log, environment))
        daemons.enter_context(daemon(["slurmd", "-D", "-N", "check"], log, environment))
        wait_until(lambda: told(environment, "sinfo", "--noheader", "--format=%T") == "idle", 60, "the node is not idle")
        daemons.callback(_end_jobs, environment)
        yield environment


def told(environment: Environment, *command: str) -> str:
    """What one of Slurm's programs prints."""
    return subprocess.run(command, env=environment, capture_output=True, text=True).stdout.strip()


def running(environment: Environment) -> list[str]:
    """Numbers of the jobs that run."""
    return told(environment, "squeue", "--noheader", "--array", "--states=RUNNING", "--format=%i").split()


def _end_jobs(environment: Environment) -> None:
    told(environment, "scancel", "--full", "--signal=KILL", f"--user={getpass.getuser()}")
    told(environment, "scancel", f"--user={getpass.getuser()}")
    wait_until(lambda: not told(environment, "squeue", "--noheader"), 60, "jobs are still in the queue")


def check(folder: Path, overrides: list[str], promises: Promises) -> None:
    """Run a sweep on a cluster, with a job that is killed and one that is requeued, then the same sweep again."""
    with cluster(folder) as environment:
        promises.tell(f"a cluster of one node with {CPUS} processors: {told(environment, 'sinfo', '--version')}")
        launcher = ("hydra/launcher=submitit_slurm", "hydra.launcher.cpus_per_task=1", "hydra.launcher.max_num_timeout=3")
        sweep = Sweep(folder / "smoke", environment, *launcher, *overrides)
        with sweep.started() as process:
            killed = _disturb(sweep, environment, process, promises)
            status = process.wait()
        done, output = sweep.results(), sweep.output.read_text()
        promises.tell(f"the sweep ended with {len(done)} results")
        promises.check(status == 1, "a sweep that lost a job ends with status 1", status)
        promises.check(str(killed.relative_to(sweep.folder)) in output, "its summary names the run that was lost")
        promises.check("Traceback" not in output, "without a traceback")
        promises.check(sweep.at_work() == [killed], "all others are finished, the requeued one too", f"{len(done)} results")
        _again(sweep, done, promises)


def _disturb(sweep: Sweep, environment: Environment, process: subprocess.Popen, promises: Promises) -> Path:
    """When two runs are at work, requeue one as at its time limit, and kill the other.

    Returns:
        The folder of the one that was killed.
    """

    def two_more() -> bool:
        assert process.poll() is None, f"the sweep has ended: {sweep.output.read_text()[-2000:]}"
        return len(_jobs_at_work(sweep, environment)) == CPUS

    wait_until(two_more, 600, "no two jobs are at work")
    (killed, folder), (warned, there) = sorted(_jobs_at_work(sweep, environment).items())[:CPUS]
    told(environment, "scancel", "--signal=KILL", killed)
    promises.tell(f"job {killed} ({folder.relative_to(sweep.folder)}) was killed")
    with daemon(
        ["scancel", "--signal=USR2", warned], sweep.folder.with_name("scancel.log"), environment
    ):  # it may try for minutes
        promises.tell(f"job {warned} ({there.relative_to(sweep.folder)}) was warned, as it is before its time limit")
        restarted = partial(_restarted, environment, warned)
        wait_until(restarted, 60, "SLURM has not put it into the queue again")
    return folder


def _jobs_at_work(sweep: Sweep, environment: Environment) -> dict[str, Path]:
    """Jobs that run, with the folders of their runs: as hydra.job.id, each job has written down its number there."""
    jobs = {OmegaConf.load(run / ".hydra" / "hydra.yaml").hydra.job.id: run for run in sweep.at_work()}
    return {job: run for job, run in jobs.items() if job in running(environment)}


def _restarted(environment: Environment, job: str) -> bool:
    return "Restarts=1" in told(environment, "scontrol", "show", "job", job)


def _again(sweep: Sweep, done: dict[Path, int], promises: Promises) -> None:
    """The same command continues a sweep, and what was finished is left as it was."""
    status = sweep.run()
    promises.check(status == 0, "the same command ends with status 0", status)
    promises.check(not sweep.at_work(), "every run is finished", f"{len(sweep.results())} results")
    promises.check(done.items() <= sweep.results().items(), "what was finished was not run again")
    promises.check(sweep.report().exists(), "report.py makes the page")


def main() -> None:
    """Run the check."""
    args = options(__doc__).parse_args()
    os.environ["PATH"] += ":/usr/sbin:/sbin"  # where Debian keeps daemons
    if missing := [name for name in PROGRAMS if not shutil.which(name)]:
        sys.exit(f"slurm-check: there is no {', '.join(missing)} here: apt-get install slurm-wlm munge")
    run_check(check, args)


if __name__ == "__main__":
    main()
