"""A disk that is full after 1 to 90 per cent of what a verb writes, for every verb that writes."""

import random
import re
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.campaign.commands import ENDED, Ended, measured, run
from tests.campaign.runs import SAMPLE, whole_sessions
from tests.campaign.small_disks import filled_after, in_memory, resize, used
from tests.campaign.studies import study_file
from tests.campaign.tally import Tally

LEVELS = (0.01, 0.02, 0.05, 0.10, 0.20, 0.50, 0.90)
LATE_S = 10.0  # after as long as it takes with room, and so much more, it has ended
_MB = 400
_PAGE = 4096
_AT_WORK = 0.6  # of the time that it usually takes
Results = dict[str, bytes]


@dataclass(frozen=True)
class Verb:
    """A verb that writes to a disk.

    Attributes:
        name: what is counted under.
        share: of all tries.
        begin: puts on the disk what must lie there, from a measured session.
        arguments: of the command line.
        results: what has to be equal in the end; empty where there is nothing yet.
    """

    name: str
    share: int
    begin: Callable[[Path, Path], None]
    arguments: Callable[[Path, Path], list[str | Path]]
    results: Callable[[Path], Results]


def _nothing(disk: Path, session: Path) -> None:
    """The verb finds an empty disk."""


def _a_study(disk: Path, session: Path) -> None:
    (disk / "rawdata").mkdir()
    shutil.copy(SAMPLE, disk / "rawdata" / "walk.mcap")
    study_file(disk, [("m1", "rawdata/walk.mcap")])


def _the_session(disk: Path, session: Path) -> None:
    shutil.copytree(session, disk / session.name)


def _one(*places: str) -> Callable[[Path], Results]:
    """These files or folders, where they are."""

    def results(disk: Path) -> Results:
        found = [path for place in places for path in sorted(disk.glob(place)) if path.is_file()]
        return {str(path.relative_to(disk)): path.read_bytes() for path in found}

    return results


def _tables(disk: Path) -> Results:
    return {
        f"{place}/{name}": content
        for place, tables in whole_sessions(disk).items()
        for name, content in tables.items()
    }


def _names(pattern: str) -> Callable[[Path], Results]:
    """The names alone of files that bear the time of their writing."""
    return lambda disk: {path.name: b"" for path in disk.glob(pattern)}


def _export(to: str, share: int, results: Callable[[Path], Results]) -> Verb:
    """An export of the measured session."""
    return Verb(
        f"export {to}",
        share,
        _nothing,
        lambda d, s: ["export", s, "--to", to, "--out", d / "x"],
        results,
    )


def _groups_of(session: Path) -> Path:
    """Two groups of two animals each, beside the measured session; made when first asked for."""
    folder = session.parent / "groups"
    if not folder.exists():
        for k in range(4):
            copy = folder / f"m{k}.liex"
            shutil.copytree(session, copy)
            told = run("describe", copy, f"subject_id=m{k}", f"group={'ab'[k // 2]}")
            assert told.code == 0, told.said
    return folder


VERBS = (
    Verb("run", 20, _nothing, lambda d, s: ["run", SAMPLE, "--out", d / "out"], _tables),
    Verb(
        "cohort",
        6,
        _a_study,
        lambda d, s: ["cohort", d / "study.toml", "--workers", "1", "--retry"],
        _tables,
    ),
    Verb(
        "convert", 13, _nothing, lambda d, s: ["convert", SAMPLE, "--to", d / "a"], _one("a/*.png")
    ),
    Verb(
        "pack",
        13,
        _nothing,
        lambda d, s: ["pack", SAMPLE, "--to", d / "a.pack.mcap"],
        _one("a.pack.mcap"),
    ),
    _export("csv", 10, _one("x/*/*")),
    _export("nwb", 8, _names("x/*.nwb")),
    _export("movement", 3, _one("x/*.nc")),
    _export("sleap", 3, _one("x/*.h5")),
    _export("xlsx", 3, _names("x/*.xlsx")),
    Verb("report", 6, _the_session, lambda d, s: ["report", d / s.name], _tables),
    Verb(
        "figures",
        6,
        _nothing,
        lambda d, s: ["figures", s, "--out", d / "f", "--format", "svg"],
        _names("f/*.svg"),
    ),
    Verb(
        "compare",
        6,
        _nothing,
        lambda d, s: ["compare", _groups_of(s), "--out", d / "c"],
        _one("c/*.csv", "c/*.parquet", "c/methods.txt"),
    ),
    Verb(
        "train",
        3,
        _nothing,
        lambda d, s: ["train", "fish", "--images", "512", "--out", d / "fish.npz"],
        _one("fish.npz"),
    ),
)


