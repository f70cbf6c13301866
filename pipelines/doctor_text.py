"""What `liex doctor` found, as lines for a person.

Numbers stand with their units; what cannot be told is unknown, never 0.
"""

from __future__ import annotations

import math
from typing import Any

from liex_lab.errors import printable
from liex_lab.optics.camera import SensorCard
from liex_lab.scene.outline import Arena
from liex_lab.scene.scene import Fixture
from liex_lab.sessions.folder import megabytes

# lines that decide whether a run makes sense
_FIRST = ("frames", "rate", "gaps", "intrinsics from", "floor", "arena", "animal", "plan")


def print_report(findings: dict[str, Any], verbose: bool = True) -> None:
    """Print the findings on one screen, and the problems below.

    Args:
        findings: what `examine` returns.
        verbose: print every line, not only those that decide whether a run makes sense.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, pad_edge=False)
    for name, value in lines(findings):
        if verbose or name in _FIRST:
            table.add_row(name, Text(printable(value)))
    console = Console()
    console.print(table)
    if not findings["problems"] and not findings["missing"]:
        console.print("no problems found", style="green")
    for problem in (*findings["missing"], *findings["problems"]):
        console.print(Text(printable(f"- {problem}"), style="yellow"), soft_wrap=True)
    if findings["arenas"]:
        told = "several arenas are seen; lines for a plan, with subject_id and group to be added:"
        console.print(Text(told), soft_wrap=True)
        for line in findings["arenas"]:
            console.print(Text(line), soft_wrap=True)
    if findings["next"]:
        console.print(Text(printable(f"next: {findings['next']}")), soft_wrap=True)


def lines(findings: dict[str, Any]) -> list[tuple[str, str]]:
    """The findings as (name, text), in the order in which they are printed.

    Args:
        findings: what `examine` returns.
    """
    return [*_recording(findings), *_optics(findings), *_floor(findings), *_animal(findings)]


def _recording(f: dict[str, Any]) -> list[tuple[str, str]]:
    """The lines on frames and their times."""
    return [
        ("format", f["format"]),
        ("frames", f"{f['n_frames']} in {_text(f['duration_s'], 's', 2)}"),
        (
            "rate",
            f"{_text(f['rate_hz'], 'frames/s', 2)}, steps vary by {_text(f['jitter_ms'], 'ms', 2)}",
        ),
        ("gaps", f"{f['n_gaps']}, {f['n_missing']} frames missing" if f["n_gaps"] else "none"),
        (
            "time stamps",
            f"{f['n_time_faults']} could not be true"
            if f["n_time_faults"]
            else "increase as they should",
        ),
    ]


def _optics(f: dict[str, Any]) -> list[tuple[str, str]]:
    """The lines on the picture, the lens and the water."""
    water = f["water"]
    bent = f["distortion"]
    coefficients = (
        None if bent is None else ", ".join(f"{value:g}" for value in bent["coefficients"])
    )
    return [
        ("picture", f"{f['width']} x {f['height']} px"),
        (
            "intrinsics",
            f"fx {f['fx']:.1f}, fy {f['fy']:.1f}, cx {f['cx']:.1f}, cy {f['cy']:.1f} px",
        ),
        ("intrinsics from", f["intrinsics_source"]),
        (
            "lens distortion",
            "none" if bent is None else f"{bent['model']} {coefficients}, undone on reading",
        ),
        (
            "water",
            "none"
            if water is None
            else (
                f"{_text(f['water_depth_mm'], 'mm')} deep, n = {water['refractive_index']:g}, "
                f"{water['ranging'].replace('_', ' ')}; refraction undone on reading"
            ),
        ),
        (
            "depth",
            f"{_text(f['depth_min_mm'], 'mm')} to {_text(f['depth_max_mm'], 'mm')}, "
            f"{f['unread_share']:.1%} of the pixels unread",
        ),
    ]


def _floor(f: dict[str, Any]) -> list[tuple[str, str]]:
    """The lines on the floor, the arena, what stands on it, and the sensor."""
    tilt = f["floor_tilt_rad"]
    degrees = None if tilt is None else f"{math.degrees(tilt):.1f}"
    return [
        (
            "on the floor",
            "unknown"
            if f["floor_unread_share"] is None
            else f"{f['floor_unread_share']:.1%} unread, noise {_text(f['noise_mm'], 'mm', 1)}",
        ),
        (
            "floor",
            "unknown"
            if degrees is None
            else f"{_text(f['floor_mm'], 'mm')} from the lens, tilted by {degrees} degrees",
        ),
        ("arena", _arena_text(f["arena"], f["scene"])),
        ("scene", _scene_text(f["scene"])),
        *_sensor_lines(f["scene"]),
    ]


def _animal(f: dict[str, Any]) -> list[tuple[str, str]]:
    """The lines on the animal, the plan that fits it, and the room that a session takes."""
    moves = {True: "sits still", False: "moves about", None: ""}[f["animal_sits_still"]]
    return [
        (
            "animal",
            "not found"
            if f["animal_length_mm"] is None
            else (
                f"{_text(f['animal_length_mm'], 'mm')} long from above, {moves}, found in "
                f"{f['animal_share']:.0%} of the frames"
            ),
        ),
        *([("plan", f["plan_says"])] if f["plan_says"] else []),
        *(
            [("a session takes", f"about {megabytes(1e6 * f['session_mb'])} on disk")]
            if f["session_mb"] is not None
            else []
        ),
    ]


def _arena_text(arena: dict[str, Any] | None, scene: dict[str, Any] | None) -> str:
    """The shape of the floor, what it ends at, and whether a region is stated."""
    region = "; only a region is looked at" if scene and scene["region_px"] else ""
    if arena is None:
        return f"unknown{region}"
    edge = {"wall": ", with walls", "drop": ", ends in the air"}.get(arena.get("edge", ""), "")
    return f"{Arena.from_dict(arena)}{edge}{region}"


def _scene_text(scene: dict[str, Any] | None) -> str:
    """How the floor was found, its roughness, what stands on it and how many animals move."""
    if scene is None:
        return "unknown"
    floor = scene["floor"]
    share = floor["support"]
    support = "nothing moves" if share is None else f"{share:.0%} of what moves stands on it"
    fixtures = [Fixture.from_dict(one) for one in scene["fixtures"]]
    passing = [str(one) for one in fixtures if (one.since_s, one.until_s) != (None, None)]
    times = f" ({'; '.join(passing)})" if passing else ""
    return ", ".join(
        [
            f"floor from {floor['from']} ({support})",
            f"rough to {_text(floor['roughness_mm'], 'mm', 1)}",
            f"{len(fixtures)} thing{'' if len(fixtures) == 1 else 's'} on it{times}",
            f"at most {scene['n_animals']} moving together",
        ]
    )


def _sensor_lines(scene: dict[str, Any] | None) -> list[tuple[str, str]]:
    """The line on the sensor; none where nothing is known of it."""
    known = None if scene is None else scene.get("sensor")
    return [] if known is None else [("sensor", str(SensorCard.from_dict(known)))]


def _text(value: float | None, unit: str, digits: int = 0) -> str:
    return "unknown" if value is None else f"{value:.{digits}f} {unit}"
