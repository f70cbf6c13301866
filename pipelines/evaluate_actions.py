"""The job `liex evaluate actions`: the paper's recogniser and ours, on cut-out actions and on uncut recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from liex_lab.pipelines.acted import acted_tracks
from liex_lab.pipelines.action_data import (
    RATE_HZ,
    by_usual_camera,
    cut_sequences,
    test_recordings,
    training_recordings,
)
from liex_lab.pipelines.actions import train_actions
from liex_lab.pipelines.evaluate import estimator_of
from liex_lab.pipelines.train import cache_folder
from numpy.typing import NDArray

from liex_lab.errors import LiexError
from liex_lab.progress import Progress, silent

if TYPE_CHECKING:
    from liex_lab.actions.labelled import LabelledTrack
    from liex_lab.actions.timeline import TimelineModel
    from liex_lab.estimation.estimator import PoseEstimator

Array = NDArray[np.float64]

_SEEDS = 5
_RATES_HZ = (15.0, 30.0)  # as slower cameras see the recordings; a faster one films the same animals once more
_LEAST_FRAMES = 7  # of a cut-out sequence

PROTOCOL = (
    "Virtual animals act by kinematic definitions, are rendered in depth and measured frame by frame; every feature "
    "comes from the measured track. Cut-out sequences: {n_train} to learn from and {n_test} to test on, of different "
    "individuals; tangent_accuracy and joint_accuracy: forests of 50 trees, depth 20, mean of {seeds} seeds, each with "
    "Wilson's 95 % interval. default_accuracy: the timeline's recogniser on the same sequences. timeline: "
    "{minutes:.0f} minutes of uncut recordings of {animals} individuals whose traits lie outside those it learned "
    "from; macro_f1: "
    "mean over the actions of the frame-wise F1; segment_f1_50: bouts that share at least half of what either covers. "
    "by_fps: the same recordings thinned out to slower rates, and the same individuals filmed at 100 per second. "
    "speed_only_macro_f1: a decision tree on speed alone, to show that the task is not told by speed."
)


def evaluate_actions(
    animal: str = "fish", *, model: str | Path | None = None, pose_model: str | Path | None = None,
    minutes: float = 30.0, progress: Progress = silent,
) -> dict[str, Any]:  # fmt: skip
    """The figures of `liex evaluate actions`. model: an action model other than the bundled one or, where there is
    none, one trained now; pose_model: that measures the frames, other than the animal's own; minutes: of uncut
    test recordings.
    """
    from liex_lab.actions.scores import confusion, interval95

    if animal not in RATE_HZ:
        raise LiexError(f"actions are generated for {' and '.join(RATE_HZ)}, not for {animal}; name one of these")
    estimator = estimator_of(animal, "default", progress, pose_model)
    recogniser = _recogniser(animal, model, pose_model, progress)
    train, test = _sequences(animal, estimator, minutes, progress)
    true = [str(one.words[0]) for one in test]
    words = sorted(set(true))
    found = paper_names(train, test)
    shares = {kind: float(np.mean([_share(true, names) for names in all_of])) for kind, all_of in found.items()}
    own = [recogniser.name(one.track, one.wall_mm) for one in test]
    recordings = acted_tracks(test_recordings(animal, False, minutes), estimator, progress)
    fast = acted_tracks(test_recordings(animal, True, minutes), estimator, progress)
    timeline, by_fps = _timelines(recogniser, recordings, fast, RATE_HZ[animal])
    speed = speed_only(acted_tracks(training_recordings(animal), estimator, progress), recordings, recogniser)
    n, seconds = len(test), sum((one.track.times_ns[-1] - one.track.times_ns[0]) * 1e-9 for one in recordings)
    return {
        "animal": animal, "tangent_accuracy": shares["tangent"], "joint_accuracy": shares["joints"],
        "default_accuracy": _share(true, own),
        "accuracy_interval95": {
            "tangent": interval95(shares["tangent"] * n, n), "joints": interval95(shares["joints"] * n, n),
            "default": interval95(_share(true, own) * n, n),
        },
        "accuracy_by_seed": {kind: [_share(true, names) for names in all_of] for kind, all_of in found.items()},
        "confusion": {
            "words": words, "tangent": confusion(true, found["tangent"][0], words),
            "joints": confusion(true, found["joints"][0], words), "default": confusion(true, own, words),
        },
        "timeline": timeline, "by_fps": by_fps, "speed_only_macro_f1": speed,
        "unresolved": {f"{rate:g}": recogniser.unresolved((np.arange(9) / rate * 1e9).astype(np.int64))
                       for rate in (*_RATES_HZ, RATE_HZ[animal])},
        "protocol": PROTOCOL.format(n_train=len(train), n_test=n, seeds=_SEEDS, minutes=seconds / 60.0,
                                    animals=len(recordings)),
    }  # fmt: skip


def _recogniser(
    animal: str, model: str | Path | None, pose_model: str | Path | None, progress: Progress
) -> TimelineModel:
    """The named model, the bundled one, or one that is trained now."""
    from liex_lab.actions.storage import bundled_action_models, load_action_model

    if model is not None or animal in bundled_action_models():
        return load_action_model(model or animal)
    out = cache_folder() / f"{animal}-actions"
    return load_action_model(train_actions(out, animal=animal, pose_model=pose_model, progress=progress)[0])


def _sequences(
    animal: str, estimator: PoseEstimator, minutes: float, progress: Progress
) -> tuple[list[LabelledTrack], list[LabelledTrack]]:
    """Cut-out actions to learn from and to test on: the fish's as in the paper, others' out of uncut recordings."""
    if animal == "fish":
        train, test = (acted_tracks(cut_sequences(animal, side), estimator, progress) for side in (False, True))
        return train, test
    usual = by_usual_camera(acted_tracks(training_recordings(animal), estimator, progress))
    return cut_out(usual), cut_out(acted_tracks(test_recordings(animal, False, minutes), estimator, progress))


def cut_out(tracks: Sequence[LabelledTrack]) -> list[LabelledTrack]:
    """Every named bout of at least seven frames by itself."""
    found = []
    for one in tracks:
        starts = np.flatnonzero(np.append(True, one.words[1:] != one.words[:-1]))
        for start, stop in zip(starts, np.append(starts[1:], len(one)), strict=True):
            if one.words[start] and stop - start >= _LEAST_FRAMES:
                found.append(one[slice(start, stop)])
    return found


def paper_names(train: Sequence[LabelledTrack], test: Sequence[LabelledTrack]) -> dict[str, list[list[str]]]:
    """Per descriptor, the words that the forests of every seed give the test sequences."""
    from liex_lab.actions.recogniser import DESCRIPTORS, SequenceForest, describe

    words, found = [str(one.words[0]) for one in train], {}
    for kind in DESCRIPTORS:
        rows, asked = (describe(kind, [one.track for one in some]) for some in (train, test))
        found[kind] = [SequenceForest.learn(kind, rows, words, seed).name(asked) for seed in range(_SEEDS)]
    return found


def _timelines(
    recogniser: TimelineModel, recordings: Sequence[LabelledTrack], fast: Sequence[LabelledTrack], rate_hz: float
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Scores on uncut recordings, and the two main ones at other frame rates."""
    usual = _scores(recogniser, recordings)
    rows = {f"{rate_hz:g}": usual}
    for rate in _RATES_HZ:
        if rate < rate_hz:
            rows[f"{rate:g}"] = _scores(recogniser, [one.at_rate(rate) for one in recordings])
    rows["100"] = _scores(recogniser, fast)
    rows[f"{rate_hz:g}, those of 100"] = _scores(recogniser, [one.at_rate(rate_hz) for one in fast])
    return usual, {name: {key: row[key] for key in ("macro_f1", "segment_f1_50")} for name, row in rows.items()}


