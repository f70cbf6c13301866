"""A plan: everything a run depends on, in one small TOML file. Equal plans give equal results."""

from __future__ import annotations

import difflib
import json
import textwrap
import tomllib
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from liex_lab.errors import PlanError

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]

_HERE = Path(__file__).resolve().parent
_NOT_PLANS = {"slurm"}  # it says where sessions are measured, not how
_HEADER = """\
# A plan of liex_lab: everything a run depends on. Copy this file, change the copy, and name it:
#     liex run RECORDING --plan my-plan.toml
# or change one value for one run:  --set animal.spine_mm=65
# A line that is left out has its default value; a line in the form '# name =' is not set.
# Lengths are millimetres, times seconds, angles radians.
"""


class _Table(BaseModel):
    """A table of settings: no unknown key, no value of another type, never changed after it was made."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Animal(_Table):
    """[animal]: what is in front of the camera."""

    name: str = Field("mouse", description="the animal's kind, as it is called in tables and reports")
    skeleton: str = Field(
        "mouse", description="the skeleton: fish, mouse, hand, or the path of a TOML file of your own"
    )
    spine_mm: Positive | None = Field(
        None, description="length of this animal's skeleton from its first joint to its last; not set: it is measured"
    )
    spine_min_mm: Positive = Field(40.0, description="an animal is not shorter than this, where its size is measured")
    spine_max_mm: Positive = Field(115.0, description="an animal is not longer than this, where its size is measured")

    @model_validator(mode="after")
    def _in_order(self) -> Animal:
        if not self.spine_min_mm < self.spine_max_mm:
            raise ValueError(f"spine_min_mm={self.spine_min_mm} should be below spine_max_mm={self.spine_max_mm}")
        return self


class CameraOverride(_Table):
    """[camera]: intrinsics that overrule what the recording states or what is typical of the camera."""

    fx: Positive | None = Field(None, description="focal length along a row, pixels; not set: what the recording says")
    fy: Positive | None = Field(None, description="focal length along a column, pixels")
    cx: float | None = Field(
        None, description="column of the optical axis, pixels; 0 is the centre of the first column"
    )
    cy: float | None = Field(None, description="row of the optical axis, pixels; 0 is the centre of the first row")
    distortion: list[float] | None = Field(
        None,
        description="coefficients of the lens distortion, in OpenCV's order: [k1, k2, p1, p2, k3, k4, k5, k6], all but "
        "the first may be left out; [] says that there is none; not set: what the recording says",
    )
    distortion_model: str | None = Field(
        None, description="plumb_bob (not set), rational_polynomial, or equidistant for a fisheye lens [k1, k2, k3, k4]"
    )
    source: str | None = Field(None, description="where these numbers come from; it is written into session.json")


class WaterSurface(_Table):
    """[water]: a flat water surface between the camera and the animal; not needed for a camera behind glass in air."""

    height_mm: Positive | None = Field(
        None, description="height of the lens above the water; set, it makes millimetres under water true"
    )
    refractive_index: float = Field(
        1.333, ge=1, le=2, description="of the water: 1.333 fresh at 20 degrees C in visible light, 1.34 sea water"
    )
    tilt_x_rad: float = Field(
        0.0, ge=-1, le=1, description="angle by which the surface recedes from the camera towards the picture's right"
    )
    tilt_y_rad: float = Field(
        0.0, ge=-1, le=1, description="angle by which the surface recedes from the camera towards the picture's bottom"
    )
    ranging: Literal["light_field", "structured_light", "time_of_flight", "paraxial"] = Field(
        "light_field",
        description="how the camera measures: light_field (Raytrix), structured_light (PrimeSense, RealSense; stereo "
        "along the picture's rows), time_of_flight (Kinect v2, Azure), or paraxial: depth / n at every angle",
    )


class ArenaFacts(_Table):
    """[arena]: where in the arena the animal is."""

    zones: str | None = Field(
        None, description="path of a TOML file with named zones, circles and polygons; see the README"
    )


class RecordingOptions(_Table):
    """[recording]: how the file is read."""

    fps: Positive | None = Field(
        None, description="frames per second, only for recordings that carry no time stamps of their own"
    )
    topic: str | None = Field(None, description="the MCAP topic that holds the depth, where there are several")
    accept_truncated: bool = Field(
        False, description="true: use the whole frames of a recording that ends in the middle of one"
    )
    mirrored: bool = Field(
        False, description="true: exchange left and right, for pictures that come mirrored, or to measure a left hand"
    )


class Foreground(_Table):
    """[foreground]: what belongs to the animal and what to the scene."""

    min_height_mm: Positive = Field(
        7.0, description="a pixel of the animal stands out from the background by this much"
    )
    n_background_frames: int = Field(
        96, ge=3, description="frames, spread over the recording, that show the background"
    )
    near_mm: Positive = Field(250.0, description="a hand is not nearer to the camera than this")
    far_mm: Positive = Field(1600.0, description="a hand is not farther from the camera than this")

    @model_validator(mode="after")
    def _in_order(self) -> Foreground:
        if not self.near_mm < self.far_mm:
            raise ValueError(f"near_mm={self.near_mm} should be below far_mm={self.far_mm}")
        return self


class Estimation(_Table):
    """[estimation]: one pose per frame."""

    model: str = Field("mouse", description="a bundled model, or the path of an .npz made by `liex train`")
    n_candidates: int | None = Field(
        None, ge=1, description="poses a frame starts from; not set: as many as the model was made for"
    )
    doubtful_above_mm: Positive | None = Field(
        None, description="frames with a larger predicted error are flagged doubtful; not set: the model's own limit"
    )


class Tracking(_Table):
    """[tracking]: from the frames' poses to a curve."""

    bridge_s: NotNegative = Field(
        0.5,
        description="a stretch without a measurement that is no longer than this is bridged and flagged so, and of a "
        "longer one half as much at either end",
    )


