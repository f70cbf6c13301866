"""Data dictionary of the tables `summary`, `transitions`, `zones` and `activity`.

Unit, meaning, formula and source of each column, listed once. Which columns there are depends on
the actions' names, the zones' names, and the kind of body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from liex_lab.behaviour.body import STANDS, SWIMS
from liex_lab.behaviour.columns import OWN, bout_columns, kinematics_columns
from liex_lab.tables.schema import Column, columns

_WHO = (
    ("session_id", "string", "", "name of the session: one recording's results"),
    ("individual", "string", "", "name of the animal within the session"),
)
_SHARE = "with unlabelled_share the shares of all actions sum to 1"

_GENERAL = (
    *_WHO,
    ("n_frames", "int64", "", "recorded frames"),
    ("n_lost", "int64", "", "recorded frames without a measured pose; bridged ones are among them"),
    ("n_doubtful", "int64", "", "recorded frames whose pose is flagged as doubtful"),
    (
        "duration_s",
        "float64",
        "s",
        "length of the recording, from the first frame to the end of the last",
    ),
    (
        "observed_s",
        "float64",
        "s",
        "time with a measured pose; what rates and shares are divided by",
        "sum over frames with a measured pose of the time to the next frame; before a gap or the "
        "end, the median dt",
    ),
    (
        "spine_mm",
        "float64",
        "mm",
        "length of the animal's chain of joints",
        "median of spine_mm over the frames",
    ),
    (
        "distance_m",
        "float64",
        "m",
        "distance travelled by the body centre, including tracking jitter at rest",
        "sum of step_mm / 1000",
    ),
    (
        "mean_speed_mm_s",
        "float64",
        "mm/s",
        "mean speed over the time with a speed",
        "distance / time",
    ),
    ("median_speed_mm_s", "float64", "mm/s", "median speed of the frames"),
    ("max_speed_mm_s", "float64", "mm/s", "fastest speed of a frame"),
    (
        "speed_noise_mm_s",
        "float64",
        "mm/s",
        "the speed that errors of the pose alone may give; slower than this, "
        "nobody can be sure that the animal moved",
        "median of speed_sd_mm_s",
        OWN,
    ),
    (
        "mean_abs_yaw_rate_rad_s",
        "float64",
        "rad/s",
        "how fast the animal turns, whichever way",
        "mean of |yaw_rate_rad_s|",
    ),
    (
        "turn_bias",
        "float64",
        "",
        "1: it turns to its left only, -1: to its right only",
        "sum of yaw_rate_rad_s / sum of |yaw_rate_rad_s|",
        OWN,
    ),
    (
        "wall_distance_mm",
        "float64",
        "mm",
        "distance from the nearest wall; empty where the arena's shape is not known",
        "median of wall_distance_mm over the frames",
    ),
    (
        "outer_half_share",
        "float64",
        "",
        "share of the observed time in the outer half of the floor's area; 0.5 is no preference",
        "time nearer to a wall than the margin that halves the area / observed_s",
        OWN,
    ),
)

_WALKER = (
    (
        "distance_moving_m",
        "float64",
        "m",
        "distance travelled by the body centre in the frames in which it moves for certain: free "
        "of jitter at rest, and the same whatever the actions are named",
        "sum of step_mm / 1000 over the frames faster than the plan's behaviour.pause_below_mm_s "
        "and than speed_noise_mm_s",
        OWN,
    ),
)

_SWIMMER = (
    (
        "mean_height_mm",
        "float64",
        "mm",
        "mean height of the body centre above the floor",
        "mean of z_mm",
    ),
    (
        "top_third_share",
        "float64",
        "",
        "share of the observed time in the top third of the water; empty where the "
        "surface's height is not known",
        "time above two thirds of the water's height / observed_s",
        "novel tank test",
    ),
    (
        "bottom_third_share",
        "float64",
        "",
        "share of the observed time in the bottom third of the water",
        "time below a third of the water's height / observed_s",
        "novel tank test",
    ),
    (
        "top_third_latency_s",
        "float64",
        "s",
        "time from the first sight of the animal until it first was in the top "
        "third; empty where it never was",
        "",
        "novel tank test",
    ),
    (
        "tail_beat_hz",
        "float64",
        "Hz",
        "median frequency of the tail's beat",
        "median of tail_beat_hz over the frames",
    ),
    (
        "tail_beat_mm",
        "float64",
        "mm",
        "median amplitude of the tail's beat",
        "median of tail_beat_mm over the frames",
    ),
)


def summary_columns(
    words: Sequence[str], zones: Sequence[str] = (), kind: str = STANDS
) -> tuple[Column, ...]:
    """The columns of the table `summary`: one row per animal.

    Args:
        words: the actions' names.
        zones: the zones' names.
        kind: one of `body.KINDS`.
    """
    named = [row for word in words for row in _of_action(word)]
    if together := rears_of(words):
        named += _of_rears(together)
    placed = [row for zone in zones for row in _of_zone(zone)]
    rest = (
        (
            "unlabelled_s",
            "float64",
            "s",
            "observed time without an action",
            "observed_s - time of all actions",
        ),
        (
            "unlabelled_share",
            "float64",
            "",
            "share of the observed time without an action",
            "unlabelled_s / observed_s",
        ),
    )
    return columns(
        "summary", *_GENERAL, *(_SWIMMER if kind == SWIMS else _WALKER), *named, *rest, *placed
    )


def rears_of(words: Sequence[str]) -> tuple[str, ...]:
    """The kinds of rearing that a vocabulary tells apart; none where it has rear itself.

    Args:
        words: the actions' names.
    """
    return () if "rear" in words else tuple(word for word in words if word.startswith("rear_"))


def _of_rears(kinds: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    both = f"{' and '.join(kinds)} together"
    counts = " + ".join(f"{kind}_count" for kind in kinds)
    times = " + ".join(f"{kind}_s" for kind in kinds)
    return (
        ("rear_count", "int64", "", f"number of bouts of {both}", counts),
        ("rear_s", "float64", "s", f"time in {both}", times),
        (
            "rear_share",
            "float64",
            "",
            f"share of the observed time in {both}",
            "rear_s / observed_s",
            OWN,
        ),
        (
            "rear_latency_s",
            "float64",
            "s",
            f"time from the first sight of the animal to the first of {both}; empty where there "
            "is none",
        ),
    )


def _of_action(word: str) -> tuple[tuple[str, ...], ...]:
    return (
        (f"{word}_count", "int64", "", f"number of bouts of {word}"),
        (
            f"{word}_s",
            "float64",
            "s",
            f"observed time in {word}",
            "sum over the observed frames of its bouts of the time to the next frame",
            OWN,
        ),
        (
            f"{word}_share",
            "float64",
            "",
            f"share of the observed time in {word}; {_SHARE}",
            f"{word}_s / observed_s",
            OWN,
        ),
        (
            f"{word}_mean_s",
            "float64",
            "s",
            f"mean duration of a bout of {word}; empty where there is none",
            "mean of duration_s",
        ),
        (
            f"{word}_per_min",
            "float64",
            "1/min",
            f"bouts of {word} per minute of observed time",
            f"60 x {word}_count / observed_s",
        ),
        (
            f"{word}_latency_s",
            "float64",
            "s",
            f"time from the first sight of the animal to its first {word}; empty "
            "where there is none",
        ),
    )


def _of_zone(zone: str) -> tuple[tuple[str, ...], ...]:
    return (
        (
            f"zone_{zone}_s",
            "float64",
            "s",
            f"time in which the centroid lay in the zone {zone}",
            "sum over its frames of the time to the next frame",
            OWN,
        ),
        (
            f"zone_{zone}_share",
            "float64",
            "",
            f"share of the observed time in the zone {zone}; zones may overlap",
            f"zone_{zone}_s / observed_s",
            OWN,
        ),
    )


TRANSITIONS: tuple[Column, ...] = columns(
    "transitions",
    *_WHO,
    ("from_action", "string", "", "the action before"),
    (
        "to_action",
        "string",
        "",
        "the action after, with no gap and no nameless stretch of more than the plan's "
        "behaviour.merge_pauses_s in between",
    ),
    ("n", "int64", "", "how often the second followed upon the first"),
    ("n_from", "int64", "", "how often any other action followed upon the first"),
    (
        "probability",
        "float64",
        "",
        "share of the first action's successors that were the second",
        "n / n_from",
    ),
    (
        "by_chance",
        "float64",
        "",
        "the same if actions followed each other by chance, each as often as it does and "
        "never upon itself",
        "quasi-independence, fitted by iterative scaling",
        "Goodman 1968",
    ),
    (
        "p",
        "float64",
        "",
        "probability of an n at least as far from chance, to either side; empty where chance "
        "leaves no choice",
        "binomial test of n out of n_from",
        OWN,
    ),
    (
        "p_fdr",
        "float64",
        "",
        "p, corrected for the number of pairs in this session",
        "Benjamini-Hochberg",
    ),
)

ZONES: tuple[Column, ...] = columns(
    "zones",
    *_WHO,
    ("zone", "string", "", "a zone of the plan's arena.zones"),
    (
        "time_s",
        "float64",
        "s",
        "time in which the centroid lay in it",
        "sum over its frames of the time to the next",
    ),
    ("share", "float64", "", "share of the observed time", "time_s / observed_s"),
    (
        "n_visits",
        "int64",
        "",
        "how often the animal was there; shorter absences than the plan's "
        "behaviour.merge_pauses_s are bridged, then shorter visits than behaviour.min_bout_s "
        "dropped; a gap ends a visit",
        "",
        OWN,
    ),
    (
        "latency_s",
        "float64",
        "s",
        "time from the first sight of the animal to its first visit; empty where it never came",
    ),
    ("mean_visit_s", "float64", "s", "mean length of a visit"),
    (
        "distance_mm",
        "float64",
        "mm",
        "distance travelled by the body centre in the zone",
        "sum of step_mm",
    ),
)


def activity_columns(words: Sequence[str]) -> tuple[Column, ...]:
    """The columns of the table `activity`: one row per bin of time.

    A bin is a minute, or a tenth of a recording of less than ten.

    Args:
        words: the actions' names.
    """
    return columns(
        "activity",
        *_WHO,
        ("start_s", "float64", "s", "beginning of the interval, since the first frame"),
        ("stop_s", "float64", "s", "its end, exclusive"),
        ("observed_s", "float64", "s", "time with a pose in it"),
        (
            "distance_mm",
            "float64",
            "mm",
            "distance travelled by the body centre in it",
            "sum of step_mm",
        ),
        (
            "mean_speed_mm_s",
            "float64",
            "mm/s",
            "mean speed over the time with a speed",
            "distance / time",
        ),
        (
            "unlabelled_s",
            "float64",
            "s",
            "observed time without an action in it",
            "observed_s - time of all actions",
        ),
        *(
            (
                f"{word}_s",
                "float64",
                "s",
                f"observed time in {word} in it; with unlabelled_s all actions sum to observed_s",
                "sum over the observed frames of its bouts of the time to the next frame",
            )
            for word in words
        ),
    )


@dataclass(frozen=True)
class Vocabulary:
    """What decides which columns a session has.

    Attributes:
        words: the actions' names.
        zones: the zones' names.
        kind: of body, one of `body.KINDS`.
    """

    words: tuple[str, ...]
    zones: tuple[str, ...] = ()
    kind: str = STANDS

    @property
    def columns(self) -> tuple[Column, ...]:
        """Every column of the behaviour tables."""
        return (
            *kinematics_columns(self.kind),
            *bout_columns(self.kind),
            *summary_columns(self.words, self.zones, self.kind),
            *TRANSITIONS,
            *ZONES,
            *activity_columns(self.words),
        )
