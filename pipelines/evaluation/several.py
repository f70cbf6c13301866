"""Evaluation of several animals: `liex evaluate several`.

Groups of mice or fish that interact (`simulation.scenes.groups`) are rendered, measured as `liex
run` does, and the tables scored: identity, errors apart and in contact, abstention and
interactions. Conditions alternate: equal lengths or 15 % apart, three makes of cameras (for fish
three lenses), and builds that models were trained on or not; or virtual mice go where real ones
went. Limits are those of mice over the animal's length. The sealed split uses other seeds, which
appear in no development.
"""

import hashlib
import time
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from liex_lab.arrays import Array
from liex_lab.behaviour.interactions import Individual, find_interactions
from liex_lab.errors import LiexError
from liex_lab.evaluation.scores import error_of
from liex_lab.evaluation.several import (
    SEVERAL_PROTOCOL,
    Counts,
    Deed,
    crossing_counts,
    crossing_figures,
    deed_counts,
    deed_figures,
    pose_counts,
    summed,
    track_counts,
    track_figures,
)
from liex_lab.plan.sections import InteractionThresholds
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation.recording import RenderedRecording
from liex_lab.simulation.scenes.courses import film_courses, read_courses
from liex_lab.simulation.scenes.groups import KINDS, Act, film_group
from liex_lab.tracking.track import spans

from ..build import plan_of
from .scenes import run_product

SEEDS: Final = tuple(range(2001, 2049))
SEALED_SEEDS: Final = tuple(range(958_312_065, 958_312_113))
_CAP_MM = 65.0  # of a joint error of mice, about a body length


