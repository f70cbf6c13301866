"""Sections of a plan as pydantic models: each setting with its unit, limits and default.

The docstring of a section's class is the comment over that section in a plan file, and each field's
description the comment over that setting (`Plan.to_toml`): a change of either changes the files
that are written.
"""

import re
from collections import Counter
from collections.abc import Iterable
from datetime import datetime
from itertools import chain, pairwise
from typing import Annotated, Any, ClassVar, Literal, Self
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Factor = Annotated[float, Field(gt=1e-3, lt=1e3)]
Corner = Annotated[list[float], Field(min_length=2, max_length=2)]
Point = Annotated[list[float], Field(min_length=3, max_length=3)]
ClockTime = Annotated[str, Field(pattern=r"^([01]\d|2[0-3]):[0-5]\d$")]
ArenaName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
# names of liex_lab.optics.camera, repeated here because a plan is read before libraries are
# imported
CameraName = Literal[
    "kinect-v2",
    "primesense",
    "azure-nfov",
    "azure-wfov",
    "femto-bolt",
    "femto-mega",
    "gemini-2",
    "gemini-335",
    "d435",
    "d455",
    "d405",
    "raytrix-r5",
]
N_PLACES = 5  # along the body, of liex_lab.estimation.session_shape
_TAXON = "http://purl.obolibrary.org/obo/NCBITaxon_"
_LATIN = re.compile(rf"[A-Z][a-z]+ [a-z]+|{re.escape(_TAXON)}\d+")
_AGED = re.compile(r"(\d+(?:\.\d+)?) *(day|week|month|year)s?", re.IGNORECASE)
_DURATION = re.compile(r"P(?=\d)(\d+Y)?(\d+M)?(\d+W)?(\d+D)?|P\d+\.\d+[YMWD]")


def first_twice(names: Iterable[str]) -> str:
    """The first name that occurs again, or ''; case is ignored, as on some file systems."""
    listed = list(names)
    counts = Counter(name.lower() for name in listed)
    return next((name for name in listed if counts[name.lower()] > 1), "")


