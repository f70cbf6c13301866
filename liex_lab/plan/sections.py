"""Sections of a plan as pydantic models: each setting with its unit, limits and default.

The docstring of a section's class is the comment over that section in a plan file, and each field's
description the comment over that setting (`Plan.to_toml`): a change of either changes the files
that are written.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

Positive = Annotated[float, Field(gt=0)]
Factor = Annotated[float, Field(gt=1e-3, lt=1e3)]
N_PLACES = 5  # along the body, of liex_lab.estimation.session_shape
# names of liex_lab.optics.camera, repeated here because a plan is read before libraries are
# imported
CameraName = Literal["kinect-v2", "primesense", "azure-nfov", "femto-bolt", "d435", "raytrix-r5"]
NotNegative = Annotated[float, Field(ge=0)]
_SPECIES = "Latin name of its species, as Rattus norvegicus; not set: that of the animal's kind"
_AGE = "age of the animal on that day, as 12 weeks, or as P12W (ISO 8601)"
_TAXON = "http://purl.obolibrary.org/obo/NCBITaxon_"
_LATIN = re.compile(rf"[A-Z][a-z]+ [a-z]+|{re.escape(_TAXON)}\d+")
_AGED = re.compile(r"(\d+(?:\.\d+)?) *(day|week|month|year)s?", re.IGNORECASE)
_DURATION = re.compile(r"P(?=\d)(\d+Y)?(\d+M)?(\d+W)?(\d+D)?|P\d+\.\d+[YMWD]")


def known_species(species: str | None) -> str | None:
    """Check a species name.

    Args:
        species: Latin name or entry in NCBI's taxonomy; None is that of the animal's kind.

    Raises:
        ValueError: it is neither.
    """
    if species is None or _LATIN.fullmatch(species):
        return species
    raise ValueError(f"should be a Latin name such as Rattus norvegicus, or {_TAXON}10116")


def whole_age(age: str | None) -> str | None:
    """An age as an ISO 8601 duration.

    Args:
        age: text such as 12 weeks, or an ISO 8601 duration (P12W); None if unknown.

    Raises:
        ValueError: it is neither.
    """
    if age is None:
        return None
    if said := _AGED.fullmatch(age.strip()):
        return f"P{said[1]}{said[2][0].upper()}"
    if _DURATION.fullmatch(age.strip()):
        return age.strip()
    raise ValueError("should be an age such as 12 weeks or 84 days, or ISO 8601, as P12W")


def first_twice(names: Iterable[str]) -> str:
    """The first name that occurs again, or ''; case is ignored, as on some file systems."""
    listed = list(names)
    counts = Counter(name.lower() for name in listed)
    return next((name for name in listed if counts[name.lower()] > 1), "")


class Table(BaseModel):
    """Base of the tables of settings.

    Tables are immutable and reject unknown keys, values of another type, infinity and NaN.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class SharedShape(Table):
    """Widths and heights of an animal and offsets of its joints, as in session.json."""

    width: list[Factor] = Field(
        min_length=N_PLACES,
        max_length=N_PLACES,
        description="half widths over the average animal's of that length, at five places",
    )
    height: list[Factor] = Field(
        min_length=N_PLACES, max_length=N_PLACES, description="half heights likewise"
    )
    joints_moved: list[Annotated[list[float], Field(min_length=3, max_length=3)]] = Field(
        description="what is added to each joint in the frame of the body's base, over the length"
    )


class SharedBody(Table):
    """Size and shape estimated from all sessions of one animal."""

    subject: str = Field(min_length=1, max_length=500, description="the animal")
    n_sessions: int = Field(ge=2, description="how many sessions found it")
    spine_mm: Positive | None = Field(
        None, description="its length; not set: every session states or measures its own"
    )
    girth: Factor | None = Field(
        None, description="of the average body of that length; not set: every session finds its own"
    )
    shape: SharedShape | None = Field(
        None, description="its shape; not set: the average animal's is used"
    )

    def __repr__(self) -> str:
        length = "" if self.spine_mm is None else f": {self.spine_mm:g} mm long"
        return f"<SharedBody of {self.by}{length}>"

    @property
    def by(self) -> str:
        """The sessions that share it, as text."""
        return f"{self.n_sessions} sessions of {self.subject}"


