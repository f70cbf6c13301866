"""A real Slurm (Debian's slurmctld, slurmd and munge) on this machine, and studies on it whose
jobs, node and submitting process are killed, held up and started again.

It wants root and `apt-get install slurmctld slurmd slurm-client munge`; else it says so.
"""

import os
import random
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.campaign.commands import started
from tests.campaign.runs import SAMPLE, whole_sessions
from tests.campaign.studies import study_file
from tests.campaign.tally import Tally

_PROGRAMS = ("munged", "slurmctld", "slurmd", "sinfo", "scancel", "scontrol", "squeue")
_KEY = Path("/etc/munge/munge.key")
_N_SESSIONS = 4  # of a study
_N_LONG = 30  # of one that lasts well longer than the shortest time limit of Slurm, a minute
_LONGEST_S = 900.0  # of a study; one that hangs is killed
_HELD_S = 8.0  # a node is held up for so long
_EMPTY_S = 120.0  # after the study the queue is empty within so long
_CONFIGURATION = """ClusterName=liex
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CryptoType=crypto/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
KillWait=2
MpiDefault=none
NodeName=localhost NodeAddr=127.0.0.1 CPUs=4 RealMemory=16000 State=UNKNOWN
PartitionName=main Nodes=localhost Default=YES MaxTime=INFINITE State=UP
"""
_JOBS = """jobs = 2
cores_per_job = 1
memory = "4GB"
walltime = "00:30:00"
interface = "lo"
shared_folder = "{folder}/keys"
log_folder = "{folder}/logs"
"""
# faults of one study, in turn
STUDIES = (
    ("all jobs killed",),
    ("job killed", "job killed", "job killed"),
    ("node drained and resumed", "job killed"),
    ("node down and resumed",),
    ("submitter killed", "submitter killed"),
    ("time limit met",),
)


def slurm(n: int, seed: int) -> Tally:
    """n faults in studies on a Slurm cluster of this machine: the tables are those of a study that
    was left alone, and nothing is left in the queue.

    Args:
        n: faults.
        seed: that the moments are drawn from.
    """
    rng, tally = random.Random(seed), Tally()
    missing = [name for name in _PROGRAMS if not shutil.which(name)]
    if os.geteuid() or missing or not _KEY.is_file():
        tally.more["not_tried"] = f"it wants root and Slurm's programs; missing: {missing}"
        return tally
    scratch = Path(tempfile.mkdtemp(prefix="liex-slurm-"))
    with _cluster(scratch):
        usual_s, expected, said = _studied(scratch / "alone", _N_LONG, (), rng, 60.0)
        assert len(expected) == _N_LONG, said
        usual_s *= _N_SESSIONS / _N_LONG
        k = 0
        while tally.tried < n:
            faults = STUDIES[k % len(STUDIES)][: n - tally.tried]
            folder = scratch / f"study{k}"
            n_sessions = _N_LONG if "time limit met" in faults else _N_SESSIONS
            seconds, found, said = _studied(folder, n_sessions, faults, rng, usual_s)
            whole = len(found) == n_sessions and found.items() <= expected.items()
            wrong = "" if whole else f"{len(found)} sessions, some of them others"
            if seconds > _LONGEST_S:
                wrong = f"it hung; {wrong}"
            elif left := _left():
                wrong = f"{wrong} left in the queue: {left}"
            for fault in faults[:-1]:
                tally.fault(fault)
            tally.fault(faults[-1], wrong=wrong, traceback="Traceback" in said, said=said)
            tally.more.setdefault("study_s", []).append(round(seconds))
            k += 1
        told = (scratch / "slurmctld.log").read_text(encoding="utf-8", errors="replace")
    tally.more["undisturbed_s"] = round(usual_s)
    tally.more["jobs_ended_by_their_time"] = told.count("Time limit exhausted")
    shutil.rmtree(scratch, ignore_errors=True)  # its daemons take their sockets away themselves
    return tally