class SettingsTable(BaseModel):
    """Base of the tables of settings.

    Tables are immutable and reject unknown keys, values of another type, infinity and NaN.

    Attributes:
        increasing: names of two settings, the first of which is below the second; may be empty.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
    increasing: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        values = [getattr(self, name) for name in self.increasing]
        if values and not values[0] < values[1]:
            low, high = (f"{a}={b}" for a, b in zip(self.increasing, values, strict=True))
            raise ValueError(f"{low} should be below {high}")
        return self


class SubjectFacts(SettingsTable):
    """Facts about the animal of a session."""

    subject_id: str | None = Field(None, description="the animal's identity across the whole study")
    group: str | None = Field(None, description="experimental group of the animal")
    cage: str | None = Field(None, description="home cage or tank of the animal")
    sex: str | None = Field(None, description="sex of the animal")
    batch: str | None = Field(None, description="batch of the experiment")
    species: str | None = Field(
        None, description="Latin name, such as Rattus norvegicus; not set: that of the animal"
    )
    age: str | None = Field(
        None, description="age on that day, such as 12 weeks, or P12W (ISO 8601)"
    )

    @field_validator("species")
    @classmethod
    def _known(cls, species: str | None) -> str | None:
        if species is None or _LATIN.fullmatch(species):
            return species
        raise ValueError(f"should be a Latin name such as Rattus norvegicus, or {_TAXON}10116")

    @field_validator("age")
    @classmethod
    def _in_iso_8601(cls, age: str | None) -> str | None:
        if age is None or _DURATION.fullmatch(age.strip()):
            return age and age.strip()
        if found := _AGED.fullmatch(age.strip()):
            return f"P{found[1]}{found[2][0].upper()}"
        raise ValueError("should be an age such as 12 weeks or 84 days, or ISO 8601, as P12W")


class SharedShape(SettingsTable):
    """Widths and heights of an animal and offsets of its joints, as in session.json."""

    width: list[Factor] = Field(
        min_length=N_PLACES,
        max_length=N_PLACES,
        description="half widths relative to the average animal of that length, at five places",
    )
    height: list[Factor] = Field(
        min_length=N_PLACES, max_length=N_PLACES, description="half heights likewise"
    )
    joints_moved: list[Point] = Field(
        description="offset of each joint in the frame of the body's base, relative to the length"
    )


class SharedBody(SettingsTable):
    """Size and shape estimated from all sessions of one animal."""

    subject: str = Field(min_length=1, max_length=500, description="the animal")
    n_sessions: int = Field(ge=2, description="number of sessions with an estimate")
    spine_mm: Positive | None = Field(
        None, description="its length; not set: each session states or measures its own"
    )
    girth: Factor | None = Field(
        None,
        description=(
            "girth relative to the average body of that length; not set: each session measures its "
            "own"
        ),
    )
    shape: SharedShape | None = Field(
        None, description="its shape; not set: that of the average animal"
    )

    def __repr__(self) -> str:
        length = "" if self.spine_mm is None else f": {self.spine_mm:g} mm long"
        return f"<SharedBody of {self.by}{length}>"

    @property
    def by(self) -> str:
        """The sessions that share it, as text."""
        return f"{self.n_sessions} sessions of {self.subject}"


class Circle(SettingsTable):
    """A circle: its centre [x, y] and its radius."""

    centre: Corner
    radius: Positive


class Rfid(SettingsTable):
    """RFID readings that identify the animals of one arena."""

    readings: str = Field(
        description=(
            "path of a CSV file with the columns time_s (s since the first frame), antenna and id"
        )
    )
    tags: list[str] = Field(
        min_length=1, description="ids of the animals' tags; they become their subject_id"
    )
    antennas: dict[ArenaName, Circle] = Field(
        description="centre and range of each antenna by its name, mm on the floor, as of a region"
    )
    offset_s: float = Field(0.0, description="is added to the times of the readings")


class AnimalSettings(SettingsTable):
    """[animal]: the animal and its skeleton."""

    increasing = ("spine_min_mm", "spine_max_mm")

    name: str = Field("mouse", description="kind of animal, as named in tables and reports")
    skeleton: str = Field(
        "mouse", description="skeleton: fish, mouse, hand, or the path of your own TOML file"
    )
    spine_mm: Positive | None = Field(
        None,
        description="length of the skeleton from the first to the last joint; not set: measured",
    )
    spine_min_mm: Positive = Field(40.0, description="shortest length when the length is measured")
    spine_max_mm: Positive = Field(115.0, description="longest length when the length is measured")
    count: Literal["auto"] | Annotated[int, Field(ge=1, le=4)] = Field(
        1,
        description=(
            "animals of this kind in the arena that are measured, each a session of its own; "
            "'auto' counts them"
        ),
    )
    rfid: Rfid | None = Field(
        None,
        description=(
            "RFID readings that identify several animals: {readings = 'FILE.csv', tags = [...], "
            "antennas = {NAME = {centre = [x, y], radius = r}}}; see docs/howto/rfid.md"
        ),
    )
    shared: SharedBody | None = Field(
        None,
        description=(
            "size and shape estimated from all sessions of this animal; set by a study with shared "
            "= 'subject'; not set: the session's own"
        ),
    )

    @model_validator(mode="after")
    def _of_several(self) -> Self:
        if self.rfid is not None and self.count == 1:
            raise ValueError(
                "[animal.rfid] distinguishes several animals, and count is 1; state how many are "
                "in the arena, or 'auto'"
            )
        return self


class CameraOverride(SettingsTable):
    """[camera]: intrinsics that replace those of the recording or the camera's typical ones."""

    preset: CameraName | None = Field(
        None,
        description=(
            "camera by name, for recordings that do not state their camera: nominal intrinsics, "
            "which differ from a calibration by one or two per cent"
        ),
    )
    fx: Positive | None = Field(
        None, description="focal length along image rows, pixels; not set: that of the recording"
    )
    fy: Positive | None = Field(None, description="focal length along image columns, pixels")
    cx: float | None = Field(
        None, description="column of the optical axis, pixels; 0 is the centre of the first column"
    )
    cy: float | None = Field(
        None, description="row of the optical axis, pixels; 0 is the centre of the first row"
    )
    distortion: list[float] | None = Field(
        None,
        description=(
            "coefficients of the lens distortion in OpenCV's order [k1, k2, p1, p2, k3, k4, k5, "
            "k6]; later ones may be left out; [] is no distortion; not set: those of the recording"
        ),
    )
    distortion_model: str | None = Field(
        None,
        description=(
            "plumb_bob (default), rational_polynomial, or equidistant for a fisheye lens [k1, k2, "
            "k3, k4]"
        ),
    )
    source: str | None = Field(
        None, description="origin of these numbers, written into session.json"
    )