class Animal(Table):
    """[animal]: what is in front of the camera."""

    name: str = Field(
        "mouse", description="the animal's kind, as it is called in tables and reports"
    )
    skeleton: str = Field(
        "mouse",
        description="the skeleton: fish, mouse, hand, or the path of a TOML file of your own",
    )
    spine_mm: Positive | None = Field(
        None,
        description=(
            "length of this animal's skeleton from its first joint to its last; not set: it is "
            "measured"
        ),
    )
    spine_min_mm: Positive = Field(
        40.0, description="an animal is not shorter than this, where its size is measured"
    )
    spine_max_mm: Positive = Field(
        115.0, description="an animal is not longer than this, where its size is measured"
    )
    shared: SharedBody | None = Field(
        None,
        description=(
            "size and shape that the sessions of this animal agree on; a study with shared = "
            "'subject' puts them in; not set: the session's own"
        ),
    )

    @model_validator(mode="after")
    def _in_order(self) -> Animal:
        if not self.spine_min_mm < self.spine_max_mm:
            raise ValueError(
                f"spine_min_mm={self.spine_min_mm} should be below spine_max_mm={self.spine_max_mm}"
            )
        return self


class CameraOverride(Table):
    """[camera]: intrinsics that overrule what the recording states or what is typical of the
    camera.
    """

    preset: CameraName | None = Field(
        None,
        description=(
            "a camera by name, for recordings that do not say what took them: its nominal numbers, "
            "which its own calibration betters by one or two per cent"
        ),
    )
    fx: Positive | None = Field(
        None, description="focal length along a row, pixels; not set: what the recording says"
    )
    fy: Positive | None = Field(None, description="focal length along a column, pixels")
    cx: float | None = Field(
        None, description="column of the optical axis, pixels; 0 is the centre of the first column"
    )
    cy: float | None = Field(
        None, description="row of the optical axis, pixels; 0 is the centre of the first row"
    )
    distortion: list[float] | None = Field(
        None,
        description=(
            "coefficients of the lens distortion, in OpenCV's order: [k1, k2, p1, p2, k3, k4, "
            "k5, k6], all but the first may be left out; [] says that there is none; not set: "
            "what the recording says"
        ),
    )
    distortion_model: str | None = Field(
        None,
        description=(
            "plumb_bob (not set), rational_polynomial, or equidistant for a fisheye lens [k1, "
            "k2, k3, k4]"
        ),
    )
    source: str | None = Field(
        None, description="where these numbers come from; it is written into session.json"
    )


class WaterSurface(Table):
    """[water]: a flat water surface between the camera and the animal; not needed for a camera
    behind glass in air.
    """

    height_mm: Positive | None = Field(
        None,
        description=(
            "height of the lens above the water; set, it makes millimetres under water true"
        ),
    )
    refractive_index: float = Field(
        1.333,
        ge=1,
        le=2,
        description="of the water: 1.333 fresh at 20 degrees C in visible light, 1.34 sea water",
    )
    tilt_x_rad: float = Field(
        0.0,
        ge=-1,
        le=1,
        description=(
            "angle by which the surface recedes from the camera towards the picture's right"
        ),
    )
    tilt_y_rad: float = Field(
        0.0,
        ge=-1,
        le=1,
        description=(
            "angle by which the surface recedes from the camera towards the picture's bottom"
        ),
    )
    ranging: Literal["light_field", "structured_light", "time_of_flight", "paraxial"] = Field(
        "light_field",
        description=(
            "how the camera measures: light_field (Raytrix), structured_light (PrimeSense, "
            "RealSense; stereo along the picture's rows), time_of_flight (Kinect v2, Azure), or "
            "paraxial: depth / n at every angle"
        ),
    )


class StatedFloor(Table):
    """A user-defined floor: a point of the plane and its normal, camera frame."""

    point: Annotated[list[float], Field(min_length=3, max_length=3)]
    normal: Annotated[list[float], Field(min_length=3, max_length=3)]


Corner = Annotated[list[float], Field(min_length=2, max_length=2)]


class Circle(Table):
    """A circle: its centre [x, y] and its radius."""

    centre: Corner
    radius: Positive


