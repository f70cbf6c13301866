"""Paragraphs for a methods section, from the record of the run that made the tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from liex_lab.actions.ethogram import ACROSS_GAPS
from liex_lab.behaviour.body import axis_of
from liex_lab.sessions import Session

from ..units import counted

_TEMPLATE = Path(__file__).parent / "templates" / "methods.j2"


def methods(session: Session) -> list[str]:
    """Paragraphs for a methods section, from the run's own record; the words are in methods.j2.

    Args:
        session: the opened session.
    """
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
    """The recogniser, what it learned from and how often it decides."""
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
    """The length of the animal on a page: that of the fitted chain, median over the frames, mm.

    Args:
        session: the opened session.
    """
    return float(session.frames["spine_mm"].median())


def optics(session: Session) -> str:
    """What was undone between the real camera and the ideal one; empty where nothing was.

    A sentence without its full stop.

    Args:
        session: the opened session.
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
    """Who named the actions: model, rule or human, those of the table `bouts` and of the record.

    Args:
        session: the opened session.
    """
    found = {str(source) for source in session.bouts["source"]}
    if session.metadata.get("action_model"):
        found.add("model")
    elif session.metadata.get("actions") and not found & {"model", "rule"}:
        found.add("rule")
    return found