def disks(n: int, seed: int) -> Tally:
    """Fill the disk under n commands; with room again, the same command, or the one that was told,
    does what it should.

    Args:
        n: commands.
        seed: that the filling between two levels is drawn from.
    """
    tally, rng = Tally(), random.Random(seed)
    scratch = Path(tempfile.mkdtemp(prefix="liex-disks-"))
    with in_memory(scratch / "probe", _MB) as probe:
        if probe is None:
            tally.more["not_tried"] = "mounting a small disk wants root"
            return tally
    session, _ = measured(scratch / "measured")
    told = run("describe", session, "session_start_time=2026-08-21T10:00:00+02:00")
    assert told.code == 0, told.said  # NWB wants to know
    total = sum(verb.share for verb in VERBS)
    for verb in VERBS:
        tries = max(1, round(n * verb.share / total))
        _tries(tally, verb, tries, session, scratch / verb.name.replace(" ", "-"), rng)
    shutil.rmtree(scratch)
    return tally


def _tries(
    tally: Tally, verb: Verb, n: int, session: Path, place: Path, rng: random.Random
) -> None:
    """One verb, n times."""
    with in_memory(place, _MB) as disk:
        assert disk is not None
        verb.begin(disk, session)
        began = time.time()
        usual = run(*verb.arguments(disk, session))
        assert usual.code in ENDED, usual.said
        told = [path.stat() for path in disk.rglob("*") if path.is_file()]
        needed = sum(one.st_size for one in told if one.st_mtime >= began)
        expected = verb.results(disk)
        assert expected, verb.name
    for k in range(n):
        level = LEVELS[k % len(LEVELS)]
        room = int(needed * level * rng.uniform(0.8, 1.2))
        with in_memory(place, _MB) as disk:
            assert disk is not None
            verb.begin(disk, session)
            full = used(disk) + max(room, _PAGE)
            arguments = verb.arguments(disk, session)
            if k // len(LEVELS) % 2:  # another program fills it while the command is at work
                with filled_after(_AT_WORK * usual.seconds, disk, full):
                    ended = run(*arguments)
            else:
                resize(disk, full)
                ended = run(*arguments)
            wrong = _wrong(ended, verb.results(disk), expected, usual.seconds)
            resize(disk, _MB << 20)
            again = run(*_as_told(ended) or (*verb.arguments(disk, session), *_over(verb, ended)))
            lost = ""
            if again.code not in ENDED or verb.results(disk) != expected:
                lost = f"with room it ends with {again.code}: {again.said[-600:]}"
        tally.fault(
            f"{verb.name} at {level:.0%}",
            max(ended.seconds - usual.seconds, 0.0),
            lost=lost,
            wrong=wrong,
            traceback=ended.traceback or again.traceback,
            said=ended.said,
        )


def _wrong(ended: Ended, found: Results, expected: Results, usual_s: float) -> str:
    """What is wrong with how a command ended on a full disk; empty where nothing is."""
    if ended.hung or ended.seconds > usual_s + LATE_S:
        return f"it took {ended.seconds:.0f} s, usually {usual_s:.0f}"
    if ended.code in ENDED:
        return "" if found == expected else "it ended well without its results"
    if any(content != expected.get(name) for name, content in found.items()):
        return "half a result lies where whole ones do"
    return "" if "liex:" in ended.said or "failed" in ended.said else "it did not say why"


def _as_told(ended: Ended) -> list[str]:
    """What a command said that should be typed once there is room; nothing: the same again."""
    told = re.search(r"then make it with liex (report \S+)", ended.said)
    return told[1].split() if told else []


def _over(verb: Verb, ended: Ended) -> list[str]:
    """What was made with too little room after all is made again."""
    return ["--overwrite"] if ended.code in ENDED and verb.name not in _ANEW else []


_ANEW = ("cohort", "report", "figures", "compare", "train")  # do what is left, or write anew
