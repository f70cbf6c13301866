"""Find the animal of a recording from its metadata, folders and file name.

A name such as `m01_day1` contains an animal, an occasion (day, session, date, test) and often words
that identify neither (`depth`, `copy`). `liex run` and `liex cohort init` find the animal by the
same rules, and `liex compare` finds ids that differ only by an occasion. An ambiguous name is kept
whole: cutting too much would merge two animals.
"""

import hashlib
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from liex_lab.plan.study import RAW, STUDY_FILE

_WORDS = (
    "days?|sessions?|sess?|recordings?|rec|trials?|weeks?|wk|months?|hours?|hrs?|tests?|testing|"
    "runs?|reps?|takes?|visits?|blocks?|phases?|stages?|rounds?|timepoint|habituation|habit|hab|"
    "training|train|baseline|base|pre|post|probe|acquisition|acq|extinction|ext|reversal|"
    "retention|recovery|washout|injection|open[-_ ]?field|oft?|epm|nor|morning|afternoon|evening|"
    "night"
)
_GLUED = "days?|sessions?|sess?|recording|rec|trial|week|wk|test|visit|run"  # as in m01day1
_MONTHS = "(?:jan|feb|mar|apr|may|jun|jul|aug|sept?|oct|nov|dec)[a-z]{0,6}"
_MONTH, _DAY = "(?:0[1-9]|1[0-2])", r"(?:0[1-9]|[12]\d|3[01])"
_MD = _MONTH + _DAY
_TIME = (
    r"(?:[T_ -]?(?:[01]\d|2[0-3])[-_:.h]?[0-5]\d(?:[-_:.m]?[0-5]\d(?:[.,_]?\d{1,9})?s?)?"
    r"(?:Z|[+-]\d\d:?\d\d)?(?!-\d\d(?!\d)))?"
)
_START, _END = r"(?<![^\W_])", r"(?![^\W_])"  # of a word of letters and digits
_AFTER = r"(?<=[^\W_][-_. ])"  # after another word
_OCCASION = re.compile(
    rf"{_START}(?:(?:19|20)\d\d{_MD}{_TIME}"
    rf"|(?:19|20)\d\d([-_. ])(?:0?[1-9]|1[0-2])\1(?:0?[1-9]|[12]\d|3[01]){_TIME}"
    rf"|[0-3]?\d([-_. ])[0-3]?\d\2(?:19|20)\d\d{_TIME}|[0-3]\d([-_. ])[0-5]\d\3[0-5]\d"
    rf"|\d{{1,2}}[-_. ]?{_MONTHS}(?:[-_. ]?(?:20)?\d\d)?|{_MONTHS}[-_. ]?\d{{1,2}}[-_. ]20\d\d"
    rf"|1[5-9]\d{{8}}(?:\d{{3}})?|{_AFTER}\d\d{_MD}{_TIME}|\d\d{_MD}{_TIME}(?=[-_. ][^\W_])"
    rf"|(?:{_WORDS})(?:[-_. #]?\d{{1,4}}[a-d]?|[-_. ][a-d]|(?-i:[A-D]))?"
    rf"|\d{{1,3}}(?:days?|hrs?|hours?|wk|weeks?|min)|{_AFTER}(?:24|48|72|96|120|168)h"
    rf"|{_AFTER}(?:[dstwv][-_]?\d{{1,3}}|am|pm)"
    rf"){_END}|(?<=\d)(?:{_GLUED})[-_]?\d{{1,3}}{_END}",
    re.IGNORECASE,
)
_SHORT_GLUED = re.compile(r"(?<=\d)[dsw]\d{1,3}$", re.IGNORECASE)  # as in m01d2, of ids only
_SILENT = re.compile(  # words added by programs and cameras
    rf"{_START}(?:depth|data|raw|rawdata|videos?|vid|movie|film|frames?|images?|pictures?|"
    r"cam(?:era)?|kinect|azure|realsense|d4\d\d|femto|orbbec|topdown|topview|moseq|proc|processed|"
    r"behav(?:iou?r)?|func|converted|compressed|output|exported|capture|copy(?: of)?|kopie|copie)"
    rf"(?:[-_ ]?\d)?{_END}|\(\d+\)",
    re.IGNORECASE,
)
_PLACES = re.compile(  # part of an animal's id at most, never an animal by itself
    rf"{_START}(?:(?:group|grp|cohort|batch|cage|litter|experiment|exp|study|project|pilot|strain|"
    r"line|condition|cond|box|rig|room|arena|lab|setup|chamber|set)[-_ ]?(?:\d{1,3}|[a-z])?|"
    r"mouse|mice|rats?|animals?|subjects?|subj|fish|hand|default|unknown|unnamed|none|nan|null|na|"
    r"name|wt|wildtype|ko|het|hom|controls?|ctrl|ctl|vehicle|veh|saline|sal|drug|treated|c57\w*|"
    r"bl6|b6j?|cd1|dba\d?|129\w*|treatment|sham|stress|naive|cno|males?|females?|adults?|"
    rf"(?:19|20)\d\d|[dstwv]\d{{1,3}}(?=$)){_END}",
    re.IGNORECASE,
)
_ANIMAL = re.compile(
    rf"{_START}(?:m|ms|mouse|rat|animal|subj|subject|sub|id|fish|zf|pup|no|nr|tag|ear)[-_ .#]?\d"
    r"|#\d",
    re.IGNORECASE,
)
_FIRST = re.compile(rf"([dstwv]\d{{1,3}})[-_. ](?={_ANIMAL.pattern})", re.IGNORECASE)
_DATED = re.compile(  # as in m01_012517 or m01_250117: the digits alone may be an animal's number
    rf"(.*[^\W\d_].*[^\W_])[-_. ]((?:{_MD}|{_DAY}{_MONTH})[1-3]\d)", re.IGNORECASE
)
_TAG = re.compile(r"[a-z]{0,3}[-_ ]?\d{1,4}[a-z]{0,2}", re.IGNORECASE)
_CAGE = re.compile(r"(?:home[-_ ]?)?(?:cage|litter)[-_ ]?(?:\d{1,4}|[a-z])", re.IGNORECASE)
CONTAINER = re.compile(r"\.(?:tar\.gz|tgz|tar|mcap|bag|db3|oni|avi|mkv|dat)$", re.IGNORECASE)
_REFERENCE = re.compile(
    rf"{_START}(?:controls?|ctrl|ctl|con|vehicle|veh|saline|sal|pbs|wt|wild[-_ ]?type|sham|naive|"
    rf"untreated|placebo|mock|none){_END}|^\+/\+$",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class SubjectName:
    """The animal of a recording.

    Attributes:
        id: its name, letters and digits; the recording's whole name if nothing names it.
        origin: source of the name: metadata, folder or file name; empty if nothing names it.
        session: the rest of the path's information, such as day1; may be empty.
    """

    id: str
    origin: str
    session: str


def find_subject(path: Path, stated: str = "", root: Path | None = None) -> SubjectName:
    """Find the animal by metadata, a folder sub-NAME, another folder, or the recording's name.

    Args:
        path: the recording.
        stated: the animal's name in the recording's metadata; may be empty.
        root: folder from which names count. None: from `rawdata` or a study file's folder on, or
            without either, folders that look like an animal's tag, such as m01.
    """
    whole = path.absolute()
    studies = (one for one in whole.parents if one.name == RAW or (one / STUDY_FILE).is_file())
    known = root.absolute() if root else next(studies, None)
    above = list(whole.relative_to(known).parts[:-1]) if known else _tags_above(whole)
    names = [*above, whole.name if path.is_dir() else CONTAINER.sub("", whole.name)]
    kept = [animal_part(name) for name in names]
    sure = [4.0 * name.lower().startswith("sub-") or strength(name) for name in names]
    best = max(sure)
    chosen = sure.index(best)
    animal = kept[chosen] if best and (known or best >= 2) else ""
    cage = next((name for name in above[::-1] if _CAGE.fullmatch(name)), "")
    if chosen == len(above) and animal and cage not in animal:
        animal = f"{cage} {animal}"
    by_metadata = strength(stated) > 0
    name = animal_part(stated) if by_metadata else animal
    if not name:
        return SubjectName(letters(re.sub(r"\W|_", "", "".join(names))), "", "")
    origin = "file name" if chosen == len(above) else "folder"
    session = _session(names, f"{same(name)} {same(letters(animal))}")
    return SubjectName(letters(name), "metadata" if by_metadata else origin, session)


def _session(names: Sequence[str], animal: str) -> str:
    """A short text of what names contain besides the animal."""
    pieces: list[str] = []
    for name in names:
        if name.lower().startswith("ses-"):
            return name[4:]
        kept, occasions = _split(name)
        pieces += [*([] if same(kept) in animal else [kept]), *occasions]
    named = (re.sub(r"(?i)^(?:sessions?|sess?)(?=[-_ .\d]|$)", "", piece) for piece in pieces)
    return "".join(letters(plain) for one in named if (plain := re.sub(r"\W|_", "", one)))


def _tags_above(whole: Path) -> list[str]:
    """Names of the folders above a recording, up to one that looks like an animal's tag."""
    names = [folder.name for folder in whole.parents]
    bids = [k for k, name in enumerate(names) if name.lower().startswith("sub-")]
    n = next((k for k, name in enumerate(names) if animal_part(name)), 0)
    tag = strength(names[n]) == 3 or _CAGE.fullmatch(names[n]) or _TAG.fullmatch(names[n])
    return names[: bids[0] + 1 if bids else n + bool(tag)][::-1]


def animal_part(name: str) -> str:
    """A name without its occasions and uninformative words.

    Args:
        name: such as m01_day1_depth.
    """
    return _split(name)[0]


def _split(name: str) -> tuple[str, list[str]]:
    """A name without occasions and uninformative words, and the occasions."""
    bare = re.sub("^sub-", "", name, flags=re.IGNORECASE)
    text = re.sub(r"[-_., ]{2,}", "_", _SILENT.sub("", bare))
    occasions = [match[0] for match in _OCCASION.finditer(text)]
    kept = _OCCASION.sub("_", text).strip("-_., ()[]")
    if (first := _FIRST.match(kept)) is not None:
        occasions, kept = [first[1], *occasions], kept[first.end() :]
    if (last := _DATED.fullmatch(kept)) is not None:
        occasions, kept = [*occasions, last[2]], last[1]
    return kept, occasions


def strength(text: str) -> float:
    """How clearly a name without its occasions names an animal: 0 not at all, 3 as m01 does.

    Args:
        text: such as m01, A12 or Bella.
    """
    text = animal_part(text)
    if len(_ANIMAL.findall(text)) == 1:
        return 3.0
    rest = _PLACES.sub("", text).strip("-_., ()[]")
    if re.search(r"\d", rest):
        return 2.5 if _TAG.fullmatch(rest) else 2.0
    return float(re.search(r"[^\W_]", rest) is not None)


def letters(text: str) -> str:
    """An alphanumeric form of a name; collisions are rare.

    Returns:
        At most 64 of a to z, A to Z and 0 to 9.
    """
    plain = unicodedata.normalize("NFKD", re.sub(r"(?<=\d)[\W_]+(?=\d)", "x", text.strip()))
    plain = "".join(
        c if c.isascii() and c.isalnum() else "plus" if c == "+" else f"u{ord(c):x}" * c.isalpha()
        for c in plain
    )
    mark = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    return plain if 0 < len(plain) <= 64 else f"{plain[:56]}{mark}"


def same(text: str) -> str:
    """A key shared by spellings of a name that differ only in case, spaces, _ or -.

    Separators between two digits count: 1-12 and 11-2 are two names.

    Args:
        text: the name of an animal, group or cage.
    """
    inside = r"(?<=[^\W\d])[\s_-]+(?=\w)|(?<=\d)[\s_-]+(?=[^\W\d])"
    return re.sub(inside, "", text.strip()).casefold()


def alike(names: Iterable[str]) -> list[list[str]]:
    """Names that differ only in case, spaces, _ or -, the most frequent spelling first.

    Args:
        names: each as often as it occurs.
    """
    counts = Counter(names)
    ordered = sorted(counts, key=lambda name: (same(name), -counts[name], name))
    spelled = (list(some) for _, some in groupby(ordered, same))
    return [some for some in spelled if len(some) > 1]


def one_animal(ids: Iterable[str]) -> list[list[str]]:
    """Ids that differ only by an occasion, such as m01day1 and m01day2, or consist only of one.

    Args:
        ids: ids that are treated as different animals.
    """

    def bare(id: str) -> str:
        return same(_SHORT_GLUED.sub("", animal_part(id)))

    found = (
        list(some) for _, some in groupby(sorted(set(ids), key=lambda id: (bare(id), id)), bare)
    )
    return [some for some in found if len({same(id) for id in some}) > 1]


def references_first(groups: Iterable[str]) -> list[str]:
    """Sorted names of groups, with those named like a control group first."""
    return sorted(set(groups), key=lambda name: (_REFERENCE.search(name) is None, name))