class Region(Table):
    """An arena's region in the image: a polygon, a rectangle or a circle, in px or in mm.

    Millimetres are on the floor, in the arena frame: origin below the camera, x along image rows, y
    towards the top of the image. A bare list of corners is a polygon in pixels.
    """

    polygon: list[Corner] | None = None
    rectangle: Annotated[list[Corner], Field(min_length=2, max_length=2)] | None = None
    circle: Circle | None = None
    unit: Literal["px", "mm"] = "px"

    @model_validator(mode="before")
    @classmethod
    def _of_corners(cls, value: Any) -> Any:
        return {"polygon": value} if isinstance(value, list) else value

    @model_validator(mode="after")
    def _one_shape(self) -> Region:
        shapes = (self.polygon, self.rectangle, self.circle)
        if sum(shape is not None for shape in shapes) != 1:
            raise ValueError(
                "a region is one of polygon = [[x, y], [x, y], [x, y], ...], rectangle = [[x, y], "
                "[x, y]] (two opposite corners) and circle = {centre = [x, y], radius = r}"
            )
        return self


ArenaName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]


class SeveralArenas(Table):
    """[[arenas]]: one of several arenas in the picture, which becomes a session of its own."""

    name: ArenaName = Field(description="of the arena; its session is called NAME-ARENA")
    region: Region = Field(
        description="where it is, as arena.region says it; what lies outside is cut out"
    )
    spine_mm: Positive | None = Field(None, description="of its animal; not set: it is measured")
    zones: str | None = Field(None, description="path of the TOML file with its zones")
    individual: str | None = Field(None, description="name of its animal within the session")
    subject_id: str | None = Field(None, description="its animal's identity across the study")
    group: str | None = Field(None, description="experimental group of its animal")
    cage: str | None = Field(None, description="home cage or tank of its animal")
    sex: str | None = Field(None, description="sex of its animal")
    batch: str | None = Field(None, description="batch of the experiment")
    species: str | None = Field(None, description=_SPECIES)
    age: str | None = Field(None, description=_AGE)

    _aged = field_validator("age")(whole_age)
    _named = field_validator("species")(known_species)


class ArenaFacts(Table):
    """[arena]: where the arena is in the picture, and where in it the animal is."""

    floor: Literal["auto"] | StatedFloor = Field(
        "auto",
        description=(
            "the plane animals stand on: 'auto' finds it, or {point = [x, y, z], normal = [x, y, "
            "z]}, mm in the camera's frame (x right, y down, z away)"
        ),
    )
    region: Region | None = Field(
        None,
        description=(
            "corners [x, y], pixels, of a polygon around the arena, outside of which nothing is "
            "looked at; or {rectangle = [[x, y], [x, y]]}, {circle = {centre = [x, y], radius = "
            "r}}, {polygon = [...], unit = 'mm'} on the floor; not set: the whole picture, or what "
            "lies around the floor that was found"
        ),
    )
    zones: str | None = Field(
        None,
        description=(
            "path of a TOML file with named zones, circles and polygons; see docs/howto/zones.md"
        ),
    )


class RecordingOptions(Table):
    """[recording]: how the file is read."""

    fps: Positive | None = Field(
        None,
        description="frames per second, only for recordings that carry no time stamps of their own",
    )
    topic: str | None = Field(
        None, description="the MCAP topic that holds the depth, where there are several"
    )
    accept_truncated: bool = Field(
        False,
        description="true: use the whole frames of a recording that ends in the middle of one",
    )
    mirrored: bool | None = Field(
        None,
        description=(
            "true: exchange left and right, for pictures that come mirrored, or to measure a "
            "left hand; not set: of a hand it is found, of others false"
        ),
    )


class Foreground(Table):
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


class Estimation(Table):
    """[estimation]: one pose per frame."""

    model: str = Field(
        "mouse", description="a bundled model, or the path of an .npz made by `liex train`"
    )
    n_candidates: int | None = Field(
        None,
        ge=1,
        description="poses a frame starts from; not set: as many as the model was made for",
    )
    doubtful_above_mm: Positive | None = Field(
        None,
        description=(
            "frames with a larger predicted error are flagged doubtful; not set: the model's own "
            "limit"
        ),
    )
    accept_misfit: bool = Field(
        False,
        description=(
            "true: measure a recording that does not look like this plan's animal all the same, as "
            "liex run --accept does"
        ),
    )
    adapt: Literal["auto", "off"] = Field(
        "auto",
        description=(
            "auto: a shape of the animal's own is fitted to sampled frames, and kept where frames "
            "that it was not fitted to bear it out; off: it has the average animal's"
        ),
    )


class Tracking(Table):
    """[tracking]: from the frames' poses to a curve."""

    bridge_s: NotNegative = Field(
        0.5,
        description=(
            "a stretch without a measurement that is no longer than this is bridged and flagged "
            "so, and of a longer one half as much at either end"
        ),
    )


