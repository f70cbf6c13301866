"""Plan file: all settings of a run in one small TOML file, validated by pydantic.

Equal plans give equal results. Missing settings have default values. `Plan.to_toml` writes the file
with a comment for every setting; the comment over a section is the docstring of its class in
`liex_lab.plan.sections`, the one over a setting its description there.
"""

from __future__ import annotations

import difflib
import json
import textwrap
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import Field, ValidationError, model_validator

from liex_lab.errors import PlanError, did_you_mean, expecting
from liex_lab.plan.sections import (
    Actions,
    AnimalSettings,
    ArenaFacts,
    BehaviourThresholds,
    CameraOverride,
    Estimation,
    Foreground,
    InteractionThresholds,
    LightSettings,
    RecordingOptions,
    Replay,
    Report,
    SessionFacts,
    SettingsTable,
    SeveralArenas,
    Tracking,
    WaterSurface,
    first_twice,
)
from liex_lab.runtime.text_files import parse_toml, read_text

_HERE = Path(__file__).resolve().parents[1]
_HEADER = """\
# A plan of liex_lab: all settings of a run. Copy this file, edit the copy, and use it with:
#     liex run RECORDING --plan my-plan.toml
# or change one value for one run:  --set animal.spine_mm=65
# A missing line has its default value; a line such as '# name =' is not set.
# Lengths are millimetres, times seconds, angles radians.
"""


