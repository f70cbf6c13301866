"""Ctrl-C, SIGTERM and SIGHUP at random moments of runs and studies."""

import random
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from tests.campaign.commands import ENDED, Ended, run, started
from tests.campaign.runs import SAMPLE, whole_sessions
from tests.campaign.studies import study_file
from tests.campaign.tally import Tally
from tests.runtime.test_signals import alive

LATE_S = 5.0
_KINDS = {
    "Ctrl-C": (signal.SIGINT,),
    "Ctrl-C twice": (signal.SIGINT, signal.SIGINT),
    "SIGTERM": (signal.SIGTERM,),
    "SIGHUP": (signal.SIGHUP,),
}
_CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}
_ORPHANS_S = 3.0
_SCRATCH = "liex-scratch-"
_EARLIEST_S = 0.4  # before, Python itself begins and heeds nothing of ours


def signals(n: int, seed: int) -> Tally:
    """Send signals to n commands; each ends in time and says so, leaves no process and no file of
    its own, and the same command goes on to the same tables.

    Args:
        n: signals.
        seed: that kinds and moments are drawn from.
    """
    rng, tally = random.Random(seed), Tally()
    scratch = Path(tempfile.mkdtemp(prefix="liex-signals-"))
    (scratch / "tmp").mkdir()
    (scratch / "rawdata").mkdir()
    shutil.copy(SAMPLE, scratch / "rawdata" / "walk.mcap")
    study_file(scratch, [("m1", "rawdata/walk.mcap"), ("m2", "rawdata/walk.mcap")])
    commands: dict[str, list[str | Path]] = {
        "run": ["run", SAMPLE, "--out", scratch / "out"],
        "cohort": ["cohort", scratch / "study.toml", "--workers", "2", "--retry"],
    }
    expected: dict[str, dict[str, dict[str, bytes]]] = {}
    usual_s: dict[str, float] = {}
    for name, command in commands.items():
        ended = run(*command)
        assert ended.code in ENDED, ended.said
        expected[name], usual_s[name] = whole_sessions(scratch), ended.seconds
        _clear(scratch)
    for k in range(n):
        name = "cohort" if k % 4 == 3 else "run"
        kind = rng.choice(list(_KINDS))
        at_s = rng.uniform(_EARLIEST_S, usual_s[name])
        ended, seconds, problem = _signalled(commands[name], kind, at_s, scratch / "tmp")
        lost = ""
        if not whole_sessions(scratch) and (
            k % 5 == 4 or k == n - 1
        ):  # what is left goes on to the end
            whole = run(*commands[name])
            if whole.code not in ENDED or whole_sessions(scratch) != expected[name]:
                lost = f"the same command then ends with {whole.code}: {whole.said[-600:]}"
            _clear(scratch)
        elif k % 4 in (2, 3) or whole_sessions(
            scratch
        ):  # another command is next, or nothing is left
            if not whole_sessions(scratch).items() <= expected[name].items():
                problem += " a session that lies there is another one"
            _clear(scratch)
        tally.fault(
            f"{kind} in {name}",
            seconds,
            lost=lost,
            wrong=problem,
            traceback=ended.traceback,
            said=f"after {at_s:.1f} s: {ended.said}",
        )
    with started(*commands["run"], environment={"TMPDIR": str(scratch / "tmp")}) as last:
        last.communicate()
    if left := [path.name for path in (scratch / "tmp").glob("liex*")]:
        tally.fault("the command after all others", wrong=f"{left} stay in TMPDIR")
    shutil.rmtree(scratch)
    return tally


def _signalled(
    command: list[str | Path], kind: str, at_s: float, tmp: Path
) -> tuple[Ended, float, str]:
    """A command that is sent signals; how it ended, how long after, and what is wrong with it."""
    import psutil

    process = started(*command, environment={"TMPDIR": str(tmp)})
    time.sleep(at_s)
    family = [one.pid for one in psutil.Process(process.pid).children(recursive=True)]
    sent = time.monotonic()
    for number in _KINDS[kind]:
        process.send_signal(number)
        time.sleep(0.1)
    try:
        said, _ = process.communicate(timeout=60)
        hung = False
    except subprocess.TimeoutExpired:
        process.kill()
        said, _ = process.communicate()
        hung = True
    seconds = time.monotonic() - sent
    ended = Ended(process.returncode, said, at_s + seconds, hung)
    until = time.monotonic() + _ORPHANS_S
    while any(map(alive, family)) and time.monotonic() < until:
        time.sleep(0.1)
    problems = []
    if hung or seconds > LATE_S:
        problems.append(f"it took {seconds:.1f} s to end")
    number = _KINDS[kind][0]
    # once Python is past everything of ours the signal itself ends it, which shells call the same
    if ended.code not in (*ENDED, _CODES[number], -number):
        problems.append(f"exit code {ended.code}")
    if ended.code not in ENDED and "liex:" not in said and "result:" not in said:
        problems.append("it said nothing")
    if orphans := [pid for pid in family if alive(pid)]:
        problems.append(f"{len(orphans)} processes stay")
    # what is ended while it tidies up leaves its scratch folder to the next command
    if left := [path.name for path in tmp.glob("liex*") if not path.name.startswith(_SCRATCH)]:
        problems.append(f"{left} stay in TMPDIR")
        for name in left:
            shutil.rmtree(tmp / name)
    return ended, seconds, ", ".join(problems)


def _clear(scratch: Path) -> None:
    """Away with everything that was made."""
    for path in scratch.iterdir():
        if path.name not in ("tmp", "rawdata", "study.toml"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