class SessionFacts(_Table):
    """[session]: facts about the animal and the day, copied into every table."""

    name: str | None = Field(
        None,
        pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+@-]{0,199}$",
        description="the session's id in every table, and the name of its folder; not set: the recording's name",
    )
    individual: str = Field("animal", description="name of the animal within this session")
    subject_id: str | None = Field(None, description="the animal's identity across the whole study")
    group: str | None = Field(None, description="experimental group of the animal")
    cage: str | None = Field(None, description="home cage or tank of the animal")
    sex: str | None = Field(None, description="sex of the animal")
    batch: str | None = Field(None, description="batch of the experiment")
    session_start_time: str | None = Field(
        None, description="ISO 8601 with time zone, as 2026-08-21T10:00:00+02:00; not set: what the recording says"
    )

    @field_validator("session_start_time", mode="before")
    @classmethod
    def _zoned(cls, value: Any) -> Any:
        if value is None:
            return None
        try:
            moment = value if isinstance(value, datetime) else datetime.fromisoformat(value)
        except (TypeError, ValueError):
            moment = None
        if moment is None or moment.tzinfo is None:
            raise ValueError("should be ISO 8601 with a time zone, as 2026-08-21T10:00:00+02:00")
        return moment.isoformat()


class Behaviour(_Table):
    """[behaviour]: where one behaviour ends and the next begins. Starting values: check them on your own animals."""

    speed_half_window_s: Positive = Field(
        0.034, description="speed at time t is measured from t - this to t + this (one frame each side at 30 fps)"
    )
    pause_below_mm_s: Positive = Field(50.0, description="slower than this is a pause, faster is walking")
    run_above_mm_s: Positive = Field(300.0, description="faster than this is running")
    impossible_above_mm_s: Positive = Field(3000.0, description="faster than this is an error of measurement")
    rear_height_mm: Positive = Field(
        40.0, description="rearing begins when the nose is this much higher than the tail's base ..."
    )
    rear_height_bl: Positive = Field(
        0.6, description="... or, for a smaller animal, by this many of its own body lengths"
    )
    rear_leave: Positive = Field(
        2.0 / 3.0, le=1, description="rearing reaches to where the nose is below this share of that height"
    )
    speed_hysteresis: NotNegative = Field(
        0.1, lt=1, description="a speed is crossed upwards this share above it, downwards this share below"
    )
    merge_pauses_s: NotNegative = Field(0.33, description="shorter interruptions of a bout are bridged")
    min_bout_s: NotNegative = Field(0.23, description="shorter bouts are dropped, after bridging")

    @model_validator(mode="after")
    def _in_order(self) -> Behaviour:
        if not self.pause_below_mm_s < self.run_above_mm_s:
            raise ValueError(
                f"pause_below_mm_s={self.pause_below_mm_s} should be below run_above_mm_s={self.run_above_mm_s}"
            )
        return self