class WaterSurface(SettingsTable):
    """[water]: a flat water surface between the camera and the animal. It is not needed for a
    camera behind glass in air.
    """

    height_mm: Positive | None = Field(
        None,
        description="height of the lens above the water; if set, refraction is corrected",
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
        description="angle by which the surface recedes from the camera towards the image's right",
    )
    tilt_y_rad: float = Field(
        0.0,
        ge=-1,
        le=1,
        description="angle by which the surface recedes from the camera towards the image's bottom",
    )
    ranging: Literal["light_field", "structured_light", "time_of_flight", "paraxial"] = Field(
        "light_field",
        description=(
            "how the camera measures: light_field (Raytrix), structured_light (PrimeSense, "
            "RealSense; stereo along image rows), time_of_flight (Kinect v2, Azure), or paraxial: "
            "depth / n at every angle"
        ),
    )


class StatedFloor(SettingsTable):
    """A user-defined floor: a point of the plane and its normal, camera frame."""

    point: Point
    normal: Point


class Region(SettingsTable):
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
    def _one_shape(self) -> "Region":
        if [self.polygon, self.rectangle, self.circle].count(None) != 2:
            raise ValueError(
                "a region is one of polygon = [[x, y], [x, y], [x, y], ...], rectangle = [[x, y], "
                "[x, y]] (two opposite corners) and circle = {centre = [x, y], radius = r}"
            )
        return self


class ArenaPlace(SettingsTable):
    """One of several arenas in an image."""

    name: ArenaName = Field(description="of the arena; its session is called NAME-ARENA")
    region: Region = Field(
        description="its region, as in arena.region; everything outside is ignored"
    )


class SeveralArenas(SubjectFacts, ArenaPlace):
    """[[arenas]]: one of several arenas in the image, each a session of its own."""

    spine_mm: Positive | None = Field(None, description="of its animal; not set: it is measured")
    zones: str | None = Field(None, description="path of the TOML file with its zones")
    individual: str | None = Field(None, description="name of its animal within the session")


class ArenaFacts(SettingsTable):
    """[arena]: floor, region and zones of the arena."""

    floor: Literal["auto"] | StatedFloor = Field(
        "auto",
        description=(
            "the plane animals stand on: 'auto' finds it, or {point = [x, y, z], normal = [x, y, "
            "z]}, mm in the camera frame (x right, y down, z away)"
        ),
    )
    region: Region | None = Field(
        None,
        description=(
            "corners [x, y], pixels, of a polygon around the arena; everything outside is ignored; "
            "or {rectangle = [[x, y], [x, y]]}, {circle = {centre = [x, y], radius = r}}, {polygon "
            "= [...], unit = 'mm'} on the floor; not set: the whole image, or the surroundings of "
            "the detected floor"
        ),
    )
    zones: str | None = Field(
        None,
        description=(
            "path of a TOML file with named zones, circles and polygons; see docs/howto/zones.md"
        ),
    )