class Plan(SettingsTable):
    """All settings of a run.

    Units are part of the names of the settings; None means not set. Plans are immutable.

    Attributes:
        seed: seed of all random numbers of a run.
        arenas: several arenas in one image; None is one.
        animal: the animal and its skeleton.
        camera: intrinsics that override those of the recording.
        recording: how the file is read.
        water: a flat water surface between camera and animal.
        arena: the arena's floor, region and zones.
        foreground: segmentation of the animal from the scene.
        estimation: one pose per frame.
        tracking: from the poses of frames to a trajectory.
        session: metadata of the animal and the session.
        actions: the action recogniser.
        behaviour: thresholds between behaviours.
        light: the light of the animal's room, and sleep by immobility.
        interactions: thresholds of interactions between animals.
        replay: contents of the replays.
        report: files written with the report.
    """

    seed: int = Field(0, ge=0, description="seed of all random numbers of a run")
    arenas: list[SeveralArenas] | Literal["auto"] | None = Field(
        None,
        description=(
            "several arenas in one image, each a session of its own: a table [[arenas]] with name "
            "and region for each, and subject_id, group, ... of its animal; 'auto' proposes them, "
            "as liex doctor prints them; not set: one arena"
        ),
    )
    animal: AnimalSettings = AnimalSettings()
    camera: CameraOverride = CameraOverride()
    recording: RecordingOptions = RecordingOptions()
    water: WaterSurface = WaterSurface()
    arena: ArenaFacts = ArenaFacts()
    foreground: Foreground = Foreground()
    estimation: Estimation = Estimation()
    tracking: Tracking = Tracking()
    session: SessionFacts = SessionFacts()
    actions: Actions = Actions()
    behaviour: BehaviourThresholds = BehaviourThresholds()
    light: LightSettings = LightSettings()
    interactions: InteractionThresholds = InteractionThresholds()
    replay: Replay = Replay()
    report: Report = Report()

    @model_validator(mode="after")
    def _apart(self) -> Plan:
        if self.arenas is not None and self.arena.region is not None:
            raise ValueError(
                "arena.region is for one arena and [[arenas]] for several; leave one of them out"
            )
        if isinstance(self.arenas, list):
            n = len(self.arenas)
            if not 1 <= n <= 8:
                raise ValueError(f"[[arenas]] lists 1 to 8 arenas, got {n}")
            if twice := first_twice(one.name for one in self.arenas):
                raise ValueError(f"two [[arenas]] are called {twice}; give each a name of its own")
        return self

    def __repr__(self) -> str:
        parts: list[str] = []
        for name, changed in self.model_dump(exclude_defaults=True).items():
            value = getattr(self, name)
            if isinstance(value, SettingsTable):
                keys = [key for key in changed if (name, key) != ("animal", "name")]
                parts += [f"{name}.{key}={getattr(value, key)!r}" for key in keys]
            else:
                parts.append(f"{name}={value if isinstance(value, int | str) else len(value)}")
        others = f"; changed settings: {', '.join(parts)}" if parts else ", default settings"
        return f"<Plan for the {self.animal.name}{others}>"

    @staticmethod
    def load(plan: str | Path) -> Plan:
        """Load a bundled plan by name, or a TOML file.

        Args:
            plan: a bundled name, such as 'mouse', or the path of a .toml file.

        Raises:
            PlanError: there is no such plan, or it is invalid.
        """
        path = plans_folder() / f"{plan}.toml"
        if not path.is_file():
            path = Path(plan)
        if not path.is_file():
            known = known_plans()
            raise PlanError(
                f"there is no plan '{plan}': {did_you_mean(plan, known)}bundled are: "
                f"{', '.join(known) or 'none'}, or give the path of a .toml file"
            )
        with expecting(PlanError, f"the plan {path} should be a TOML file", ValueError):
            text = read_text(path)
        return Plan.from_toml(text, origin=str(path))

    @staticmethod
    def from_toml(text: str, origin: str = "the plan") -> Plan:
        """Parse a plan from TOML text.

        Args:
            text: the TOML text.
            origin: the file's name for error messages.

        Raises:
            PlanError: the text is not TOML, or a setting is invalid.
        """
        with expecting(
            PlanError,
            f"{origin} should be a TOML file",
            ValueError,
            advice="compare it with `liex info --plan`",
        ):
            table = parse_toml(text)
        return Plan.from_table(table, origin)

    @staticmethod
    def from_table(table: dict[str, Any], origin: str = "the plan") -> Plan:
        """Validate a plan from a nested dict, as parsed from TOML or JSON.

        Args:
            table: sections by name; missing settings have defaults.
            origin: the file's name for error messages.

        Raises:
            PlanError: a setting is unknown or its value is invalid.
        """
        try:
            return Plan.model_validate(table)
        except ValidationError as error:
            raise PlanError(f"{origin}: {_sentence(error)}") from None

    def with_settings(self, settings: Iterable[str]) -> Plan:
        """This plan with some settings changed, as by --set on the command line.

        Args:
            settings: texts like 'animal.spine_mm=65'; 'animal.spine_mm=' restores the default.

        Raises:
            PlanError: a setting is unknown or its value is invalid.
        """
        chosen = list(settings)
        table = self.model_dump(exclude_none=True)
        for setting in chosen:
            dotted, equals, text = (part.strip() for part in setting.partition("="))
            if not equals or not dotted:
                raise PlanError(
                    f"--set takes key=value, as in --set animal.spine_mm=65, got '{setting}'"
                )
            *sections, key = dotted.split(".")
            inner = table
            for section in sections:
                inner = inner.setdefault(section, {})
                if not isinstance(inner, dict):
                    raise PlanError(f"--set {setting}: {_unknown(dotted)}")
            inner.pop(key, None)
            if text or dotted not in _settings():
                inner[key] = _value(dotted, text)
        given = " ".join(f"--set {setting}" for setting in chosen)
        return Plan.from_table(table, given) if chosen else self

    def to_toml(self) -> str:
        """The plan as TOML with a comment for every setting; loading it gives an equal plan."""
        lines = [_HEADER]
        for name, field in Plan.model_fields.items():
            value = getattr(self, name)
            if not isinstance(value, SettingsTable):
                single = None if isinstance(value, list) else value  # [[tables]] come last
                lines += [*_entry(name, single, field.description), ""]
                continue
            lines += [*_comment(" ".join((type(value).__doc__ or "").split())), f"[{name}]"]
            for key, inner in type(value).model_fields.items():
                lines += _entry(key, getattr(value, key), inner.description)
            lines.append("")
        if isinstance(self.arenas, list):
            lines += [line for arena in self.arenas for line in [*arena_lines(arena), ""]]
        return "\n".join(lines).rstrip() + "\n"


