"""Power cuts: a snapshot of a disk's blocks at a random moment of a run or a correction.

What the program has written but not synced is in memory only, and not in the snapshot; the file
system (ext4) puts itself right from its journal when the snapshot is mounted.
"""

import random
import shutil
import subprocess
import tempfile
import time
from contextlib import AbstractContextManager
from pathlib import Path

from liex_lab.errors import LiexError
from liex_lab.sessions import Session
from liex_lab.sessions.corrections import read_log
from tests.campaign.commands import ENDED, measured, run, started
from tests.campaign.runs import SAMPLE, tables_of
from tests.campaign.small_disks import mounted
from tests.campaign.tally import Tally

_MB = 256
_AFTER_S = 6.0  # the power may go so long after the command has ended
_BOUT = ["--action", "groom", "--new-word", "--by", "campaign"]


def power_cuts(n: int, seed: int) -> Tally:
    """Cut the power n times; what a command had said is done is there, and the rest goes on.

    Args:
        n: power cuts, of corrections, of runs over a corrected session, and of first runs in turn.
        seed: that the moments are drawn from.
    """
    rng, tally = random.Random(seed), Tally()
    scratch = Path(tempfile.mkdtemp(prefix="liex-power-"))
    if not _formatted(scratch / "probe.img"):
        tally.more["not_tried"] = "there is no ext4 to format a disk with"
        return tally
    with _image(scratch / "probe.img", scratch / "probe") as probe:
        if probe is None:
            tally.more["not_tried"] = "mounting an image wants root"
            return tally
    session, usual_s = measured(scratch / "measured")
    expected = tables_of(session)
    again = run("correct", "bout", session, *_BOUT, "--from", "0.5", "--to", "1")
    assert again.code == 0, again.said
    for k in range(n):
        kind = ("correction", "run over a session", "first run")[k % 3]
        _cut(tally, kind, k, session, expected, usual_s, rng)
    shutil.rmtree(scratch)
    return tally


def _cut(
    tally: Tally,
    kind: str,
    k: int,
    session: Path,
    expected: dict[str, bytes],
    usual_s: float,
    rng: random.Random,
) -> None:
    """One power cut, and what became of it."""
    scratch = session.parents[1]
    image, snapshot = scratch / f"{k}.img", scratch / f"{k}-cut.img"
    _formatted(image)
    correcting = kind == "correction"
    with _image(image, scratch / f"disk{k}") as disk:
        assert disk is not None
        place = disk / session.name
        if kind != "first run":
            shutil.copytree(session, place)
        subprocess.run(["sync"], check=True)
        if correcting:
            process = started("correct", "bout", place, *_BOUT, "--from", "2", "--to", "3")
        else:
            process = started("run", SAMPLE, "--out", disk, "--overwrite")
        time.sleep(rng.uniform(0.3, (4.0 if correcting else usual_s) + _AFTER_S))
        over = process.poll() in ENDED
        subprocess.run(["cp", "--sparse=always", str(image), str(snapshot)], check=True)
        process.communicate()
    n_made = 0 if kind == "first run" else 1 + (correcting and over)
    with _image(snapshot, scratch / f"after{k}") as disk:
        assert disk is not None
        lost, wrong, said = _judged(disk / session.name, correcting, over, n_made, expected)
    tally.fault(
        f"{kind}, {'after its end' if over else 'under way'}",
        lost=lost,
        wrong=wrong,
        traceback="Traceback" in said,
        said=said,
    )
    image.unlink()
    snapshot.unlink()


def _judged(
    place: Path, correcting: bool, over: bool, n_made: int, expected: dict[str, bytes]
) -> tuple[str, str, str]:
    """What is lost and what is wrong on a disk after the power came back, and what was said."""
    wrong = ""
    there = place.exists()
    if there:
        try:
            Session.open(place)
            if tables_of(place) != expected:
                wrong = "a session lies there as if it were whole, with other tables"
        except LiexError as error:
            wrong = f"a session lies there as if it were whole: {error}"
    lost = "a session that was said to be done is gone" if over and not there else ""
    said = ""
    if not correcting:
        again = run("run", SAMPLE, "--out", place.parent, "--overwrite")
        said = again.said
        if again.code not in ENDED or tables_of(place) != expected:
            wrong = wrong or f"the same command then ends with {again.code}"
    if n_made and not lost:
        try:
            kept = len(read_log(place).standing)
        except LiexError as error:
            kept, said = 0, str(error)
        if kept < n_made:
            lost = f"{n_made - kept} of {n_made} corrections are gone"
    return lost, wrong, said


def _formatted(image: Path) -> bool:
    """Make an empty disk; whether that could be done."""
    with image.open("wb") as file:
        file.truncate(_MB << 20)
    if not shutil.which("mkfs.ext4"):
        return False
    return not subprocess.run(["mkfs.ext4", "-qF", str(image)], check=False).returncode


def _image(image: Path, place: Path) -> AbstractContextManager[Path | None]:
    """The disk of an image, see `mounted`."""
    return mounted(place, "-o", "loop", str(image))