class SessionFacts(Table):
    """[session]: facts about the animal and the day, copied into every table."""

    name: str | None = Field(
        None,
        pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+@-]{0,199}$",
        description=(
            "the session's id in every table, and the name of its folder; not set: the "
            "recording's name"
        ),
    )
    individual: str = Field("animal", description="name of the animal within this session")
    subject_id: str | None = Field(None, description="the animal's identity across the whole study")
    group: str | None = Field(None, description="experimental group of the animal")
    cage: str | None = Field(None, description="home cage or tank of the animal")
    sex: str | None = Field(None, description="sex of the animal")
    batch: str | None = Field(None, description="batch of the experiment")
    species: str | None = Field(None, description=_SPECIES)
    age: str | None = Field(None, description=_AGE)
    session_start_time: str | None = Field(
        None,
        description=(
            "ISO 8601 with time zone, as 2026-08-21T10:00:00+02:00; not set: what the recording "
            "says"
        ),
    )

    _aged = field_validator("age")(whole_age)
    _named = field_validator("species")(known_species)

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


class Behaviour(Table):
    """[behaviour]: where one behaviour ends and the next begins. Starting values: check them on
    your own animals.
    """

    speed_half_window_s: Positive = Field(
        0.034,
        description=(
            "speed at time t is measured from t - this to t + this (one frame each side at 30 fps)"
        ),
    )
    pause_below_mm_s: Positive = Field(
        50.0, description="slower than this is a pause, faster is walking"
    )
    run_above_mm_s: Positive = Field(300.0, description="faster than this is running")
    impossible_above_mm_s: Positive = Field(
        3000.0, description="faster than this is an error of measurement"
    )
    rear_height_mm: Positive = Field(
        40.0,
        description="rearing begins when the nose is this much higher than the tail's base ...",
    )
    rear_height_bl: Positive = Field(
        0.6, description="... or, for a smaller animal, by this many of its own body lengths"
    )
    rear_leave: Positive = Field(
        2.0 / 3.0,
        le=1,
        description="rearing reaches to where the nose is below this share of that height",
    )
    speed_hysteresis: NotNegative = Field(
        0.1,
        lt=1,
        description="a speed is crossed upwards this share above it, downwards this share below",
    )
    merge_pauses_s: NotNegative = Field(
        0.33, description="shorter interruptions of a bout are bridged"
    )
    min_bout_s: NotNegative = Field(0.23, description="shorter bouts are dropped, after bridging")

    @model_validator(mode="after")
    def _in_order(self) -> Behaviour:
        if not self.pause_below_mm_s < self.run_above_mm_s:
            raise ValueError(
                f"pause_below_mm_s={self.pause_below_mm_s} should be below "
                f"run_above_mm_s={self.run_above_mm_s}"
            )
        return self


class Replay(Table):
    """[replay]: what the replays, session.rrd and session.mcap, hold."""

    depth: Literal["animal", "arena", "all", "none"] = Field(
        "animal",
        description=(
            "of the depth pictures: animal, what is around it, before the still scene; arena, its "
            "region; all, whole pictures, ten times the room; or none"
        ),
    )
    candidates: bool = Field(
        False, description="every pose that single frames thought possible, too"
    )

    @field_validator("depth", mode="before")
    @classmethod
    def _in_words(cls, value: Any) -> Any:
        """Accept booleans of earlier versions: whether depth is kept at all."""
        return {True: "all", False: "none"}[value] if isinstance(value, bool) else value


class Report(Table):
    """[report]: what is written beside report.html."""

    figures: list[Literal["svg", "pdf", "png", "pages"]] = Field(
        ["svg", "pages"],
        description=(
            "formats of figures/: svg, which the report holds, and pages, one PDF of all; also pdf "
            "or png, one of each, which takes a second or two of every run"
        ),
    )

    @field_validator("figures")
    @classmethod
    def _with_svg(cls, value: list[str]) -> list[str]:
        if "svg" not in value:
            raise ValueError(f"{value} should hold svg, too, which the report is made of")
        return value


class Actions(Table):
    """[actions]: who names what the animal does."""

    model: str | None = Field(
        None,
        description=(
            "an action model by the animal's name, or the path of a .skops made by `liex train "
            "actions`; not set: the animal's bundled one, where there is one; 'rules': the "
            "thresholds of [behaviour]"
        ),
    )