class Replay(_Table):
    """[replay]: what the Rerun replay, session.rrd, holds."""

    depth: bool = Field(True, description="the depth pictures; without them it takes a hundredth of the room")
    candidates: bool = Field(False, description="every pose that single frames thought possible, too")


class Actions(_Table):
    """[actions]: who names what the animal does."""

    model: str | None = Field(
        None,
        description="an action model by the animal's name, or the path of a .skops made by `liex train actions`; not "
        "set: the animal's bundled one, where there is one; 'rules': the thresholds of [behaviour]",
    )


class Plan(_Table):
    """Everything a run depends on. Units are in the names; None is 'not set'."""

    seed: int = Field(0, ge=0, description="all randomness of a run comes from this number")
    animal: Animal = Animal()
    camera: CameraOverride = CameraOverride()
    recording: RecordingOptions = RecordingOptions()
    water: WaterSurface = WaterSurface()
    arena: ArenaFacts = ArenaFacts()
    foreground: Foreground = Foreground()
    estimation: Estimation = Estimation()
    tracking: Tracking = Tracking()
    session: SessionFacts = SessionFacts()
    actions: Actions = Actions()
    behaviour: Behaviour = Behaviour()
    replay: Replay = Replay()

    @staticmethod
    def load(plan: str | Path) -> Plan:
        """The bundled plan of this name ('mouse'), or the plan in a TOML file."""
        path = plans_folder() / f"{plan}.toml"
        if not path.is_file():
            path = Path(plan)
        if not path.is_file():
            known = known_plans()
            near = difflib.get_close_matches(str(plan), known, 1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            raise PlanError(
                f"there is no plan '{plan}': {hint}bundled are: {', '.join(known) or 'none'}, or give the path of a "
                ".toml file"
            )
        return Plan.from_toml(_read(path), origin=str(path))

    @staticmethod
    def from_toml(text: str, origin: str = "the plan") -> Plan:
        """The plan in a TOML text; `origin` names the file in errors."""
        try:
            table = tomllib.loads(text)
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise PlanError(
                f"{origin} should be a TOML file, but: {error}; compare it with `liex info --plan`"
            ) from None
        return Plan.from_table(table, origin)

    @staticmethod
    def from_table(table: dict[str, Any], origin: str = "the plan") -> Plan:
        """The plan in a nested dict, as TOML or JSON gives it; missing settings have their defaults."""
        try:
            return Plan.model_validate(table)
        except ValidationError as error:
            raise PlanError(f"{origin}: {_sentence(error)}") from None

    def with_settings(self, settings: Iterable[str]) -> Plan:
        """This plan with settings like 'animal.spine_mm=65' put in; 'animal.spine_mm=' brings the default back."""
        chosen = list(settings)
        table = self.model_dump(exclude_none=True)
        for setting in chosen:
            dotted, equals, text = (part.strip() for part in setting.partition("="))
            if not equals or not dotted:
                raise PlanError(f"--set takes key=value, as in --set animal.spine_mm=65, got '{setting}'")
            *sections, key = dotted.split(".")
            inner = table
            for section in sections:
                inner = inner.setdefault(section, {})
                if not isinstance(inner, dict):
                    raise PlanError(f"--set {setting}: {_unknown(dotted)}")
            inner.pop(key, None)
            if text or dotted not in _settings():
                inner[key] = _value(dotted, text)
        return Plan.from_table(table, " ".join(f"--set {setting}" for setting in chosen)) if chosen else self

    def to_toml(self) -> str:
        """The plan as TOML with a comment for every setting; loading it gives an equal plan."""
        lines = [_HEADER]
        for name, field in Plan.model_fields.items():
            value = getattr(self, name)
            if not isinstance(value, _Table):
                lines += [*_entry(name, value, field.description), ""]
                continue
            lines += [*_comment(type(value).__doc__ or ""), f"[{name}]"]
            for key, inner in type(value).model_fields.items():
                lines += _entry(key, getattr(value, key), inner.description)
            lines.append("")
        return "\n".join(lines).rstrip() + "\n"


def plans_folder() -> Path:
    """The folder of bundled plans: inside the package once installed, beside it in a clone."""
    installed = _HERE / "pipelines" / "plans"
    return installed if installed.is_dir() else _HERE.parent / "pipelines" / "plans"


def known_plans() -> list[str]:
    """The names of the bundled plans."""
    return sorted(path.stem for path in plans_folder().glob("*.toml") if path.stem not in _NOT_PLANS)


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise PlanError(f"the plan {path} should be a TOML text in UTF-8, but it is not a text file") from None


def _settings() -> dict[str, Any]:
    """Every setting, dotted, with the type it takes."""
    found: dict[str, Any] = {}
    for name, field in Plan.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, _Table):
            inner = field.annotation.model_fields
            found |= {f"{name}.{key}": inner[key].annotation for key in inner}
        else:
            found[name] = field.annotation
    return found


