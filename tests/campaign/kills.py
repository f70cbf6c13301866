"""SIGKILL of the main process at random moments."""

import json
import random
import shutil
import sys
import tempfile
import time
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from liex_lab.pipelines.session import MEASURING

from liex_lab.errors import LiexError
from liex_lab.sessions import Session
from tests.campaign.runs import begin, refusal, tables_of, undisturbed
from tests.campaign.tally import Tally

# of the moments are counted from when poses are measured; the others from the very beginning
_IN_THE_WORK = 0.6


def kills(n: int, n_frames: int, seed: int) -> Tally:
    """Kill runs at n random moments; a run that was killed is begun again until it is whole, and
    compared.
    """
    rng, scratch = random.Random(seed), Path(tempfile.mkdtemp(prefix="liex-kills-"))
    usual_s, expected = undisturbed(scratch, n_frames)
    out, lost, where = scratch / "killed", [0.0], dict[str, int]()
    killed = finished = equal = half = 0
    slowest_s = 0.0
    figures: dict[str, Any] = {}
    while killed < n or not finished:
        began, process = time.monotonic(), begin(out, n_frames)
        if killed < n:
            if rng.random() < _IN_THE_WORK:
                _wait_for_the_work(process, out)
            process.join(rng.uniform(0.0, 1.1 * usual_s))
        else:
            process.join()
        if process.is_alive():
            at = time.monotonic()
            process.kill()
            process.join()
            slowest_s = max(slowest_s, time.monotonic() - at)
            killed += 1
            stage, seconds = _lost(out)
            where[stage] = where.get(stage, 0) + 1
            lost.append(seconds)
        elif process.exitcode:
            raise RuntimeError(f"a run that nobody killed ended by itself: {refusal(out)}")
        else:  # the first run compiled kernels
            usual_s = min(usual_s, time.monotonic() - began)
        for place in out.glob("*.liex"):  # it is there: then it is whole
            try:
                Session.open(place)
                equal += tables_of(place) == expected
                finished += 1
            except LiexError:
                half += 1
            shutil.rmtree(place)
        figures = {
            "killed": killed,
            "killed_while": where,
            "finished": finished,
            "equal_tables": equal,
            "half_written_read_as_whole": half,
            "usual_s": round(usual_s, 1),
            "most_s_of_measuring_done_again": round(max(lost), 1),
        }
        print(json.dumps(figures), file=sys.stderr, flush=True)  # so far
    shutil.rmtree(scratch)
    tally = Tally(tried=killed, wrong=finished - equal + half, slowest_s=slowest_s, more=figures)
    tally.kinds.update({f"SIGKILL while {stage}": count for stage, count in where.items()})
    if tally.wrong:
        tally.broken.append(f"{tally.wrong} of {finished} sessions are not as if undisturbed")
    return tally


def _wait_for_the_work(process: BaseProcess, out: Path) -> None:
    """Until poses are measured, or the process has ended."""
    while process.is_alive():
        try:
            if json.loads((out / "stage.json").read_text())[0] == MEASURING:
                return
        except (OSError, ValueError):
            pass
        process.join(0.02)


def _lost(out: Path) -> tuple[str, float]:
    """What was being done, and seconds of measuring since the last checkpoint, or since this
    process began to.
    """
    try:
        stage, since = json.loads((out / "stage.json").read_text())
    except (OSError, ValueError):
        return "beginning", 0.0
    (out / "stage.json").unlink()
    if stage != MEASURING:
        return stage, 0.0
    spent = time.monotonic() - since
    states = [time.time() - state.stat().st_mtime for state in out.glob("*.part/checkpoint.json")]
    return stage, min([spent, *states])
