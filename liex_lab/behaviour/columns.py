"""Data dictionary of the tables `kinematics` and `bouts`.

Unit, meaning, formula and source of every column, listed once; writers, readers, columns.json and
the report share the list. Rules after Live Mouse Tracker (de Chaumont et al. 2019) and ZebraZoom
(Mirat et al. 2013) are marked as such.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import replace

from liex_lab.behaviour.body import BRANCHES, STANDS, SWIMS
from liex_lab.tables.schema import FRAMES, Column, columns

OWN = "this library's choice"
LMT = "Live Mouse Tracker's rule"
ZZ = "after ZebraZoom's list of bout parameters"
_SD = "standard deviation of"
_INDEPENDENT = "the joints' sd_mm, errors lasting 0.3 s; on a rendered recording they lasted longer"

KINEMATICS: tuple[Column, ...] = columns(
    "kinematics",
    *((c.name, c.dtype, c.unit, c.meaning, c.formula, c.source) for c in FRAMES[:5]),
    (
        "x_mm",
        "float64",
        "mm",
        "body centre in the arena, along the picture's rows",
        "mean of all joints but the nose; of a swimming animal, of the front half of its chain; of "
        "a hand, of the palm and the joints next to it",
    ),
    ("y_mm", "float64", "mm", "body centre in the arena, up in the picture", "as x_mm"),
    ("z_mm", "float64", "mm", "height of the body centre above the floor", "as x_mm"),
    (
        "position_sd_mm",
        "float64",
        "mm",
        f"{_SD} the body centre along one axis from one frame to another",
        "mean of the joints' sd_mm, whose errors in one frame count as one common error",
    ),
    (
        "speed_mm_s",
        "float64",
        "mm/s",
        "speed of the body centre: over the floor for an animal that stands on it, in space for "
        "one that swims; never taken across a gap; faster than the plan's "
        "behaviour.impossible_above_mm_s it is an error and left empty",
        "|p(t + h) - p(t - h)| over the true time between the two frames, h the plan's "
        "behaviour.speed_half_window_s",
        LMT,
    ),
    (
        "speed_sd_mm_s",
        "float64",
        "mm/s",
        f"{_SD} the speed; an animal at rest seems to move about as fast as this",
        "sd(p(t + h) - p(t - h)) / time between them, where errors agree by exp(-time / 0.3 s)",
        _INDEPENDENT,
    ),
    (
        "vertical_speed_mm_s",
        "float64",
        "mm/s",
        "upward speed of the body centre",
        "as speed_mm_s, of z_mm",
    ),
    (
        "acceleration_mm_s2",
        "float64",
        "mm/s²",
        "how fast the speed grows; negative when it slows down",
        "as speed_mm_s, of speed_mm_s",
    ),
    (
        "acceleration_sd_mm_s2",
        "float64",
        "mm/s²",
        f"{_SD} the acceleration",
        "as speed_sd_mm_s, of speed_sd_mm_s",
        _INDEPENDENT,
    ),
    (
        "step_mm",
        "float64",
        "mm",
        "distance travelled by the body centre that this frame stands for",
        "speed_mm_s x time to the next frame",
    ),
    (
        "heading_rad",
        "float64",
        "rad",
        "direction from rump to neck (of a swimming animal, along its front quarter to the head; "
        "of a hand, from the palm to the root of the middle finger) on the floor, 0 along x, "
        "counter-clockwise seen from above; empty when the body stands steeper than 75 degrees",
        "atan2(dy, dx)",
    ),
    (
        "heading_sd_rad",
        "float64",
        "rad",
        f"{_SD} the heading",
        "hypot(sd of both joints) / their distance on the floor",
        _INDEPENDENT,
    ),
    (
        "yaw_rate_rad_s",
        "float64",
        "rad/s",
        "turning speed of the heading; positive to the animal's left",
        "as speed_mm_s, of the unwrapped heading",
    ),
    (
        "yaw_rate_sd_rad_s",
        "float64",
        "rad/s",
        f"{_SD} the turning speed",
        "as speed_sd_mm_s, of heading_sd_rad",
        _INDEPENDENT,
    ),
    (
        "body_pitch_rad",
        "float64",
        "rad",
        "angle of the same line above the floor; positive nose up",
        "atan2(dz, reach)",
    ),
    (
        "body_pitch_sd_rad",
        "float64",
        "rad",
        f"{_SD} the pitch",
        "hypot(sd of both joints) / their distance",
        _INDEPENDENT,
    ),
    (
        "length_mm",
        "float64",
        "mm",
        "length of the chain of joints; of a hand, from the palm to the tip of the middle finger",
        "sum of the bones",
    ),
    (
        "straightness",
        "float64",
        "",
        "1 when the body is straight; 0.64 when it is bent to a half circle",
        "distance of the chain's ends / length_mm",
    ),
    (
        "bend_rad",
        "float64",
        "rad",
        "by how much the body turns from its front bone to its rear one, in the plane of "
        "its axis and the horizontal; positive to the animal's left",
        "sum of the turns at the inner joints",
        OWN,
    ),
)

WALKING: tuple[Column, ...] = columns(
    "kinematics",
    (
        "nose_height_mm",
        "float64",
        "mm",
        "height of the nose above the floor; joints lie on the body's mid-axis",
    ),
    (
        "nose_height_sd_mm",
        "float64",
        "mm",
        f"{_SD} the nose's height",
        "sd_mm of the nose",
        "estimator",
    ),
    (
        "back_height_mm",
        "float64",
        "mm",
        "height of the highest joint between rump and nose; joints lie on the body's "
        "mid-axis, so the back itself is higher",
    ),
    (
        "nose_over_rump_mm",
        "float64",
        "mm",
        "how much higher the nose is than the tail's base",
        "z of nose - z of rump",
        LMT,
    ),
    (
        "reach_mm",
        "float64",
        "mm",
        "how far the nose is from the tail's base as seen from above",
        "hypot of nose - rump in x and y",
    ),
)

_BEAT_FPS = 12.0  # four frames to a beat of 3 Hz, the slowest that an adult fish swims with
_BEND_FPS = 250.0  # the first stage of a startle takes 20 ms

SWIMMING: tuple[Column, ...] = columns(
    "kinematics",
    *(
        (
            f"bend_{part}_rad",
            "float64",
            "rad",
            f"by how much the {part} third of the body turns; positive to the left; "
            "the wave of curvature that runs down the body reaches the three one after the other",
            "sum of the turns at its joints",
        )
        for part in ("front", "middle", "rear")
    ),
    (
        "tail_angle_rad",
        "float64",
        "rad",
        "angle at the head between the body's axis and the line to the tail's tip; "
        "positive to the left",
        "atan2(tail_mm, distance along the axis)",
        ZZ,
    ),
    (
        "tail_mm",
        "float64",
        "mm",
        "how far the tail's tip is beside the line of the body's axis; positive to the left",
    ),
    (
        "tail_extreme_rad",
        "float64",
        "rad",
        "tail_angle_rad in the frames where the tail turns back (bends), empty in all others",
        "turning points of tail_mm that stand out by 5 % of the length and by 2 sd",
        ZZ,
    ),
    (
        "tail_beat_hz",
        "float64",
        "Hz",
        "frequency of the tail's beat that the frame is in; empty at rest, and where it "
        "is faster than a quarter of the frame rate",
        "1 / (2 x time from one bend to the next)",
        ZZ,
    ),
    (
        "tail_beat_mm",
        "float64",
        "mm",
        "amplitude of the beat that the frame is in: half the tip's way from one side to the other",
        "|tail_mm(next bend) - tail_mm(last bend)| / 2",
    ),
    (
        "below_surface_mm",
        "float64",
        "mm",
        "depth of the body centre below the water's surface; empty where its height is not known",
        "height of the surface - z_mm",
        "the plan's [water]",
    ),
)
SWIMMING = tuple(
    replace(c, unreliable_below_fps=_BEAT_FPS)
    if c.name.startswith(("tail_beat", "tail_extreme"))
    else c
    for c in SWIMMING
)

BOUT_MEASURES: tuple[Column, ...] = columns(
    "bouts",
    (
        "path_mm",
        "float64",
        "mm",
        "distance travelled by the body centre in the observed frames of the bout; the distance "
        "across a gap is not included, so it can be shorter than displacement_mm there",
        "sum of step_mm",
    ),
    (
        "path_bl",
        "float64",
        "",
        "the same in body lengths",
        "path_mm / median length_mm of the session",
    ),
    (
        "displacement_mm",
        "float64",
        "mm",
        "distance between the first and the last observed place of the bout, across gaps too",
        "|p(last) - p(first)|",
    ),
    (
        "rise_mm",
        "float64",
        "mm",
        "how much higher the bout ends than it begins",
        "z_mm(last) - z_mm(first)",
    ),
    (
        "mean_speed_mm_s",
        "float64",
        "mm/s",
        "mean speed within the bout",
        "path_mm / time with a speed",
    ),
    ("median_speed_mm_s", "float64", "mm/s", "median speed of the bout's frames"),
    ("peak_speed_mm_s", "float64", "mm/s", "fastest speed within the bout", "max of speed_mm_s"),
    (
        "peak_speed_sd_mm_s",
        "float64",
        "mm/s",
        "standard deviation of that speed",
        "speed_sd_mm_s of its frame",
        _INDEPENDENT,
    ),
    ("time_to_peak_s", "float64", "s", "from the bout's onset to its fastest frame"),
    (
        "net_turn_rad",
        "float64",
        "rad",
        "turn from the bout's first to its last heading; positive to the left",
        "difference of the unwrapped heading",
    ),
    (
        "net_turn_sd_rad",
        "float64",
        "rad",
        "standard deviation of that turn",
        "hypot(heading_sd_rad of both frames)",
        _INDEPENDENT,
    ),
    (
        "heading_range_rad",
        "float64",
        "rad",
        "how far the heading swings within the bout",
        "max - min of the unwrapped heading",
        ZZ,
    ),
    ("mean_pitch_rad", "float64", "rad", "mean pitch of the body", "mean of body_pitch_rad"),
    (
        "bend_max_rad",
        "float64",
        "rad",
        "largest bend of the body, whichever side",
        "max of |bend_rad|",
    ),
    (
        "since_last_s",
        "float64",
        "s",
        "time since the last bout of the same action; empty at the first, and where the "
        "animal was out of sight in between",
        "start_s - stop_s of the last one",
        ZZ,
    ),
    (
        "contradicts",
        "string",
        "",
        "what of the printed definition of its word does not hold of the bout; empty where all "
        "that can be measured holds, and where no limits are stated. Such bouts of a model are "
        "named otherwise, those of a person stay",
        "the limits behind `checked` in the definition",
        OWN,
    ),
)

WALKING_BOUTS: tuple[Column, ...] = columns(
    "bouts",
    (
        "peak_nose_height_mm",
        "float64",
        "mm",
        "highest nose within the bout",
        "max of nose_height_mm",
    ),
    (
        "peak_nose_over_rump_mm",
        "float64",
        "mm",
        "how far the nose is above the tail's base at most within the bout",
        "max of nose_over_rump_mm",
    ),
    ("time_to_peak_height_s", "float64", "s", "from the bout's onset to its highest nose"),
)

SWIMMING_BOUTS: tuple[Column, ...] = columns(
    "bouts",
    (
        "n_bends",
        "int64",
        "",
        "how often the tail turns back within the bout",
        "number of tail_extreme_rad",
        ZZ,
    ),
    ("n_oscillations", "float64", "", "number of tail beats", "n_bends / 2", ZZ),
    (
        "tail_beat_hz",
        "float64",
        "Hz",
        "tail beats per second of the bout",
        "n_oscillations / duration_s",
        ZZ,
    ),
    *(
        (
            f"tail_beat_{word}_hz",
            "float64",
            "Hz",
            f"{word} of the frequencies from bend to bend",
            f"{word} of tail_beat_hz over the frames",
            ZZ,
        )
        for word in ("max", "mean", "median")
    ),
    *(
        (
            f"tail_{word}_rad",
            "float64",
            "rad",
            f"{word} of the bends, whichever side",
            f"{word} of |tail_extreme_rad|",
            ZZ,
        )
        for word in ("max", "mean", "median")
    ),
    ("first_bend_s", "float64", "s", "from the bout's onset to its first bend", "", ZZ),
    (
        "first_bend_rad",
        "float64",
        "rad",
        "the first bend; positive to the left",
        "first tail_extreme_rad",
        ZZ,
    ),
    (
        "second_over_first",
        "float64",
        "",
        "the second bend relative to the first; negative to the other side",
        "",
        ZZ,
    ),
    (
        "tail_angle_mean_rad",
        "float64",
        "rad",
        "mean of the tail's angle over time; positive to the left",
        "sum of tail_angle_rad x dt / duration_s",
        ZZ,
    ),
    (
        "tail_angle_mean_abs_rad",
        "float64",
        "rad",
        "the same, whichever side",
        "sum of |tail_angle_rad| x dt / duration_s",
        ZZ,
    ),
    (
        "tail_symmetry",
        "float64",
        "",
        "1 when the tail goes as far to one side as to the other, 0 when to one only",
        "smaller / larger of the extremes to the two sides",
        ZZ,
    ),
    (
        "wave_speed_mm_s",
        "float64",
        "mm/s",
        "speed of the wave of curvature that runs down the body",
        "a third of the length / the lag from bend_middle_rad to bend_rear_rad at which they "
        "agree best",
        OWN,
    ),
)
_FPS = {"first_bend_s": _BEND_FPS, "wave_speed_mm_s": 4 * _BEAT_FPS}
SWIMMING_BOUTS = tuple(
    replace(c, unreliable_below_fps=_FPS.get(c.name, _BEAT_FPS if "beat" in c.name else None))
    for c in SWIMMING_BOUTS
)


BRANCHING: tuple[Column, ...] = columns(
    "kinematics",
    (
        "opening",
        "float64",
        "",
        "1 when all limbs, a hand's fingers, are stretched out; less the more they are bent",
        "mean over the limbs of the distance from the base joint to the limb's end / length of the "
        "bones in between",
        OWN,
    ),
)
_KINEMATICS = {STANDS: WALKING, SWIMS: SWIMMING, BRANCHES: BRANCHING}
_BOUTS: dict[str, tuple[Column, ...]] = {
    STANDS: WALKING_BOUTS,
    SWIMS: SWIMMING_BOUTS,
    BRANCHES: (),
}


def kinematics_columns(kind: str) -> tuple[Column, ...]:
    """The columns of the table `kinematics`.

    Args:
        kind: one of `body.KINDS`.
    """
    return (*KINEMATICS, *_KINEMATICS[kind])


def kind_of(names: Iterable[Hashable]) -> str:
    """The kind of body, one of `body.KINDS`, whose table `kinematics` has these columns.

    Args:
        names: the columns of the table.
    """
    known = set(names)
    return next((kind for kind in (SWIMS, BRANCHES) if _KINEMATICS[kind][0].name in known), STANDS)


def bout_columns(kind: str) -> tuple[Column, ...]:
    """The measures that the table `bouts` has beside who, when and what.

    Args:
        kind: one of `body.KINDS`.
    """
    return (*BOUT_MEASURES, *_BOUTS[kind])


def trusted(columns_of: tuple[Column, ...], fps: float) -> frozenset[str]:
    """Names of the columns that a camera of this rate can measure; the others stay empty.

    Args:
        columns_of: the columns to choose from.
        fps: frame rate of the camera, frames/s.
    """
    return frozenset(
        c.name
        for c in columns_of
        if c.unreliable_below_fps is None or fps >= c.unreliable_below_fps
    )
