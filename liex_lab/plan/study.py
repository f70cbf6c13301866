"""Study file: animals, groups, sessions and plans of a study; and the animal of a recording.

One small TOML file, validated by pydantic; names follow NeuroBlueprint (`sub-m01/ses-01`). All its
recordings, plans and results are inside the folder of the file.
"""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal
from urllib.parse import parse_qsl

from pydantic import Field, ValidationError, model_validator

from liex_lab.errors import PlanError, StudyError, did_you_mean, expecting, refuse
from liex_lab.plan import Plan, known_plans
from liex_lab.plan.sections import ArenaPlace, SettingsTable, first_twice
from liex_lab.runtime import durable, text_files

# as in NeuroBlueprint: only letters and digits, so that no name is a path, a formula or markup
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9]{1,64}$")]
SessionName = Annotated[
    str, Field(pattern=r"^[A-Za-z0-9]{1,32}(_[A-Za-z0-9]{1,32}-[A-Za-z0-9]{1,64}){0,6}$")
]
Text = Annotated[str, Field(max_length=500)]
PathText = Annotated[str, Field(min_length=1, max_length=1000)]
Settings = dict[str, Any]

STUDY_FILE = "study.toml"
RAW = "rawdata"
DERIVED = "derivatives/liex-lab"
VIRTUAL = "synthetic:"
_PATTERNS = {
    "id": "should be letters and digits only, as in m01",
    "animal": "should be the id of an animal: letters and digits only, as in m01",
    "session": (
        "should be letters and digits, with key-value pairs after them, as in 01 or "
        "01_date-20260821"
    ),
}


class StudyAnimal(SettingsTable):
    """One animal of the study, a table [[animals]].

    Attributes:
        id: letters and digits only, unique whatever the case.
        group: experimental group.
        cage: home cage or tank.
        sex: sex of the animal.
        batch: batch of the experiment.
        set: settings of the plan for this animal, nested.
    """

    id: Name
    group: Text = ""
    cage: Text = ""
    sex: Text = ""
    batch: Text = ""
    set: Settings = Field(default_factory=dict)


class StudyArena(ArenaPlace):
    """One of several arenas in the images of the study's rig, a table [[arenas]].

    Attributes:
        name: the arena's name, as used by sessions.
        region: its region in the image, as arena.region of a plan.
        set: settings of the plan for this arena, nested, such as its zones.
    """

    set: Settings = Field(default_factory=dict)