def _scores(recogniser: TimelineModel, tracks: Sequence[LabelledTrack]) -> dict[str, Any]:
    from liex_lab.actions.scores import timeline_scores

    return timeline_scores(
        ((one, recogniser.recognise(one.track, one.wall_mm).ethogram.words(one.track.times_ns)) for one in tracks),
        recogniser.words,
    )


def speed_only(train: Sequence[LabelledTrack], test: Sequence[LabelledTrack], recogniser: TimelineModel) -> float:
    """Macro F1 of a decision tree that knows nothing but the speed of the moment."""
    from sklearn.metrics import f1_score
    from sklearn.tree import DecisionTreeClassifier

    (x, y), (asked, true) = (_speeds(some, recogniser.clock_hz) for some in (train, test))
    tree = DecisionTreeClassifier(max_depth=8, class_weight="balanced", min_samples_leaf=50, random_state=0).fit(x, y)
    named = [word for word in recogniser.words if word]
    return float(f1_score(true, tree.predict(asked), labels=named, average="macro", zero_division=0.0))


def _speeds(tracks: Sequence[LabelledTrack], clock_hz: float) -> tuple[Array, NDArray[np.str_]]:
    from liex_lab.actions.channels import channel_names, stretches_of

    speeds, words = [], []
    for one in tracks:
        time_s, column = one.track.times_ns * 1e-9, channel_names(one.track.skeleton).index("speed")
        for stretch in stretches_of(one.track, clock_hz):
            row = np.searchsorted(time_s, stretch.times_s - 0.5 / clock_hz).clip(0, len(time_s) - 1)
            speeds.append(stretch.values[:, [column]])
            words.append(one.words[row])
    return np.concatenate(speeds), np.concatenate(words)


def _share(true: Sequence[str], found: Sequence[str]) -> float:
    return float(np.mean([a == b for a, b in zip(true, found, strict=True)]))
