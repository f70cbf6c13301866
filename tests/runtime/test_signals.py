"""A process that is asked to end does so within five seconds, with a sentence and its exit code,
and leaves no other process behind.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals differ")

SLACK_S = 4.0  # what a machine with other work may add

MAIN = """
import sys, time, threading
import liex_lab.cli.main
cli = sys.modules["liex_lab.cli.main"]
def work():
    {work}
cli.app = work
cli.main()
"""
TIDY = """
    try:
        print("begun", flush=True); time.sleep(60)
    finally:
        print("tidied", flush=True)
"""
STUCK = """
    threading.Thread(target=time.sleep, args=(60,)).start()
    try:
        print("begun", flush=True); time.sleep(60)
    finally:
        time.sleep(60)
"""
DEAF = """
    print("begun", flush=True)
    while True:
        try:
            time.sleep(60)
        except BaseException:
            pass
"""

IN_A_CALLBACK = """
    import os, signal, weakref
    class Gone: pass
    def call(_):
        os.kill(os.getpid(), signal.SIGTERM); time.sleep(0.1)
    gone = Gone()
    kept = weakref.ref(gone, call)
    try:
        print("begun", flush=True); del gone; time.sleep(60)
    finally:
        print("tidied", flush=True)
"""


def heeding() -> None:
    """In a new process: heed the signals, though the tests were started to ignore some (nohup)."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def started(*arguments: str) -> subprocess.Popen[str]:
    """A process of Python that heeds signals."""
    return subprocess.Popen(
        [sys.executable, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heeding,
    )


def ended(work: str, *signals: int) -> tuple[int, str, str, float]:
    """Exit code, output, errors and seconds of a process that is sent signals."""
    code = MAIN.format(work=work.strip())
    with started("-c", code) as running:
        assert running.stdout is not None
        assert running.stdout.readline() == "begun\n"
        began = time.monotonic()
        for number in signals:
            running.send_signal(number)
            time.sleep(0.2)
        out, err = running.communicate(timeout=30)
        return running.returncode, out, err, time.monotonic() - began


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 130),
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.nightly),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.nightly),
    ],
)
def test_what_is_under_way_is_put_down_and_said(number: int, code: int) -> None:
    returned, out, err, seconds = ended(TIDY, number)
    assert returned == code
    assert "tidied" in out
    assert len(err.splitlines()) == 1
    assert err.startswith("liex: ")
    assert "same command" in err
    assert seconds < 5.0 + SLACK_S


@pytest.mark.parametrize("work", [STUCK, pytest.param(DEAF, marks=pytest.mark.nightly)])
def test_what_does_not_end_is_ended(work: str) -> None:
    returned, _, err, seconds = ended(work, signal.SIGTERM)
    assert returned == 143
    assert err.count("ended (SIGTERM)") == 1
    assert seconds < 6.0 + SLACK_S


def test_a_signal_that_comes_where_python_lets_no_error_out_is_heard_all_the_same() -> None:
    returned, out, err, seconds = ended(IN_A_CALLBACK)
    assert returned == 143
    assert "tidied" in out
    assert err.count("\n") == 1
    assert err.startswith("liex: ended (SIGTERM)")
    assert seconds < 3.0 + SLACK_S


def test_a_second_signal_ends_it_at_once() -> None:
    returned, _, _, seconds = ended(STUCK, signal.SIGINT, signal.SIGINT)
    assert returned == 130
    assert seconds < 2.0 + SLACK_S


POOL = """
import os, time, sys
from liex_lab.runtime.processes import Processes
def do(k):
    os.write(1, b"%d\\n" % os.getpid())  # in one piece: two workers write at once
    time.sleep(60)
if __name__ == "__main__":
    {main}
"""


def alive(pid: int) -> bool:
    """Whether a process is there and is no zombie."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="there is no /proc")
@pytest.mark.parametrize(
    ("number", "handled"),
    [
        (signal.SIGKILL, False),
        (signal.SIGINT, True),
        pytest.param(signal.SIGKILL, True, marks=pytest.mark.nightly),
        pytest.param(signal.SIGTERM, True, marks=pytest.mark.nightly),
        pytest.param(signal.SIGTERM, False, marks=pytest.mark.nightly),
        pytest.param(signal.SIGINT, False, marks=pytest.mark.nightly),
    ],
)
def test_no_worker_is_left_behind(number: int, handled: bool, tmp_path: Path) -> None:
    work = "list(Processes(2, 1).each(do, [1, 2, 3]))"
    if handled:
        begin = "import liex_lab.cli.main; cli = sys.modules['liex_lab.cli.main']; "
        work = f"{begin}cli.app = lambda: {work}; cli.main()"
    script = tmp_path / "script.py"
    script.write_text(POOL.format(main=work))
    with started(str(script)) as running:
        assert running.stdout is not None
        workers = [int(running.stdout.readline()) for _ in range(2)]
        assert all(map(alive, workers))
        os.kill(running.pid, number)
        began = time.monotonic()
        while any(map(alive, workers)) and time.monotonic() - began < 10.0:
            time.sleep(0.1)
        assert not any(map(alive, workers))
        running.wait(10)
    assert time.monotonic() - began < 6.0 + SLACK_S