class RecordingOptions(SettingsTable):
    """[recording]: how the file is read."""

    fps: Positive | None = Field(
        None, description="frames per second, only for recordings without timestamps"
    )
    topic: str | None = Field(None, description="MCAP topic of the depth images if several exist")
    accept_truncated: bool = Field(
        False,
        description="true: use the complete frames of a recording that ends in the middle of one",
    )
    mirrored: bool | None = Field(
        None,
        description=(
            "true: exchange left and right, for mirrored images, or to measure a left hand; not "
            "set: detected for a hand, false for other animals"
        ),
    )


class Foreground(SettingsTable):
    """[foreground]: segmentation of the animal from the scene."""

    increasing = ("near_mm", "far_mm")

    min_height_mm: Positive = Field(
        7.0, description="least height of the animal's pixels above the background"
    )
    n_background_frames: int = Field(
        96, ge=3, description="frames, spread over the recording, from which the background is made"
    )
    near_mm: Positive = Field(250.0, description="least distance of a hand from the camera")
    far_mm: Positive = Field(1600.0, description="largest distance of a hand from the camera")


class Estimation(SettingsTable):
    """[estimation]: one pose per frame."""

    model: str = Field(
        "mouse", description="a bundled model, or the path of an .npz made by `liex train`"
    )
    n_candidates: int | None = Field(
        None, ge=1, description="initial poses per frame; not set: as trained"
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
            "true: also measure a recording that does not fit this plan's animal, as liex run "
            "--accept does"
        ),
    )
    adapt: Literal["auto", "off"] = Field(
        "auto",
        description=(
            "auto: the body's shape is fitted to sampled frames, and used if it also fits other "
            "frames better; off: the average animal's shape"
        ),
    )


class Tracking(SettingsTable):
    """[tracking]: from the poses of single frames to a trajectory."""

    bridge_s: NotNegative = Field(
        0.5,
        description=(
            "longest gap without a measurement that is interpolated; of a longer one half as much "
            "is extrapolated at either end; these frames are flagged"
        ),
    )