def evaluate_several(
    animals: int = 2,
    *,
    animal: str = "mouse",
    n_frames: int = 1800,
    n_recordings: int = 6,
    sealed: bool = False,
    courses: str | Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure rendered groups of animals, and score the tables, see `SEVERAL_PROTOCOL`.

    Args:
        animals: in each recording, 2 to 4.
        animal: their kind, mouse or fish.
        n_frames: length of each recording.
        n_recordings: of different seeds, 1 to 48.
        sealed: use the sealed seeds, which are not for development.
        courses: pose file of JABS with identities: the mice go where real ones went, see
            `simulation.scenes.courses`, and all their groups of this number take turns.
        progress: called recording by recording.

    Returns:
        `rows` of results over all recordings and by condition, the seeds and the protocol.

    Raises:
        LiexError: there are not so many recordings, or animals, or no groups of them.
    """
    seeds = SEALED_SEEDS if sealed else SEEDS
    if not (1 <= n_recordings <= len(seeds) and 2 <= animals <= 4 and animal in KINDS):
        raise LiexError(
            f"there are 1 to {len(seeds)} recordings of 2 to 4 animals, got {n_recordings} of "
            f"{animals} ({animal}); they are of {' or '.join(KINDS)}"
        )
    if courses is not None and (animal != "mouse" or sealed):
        raise LiexError("courses are those of mice, and have no sealed split; leave these out")
    backs = _groups(Path(courses), animals, n_frames) if courses is not None else []
    results: dict[str, list[Counts]] = {}
    messages: list[str] = []
    for k, seed in enumerate(seeds[:n_recordings]):
        progress(k, n_recordings, f"measuring group {k + 1}")
        apart, family = 0.15 * (k % 2), ("train", "other")[k // 2 % 2]
        condition = "15 % apart" if apart else "equal"
        sensor = KINDS[animal].sensors[k % 3]
        acts: list[Act] = []
        if backs:
            recording = film_courses(backs[k % len(backs)], seed, sensor, family)
            condition = "real courses"
        else:
            recording, acts = film_group(
                seed,
                n_frames,
                animal=animal,
                animals=animals,
                apart=apart,
                sensor=sensor,
                family=family,
            )
        recording.files.known_digest = hashlib.sha256(
            f"{recording.name} {animals} {condition} {n_frames}".encode()
        ).hexdigest()
        one, sentences = _counts(recording, animal, acts)
        for name in ("all", condition, f"builds: {family}"):
            results.setdefault(name, []).append(one)
        messages += [sentence for sentence in sentences if sentence not in messages]
    return {
        "animal": animal,
        "animals": animals,
        "rows": {name: _figures(summed(counts)) for name, counts in results.items()},
        "said": messages,
        "seeds": "sealed" if sealed else list(seeds[:n_recordings]),
        "n_frames": n_frames,
        "protocol": SEVERAL_PROTOCOL,
    }


def _groups(courses: Path, animals: int, n_frames: int) -> list[Array]:
    """The backs (n, animals, 4, 2) mm of all groups of real mice of this number."""
    backs = read_courses(courses)[:n_frames]
    if backs.shape[1] < animals:
        raise LiexError(f"{courses} has {backs.shape[1]} mice, got {animals}; state fewer")
    return [backs[:, some] for some in combinations(range(backs.shape[1]), animals)]


def _counts(
    recording: RenderedRecording, animal: str, acts: Sequence[Act]
) -> tuple[Counts, list[str]]:
    """Counts of one recording, those of interactions under `true` and `measured`, and the messages
    of the run.
    """
    actors, n = recording.stage.actors, len(recording)
    time_s = (recording.times_ns - recording.times_ns[0]) * 1e-9
    gaps = skin_gaps(recording)
    plan = plan_of(animal).with_settings([f"animal.count={len(actors)}"])
    limits, unit = plan.interactions, KINDS[animal].unit
    deeds: list[Deed] = [*acts, *_of_gaps(gaps, time_s, limits)]
    true = [  # whose names and ends are always clear
        Individual(
            str(k), actor.surface.skeleton, actor.joints, actor.present, *np.ones((2, n), np.bool_)
        )
        for k, actor in enumerate(actors)
    ]
    exact = _deeds(
        find_interactions(time_s, true, limits).events, {str(k): k for k in range(len(true))}
    )
    found = {f"true {name}": value for name, value in deed_counts(deeds, exact, n).items()}
    touching = np.asarray(np.nan_to_num(gaps, nan=np.inf) <= limits.contact_mm)
    found["contact_s"] = float(touching.sum()) / 2.0 * float(np.median(np.diff(time_s)))
    began = time.perf_counter()
    individuals, messages, _ = run_product(recording, plan)
    found["seconds"] = time.perf_counter() - began
    camera = recording.T_arena_camera.inverse()
    distance = np.full((n, len(actors), len(individuals)), np.nan)
    for t, actor in enumerate(actors):
        for k, one in enumerate(individuals):
            distance[:, t, k] = error_of(one.joints_camera, camera @ actor.joints)
    trusted = (
        np.stack([one.trusted for one in individuals], axis=1)
        if individuals
        else (np.zeros((n, 0), np.bool_))
    )
    resting = np.zeros(n, np.bool_)
    for act in acts:
        resting[act.start : act.stop] |= act.action == "huddle"
    found |= track_counts(distance / unit, time_s)
    sure = np.where(trusted[:, None], distance / unit, np.nan)
    found["trusted_swaps"] = track_counts(sure, time_s).get("swaps", 0)
    crossings = np.concatenate([np.zeros((0, 3)), *(one.crossings for one in individuals)])
    found |= crossing_counts(distance / unit, np.unique(crossings, axis=0))
    most_mm = _CAP_MM * unit
    found |= pose_counts(distance, np.asarray(touching.any(axis=2)), trusted, resting, most_mm)
    if individuals and (events := individuals[0].interactions) is not None:
        # of each individual the true animal that it is nearest to in most frames
        cost = np.nan_to_num(np.minimum(distance, most_mm), nan=most_mm).mean(axis=0)
        numbers = {f"animal{k}": int(one) for k, one in enumerate(cost.argmin(axis=0), 1)}
        own = deed_counts(deeds, _deeds(events, numbers), n)
        found |= {f"measured {name}": value for name, value in own.items()}
    return found, messages


def _deeds(events: pd.DataFrame, numbers: Mapping[str, int]) -> list[Deed]:
    """The interactions of a table, by the numbers of the animals."""
    names = ["agent", "target", "action", "start_frame", "stop_frame"]
    return [
        (numbers[agent], numbers[target] if target else -1, *rest)
        for agent, target, *rest in events[names].itertuples(index=False, name=None)
    ]


def skin_gaps(recording: RenderedRecording) -> Array:
    """(n, A, A) distance of the rendered trunks' vertices of two animals, mm; NaN of one alone."""
    actors, n = recording.stage.actors, len(recording)
    gaps = np.full((n, len(actors), len(actors)), np.nan)
    for start in range(0, n, 256):
        rows = slice(start, start + 256)
        skins = [
            actor[rows].solids[0].vertices()[:, : actor.surface.n_trunk_vertices]
            for actor in actors
        ]
        for i in range(len(skins[0])):
            trees = [cKDTree(skin[i]) for skin in skins]
            for a, tree in enumerate(trees):
                for b in range(a):
                    gap = float(tree.query(skins[b][i])[0].min())
                    gaps[start + i, [a, b], [b, a]] = gap
    return gaps


def _of_gaps(gaps: Array, time_s: Array, limits: InteractionThresholds) -> list[Deed]:
    """True contact and isolation, by the distances of the skins."""
    nearest = np.nanmin(gaps, axis=2)
    found: list[Deed] = []
    for a in range(gaps.shape[1]):
        found += [
            (a, -1, "isolated", start, stop)
            for start, stop in spans(nearest[:, a] > limits.isolated_mm)
            if time_s[stop - 1] - time_s[start] >= limits.isolated_s
        ]
        for b in range(a):
            found += [
                (a, b, "contact", *span) for span in spans(gaps[:, a, b] <= limits.contact_mm)
            ]
    return found


def _figures(counts: Counts) -> dict[str, Any]:
    """One row of results."""

    def ratio(of: str, per: str) -> float | None:
        return counts[of] / counts[per] if counts.get(per) else None

    hours = counts["contact_s"] / 3600.0
    figures: dict[str, Any] = {
        "swaps": int(counts["swaps"]),
        "swaps_per_contact_hour": counts["swaps"] / hours if hours else None,
        "trusted_swaps": int(counts["trusted_swaps"]),
        **track_figures(counts),
        "joint_error_apart_mm": ratio("apart_mm", "n_apart"),
        "joint_error_contact_mm": ratio("contact_mm", "n_contact"),
        "abstained": ratio("abstained", "n_asked"),
        **crossing_figures(counts),
        "frames_per_s": ratio("n_frames", "seconds"),
        "contact_s": counts["contact_s"],
    }
    for kind in ("true", "measured"):
        own = {
            name.removeprefix(f"{kind} "): value
            for name, value in counts.items()
            if name.startswith(f"{kind} ")
        }
        figures[f"interactions_{kind}"] = deed_figures(own) if own else None
    return figures