class StudySession(SettingsTable):
    """One recording, a table [[sessions]].

    Attributes:
        animal: id of the animal, if it is alone.
        animals: ids of several animals in one arena, the largest first.
        session: letters and digits, with key-value pairs after them, as in 01_date-20260821.
        recording: path below the study's folder, or address of a virtual recording; a pattern such
            as rawdata/m01/cam1_*.mcap is one recording in several files.
        plan: a bundled plan or a path below the study's folder; None uses the study's.
        arena: the animal's arena, if the image shows several; else empty.
        start_time: ISO 8601 with time zone; None uses the recording's.
        exclude: reason for excluding the session; empty if included.
        set: settings of the plan for this session, nested.
    """

    animal: Name = ""
    animals: list[Name] = Field(default_factory=list, min_length=2, max_length=4)
    session: SessionName
    recording: PathText
    plan: PathText | None = None
    arena: Text = ""
    start_time: str | None = None
    exclude: Text = ""
    set: Settings = Field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Ids of its animals."""
        return self.animals or [self.animal]


class StudyTable(SettingsTable):
    """The content of a study file.

    Attributes:
        name: the study's name.
        plan: a bundled plan or a path below the study's folder.
        results: folder of the results, a path below the study's folder.
        shared: what the sessions of one animal share: 'subject' (size and shape) or 'off'.
        set: settings of the plan for all sessions, nested.
        animals: the animals.
        arenas: several arenas in one image, each with its own animal.
        sessions: the sessions.
    """

    name: Text = "study"
    plan: PathText = "mouse"
    results: PathText = DERIVED
    shared: Literal["off", "subject"] = "off"
    set: Settings = Field(default_factory=dict)
    animals: list[StudyAnimal] = Field(default_factory=list)
    arenas: list[StudyArena] = Field(default_factory=list)
    sessions: list[StudySession] = Field(default_factory=list)

    @model_validator(mode="after")
    def _agree(self) -> StudyTable:
        ids = [animal.id for animal in self.animals]
        arenas = [arena.name for arena in self.arenas]
        recorded = Counter((one.arena, one.recording) for one in self.sessions if one.arena)
        twice = first_twice(ids)
        each = [(name, one) for one in self.sessions for name in one.names]
        named = first_twice(f"{name} has two sessions {one.session}" for name, one in each)
        refuse(
            ValueError,
            (twice, f"the animal {twice} is listed twice; keep one"),
            (first_twice(arenas), "two [[arenas]] have the same name; give each its own"),
            *(
                (
                    bool(one.animal) == bool(one.animals),
                    f"the session {one.session} of {one.recording} should name its animal, as in "
                    'animal = "m01", or several of one arena, the largest first, as in animals = '
                    '["m01", "m02"]',
                )
                for one in self.sessions
            ),
            *(
                (
                    name not in ids,
                    f"the session {one.session} is of {name}, an animal that is not in [[animals]]",
                )
                for name, one in each
            ),
            *(
                (
                    one.arena and one.arena not in arenas,
                    f"the session {one.session} of {one.names[0]} is in the arena {one.arena}, "
                    "which is not in [[arenas]]",
                )
                for one in self.sessions
            ),
            *(
                (
                    n > 1,
                    f"two sessions are of the arena {arena} in {recording}; one session lists all "
                    "animals of an arena",
                )
                for (arena, recording), n in recorded.items()
            ),
            (named, f"the animal {named}; give each its own name"),
        )
        return self


@dataclass(frozen=True)
class PlannedSession:
    """One session of the study with its resolved settings.

    Attributes:
        id: unique in the study, as in sub-m01_ses-01.
        animal: the animal.
        recording: a path, or the address of a virtual recording.
        folder: folder of its results.
        plan: all settings, resolved.
        exclude: reason for excluding it; empty if included.
        remark: an extra remark for session.json; may be empty.
        arena: the sessions of all animals of its arena, which are measured together, the largest
            animal first; () if it is alone.
    """

    id: str
    animal: StudyAnimal
    recording: str
    folder: Path
    plan: Plan
    exclude: str = ""
    remark: str = ""
    arena: tuple[PlannedSession, ...] = ()

    @property
    def together(self) -> tuple[PlannedSession, ...]:
        """The sessions that are measured with it, itself among them."""
        return self.arena or (self,)

    @property
    def recording_exists(self) -> bool:
        """Whether the recording's file exists; True for a virtual recording."""
        return self.recording.startswith(VIRTUAL) or durable.is_there(self.recording)