def _value(dotted: str, text: str) -> Any:
    """The value that a person typed after --set: as TOML, or as the plain word it is."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return text
    annotation = _settings().get(dotted)
    takes_text = str in (get_args(annotation) or (annotation,))
    return text if takes_text and not isinstance(value, str) else value  # subject_id=0123 is a name, not a number


def _unknown(dotted: str) -> str:
    """What to say about a setting that does not exist: the nearest one that does."""
    known = list(_settings())
    section, _, key = dotted.rpartition(".")
    tables = sorted({name.partition(".")[0] for name in known if "." in name})
    elsewhere = [name for name in known if name.rpartition(".")[2] == key]
    beside = [name for name in known if section and name.startswith(f"{section}.")]
    if not section and not elsewhere and difflib.get_close_matches(key, tables, 1, cutoff=0.7):
        return f"[{key}] is not a section of a plan; the nearest one is [{_nearest(key, tables)}]"
    near = elsewhere[0] if elsewhere else _nearest(dotted, beside or known)
    return f"{dotted} is not a setting of a plan; the nearest one is {near}"


def _nearest(word: str, known: list[str]) -> str:
    return difflib.get_close_matches(word, known, 1, cutoff=0.0)[0]


def _sentence(error: ValidationError) -> str:
    """The first complaint, as one sentence that says what to do."""
    first, *others = error.errors(include_url=False)
    dotted = ".".join(str(part) for part in first["loc"])
    more = f" (and {len(others)} more)" if others else ""
    if first["type"] == "extra_forbidden":
        return _unknown(dotted) + more
    if first["type"] in {"model_type", "model_attributes_type"}:
        return f"[{dotted}] is a section with settings below it, got {first['input']!r}{more}"
    if first["type"] == "value_error" and dotted not in _settings():
        return f"[{dotted}]: {first['msg'].removeprefix('Value error, ')}{more}"
    expected = first["msg"].removeprefix("Value error, ").replace("Input should", "should")
    got = first["input"].isoformat() if isinstance(first["input"], datetime) else repr(first["input"])
    return f"{dotted} {expected}, got {got}; correct it in the plan or with --set {dotted}=...{more}"


def _entry(name: str, value: Any, description: str | None) -> list[str]:
    text = "# " + name + " =" if value is None else f"{name} = {_literal(value)}"
    return [*_comment(description or ""), text]


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, 116, initial_indent="# ", subsequent_indent="# ")


def _literal(value: bool | int | float | str | list[float]) -> str:
    """A value as TOML writes it. JSON's string escapes are TOML's, but for DEL."""
    if isinstance(value, list):
        return f"[{', '.join(_literal(item) for item in value)}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