class SessionFacts(SubjectFacts):
    """[session]: facts about the animal and the day, copied into every table."""

    name: str | None = Field(
        None,
        pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+@-]{0,199}$",
        description=(
            "the session's id in every table, and the name of its folder; not set: the recording's "
            "name"
        ),
    )
    individual: str = Field("animal", description="name of the animal within this session")
    session_start_time: str | None = Field(
        None,
        description=(
            "ISO 8601 with time zone, as 2026-08-21T10:00:00+02:00; not set: that of the recording"
        ),
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


class Period(SettingsTable):
    """A named part of the recording; times count from the first frame."""

    name: str = Field(pattern="^[a-z][a-z0-9_]{0,39}$", description="such as baseline")
    start_s: NotNegative = Field(description="its beginning")
    stop_s: Positive | None = Field(None, description="its end; not set: that of the recording")


class BehaviourThresholds(SettingsTable):
    """[behaviour]: thresholds between behaviours. These are starting values; check them on your own
    animals.
    """

    increasing = ("pause_below_mm_s", "run_above_mm_s")

    speed_half_window_s: Positive = Field(
        0.034,
        description="speed at time t is measured from t - this to t + this (one frame at 30 fps)",
    )
    pause_below_mm_s: Positive = Field(
        50.0, description="a slower animal pauses, a faster one walks"
    )
    run_above_mm_s: Positive = Field(300.0, description="a faster animal runs")
    impossible_above_mm_s: Positive = Field(
        3000.0, description="faster movements are errors of measurement"
    )
    rear_height_mm: Positive = Field(
        40.0,
        description=(
            "rearing begins when the nose is this far above the tail base's usual (median) height "
            "..."
        ),
    )
    rear_height_bl: Positive = Field(
        0.4, description="... or, for a smaller animal, by this many body lengths"
    )
    rear_leave: Positive = Field(
        0.5, le=1, description="rearing ends when the nose is below this share of that height"
    )
    groom_reach_bl: Positive = Field(
        0.7,
        description=(
            "grooming begins when a slow animal is so hunched that its nose, in top view, is "
            "within this many body lengths of its tail's base ..."
        ),
    )
    groom_leave_bl: Positive = Field(0.8, description="... and ends beyond this many")
    groom_below_mm_s: Positive = Field(20.0, description="a faster animal does not groom")
    speed_hysteresis: NotNegative = Field(
        0.1,
        lt=1,
        description=(
            "a speed threshold is crossed upwards at this share above it, downwards at this share "
            "below it"
        ),
    )
    merge_pauses_s: NotNegative = Field(
        0.33, description="shorter interruptions of a bout are bridged"
    )
    min_bout_s: NotNegative = Field(0.23, description="shorter bouts are dropped, after bridging")
    bin_s: NotNegative = Field(
        0.0,
        description="length of the bins of the table activity; 0 is a minute, or a tenth of a "
        "recording of less than ten minutes",
    )
    periods: list[Period] | None = Field(
        None,
        description=(
            "states of one session, seconds since the first frame, as [{name = 'baseline', start_s "
            "= 0, stop_s = 600}, {name = 'after', start_s = 900}]; each is measured on its own, "
            "and compared with the first"
        ),
    )

    @field_validator("periods")
    @classmethod
    def _apart(cls, periods: list[Period] | None) -> list[Period] | None:
        if twice := first_twice(one.name for one in periods or ()):
            raise ValueError(f"should have a name of its own for each period, and {twice} is twice")
        spans = sorted(
            (one.start_s, float("inf") if one.stop_s is None else one.stop_s)
            for one in periods or ()
        )
        if any(one > after for one, after in pairwise(chain.from_iterable(spans))):
            raise ValueError("should not overlap, and each should begin before it ends")
        return periods

    @field_validator("bin_s")
    @classmethod
    def _is_long_enough(cls, value: float) -> float:
        if 0.0 < value < 1.0:
            raise ValueError("should be 0 or at least 1 s")
        return value


class LightSettings(SettingsTable):
    """[light]: when the light of the animal's room is on. With on, off and zone, activity by the
    hour, an actogram, circadian measures and sleep by immobility are made.
    """

    on: ClockTime | None = Field(None, description="when the light goes on, as '07:00'")
    off: ClockTime | None = Field(None, description="when it goes off, as '19:00'")
    zone: str | None = Field(
        None,
        description=(
            "time zone of these times, as 'Europe/Berlin'; 'Etc/GMT-1' is one hour ahead of UTC "
            "all year round, for a timer without summer time"
        ),
    )
    immobile_s: Positive = Field(
        40.0, description="sleep by immobility lasts at least so long (Fisher et al. 2012: 40)"
    )
    still_mm_s: Positive = Field(
        2.0, description="an animal is immobile if it moves less from second to second"
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        stated = [self.on, self.off, self.zone]
        if any(stated) and (not all(stated) or self.on == self.off):
            raise ValueError(
                "[light] takes on, off and zone together, as on = '07:00', off = '19:00', zone = "
                "'Europe/Berlin'"
            )
        try:
            ZoneInfo(self.zone or "UTC")
        except (ZoneInfoNotFoundError, ValueError, OSError):
            raise ValueError(
                f"light.zone should be a time zone such as 'Europe/Berlin', got {self.zone!r}"
            ) from None
        return self


class InteractionThresholds(SettingsTable):
    """[interactions]: distances, speeds and times that define interactions between animals of one
    arena. These are starting values; check them on your own animals. Sources: Live Mouse Tracker
    (LMT; de Chaumont 2019) and deepof (Bordes 2023); settings without a source are this library's.
    """

    increasing = ("still_mm_s", "moving_mm_s")

    contact_mm: Positive = Field(
        10.0, description="skins that are nearer touch, and a nose so near to a side sniffs it"
    )
    nose_mm: Positive = Field(
        26.0, description="largest distance of a nose from a sniffed nose or tail base (LMT: 26)"
    )
    nose_angle_rad: Positive = Field(
        0.785, description="largest angle between a head and what its nose sniffs"
    )
    side_by_side_mm: Positive = Field(
        50.0, description="largest distance of both ends of two bodies side by side (deepof: 50)"
    )
    near_mm: Positive = Field(
        25.0,
        description="approaches end and leaving begins at this distance of the skins (deepof: 25)",
    )
    avoid_mm: Positive = Field(
        150.0, description="an animal avoids another that comes within this distance of the skins"
    )
    isolated_mm: Positive = Field(
        100.0, description="an animal farther from all others is isolated ..."
    )
    isolated_s: NotNegative = Field(1.0, description="... for at least this time")
    follow_mm: Positive = Field(
        25.0,
        description="followers' noses are this near to where the tail base was (deepof: 25) ...",
    )
    follow_s: Positive = Field(0.5, description="... within this time (deepof: 0.5) ...")
    follow_angle_rad: Positive = Field(
        1.05, description="... and head the same way within this angle (LMT: 0.785)"
    )
    mount_above_mm: Positive = Field(
        10.0,
        description="the chest of a mounting animal is this far above the other's mid-axis ...",
    )
    mount_angle_rad: Positive = Field(
        1.05, description="... and it heads the same way within this angle"
    )
    mount_hidden: Positive = Field(
        0.35,
        description="where poses are missing: the outline of both lacks this share of an animal's "
        "area, but less than half as much volume",
    )
    still_mm_s: Positive = Field(20.0, description="animals that huddle are slower ...")
    huddle_s: NotNegative = Field(3.0, description="... and touch for at least this time")
    moving_mm_s: Positive = Field(
        50.0,
        description="a slower animal stands (LMT: 50): it neither follows, approaches nor leaves",
    )
    fast_mm_s: Positive = Field(
        300.0, description="a faster follower chases, a faster leaving animal escapes"
    )
    speed_half_window_s: Positive = Field(
        0.1, description="speed at time t is measured from t - this to t + this"
    )
    before_s: Positive = Field(
        1.0, description="the agent of a mutual contact came nearer by more in this time before it"
    )
    hysteresis: NotNegative = Field(
        0.2,
        lt=1,
        description="pauses in which limits are exceeded by this share at most belong to an "
        "interaction",
    )
    merge_s: NotNegative = Field(
        0.33, description="shorter interruptions are bridged (LMT: 10 frames)"
    )
    min_s: NotNegative = Field(
        0.23, description="shorter interactions are dropped, after bridging (LMT: 7 frames)"
    )


class Replay(SettingsTable):
    """[replay]: contents of the replays session.rrd and session.mcap."""

    depth: Literal["animal", "arena", "all", "none"] = Field(
        "animal",
        description=(
            "kept depth: animal, the surroundings of the animal before the still scene; arena, its "
            "region; all, whole images, ten times the size; or none"
        ),
    )
    candidates: bool = Field(False, description="true: also all pose hypotheses of single frames")

    @field_validator("depth", mode="before")
    @classmethod
    def _in_words(cls, value: Any) -> Any:
        """Accept booleans of earlier versions: whether depth is kept at all."""
        return {True: "all", False: "none"}[value] if isinstance(value, bool) else value


class Report(SettingsTable):
    """[report]: files written beside report.html."""

    figures: list[Literal["svg", "pdf", "png", "pages"]] = Field(
        ["svg", "pages"],
        description=(
            "formats of figures/: svg, which the report contains, and pages, one PDF of all; also "
            "pdf or png, one file per figure, which takes a second or two of each run"
        ),
    )

    @field_validator("figures")
    @classmethod
    def _with_svg(cls, value: list[str]) -> list[str]:
        if "svg" not in value:
            raise ValueError(f"{value} should also contain svg, which the report needs")
        return value


class Actions(SettingsTable):
    """[actions]: the recogniser of actions."""

    model: str | None = Field(
        None,
        description=(
            "an action model by the animal's name, or the path of a .skops made by `liex train "
            "actions`; not set: the animal's bundled one, if there is one; 'rules': the thresholds "
            "of [behaviour]"
        ),
    )
