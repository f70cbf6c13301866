"""Paragraphs for a methods section, from the record of the run that made the tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from liex_lab.actions.ethogram import ACROSS_GAPS
from liex_lab.behaviour.body import BRANCHES, SWIMS, axis_of
from liex_lab.sessions import Session

from ..units import counted

_GENERATED = "generated"  # in a card's `labels`: it learned from virtual animals


def methods(session: Session) -> list[str]:
    """Paragraphs for a methods section, from the run's own record.

    Args:
        session: the opened session.
    """
    about = session.metadata
    camera = about["camera"]
    frames = about["frames"]
    animal = about["animal"]
    model = about["model"]
    error = session.frames["predicted_error_mm"].median()
    rate = f" at {frames['fps_median']:.1f} frames/s" if frames["fps_median"] else ""
    learned = (
        f" with the model {model['name']} (sha256 {model.get('sha256', '')[:16]})"
        if model.get("name")
        else ""
    )
    spine = spine_mm(session)
    size = (
        f"; the length of their chain is {spine:.1f} mm, median over the frames"
        if np.isfinite(spine)
        else ""
    )
    known = (
        f" The median joint error that the model predicts is {error:.1f} mm."
        if np.isfinite(error)
        else ""
    )
    branches = axis_of(animal).kind == BRANCHES
    where = "inside the body" if branches else "on the body's mid-axis"
    first = (
        f"Depth images of one {animal['name']} ({camera['width']} x {camera['height']} pixels, "
        f"{counted(frames['n_frames'], 'frame')}{rate}, camera "
        f"{camera['floor_distance_mm']:.0f} mm from "
        f"the floor) were analysed with liex_lab {about['versions']['liex_lab']}{learned}. A "
        f"skeleton of {len(animal['joints'])} joints ({', '.join(animal['joints'])}) {where} "
        f"was fitted to every frame{size}. {frames['n_observed']:,} of "
        f"{frames['n_frames']:,} recorded frames have a pose, {frames['flags'].get('doubtful', 0)} "
        f"of them flagged as doubtful; {frames['n_missing']} further frames were not delivered by "
        f"the camera.{known} Positions are millimetres in the arena frame, z up from the floor."
    )
    if undone := optics(session):
        first += f" {undone[0].upper()}{undone[1:]}."
    return [first, *_by_hand(session), *_behaviour(session)]


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


def _by_hand(session: Session) -> list[str]:
    """What people corrected, as a methods section has to say it; empty where nothing was."""
    told = session.metadata.get("corrections")
    if not told:
        return []
    kinds = {
        "flip": "head and tail exchanged over a stretch",
        "joint": "joints placed",
        "bout": "edits of bouts",
    }
    parts = ", ".join(f"{text}: {told[kind]}" for kind, text in kinds.items() if told.get(kind))
    return [
        f"After measurement, {counted(told['n'], 'correction was', 'corrections were')} made by "
        f"hand by {', '.join(told['authors'])} ({parts})."
    ]


def _behaviour(session: Session) -> list[str]:
    """How speed was taken and who named the actions; empty where nothing was measured of them."""
    rules = session.metadata.get("rules")
    if not rules:
        return []
    observed_s = session.metadata["frames"]["observed_s"]
    sentences = [_speed(session.metadata["animal"], rules)]
    if reason := session.metadata.get("no_actions"):
        sentences.append(reason)
    if "model" in naming(session):
        sentences += _by_model(session)
    if "rule" in naming(session):
        sentences += _by_rule(session, rules)
    if "human" in naming(session):
        n = int((session.bouts["source"] == "human").sum())
        sentences.append(f"{counted(n, 'bout was', 'bouts were')} named by a person.")
    if session.metadata.get("actions"):
        sentences.append(
            f"Shares are fractions of the {observed_s:.1f} s in which the animal was observed; "
            f"with unlabelled time they sum to 1. {ACROSS_GAPS}"
        )
    return [" ".join(sentences)]


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


def _speed(animal: dict[str, Any], rules: dict[str, Any]) -> str:
    """Which joints the speed is of, and how it is taken."""
    axis = axis_of(animal)
    joints = axis.joints
    trunk = [joints[k] for k in axis.trunk]
    rest = [name for name in joints if name not in trunk]
    if axis.kind == SWIMS:
        which = f"the first {len(trunk)} joints of the chain, {trunk[0]} to {trunk[-1]}, in space"
    elif axis.kind == BRANCHES:
        which = f"{', '.join(trunk)} in space"
    elif len(trunk) <= 6:
        which = f"{', '.join(trunk)} over the floor"
    else:
        which = f"all joints but {', '.join(rest)} over the floor"
    return (
        f"Speed is that of the mean of {which}, from its positions "
        f"{rules['speed_half_window_s']:g} s before and after at the frames' true times, never "
        "across a gap."
    )


def _by_model(session: Session) -> list[str]:
    """The recogniser, what it learned from, how it decides, what its words mean."""
    model = session.metadata.get("action_model") or {}
    planned = session.metadata.get("plan", {}).get("actions") or {}
    name = planned.get("model") or f"{session.metadata['animal']['name']}, bundled"
    hashes = [str(one) for one in session.bouts["model_hash"] if str(one)]
    digest = str(model.get("sha256") or (hashes[0] if hashes else ""))[:16]
    known = f" ({name}{', sha256 ' + digest if digest else ''})"
    labels = str(model.get("labels", ""))
    n = int(model.get("n_recordings", 0))
    recordings = counted(n, "recording")
    if _GENERATED in labels:
        learned = f", which learned from {recordings} of virtual animals only"
    elif labels:
        learned = f", which learned from {recordings} that people labelled"
    else:
        learned = ""
    clock = f" {model['clock_hz']:g} times a second" if model.get("clock_hz") else ""
    told = [
        f"Actions were named by a trained recogniser{known}{learned}: a network gives each word a "
        f"probability{clock}, and a semi-Markov chain of their durations and transitions decides, "
        "so that every frame has at most one name; a bout's score is the mean probability of its "
        "name.",
        _words(session),
    ]
    refused = (session.metadata.get("refused_bouts") or {}).get("bouts", [])
    if any("(checked: " in meaning for meaning in (session.metadata.get("actions") or {}).values()):
        told.append(
            "Every bout was checked against the numbers behind its definition; "
            + (
                f"{counted(len(refused), 'bout')} that contradicted them "
                f"{'has' if len(refused) == 1 else 'have'} another name or none."
                if refused
                else "none contradicted them."
            )
        )
    return told


def _by_rule(session: Session, rules: dict[str, Any]) -> list[str]:
    """The rules in their order, and how their bouts were tidied."""
    return [
        "Every frame has at most one name, given by rule, the first that applies. "
        f"{_words(session)} Bouts of one kind with less than {rules['merge_pauses_s']:g} s "
        f"between them were joined, then those shorter than {rules['min_bout_s']:g} s dropped."
    ]


def _words(session: Session) -> str:
    """The vocabulary with the definitions that there are, as a sentence."""
    actions = session.metadata.get("actions") or {}
    named = {word.replace("_", " "): meaning for word, meaning in actions.items()}
    defined = "; ".join(f"{word}: {meaning}" for word, meaning in named.items() if meaning)
    bare = ", ".join(word for word, meaning in named.items() if not meaning)
    told = [f"The words mean: {defined}."] if defined else []
    if bare:
        told.append(f"{'Without' if defined else 'The words, without'} a definition: {bare}.")
    return " ".join(told)