def _studied(
    folder: Path, n_sessions: int, faults: tuple[str, ...], rng: random.Random, usual_s: float
) -> tuple[float, dict[str, dict[str, bytes]], str]:
    """A study with faults at random moments: how long it took, its tables, and what it said."""
    (folder / "rawdata").mkdir(parents=True)
    shutil.copy(SAMPLE, folder / "rawdata" / "walk.mcap")
    study = study_file(folder, [(f"m{k}", "rawdata/walk.mcap") for k in range(n_sessions)])
    (folder / "slurm.toml").write_text(_JOBS.format(folder=folder))
    command: list[str | Path] = ["cohort", study, "--slurm", folder / "slurm.toml"]
    with (folder / "said").open("w+", encoding="utf-8") as heard:
        began = time.monotonic()
        process = started(*command, out=heard)
        for fault in faults:
            time.sleep(rng.uniform(0.1, 0.6) * usual_s)
            process = _FAULTS[fault](process, lambda: started(*command, out=heard))
        try:
            process.wait(_LONGEST_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        seconds = time.monotonic() - began
        heard.seek(0)
        said = heard.read()
    return seconds, whole_sessions(folder), said


Process = subprocess.Popen[str]
Begin = Callable[[], Process]


def _kill_a_job(process: Process, begin: Begin) -> Process:
    for job in _jobs()[:1]:
        _do("scancel", "--signal=KILL", "--full", job)
    return process


def _kill_all_jobs(process: Process, begin: Begin) -> Process:
    for job in _jobs():
        _do("scancel", job)
    return process


def _meet_the_time_limit(process: Process, begin: Begin) -> Process:
    """Slurm ends the jobs that run by then for their time."""
    for job in _jobs():
        _do("scontrol", "update", f"JobId={job}", "TimeLimit=1")
    return process


def _hold_up(state: str) -> Callable[[Process, Begin], Process]:
    """The node is out for some seconds."""

    def hold(process: Process, begin: Begin) -> Process:
        _do("scontrol", "update", "NodeName=localhost", f"State={state}", "Reason=campaign")
        time.sleep(_HELD_S)
        _do("scontrol", "update", "NodeName=localhost", "State=RESUME")
        return process

    return hold


def _kill_the_submitter(process: Process, begin: Begin) -> Process:
    process.kill()
    process.wait()
    return begin()


_FAULTS: dict[str, Callable[[Process, Begin], Process]] = {
    "job killed": _kill_a_job,
    "all jobs killed": _kill_all_jobs,
    "node drained and resumed": _hold_up("DRAIN"),
    "node down and resumed": _hold_up("DOWN"),
    "submitter killed": _kill_the_submitter,
    "time limit met": _meet_the_time_limit,
}


def _do(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


def _jobs() -> list[str]:
    """Numbers of the jobs that run."""
    return _do("squeue", "--noheader", "--states=RUNNING", "--format=%i").split()


def _left() -> str:
    """What is in the queue when it should be empty."""
    until = time.monotonic() + _EMPTY_S
    while (left := _do("squeue", "--noheader")) and time.monotonic() < until:
        time.sleep(1.0)
    return left


@contextmanager
def _cluster(folder: Path) -> Iterator[None]:
    """Munge, the controller and one node, with a configuration of their own."""
    for name in ("state", "spool", "keys", "logs"):
        (folder / name).mkdir()
    folder.chmod(0o755)
    with socket.socket() as one, socket.socket() as other:
        one.bind(("127.0.0.1", 0))
        other.bind(("127.0.0.1", 0))
        ports = one.getsockname()[1], other.getsockname()[1]
    (folder / "slurm.conf").write_text(_CONFIGURATION.format(folder=folder, ports=ports))
    shutil.copy(_KEY, folder / "key")
    (folder / "key").chmod(0o400)
    os.environ["SLURM_CONF"] = str(folder / "slurm.conf")
    own = {
        "key-file": "key",
        "socket": "munge.socket",
        "pid-file": "munged.pid",
        "log-file": "munged.log",
        "seed-file": "seed",
    }
    munge = [f"--{option}={folder / name}" for option, name in own.items()]
    try:
        subprocess.run(["munged", "--force", *munge], check=True, capture_output=True)
        subprocess.run(["slurmctld"], check=True, capture_output=True)
        subprocess.run(["slurmd", "-N", "localhost"], check=True, capture_output=True)
        until = time.monotonic() + 30.0
        while "idle" not in _do("sinfo") and time.monotonic() < until:
            time.sleep(0.5)
        yield
    finally:
        for name in ("slurmd.pid", "slurmctld.pid", "munged.pid"):
            if (folder / name).is_file():
                subprocess.run(["kill", (folder / name).read_text().strip()], check=False)