def arena_lines(arena: SeveralArenas) -> list[str]:
    """The lines of one `[[arenas]]` table in a plan."""
    stated = arena.model_dump(exclude_none=True)
    return ["[[arenas]]", *(f"{key} = {toml_value(value)}" for key, value in stated.items())]


def plans_folder() -> Path:
    """Folder of the bundled plans: in the package if installed, next to it in a clone."""
    installed = _HERE / "pipelines" / "plans"
    return installed if installed.is_dir() else _HERE.parent / "pipelines" / "plans"


def known_plans() -> list[str]:
    """Names of the bundled plans, in alphabetical order."""
    # slurm.toml configures where sessions are measured, not how
    return sorted(path.stem for path in plans_folder().glob("*.toml") if path.stem != "slurm")


def _settings() -> dict[str, Any]:
    """Type of every setting, by dotted name."""
    found: dict[str, Any] = {}
    for name, field in Plan.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, SettingsTable):
            inner = field.annotation.model_fields
            found |= {f"{name}.{key}": inner[key].annotation for key in inner}
        else:
            found[name] = field.annotation
    return found


def _value(dotted: str, text: str) -> Any:
    """Value of a setting typed after --set: parsed as TOML, or the plain word."""
    try:
        value = parse_toml(f"value = {text}")["value"]
    except ValueError:
        return text
    annotation = _settings().get(dotted)
    takes_text = str in (get_args(annotation) or (annotation,))
    # subject_id=0123 is a name, not a number
    return text if takes_text and not isinstance(value, str) else value


def _unknown(dotted: str) -> str:
    """Error message for an unknown setting, with the nearest existing one."""
    known = list(_settings())
    section, _, key = dotted.rpartition(".")
    tables = sorted({name.partition(".")[0] for name in known if "." in name})
    elsewhere = [name for name in known if name.rpartition(".")[2] == key]
    beside = [name for name in known if section and name.startswith(f"{section}.")]
    sections = difflib.get_close_matches(key, tables, 1, cutoff=0.7)
    if not section and not elsewhere and sections:
        return f"[{key}] is not a section of a plan; the nearest one is [{sections[0]}]"
    near = elsewhere or difflib.get_close_matches(dotted, beside or known, 1, cutoff=0.0)
    return f"{dotted} is not a setting of a plan; the nearest one is {near[0]}"


def _sentence(error: ValidationError) -> str:
    """The first validation error as one sentence with advice."""
    first, *others = error.errors(include_url=False)
    # pydantic adds the names of alternative types, which do not occur in a plan
    words = [str(part) for part in first["loc"] if "[" not in str(part)]
    dotted = ".".join(word for word in words if word not in {"Region", "StatedFloor"})
    more = f" (and {len(others)} more)" if others else ""
    if first["type"] == "extra_forbidden":
        return _unknown(dotted) + more
    if first["type"] in {"model_type", "model_attributes_type"}:
        return f"[{dotted}] is a section with settings below it, got {first['input']!r}{more}"
    if first["type"] == "value_error" and dotted not in _settings():
        where = f"[{dotted}]: " if dotted else ""
        return f"{where}{first['msg'].removeprefix('Value error, ')}{more}"
    expected = first["msg"].removeprefix("Value error, ").replace("Input should", "should")
    value = first["input"]
    got = value.isoformat() if isinstance(value, datetime) else repr(value)
    return (
        f"{dotted} {expected}, got {got}; correct it in the plan or with --set {dotted}=...{more}"
    )


def _entry(name: str, value: Any, description: str | None) -> list[str]:
    text = "# " + name + " =" if value is None else f"{name} = {toml_value(value)}"
    return [*_comment(description or ""), text]


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, 116, initial_indent="# ", subsequent_indent="# ")


def toml_value(value: Any) -> str:
    """Format a value as TOML. JSON's string escapes are valid TOML except for DEL.

    Args:
        value: a setting's table, list, text, number or bool.
    """
    if isinstance(value, SettingsTable):
        return toml_value(value.model_dump(exclude_none=True))
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {toml_value(item)}' for key, item in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(toml_value(item) for item in value)}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
