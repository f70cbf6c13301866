"""Where a report's numbers come from: recording, camera, sensor, animal, software, and cost."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from liex_lab.optics.camera import SensorCard
from liex_lab.sessions import Session

from ..units import counted
from .methods import optics, spine_mm


def beside_average(shape: Mapping[str, Any]) -> str:
    """This animal beside the average one of its length, in words.

    Args:
        shape: section `animal.shape` of session.json.
    """
    if not shape.get("kept"):
        return f"the average animal's: {shape.get('why', 'none was fitted')}"
    places = ", ".join(f"{100 * place:.0f}" for place in shape["places"])
    wide, high = (
        ", ".join(
            f"{factor:.2f} ± {factor * sd:.2f}"
            for factor, sd in zip(shape[name], shape[f"{name}_sd"], strict=True)
        )
        for name in ("width", "height")
    )
    most = max(float(np.linalg.norm(moved)) for moved in shape["joints_moved"])
    by = shape.get("shared_by")
    whose = f"shared by {by}" if by else f"its own, fitted to {shape['n_frames']} frames"
    told = (
        f"{whose}; at {places} % of its length it is {wide} times as wide and {high} times as high "
        f"as the average animal. Joints were moved by up to {100 * most:.1f} % of its length for it"
    )
    own, average = shape.get("residual_mm"), shape.get("average_residual_mm")
    if own is None or average is None:
        return told
    held = f"{shape['n_frames']} frames" if by else "frames that were held out"
    return (
        f"{told}. On {held} this body lies {own:.2f} mm from the depth, the average one "
        f"{average:.2f} mm"
    )


def facts(session: Session) -> list[tuple[str, str]]:
    """Where the numbers come from: recording, camera, animal, software, cost, as (what, value).

    Args:
        session: the opened session.
    """
    about = session.metadata
    camera = about["camera"]
    frames = about["frames"]
    animal = about["animal"]
    flags = ", ".join(
        f"{count} {flag.replace('_', ' ')}" for flag, count in frames["flags"].items()
    )
    spine = spine_mm(session)
    size = f"spine {spine:.1f} mm" if np.isfinite(spine) else "spine unknown"
    if animal.get("spine_mm"):
        size += (
            f"; size that the method began with {animal['spine_mm']:.1f} mm "
            f"({animal.get('origin', 'origin unknown')})"
        )
    memory = about.get("peak_memory_mb")
    zones = ", ".join(zone.name for zone in session.zones)
    known = [
        ("Recording", f"{about['input']['name']} ({about['input']['format']})"),
        ("Input, sha256", about["input"]["sha256"]),
        (
            "Animal",
            f"{about['individual']}, {animal['name']}, {size}",
        ),
        *([("Shape", beside_average(animal["shape"]))] if animal.get("shape") else []),
        (
            "Frames",
            f"{frames['n_frames']:,} recorded ({flags}); {frames['n_missing']} not delivered, in "
            f"{counted(frames['n_gaps'], 'gap')}",
        ),
        (
            "Camera",
            f"{camera['width']} x {camera['height']} px, fx {camera['fx']:.1f}, fy "
            f"{camera['fy']:.1f}, cx {camera['cx']:.1f}, cy {camera['cy']:.1f} px "
            f"({camera['source']}), {camera['floor_distance_mm']:.0f} mm from the floor",
        ),
        *sensor_row(about),
        ("Arena", f"{session.arena}{f'; zones: {zones}' if zones else ''}"),
        (
            "Model",
            f"{about['model'].get('name', 'none')} {about['model'].get('sha256', '')[:16]}".strip(),
        ),
        (
            "Software",
            ", ".join(f"{name} {v}" for name, v in about["versions"].items() if v != "unknown"),
        ),
        (
            "Run",
            f"{about['timings_s']['total']:.1f} s, {about['frames_per_s']:.0f} frames/s"
            + (f", peak memory {memory:.0f} MB" if memory else ""),
        ),
    ]
    if undone := optics(session):
        known.insert(5, ("Optics", undone))
    subject = ", ".join(f"{name} {value}" for name, value in about["subject"].items())
    return known + ([("Subject", subject)] if subject else [])


def sensor_row(about: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The line on how good the sensor's readings are; none where nothing is known of it.

    Args:
        about: session.json.
    """
    known = about.get("scene", {}).get("sensor")
    return [] if known is None else [("Sensor", str(SensorCard.from_dict(known)))]