@dataclass(frozen=True)
class Study:
    """A study file that was read.

    Attributes:
        path: absolute path of the file; its paths are relative to its folder.
        table: its content.
    """

    path: Path
    table: StudyTable

    def __repr__(self) -> str:
        groups = ", ".join(sorted({animal.group for animal in self.table.animals if animal.group}))
        n = len(self.table.sessions)
        return (
            f"<Study {self.name}: {len(self.table.animals)} animals"
            f"{f' in the groups {groups}' if groups else ''}, "
            f"{n} session{'' if n == 1 else 's'}, {self.path}>"
        )

    @staticmethod
    def load(path: str | Path) -> Study:
        """Read a study from a TOML file.

        Args:
            path: the file, or a folder that contains study.toml.

        Raises:
            StudyError: the file does not exist or is invalid.
        """
        file = Path(path)
        if file.is_dir():
            file = file / STUDY_FILE
        if not file.is_file():
            raise StudyError(f"there is no study file {file}; `liex cohort init FOLDER` begins one")
        with expecting(
            StudyError, f"{file} should be a TOML file", ValueError, advice="correct it"
        ):
            table = text_files.read_toml(file)
        return Study.from_table(table, file)

    @staticmethod
    def from_table(table: dict[str, Any], path: Path) -> Study:
        """Validate a study from a nested dict, as parsed from TOML.

        Args:
            table: the content of a study file.
            path: path of the file, which need not exist.

        Raises:
            StudyError: the content is invalid.
        """
        try:
            study = Study(path.absolute(), StudyTable.model_validate(table))
        except ValidationError as error:
            raise StudyError(f"{path}: {_sentence(error)}") from None
        for one in study.table.sessions:
            what = f"the recording of {', '.join(one.names)} {one.session}"
            if not one.recording.startswith(VIRTUAL):
                study.inside(one.recording, what)
            for key, value in parse_qsl(one.recording.partition("?")[2]):
                if key == "animal" and one.recording.startswith(VIRTUAL):
                    study.inside(value, f"the animal in {what}")
        return study

    @property
    def name(self) -> str:
        """The study's name."""
        return self.table.name

    @property
    def folder(self) -> Path:
        """The folder of the study."""
        return self.path.parent

    @property
    def results(self) -> Path:
        """Folder of the sessions' folders.

        Raises:
            StudyError: it is in rawdata, which is never written to, or outside the study.
        """
        found = self.inside(self.table.results, "results")
        raw = self.folder / RAW
        if found == raw or raw in found.parents:
            raise StudyError(
                f"{self.path}: results = '{self.table.results}' lies in {RAW}, where nothing is "
                "written"
            )
        return found

    @property
    def cohort_folder(self) -> Path:
        """Folder of the tables of the whole study."""
        return self.results / "cohort"

    @cached_property
    def sessions(self) -> tuple[PlannedSession, ...]:
        """Every session of the file, in order, with its plan resolved.

        Raises:
            StudyError: a setting or a path is invalid.
            PlanError: a named plan is invalid.
        """
        animals = {animal.id: animal for animal in self.table.animals}
        planned: list[PlannedSession] = []
        for one in self.table.sessions:
            own = [self._planned(animals[name], one) for name in one.names]
            several = tuple(own) if len(own) > 1 else ()
            plans = [each.plan.model_copy(update={"session": own[0].plan.session}) for each in own]
            if plans != plans[:1] * len(plans):
                raise StudyError(
                    f"{self.path}, session {own[0].id}: {', '.join(one.names)} are measured "
                    "together, and their settings differ; move them from `set` of the animal to "
                    "`set` of the session"
                )
            planned += [replace(each, arena=several) for each in own]
        return tuple(planned)

    def _planned(self, animal: StudyAnimal, one: StudySession) -> PlannedSession:
        """The session of one animal."""
        id = f"sub-{animal.id}_ses-{one.session}"
        recording = one.recording
        if not recording.startswith(VIRTUAL):
            recording = str(self.inside(recording, f"the recording of {id}"))
        # NeuroBlueprint's name of the folder of behavioural data
        folder = self.results / f"sub-{'-'.join(one.names)}" / f"ses-{one.session}" / "behav"
        folder = folder / f"{animal.id}.liex" if one.animals else folder
        plan = self._plan(animal, one, id)
        return PlannedSession(id, animal, recording, folder, plan, one.exclude)

    def inside(self, text: str, what: str) -> Path:
        """Full path of a path in the study file, which must stay in the study's folder.

        Args:
            text: the path as written, with / or backslashes.
            what: description of the path, for the error message.

        Raises:
            StudyError: the path is absolute, begins with ~ or a drive, or has a part '..'.
        """
        if not durable.named_beside(text):
            raise StudyError(
                f"{self.path}: {what} is '{text}', and a study names only what is in its own "
                f"folder {self.folder}; move or link it there and write the path from there, "
                "without .."
            )
        return self.folder.joinpath(*PurePosixPath(text.replace("\\", "/")).parts)

    def _plan(self, animal: StudyAnimal, one: StudySession, id: str) -> Plan:
        """The plan with the settings of study, arena, animal and session applied, in this order."""
        named = one.plan or self.table.plan
        plan = Plan.load(named if named in known_plans() else self.inside(named, "plan"))
        facts: Settings = {"name": id, "individual": animal.id, "subject_id": animal.id}
        stated = {key: getattr(animal, key) for key in ("group", "cage", "sex", "batch")}
        stated["session_start_time"] = one.start_time
        facts |= {key: value for key, value in stated.items() if value}
        table = plan.model_dump(exclude_none=True)
        arena = next((each for each in self.table.arenas if each.name == one.arena), None)
        where: Settings = {}
        if arena is not None:
            region = arena.region.model_dump(exclude_none=True)
            where = merged(arena.set, {"arena": {"region": region}})
        number: Settings = {"animal": {"count": len(one.animals)}} if one.animals else {}
        for settings in (self.table.set, where, animal.set, {"session": facts}, number, one.set):
            table = merged(table, settings)
        # settings that may name a file
        for section, key in (("arena", "zones"), ("estimation", "model"), ("animal", "skeleton")):
            inner: Any = table.get(section)
            text = inner.get(key) if isinstance(inner, dict) else None
            if isinstance(text, str) and (self.folder / text).is_file():
                # workers run in other folders
                table[section][key] = str(self.inside(text, f"{section}.{key}"))
        if table.get("arenas") is not None:
            raise StudyError(
                f"{self.path}, session {id}: a session of a study is of one animal in one arena; "
                'list [[arenas]] with name and region in the study and set arena = "NAME" in each '
                "of [[sessions]]"
            )
        try:
            plan = Plan.from_table(table, f"{self.path}, session {id}")
        except PlanError as error:
            raise StudyError(str(error)) from None
        refuse(
            StudyError,
            (
                plan.animal.count != len(one.names),
                f"{self.path}, session {id}: animal.count is {plan.animal.count}, and the session "
                f"names {len(one.names)}; list the animals of the arena, the largest first, as in "
                'animals = ["m01", "m02"]',
            ),
            (
                plan.animal.rfid is not None,
                f"{self.path}, session {id}: animal.rfid names the animals itself, so measure this "
                "recording with `liex run`; `liex compare` takes its sessions, too",
            ),
        )
        return plan


