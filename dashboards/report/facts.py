"""Facts of a report: methods, provenance, warnings, and the account of all frames.

Thresholds of the warnings: 2 % of the frames lost, 5 % doubtful, a predicted joint error of 10 % of
the length, a speed noise as large as the pause threshold.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.actions.ethogram import ACROSS_GAPS
from liex_lab.behaviour.body import axis_of
from liex_lab.sessions import Session
from liex_lab.sessions.correcting import disagreements

from ..units import counted, paragraphs, shown

_TEMPLATES = Path(__file__).parent / "templates"
_LOST_SHARE = 0.02
_DOUBTFUL_SHARE = 0.05
_ERROR_SHARE = 0.1
_NOISE_SHARE = 1.0


def methods(session: Session) -> list[str]:
    """Paragraphs for a methods section, from the run's record; the text is in methods.j2."""
    about = session.metadata
    axis = axis_of(about["animal"])
    actions = about.get("actions") or {}
    named = {word.replace("_", " "): meaning for word, meaning in actions.items()}
    sources = {str(source) for source in session.bouts["source"]}
    if about.get("action_model"):
        sources.add("model")
    elif actions and not sources & {"model", "rule"}:
        sources.add("rule")
    return paragraphs(
        _TEMPLATES / "methods.j2",
        about=about,
        counted=counted,
        kind=axis.kind,
        trunk=[axis.joints[k] for k in axis.trunk],
        spine=spine_mm(session),
        error=session.frames["predicted_error_mm"].median(),
        optics=optics(session),
        corrections=about.get("corrections"),
        rules=about.get("rules"),
        sources=sources,
        recogniser=_recogniser(session),
        n_refused=len((about.get("refused_bouts") or {}).get("bouts", [])),
        n_human=int((session.bouts["source"] == "human").sum()),
        actions=actions,
        defined=[f"{word}: {meaning}" for word, meaning in named.items() if meaning],
        bare=[word for word, meaning in named.items() if not meaning],
        checked=any("(checked: " in meaning for meaning in actions.values()),
        across_gaps=ACROSS_GAPS,
    )


def warnings(session: Session) -> list[str]:
    """Warnings as sentences, those of the recording first; the text is in warnings.j2."""
    about = session.metadata
    frames = about["frames"]
    hidden = int(frames["flags"].get("hidden", 0))
    # only two columns: the dashboard reads them for every session of a study
    error, spine = session.table("frames", ["predicted_error_mm", "spine_mm"]).median()
    behaviour = session.has("summary.csv")
    fps = frames["fps_median"] or 0.0
    slow: list[str] = []
    if behaviour:
        columns = session.columns
        slow = list(
            dict.fromkeys(
                columns["name"][
                    (columns["unreliable_below_fps"] > fps)
                    & columns["table"].isin(["kinematics", "bouts"])
                ]
            )
        )
    noise = session.summary.iloc[0].get("speed_noise_mm_s", np.nan) if behaviour else np.nan
    return about["problems"] + paragraphs(
        _TEMPLATES / "warnings.j2",
        counted=counted,
        shown=shown,
        frames=frames,
        n_animals=int((about.get("verdict") or {}).get("n_animals", 1)),
        hidden=hidden,
        lost=frames["n_frames"] - frames["n_observed"] - hidden,
        doubtful=int(frames["flags"].get("doubtful", 0)),
        error=error,
        spine=spine,
        flips=session.flips,
        disagreements=disagreements(session),
        behaviour=behaviour,
        noise=noise,
        pause=(about.get("rules") or {}).get("pause_below_mm_s", np.nan),
        schema=about["schema_version"],
        n_gaps=len(session.gaps),
        slow=slow,
        fps=fps,
        n_contradicting=len(_contradicting(session)),
        lost_share=_LOST_SHARE,
        doubtful_share=_DOUBTFUL_SHARE,
        error_share=_ERROR_SHARE,
        noise_share=_NOISE_SHARE,
    )


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
        undone.append("the mirroring of the images")
    if not undone:
        return ""
    return f"{' and '.join(undone)} undone; camera and images are those of an ideal camera in air"


def beside_average(shape: Mapping[str, Any]) -> str:
    """The difference between this animal and the average one of its length, in words.

    Args:
        shape: section `animal.shape` of session.json.
    """
    moved = [float(np.linalg.norm(joint)) for joint in shape.get("joints_moved", ())]
    return " ".join(paragraphs(_TEMPLATES / "shape.j2", shape=shape, moved=moved))


def _contradicting(session: Session) -> pd.DataFrame:
    """Bouts that a person named or a correction changed, and that contradict their definition."""
    bouts = session.bouts
    if "contradicts" not in bouts:
        return bouts.iloc[:0]
    return bouts[bouts["contradicts"].fillna("") != ""]


def refusal_rows(session: Session) -> list[tuple[str, str, str, str, str]]:
    """Bouts that contradict their definition: the renamed ones first, then the unchanged ones.

    Returns:
        (from, to, name, what was done, contradiction), times in s.
    """
    refused = (session.metadata.get("refused_bouts") or {}).get("bouts", [])
    rows = [(one, one["named"] or "unlabelled", one["why"]) for one in refused]
    kept = _contradicting(session).to_dict("records")
    rows += [(one, f"left, by {one['source']}", one["contradicts"]) for one in kept]
    return [
        (f"{one['start_s']:.2f}", f"{one['stop_s']:.2f}", str(one["action"]), str(what), str(why))
        for one, what, why in rows
    ]


def frame_account(session: Session) -> list[tuple[str, float, int, str]]:
    """The classification of all frames that the camera should have taken.

    Returns:
        (class, share, number, CSS class for its colour) of trusted, doubtful, hidden, lost and
            undelivered frames; hidden ones only if present.
    """
    frames = session.metadata["frames"]
    doubtful = int(frames["flags"].get("doubtful", 0))
    hidden = int(frames["flags"].get("hidden", 0))
    lost = frames["n_frames"] - frames["n_observed"] - hidden
    parts = [
        ("trusted pose", frames["n_observed"] - doubtful, "good"),
        ("doubtful pose", doubtful, "doubt"),
        *([("hidden", hidden, "gone")] if hidden else []),
        ("no pose", lost, "lost"),
        ("not delivered", frames["n_missing"], "gone"),
    ]
    total = max(sum(count for _, count, _ in parts), 1)
    return [(what, count / total, int(count), kind) for what, count, kind in parts]
