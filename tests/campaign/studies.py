"""Studies whose workers are killed, and a study of a hundred sessions of which ten are broken."""

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from liex_lab.pipelines.study.status import SessionStatus, standings

from liex_lab.plan.study import Study
from tests.campaign.runs import SAMPLE, tables_of
from tests.campaign.tally import Tally

_N_SESSIONS = 4  # of a study whose workers are killed


def _workers_of(process: subprocess.Popen[bytes]) -> list[Any]:
    """The processes of a study that measure; none once it has ended."""
    import psutil

    found = []
    try:
        for one in psutil.Process(process.pid).children(recursive=True):
            with suppress(psutil.Error):  # it is just ending
                if "spawn_main" in " ".join(one.cmdline()):
                    found.append(one)
    except psutil.Error:
        return []
    return found


def workers(n: int, seed: int) -> Tally:
    """SIGKILL of a worker at n random moments of studies of four sessions; each study ends by
    itself.
    """
    rng, killed, done, same, again = random.Random(seed), 0, 0, 0, 0
    unfinished = 0
    expected: dict[str, dict[str, bytes]] = {}
    given_up: dict[str, int] = {}
    figures: dict[str, Any] = {}
    while killed < n or not expected:
        folder = Path(tempfile.mkdtemp(prefix="liex-workers-"))
        study = study_file(folder, [(f"m{k}", "rawdata/walk.mcap") for k in range(_N_SESSIONS)])
        (folder / "rawdata").mkdir()
        shutil.copy(SAMPLE, folder / "rawdata" / "walk.mcap")
        command = [sys.executable, "-m", "liex_lab", "cohort", str(study), "--workers", "2"]
        quiet = not expected  # the first study is left alone
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while process.poll() is None:
            time.sleep(rng.uniform(3.0, 20.0))
            found = _workers_of(process)
            if found and not quiet and killed < n:
                rng.choice(found).kill()
                killed += 1
        for one in standings(Study.load(study)):
            if one.state != "done":
                given_up[one.reason] = given_up.get(one.reason, 0) + 1
                continue
            tables = tables_of(one.session.folder)
            same += expected.setdefault(one.session.id, tables) == tables
            done += 1
        if any(
            one.state == "failed" for one in standings(Study.load(study))
        ):  # one command tries them again
            subprocess.run([*command, "--retry"], capture_output=True, check=False)
            after = standings(Study.load(study))
            unfinished += sum(one.state != "done" for one in after)
            again += all(one.state == "done" for one in after)
        shutil.rmtree(folder)
        figures = {
            "workers_killed": killed,
            "sessions_done": done,
            "equal_tables": same,
            "given_up": given_up,
            "studies_whole_after_retry": again,
        }
        print(json.dumps(figures), file=sys.stderr, flush=True)  # so far
    tally = Tally(tried=killed, lost=unfinished, wrong=done - same, more=figures)
    tally.kinds["SIGKILL of a study's worker"] = killed
    if tally.wrong or tally.lost:
        tally.broken.append(f"{tally.wrong} sessions differ, {tally.lost} were never done")
    return tally


# how a recording is broken, and what the reason has to say
BROKEN = {
    "missing": "there is no recording",
    "empty file": "is empty",
    "cut short": "is cut short or damaged, 75 whole frames",
    "no mcap": "is named like an MCAP file but holds something else",
    "no depth": "holds no depth images",
    "text": "is named like an MCAP file but holds something else",
    "8 bit": "expected 16-bit depth, got an 8-bit",
    "no animal": "no animal",
    "one frame": "learned from 1 frame",
    "dark": "no depth was read",
}


def broken(n: int, n_frames: int, n_workers: int, kept: Path | None = None) -> dict[str, Any]:
    """A study of n sessions, ten of them broken in different ways; who fails and why; mended, one
    command does them.

    kept: a folder for the study, where the campaign goes on if it was interrupted.
    """
    from liex_lab.api import run_study

    folder = kept or Path(tempfile.mkdtemp(prefix="liex-broken-"))
    raw, study, first = folder / "rawdata", folder / "study.toml", folder / "first.json"
    if not study.is_file():
        raw.mkdir(parents=True, exist_ok=True)
        _break(raw, SAMPLE.read_bytes())
        names = [(f"b{k}", f"rawdata/{_file_of(name)}") for k, name in enumerate(BROKEN)]
        names += [
            (f"g{k}", f"synthetic:walk?seed={k}&frames={n_frames}&sensor=primesense-qvga")
            for k in range(n - len(BROKEN))
        ]
        study_file(folder, names)
    if not first.is_file():
        began = time.monotonic()
        found = run_study(study, workers=n_workers)
        told = {name: _said(one) for name, one in zip(BROKEN, found, strict=False)}
        right = [name for name, said in told.items() if BROKEN[name] in str(said["reason"])]
        figures = {
            "done": _count(found, "done"),
            "failed": _count(found, "failed"),
            "with_the_right_reason": len(right),
            "reasons": told,
            "seconds": round(time.monotonic() - began),
        }
        first.write_text(json.dumps(figures))
    for name in BROKEN:
        shutil.copy(SAMPLE, raw / _file_of(name).replace(".png", ".mcap"))
    study.write_text(study.read_text().replace(".png", ".mcap"))
    after = run_study(study, workers=n_workers, retry=True)
    figures = json.loads(first.read_text())
    shutil.rmtree(folder)
    return {**figures, "done_after_they_were_mended_and_tried_again": _count(after, "done")}


def _count(found: list[SessionStatus], state: str) -> int:
    return [one.state for one in found].count(state)


def _said(one: SessionStatus) -> dict[str, Any]:
    failure = one.failure or {}
    return {name: failure.get(name) for name in ("stage", "reason", "remedy")}


def study_file(folder: Path, names: list[tuple[str, str]]) -> Path:
    """A study file with one animal for each (name, recording)."""
    text = "".join(
        f'[[animals]]\nid = "{name}"\n[[sessions]]\nanimal = "{name}"\nsession = "01"\n'
        f'recording = "{recording}"\n'
        for name, recording in names
    )
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


def _file_of(name: str) -> str:
    return name.replace(" ", "_") + (".png" if name == "8 bit" else ".mcap")


def _break(raw: Path, sample: bytes) -> None:
    """The broken recordings."""
    import cv2
    import numpy as np

    from tests.recordings.writers import write_mcap

    contents = {
        "empty file": b"",
        "cut short": sample[: len(sample) // 2],
        "no mcap": os.urandom(5000),
        "text": b"x,y\n1,2",
    }
    for name, content in contents.items():
        (raw / _file_of(name)).write_bytes(content)
    cv2.imwrite(str(raw / _file_of("8 bit")), np.zeros((20, 20), np.uint8))
    floor = np.full((40, 48, 64), 700, np.uint16)
    for name, depth in (("no animal", floor), ("one frame", floor[:1]), ("dark", 0 * floor)):
        write_mcap(raw / _file_of(name), depth)
    write_mcap(raw / _file_of("no depth"), floor[:0])
