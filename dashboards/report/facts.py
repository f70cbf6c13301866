"""Provenance of a report: recording, camera, sensor, animal, software, and cost."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.actions.ethogram import ACROSS_GAPS
from liex_lab.behaviour.body import axis_of
from liex_lab.optics.camera import SensorCard
from liex_lab.sessions import Session

from ..units import counted

_TEMPLATE = Path(__file__).parent / "templates" / "methods.j2"


def methods(session: Session) -> list[str]:
    """Paragraphs for a methods section, from the run's record; the text is in methods.j2."""
    from jinja2 import StrictUndefined, Template

    about = session.metadata
    axis = axis_of(about["animal"])
    actions = about.get("actions") or {}
    named = {word.replace("_", " "): meaning for word, meaning in actions.items()}
    template = Template(
        _TEMPLATE.read_text("utf-8"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = template.render(
        about=about,
        counted=counted,
        kind=axis.kind,
        trunk=[axis.joints[k] for k in axis.trunk],
        spine=spine_mm(session),
        error=session.frames["predicted_error_mm"].median(),
        optics=optics(session),
        corrections=about.get("corrections"),
        rules=about.get("rules"),
        sources=naming(session),
        recogniser=_recogniser(session),
        n_refused=len((about.get("refused_bouts") or {}).get("bouts", [])),
        n_human=int((session.bouts["source"] == "human").sum()),
        actions=actions,
        defined=[f"{word}: {meaning}" for word, meaning in named.items() if meaning],
        bare=[word for word, meaning in named.items() if not meaning],
        checked=any("(checked: " in meaning for meaning in actions.values()),
        across_gaps=ACROSS_GAPS,
    )
    paragraphs = (" ".join(part.split()) for part in text.split("<paragraph>"))
    return [paragraph for paragraph in paragraphs if paragraph]


def _recogniser(session: Session) -> dict[str, Any]:
    """The recogniser, its training data and its decision rate."""
    model = session.metadata.get("action_model") or {}
    planned = session.metadata.get("plan", {}).get("actions") or {}
    hashes = [str(one) for one in session.bouts["model_hash"] if str(one)]
    return {
        "name": planned.get("model") or f"{session.metadata['animal']['name']}, bundled",
        "digest": str(model.get("sha256") or (hashes[0] if hashes else ""))[:16],
        "labels": str(model.get("labels", "")),
        "n": int(model.get("n_recordings", 0)),
        "clock_hz": model.get("clock_hz"),
    }


def spine_mm(session: Session) -> float:
    """The displayed length of the animal: the fitted chain's, median over the frames, mm."""
    return float(session.frames["spine_mm"].median())


def optics(session: Session) -> str:
    """The corrected optical effects (lens, water, mirror) as text; empty if there are none.

    It has no full stop.
    """
    found = session.metadata["camera"].get("optics", {})
    undone = []
    if bent := found.get("distortion"):
        undone.append(
            f"the lens distortion ({bent['model']} "
            f"{', '.join(f'{k:g}' for k in bent['coefficients'])})"
        )
    if water := found.get("water"):
        undone.append(
            f"the refraction at a water surface {water['height_mm']:g} mm below the lens (index "
            f"{water['refractive_index']:g}, {water['ranging'].replace('_', ' ')} camera)"
        )
    if found.get("mirrored"):
        undone.append("the mirroring of the pictures")
    what = " and ".join(undone)
    return (
        f"{what} undone; camera and pictures are those of an ideal camera in air" if undone else ""
    )


def naming(session: Session) -> set[str]:
    """The sources of the actions: model, rule or human, from the table `bouts` and the metadata."""
    found = {str(source) for source in session.bouts["source"]}
    if session.metadata.get("action_model"):
        found.add("model")
    elif session.metadata.get("actions") and not found & {"model", "rule"}:
        found.add("rule")
    return found


def beside_average(shape: Mapping[str, Any]) -> str:
    """The difference between this animal and the average one of its length, in words.

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
    """Recording, camera, animal, software and cost, as (name, value)."""
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
    """The line on the sensor's quality; empty if unknown.

    Args:
        about: session.json.
    """
    known = about.get("scene", {}).get("sensor")
    return [] if known is None else [("Sensor", str(SensorCard.from_dict(known)))]
