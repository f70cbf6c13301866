"""The fault campaign, run by hand: python -m tests.campaign kills|workers|broken|fuzz (figures in the README).

What it does at random moments it does from a seed, but for the moments themselves, which the machine's load decides.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from liex_lab.catalog import find_sample
from liex_lab.errors import LiexError
from liex_lab.plan import Plan

SAMPLE = "mouse_walk.mcap"
_PRELOADED = ["pandas", "rerun", "foxglove", "cv2", "pyarrow.parquet", "scipy.spatial", "liex_lab.pipelines.session",
              "liex_lab.dashboards.report", "liex_lab.behaviour", "liex_lab.sessions.mcap"]  # fmt: skip


def run_here(recording: str, out: str, every_s: float) -> None:
    """What `liex run` does, in a process that is forked off one with everything imported."""
    from liex_lab.api import run_session
    from liex_lab.sessions import checkpoint

    checkpoint.EVERY_S = every_s
    run_session(recording, Plan.load("mouse"), out, overwrite=True)


def tables_of(folder: Path) -> dict[str, bytes]:
    """Everything that has to be equal."""
    kinds = {".parquet", ".csv", ".toml"}
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.suffix in kinds}


def kills(recording: str, n: int, every_s: float, seed: int) -> dict[str, Any]:
    """SIGKILL at n random moments: a run that was killed is begun again until it is whole, and compared."""
    from liex_lab.sessions import Session

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    rng, scratch = random.Random(seed), Path(tempfile.mkdtemp(prefix="liex-kills-"))

    def begin(out: Path) -> Any:
        process = context.Process(target=run_here, args=(recording, str(out), every_s))
        process.start()
        return process

    began = time.monotonic()
    process = begin(scratch / "undisturbed")
    process.join()
    whole = next((scratch / "undisturbed").glob("*.liex"))
    usual_s, expected = time.monotonic() - began, tables_of(whole)
    out, killed, finished, equal, lost, half = scratch / "killed", 0, 0, 0, [0.0], 0
    while killed < n:
        process = begin(out)
        process.join(rng.uniform(0.0, 1.1 * usual_s))
        if process.is_alive():
            process.kill()
            process.join()
            killed += 1
            lost.append(_since_checkpoint(out))
        places = list(out.glob("*.liex"))
        for place in places:  # it is there: then it is whole
            try:
                Session.open(place)
                equal += tables_of(place) == expected
            except LiexError:
                half += 1
            finished += 1
            shutil.rmtree(place)
    shutil.rmtree(scratch)
    return {"killed": killed, "finished": finished, "equal_tables": equal, "half_written_read_as_whole": half,
            "usual_s": round(usual_s, 1), "most_s_since_checkpoint": round(max(lost), 1)}  # fmt: skip


def _since_checkpoint(out: Path) -> float:
    """Seconds of measuring that were lost: since the last checkpoint, where the measuring had begun."""
    states = list(out.glob("*.part/checkpoint.json"))
    return time.time() - states[0].stat().st_mtime if states else 0.0


def workers(recording: str, n: int, seed: int) -> dict[str, Any]:
    """SIGKILL of a worker at n random moments of studies of four sessions; each study ends by itself."""
    import psutil
    from liex_lab.pipelines.study_state import standings

    from liex_lab.study import Study

    rng, killed, done, failed, same = random.Random(seed), 0, 0, 0, 0
    expected: dict[str, dict[str, bytes]] = {}
    while killed < n or not expected:
        folder = Path(tempfile.mkdtemp(prefix="liex-workers-"))
        (folder / "rawdata").mkdir()
        shutil.copy(recording, folder / "rawdata" / "walk.mcap")
        text = '[[animals]]\nid = "m1"\n'
        for k in range(4):
            text += f'[[sessions]]\nanimal = "m1"\nsession = "0{k}"\nrecording = "rawdata/walk.mcap"\n'
        (folder / "study.toml").write_text(text)
        command = [sys.executable, "-m", "liex_lab", "cohort", str(folder / "study.toml"), "--workers", "2"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        quiet = not expected  # the first study is left alone
        while process.poll() is None:
            time.sleep(rng.uniform(2.0, 8.0))
            found = [one for one in psutil.Process(process.pid).children(recursive=True)
                     if "spawn_main" in " ".join(one.cmdline())] if process.poll() is None else []  # fmt: skip
            if found and not quiet and killed < n:
                rng.choice(found).send_signal(signal.SIGKILL)
                killed += 1
        for one in standings(Study.load(folder / "study.toml")):
            if one.state == "done":
                tables = tables_of(one.session.folder)
                same += expected.setdefault(one.session.id, tables) == tables
                done += 1
            else:
                failed += 1
        shutil.rmtree(folder)
    return {"workers_killed": killed, "sessions_done": done, "equal_tables": same, "sessions_given_up": failed}


BROKEN = (
    "missing",
    "empty file",
    "cut short",
    "no mcap",
    "no depth",
    "text",
    "8 bit",
    "no animal",
    "one frame",
    "dark",
)


def broken(n_good: int, n_frames: int, n_workers: int) -> dict[str, Any]:
    """A study of real sessions, ten of them broken in different ways; who fails, and with which reason."""
    folder = Path(tempfile.mkdtemp(prefix="liex-broken-"))
    raw, sample = folder / "rawdata", find_sample(SAMPLE).read_bytes()
    raw.mkdir()
    _break(raw, sample)
    text = "".join(f'[[animals]]\nid = "b{k}"\n[[sessions]]\nanimal = "b{k}"\nsession = "01"\n'
                   f'recording = "rawdata/{_file_of(name)}"\n' for k, name in enumerate(BROKEN))  # fmt: skip
    for k in range(n_good):
        text += f'[[animals]]\nid = "g{k}"\n[[sessions]]\nanimal = "g{k}"\nsession = "01"\n'
        text += f'recording = "synthetic:walk?seed={k}&frames={n_frames}&sensor=primesense-qvga"\n'
    (folder / "study.toml").write_text(text)
    from liex_lab.api import run_study

    standings = run_study(folder / "study.toml", workers=n_workers)
    states = [one.state for one in standings]
    reasons = {name: one.reason for name, one in zip(BROKEN, standings, strict=False) if one.state == "failed"}
    shutil.rmtree(folder)
    return {"done": states.count("done"), "failed": states.count("failed"), "reasons": reasons}


def _file_of(name: str) -> str:
    return name.replace(" ", "_") + {"text": ".mcap", "8 bit": ".png"}.get(name, ".mcap")


def _break(raw: Path, sample: bytes) -> None:
    """The broken recordings."""
    import cv2
    import numpy as np

    from tests.recordings.writers import write_mcap

    half = sample[: len(sample) // 2]
    contents = {"empty file": b"", "cut short": half, "no mcap": os.urandom(5000), "text": b"x,y\n1,2"}
    for name, content in contents.items():
        (raw / _file_of(name)).write_bytes(content)
    cv2.imwrite(str(raw / _file_of("8 bit")), np.zeros((20, 20), np.uint8))
    floor = np.full((40, 120, 160), 700, np.uint16)
    for name, depth in (("no animal", floor), ("one frame", floor[:1]), ("dark", 0 * floor)):
        write_mcap(raw / _file_of(name), depth)
    write_mcap(raw / _file_of("no depth"), floor[:0])


def fuzz(minutes: float) -> dict[str, Any]:
    """The laws of the readers of plans, studies and sessions on ever new examples."""
    from hypothesis import settings

    import tests.sessions.test_damaged_sessions as sessions
    from tests import test_plan_fuzz, test_study

    found: dict[str, Any] = {"examples": 0}
    until = time.monotonic() + 60 * minutes
    laws = (test_study.test_whatever_a_study_file_says_it_is_read_or_refused_in_one_sentence,
            test_plan_fuzz.test_whatever_a_plan_says_it_is_read_or_refused_in_one_sentence)  # fmt: skip
    with tempfile.TemporaryDirectory() as scratch:
        whole = sessions.write(Path(scratch) / "a.liex", sessions.WalkingMouse(sessions.steady(1.0))).path
        copy = Path(shutil.copytree(whole, Path(scratch) / "b.liex"))
        while time.monotonic() < until:
            for law in laws:
                settings(law, max_examples=2000, deadline=None)()  # type: ignore[operator]
                found["examples"] += 2000
            json_law = settings(sessions.test_any_value_anywhere_in_session_json, max_examples=300)
            json_law(whole, copy)  # type: ignore[operator]
            found["examples"] += 300
    return found


def main() -> None:
    """The campaign's part that was asked for; prints its figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=["kills", "workers", "broken", "fuzz"])
    parser.add_argument("--n", type=int, default=50)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--every-s", type=float, default=3.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--recording", default=str(find_sample(SAMPLE)))
    asked = parser.parse_args()
    figures = {
        "kills": lambda: kills(asked.recording, asked.n, asked.every_s, asked.seed),
        "workers": lambda: workers(asked.recording, asked.n, asked.seed),
        "broken": lambda: broken(asked.n, asked.frames, 2),
        "fuzz": lambda: fuzz(asked.minutes),
    }[asked.part]()
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
