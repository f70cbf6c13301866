"""The columns of the behaviour tables: unit, meaning, formula, source, listed once."""

from __future__ import annotations

from collections.abc import Sequence

from liex_lab.sessions.tables import FRAMES, Column, columns

_OWN = "this library's choice"
_LMT = "Live Mouse Tracker's rule"
_LENGTH = "spine_mm of the session"

KINEMATICS: tuple[Column, ...] = columns(
    "kinematics",
    *((c.name, c.dtype, c.unit, c.meaning, c.formula, c.source) for c in FRAMES[:5]),
    ("x_mm", "float64", "mm", "body centre in the arena, along the picture's rows", "mean of all joints but the nose"),
    ("y_mm", "float64", "mm", "body centre in the arena, up in the picture", "mean of all joints but the nose"),
    ("z_mm", "float64", "mm", "height of the body centre above the floor", "mean of all joints but the nose"),
    ("speed_mm_s", "float64", "mm/s", "speed of the body centre over the floor; never taken across a gap; faster "
     "than the plan's behaviour.impossible_above_mm_s it is an error and left empty", "|p(t + h) - p(t - h)| over the "
     "true time between the two frames, h the plan's behaviour.speed_half_window_s", _LMT),
    ("vertical_speed_mm_s", "float64", "mm/s", "upward speed of the body centre", "as speed_mm_s, of z_mm"),
    ("step_mm", "float64", "mm", "way of the body centre over the floor that this frame stands for",
     "speed_mm_s x time to the next frame"),
    ("heading_rad", "float64", "rad", "direction from rump to neck on the floor, 0 along x, counter-clockwise seen "
     "from above; empty when the body stands steeper than 75 degrees", "atan2(dy, dx)"),
    ("yaw_rate_rad_s", "float64", "rad/s", "turning speed of the heading; positive to the animal's left",
     "as speed_mm_s, of the unwrapped heading"),
    ("nose_height_mm", "float64", "mm", "height of the nose above the floor; joints lie on the body's mid-axis"),
    ("back_height_mm", "float64", "mm", "height of the highest joint between rump and neck; joints lie on the body's "
     "mid-axis, so the back itself is higher"),
    ("body_pitch_rad", "float64", "rad", "angle of the line from rump to neck above the floor; positive nose up"),
    ("nose_over_rump_mm", "float64", "mm", "how much higher the nose is than the tail's base", "z of nose - z of rump",
     _LMT),
)  # fmt: skip

BOUT_MEASURES: tuple[Column, ...] = columns(
    "bouts",
    ("path_mm", "float64", "mm", "way of the body centre over the floor within the bout", "sum of step_mm"),
    ("mean_speed_mm_s", "float64", "mm/s", "mean speed within the bout", "path_mm / time with a speed"),
    ("peak_speed_mm_s", "float64", "mm/s", "fastest speed within the bout", "max of speed_mm_s"),
    ("net_turn_rad", "float64", "rad", "turn from the bout's first to its last heading; positive to the left",
     "difference of the unwrapped heading"),
    ("peak_nose_height_mm", "float64", "mm", "highest nose within the bout", "max of nose_height_mm"),
)  # fmt: skip

ACTIONS = ("rear", "run", "walk", "pause")  # where two claim a frame, the first has it

_BUDGET = tuple(
    row
    for action in ACTIONS
    for row in (
        (f"{action}_s", "float64", "s", f"time in {action}", "sum of duration_s", _OWN),
        (f"{action}_share", "float64", "", f"share of the observed time in {action}; shares are not independent",
         f"{action}_s / observed_s", _OWN),
    )
)  # fmt: skip

SUMMARY: tuple[Column, ...] = columns(
    "summary",
    ("session_id", "string", "", "name of the session: one recording's results"),
    ("individual", "string", "", "name of the animal within the session"),
    ("n_frames", "int64", "", "recorded frames"),
    ("n_lost", "int64", "", "recorded frames without a pose"),
    ("n_doubtful", "int64", "", "recorded frames whose pose is flagged as doubtful"),
    ("duration_s", "float64", "s", "length of the recording, from the first frame to the end of the last"),
    ("observed_s", "float64", "s", "time with a pose; what rates and shares are divided by",
     "sum over frames with a pose of the time to the next frame; before a gap or the end, the median dt"),
    ("spine_mm", "float64", "mm", "length of the animal's chain of joints", "median of spine_mm over the frames"),
    ("distance_m", "float64", "m", "way of the body centre over the floor; at rest the tracking's jitter adds to it",
     "sum of step_mm / 1000"),
    ("distance_moving_m", "float64", "m", "way of the body centre within walk and run, free of jitter at rest",
     "sum of step_mm within walk and run / 1000"),
    ("mean_speed_mm_s", "float64", "mm/s", "mean speed over the time with a speed", "distance / time"),
    ("median_speed_mm_s", "float64", "mm/s", "median speed of the frames"),
    ("max_speed_mm_s", "float64", "mm/s", "fastest speed of a frame"),
    ("rear_count", "int64", "", "number of rears"),
    *_BUDGET,
    ("unlabelled_s", "float64", "s", "observed time that no rule names", "observed_s - time in bouts"),
    ("unlabelled_share", "float64", "", "share of the observed time that no rule names", "unlabelled_s / observed_s"),
)  # fmt: skip


def zone_columns(zones: Sequence[str]) -> tuple[Column, ...]:
    """The columns of the summary that a session has because these zones were drawn."""
    return columns("summary", *(
        row
        for zone in zones
        for row in (
            (f"zone_{zone}_s", "float64", "s", f"time in which the centroid lay in the zone {zone}",
             "sum over its frames of the time to the next frame", _OWN),
            (f"zone_{zone}_share", "float64", "", f"share of the observed time in the zone {zone}; zones may overlap",
             f"zone_{zone}_s / observed_s", _OWN),
        )
    ))  # fmt: skip


COLUMNS: tuple[Column, ...] = (*KINEMATICS, *BOUT_MEASURES, *SUMMARY)
