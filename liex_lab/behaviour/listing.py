"""The columns that are used most, listed from the columns' own descriptions.

`python -m liex_lab.behaviour.listing` prints the list; docs/generate.py writes it into
docs/reference/columns.md.
"""

from __future__ import annotations

from liex_lab.actions.vocabulary import WORDS
from liex_lab.behaviour.body import BRANCHES, STANDS, SWIMS
from liex_lab.behaviour.summary_columns import Vocabulary
from liex_lab.tables.schema import TABLES, Column

FIRST = (
    "frames.frame_index",
    "frames.time_s",
    "frames.gap_before",
    "frames.pulse_index",
    "frames.predicted_error_mm",
    "frames.residual_mm",
    "frames.flag",
    "frames.bridged",
    "frames.p_flip",
    "frames.centroid_x_mm",
    "frames.wall_distance_mm",
    "frames.zone",
    "poses.joint",
    "poses.x_mm",
    "poses.z_mm",
    "poses.u_px",
    "poses.sd_mm",
    "poses.sd_xy_mm",
    "poses.sd_z_mm",
    "kinematics.speed_mm_s",
    "kinematics.speed_sd_mm_s",
    "kinematics.acceleration_mm_s2",
    "kinematics.heading_rad",
    "kinematics.yaw_rate_rad_s",
    "kinematics.body_pitch_rad",
    "kinematics.length_mm",
    "kinematics.bend_rad",
    "kinematics.nose_height_mm",
    "kinematics.tail_beat_hz",
    "kinematics.tail_beat_mm",
    "bouts.action",
    "bouts.start_s",
    "bouts.stop_s",
    "bouts.duration_s",
    "bouts.path_mm",
    "bouts.peak_speed_mm_s",
    "bouts.net_turn_rad",
    "bouts.since_last_s",
    "summary.observed_s",
    "summary.distance_m",
    "summary.mean_speed_mm_s",
    "summary.speed_noise_mm_s",
    "summary.outer_half_share",
    "summary.rear_count",
    "summary.rear_share",
    "summary.rear_latency_s",
    "transitions.n",
    "transitions.by_chance",
    "transitions.p_fdr",
    "zones.n_visits",
    "activity.distance_mm",
)


def all_columns() -> dict[str, Column]:
    """Every column that a session can have, of every kind of body, by `table.name`."""
    walking, swimming, branching = (
        Vocabulary(tuple(WORDS.get(animal, ())), (), kind).columns
        for animal, kind in (("mouse", STANDS), ("fish", SWIMS), ("hand", BRANCHES))
    )
    stored = [column for rows in TABLES.values() for column in rows]
    return {f"{c.table}.{c.name}": c for c in (*stored, *branching, *swimming, *walking)}


def first_columns() -> str:
    """The table of the columns that are asked for most, as Markdown."""
    known = all_columns()
    lines = ["| column | unit | meaning |", "|---|---|---|"]
    for name in FIRST:
        column = known[name]
        formula = f" ({column.formula})" if column.formula and len(column.formula) < 60 else ""
        text = f"{column.meaning}{formula}".replace("|", "\\|")
        lines.append(f"| {column.table} `{column.name}` | {column.unit} | {text} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(first_columns(), end="")