def merged(table: Settings, settings: Settings) -> Settings:
    """Merge nested settings.

    Args:
        table: nested settings; not changed.
        settings: settings that override them.
    """
    out = dict(table)
    for key, value in settings.items():
        below = out.get(key)
        nested = isinstance(below, dict) and isinstance(value, dict)
        out[key] = merged(below or {}, value) if nested else value
    return out


_MODELS: dict[str, type[SettingsTable]] = {
    "animals": StudyAnimal,
    "arenas": StudyArena,
    "sessions": StudySession,
}


def _sentence(error: ValidationError) -> str:
    """The first validation error as one sentence with advice."""
    first, *others = error.errors(include_url=False)
    more = f" (and {len(others)} more)" if others else ""
    parts = [f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in first["loc"]]
    where = "".join(parts).lstrip(".")
    key = str(first["loc"][-1]) if first["loc"] else ""
    if first["type"] == "extra_forbidden":
        model = _MODELS.get(str(first["loc"][0]), StudyTable)
        hint = did_you_mean(key, model.model_fields, ", did you mean {}")
        return f"{where} is not known here{hint}; correct or remove it{more}"
    if first["type"] == "value_error":
        return first["msg"].removeprefix("Value error, ") + more
    pattern = _PATTERNS.get(key) if first["type"] == "string_pattern_mismatch" else None
    expected = re.sub("(Input|String) should", "should", first["msg"])
    text = ascii(first["input"])
    got = text if len(text) <= 80 else text[:77] + "..."
    return f"{where} {pattern or expected}, got {got}; correct it{more}"


# Find the animal of a recording from its metadata, folders and file name.


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
            without either, folders named like an animal's tag, such as m01.
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
    """Names of the folders above a recording, up to one named like an animal's tag."""
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
