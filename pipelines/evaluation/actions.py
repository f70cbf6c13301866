"""Evaluation of action recognition: cut-out sequences as in Lie-X section 5.4, and uncut timelines.

`liex evaluate actions` generates behaviour of virtual fish or mice, renders, measures and tracks
it, and scores two recognisers on individuals that neither was trained on:

- cut-out sequences of single actions (for fish 426 for training and 173 for testing): plain
  accuracy of the paper's forest (50 trees, depth 20, temporal pyramid) on tangent vectors and on
  joint positions, mean of 5 seeds with Wilson's 95 % interval, and of the default recogniser;
  confusion matrices as in Fig 20;
- uncut recordings of novel individuals (`minutes` in all): macro F1 of frames, and F1 of bouts that
  overlap by at least half (intersection over union), at the usual frame rate, at 15 and 30 Hz and
  at 100 Hz; a decision tree on speed alone as the lower bound; time for an hour's track;
- number of their bouts that contradict the printed definition of their action, with and without the
  check of `liex run`.

With `--tracks` it scores words against those of people in 3D points of real mice instead, by
`TRACKS_PROTOCOL`.
"""

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from liex_lab.dashboards.paper.figures import draw_confusions
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestClassifier
from sklearn.metrics import f1_score
from sklearn.tree import DecisionTreeClassifier

from liex_lab.actions import channels, ethogram, learning, storage, vocabulary
from liex_lab.actions.labels import (
    Array,
    LabelledTrack,
    confusion,
    interval95,
    timeline_scores,
    words_of,
)
from liex_lab.actions.timeline import TimelineModel
from liex_lab.behaviour.bouts import measure_bouts, recognise
from liex_lab.behaviour.kinematics import Joints, kinematics
from liex_lab.behaviour.summary import measure_rows
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.exchange.points import READERS, PointNames, read_points
from liex_lab.plan import Plan
from liex_lab.runtime.progress import Progress, silent
from liex_lab.tables.rows import Rows, bout_rows

from ..points import check_track, track_of_points
from ..training.action_model import (
    FAST_HZ,
    N_USUAL,
    RATE_HZ,
    AgentTrack,
    acted,
    acted_tracks,
    cut_sequences,
    read_any_labels,
    test_recordings,
    train_actions,
    training_recordings,
)
from ..training.pose_model import cache_folder, estimator_of

_SEEDS = 5
_SLOWER_HZ = (15.0, 30.0)
_MAIN = ("macro_f1", "segment_f1_50")

PROTOCOL = (
    "Virtual animals act by kinematic definitions, are rendered in depth, measured frame by frame "
    "and tracked as `liex run` tracks; every feature comes from these tracks, whose mean joint "
    "error is track_error_mm. Cut-out sequences: {n_train} to learn from and {n_test} to test on, "
    "of different individuals; tangent_accuracy and joint_accuracy: forests of 50 trees, depth "
    "20, mean of {seeds} seeds, with Wilson's 95 % interval, which takes sequences as independent "
    "though one individual did many of them. default_accuracy: the timeline's "
    "recogniser on the same sequences. timeline: {minutes:.0f} minutes of uncut recordings of "
    "{animals} individuals whose traits lie outside those it learned from; macro_f1: mean over "
    "the actions of the frame-wise F1; segment_f1_50: bouts that share at least half of what "
    "either covers. by_fps: a slower camera has of the same recordings the frames nearest to its "
    "times, and the tracker nothing else; at {fast:g} frames per second the first "
    "{fast_minutes:.0f} minutes of the same ones are rendered again, frame by frame. lost_by_fps: "
    "what that is less than at the usual rate over the same time. speed_only_macro_f1: a decision "
    "tree on speed alone, to show that speed does not solve the task. contradictions: bouts of the "
    "same uncut recordings that break a measured limit of their word's printed definition, without "
    "and with the check that `liex run` makes. one_hour: the time that features and recognition of "
    "an hour's track take; core_seconds: of the machine's cores, whatever else they did."
)


def evaluate_actions(
    animal: str = "fish",
    *,
    model: str | Path | None = None,
    pose_model: str | Path | None = None,
    minutes: float = 30.0,
    figure: Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Score action recognition on cut-out sequences and uncut virtual recordings.

    Args:
        animal: `fish` or `mouse`.
        model: an action model; None uses the bundled one or, if absent, trains one.
        pose_model: another model than the animal's own for measuring the frames.
        minutes: total length of the uncut test recordings.
        figure: PNG of the confusion matrices; None draws none.
        progress: called with the progress of rendering and measuring.

    Returns:
        Accuracies, confusion matrices, `timeline`, `by_fps`, `lost_by_fps`, `contradictions`,
        `speed_only_macro_f1`, `track_error_mm`, `one_hour`, `unresolved` actions by frame rate, and
        the protocol.

    Raises:
        LiexError: no actions are generated for this animal.
    """
    if animal not in RATE_HZ:
        raise LiexError(
            f"actions are generated for {' and '.join(RATE_HZ)}, not for {animal}; name one of "
            "these"
        )
    estimator = estimator_of(animal, "default", progress, pose_model)
    recogniser = _recogniser(animal, model, pose_model, progress)
    learners = training_recordings(animal)[:N_USUAL]
    if animal == "fish":  # other animals' cut-out sequences come from these, too
        # every third recording of fish trains the tree on speed alone
        learners = learners[::3]
    learned = acted_tracks(learners, estimator, progress)
    recordings = acted(test_recordings(animal, False, minutes), estimator, progress)
    fast = acted(test_recordings(animal, True, minutes), estimator, progress)
    progress(0, None, "tracking and naming")
    tracks = [one.tracked() for one in recordings]
    if animal == "fish":
        train, test = (
            acted_tracks(cut_sequences(animal, side), estimator, progress) for side in (False, True)
        )
    else:
        train = cut_out(learned)
        test = cut_out(tracks)
    timeline, by_fps, lost = _timelines(recogniser, recordings, tracks, fast, RATE_HZ[animal])
    result = {
        "animal": animal,
        **sequence_scores(train, test, recogniser),
        "timeline": timeline,
        "by_fps": by_fps,
        "lost_by_fps": lost,
        "contradictions": contradictions(recogniser, tracks),
        "speed_only_macro_f1": speed_only(learned, tracks, recogniser),
        "track_error_mm": track_error_mm(tracks),
        "one_hour": one_hour(recogniser, tracks[0]),
        "unresolved": {
            f"{rate:g}": recogniser.unresolved((np.arange(9) / rate * 1e9).astype(np.int64))
            for rate in (*_SLOWER_HZ, RATE_HZ[animal])
        },
        "protocol": PROTOCOL.format(
            n_train=len(train),
            n_test=len(test),
            seeds=_SEEDS,
            minutes=sum(float(np.ptp(one.track.times_ns[[0, -1]])) for one in tracks) / 60e9,
            animals=len(tracks),
            fast=FAST_HZ,
            fast_minutes=sum(one.observations.seconds[-1] for one in fast) / 60.0,
        ),
    }
    if figure is not None:
        draw_confusions(result, figure)
    return result


def sequence_scores(
    train: Sequence[LabelledTrack], test: Sequence[LabelledTrack], recogniser: TimelineModel
) -> dict[str, Any]:
    """Accuracy on cut-out actions of the paper's forest, with either descriptor, and of ours.

    Args:
        train: cut-out sequences to train the paper's forests on.
        test: cut-out sequences to recognise.
        recogniser: the default recogniser, already trained.

    Returns:
        Accuracies (0 to 1), the forests' by seed as well, 95 % intervals by Wilson, and confusion
        matrices (rows: true), those of the forests for their first seed.
    """
    true = [str(one.words[0]) for one in test]
    n = len(test)
    words = sorted(set(true))
    found = paper_names(train, test)
    shares = {
        kind: float(np.mean([_share(true, names) for names in all_of]))
        for kind, all_of in found.items()
    }
    own = [recogniser.name(one.track, one.wall_mm) for one in test]
    shares["default"] = _share(true, own)
    return {
        "tangent_accuracy": shares["tangent"],
        "joint_accuracy": shares["joints"],
        "default_accuracy": shares["default"],
        "accuracy_interval95": {kind: interval95(share * n, n) for kind, share in shares.items()},
        "accuracy_by_seed": {
            kind: [_share(true, names) for names in all_of] for kind, all_of in found.items()
        },
        "confusion": {
            "words": words,
            "tangent": confusion(true, found["tangent"][0], words),
            "joints": confusion(true, found["joints"][0], words),
            "default": confusion(true, own, words),
        },
    }


def _recogniser(
    animal: str, model: str | Path | None, pose_model: str | Path | None, progress: Progress
) -> TimelineModel:
    """The named model, the bundled one, or one that is trained now."""
    if model is not None or animal in storage.bundled_action_models():
        return storage.load_action_model(model or animal)
    out = cache_folder() / f"{animal}-actions"
    return storage.load_action_model(
        train_actions(out, animal=animal, pose_model=pose_model, progress=progress)[0]
    )


def cut_out(tracks: Sequence[LabelledTrack]) -> list[LabelledTrack]:
    """Every named bout of at least seven frames as a track of its own."""
    return [
        one[slice(start, stop)]
        for one in tracks
        for start, stop, word in zip(*ethogram.runs_of(one.words), strict=True)
        if word and stop - start >= 7
    ]


def paper_names(
    train: Sequence[LabelledTrack], test: Sequence[LabelledTrack]
) -> dict[str, list[list[str]]]:
    """The actions that the paper's forests assign to test sequences, by descriptor and seed.

    A forest has 50 trees, 20 deep.

    Returns:
        For each descriptor (`tangent`, `joints`) and seed, one action per test sequence.
    """
    words = [str(one.words[0]) for one in train]
    found = {}
    for kind, described in learning.DESCRIPTORS.items():
        rows, asked = (np.stack([described(one.track) for one in some]) for some in (train, test))
        forests = (RandomForestClassifier(50, max_depth=20, random_state=k) for k in range(_SEEDS))
        found[kind] = [forest.fit(rows, words).predict(asked).tolist() for forest in forests]
    return found


def _timelines(
    recogniser: TimelineModel,
    recordings: Sequence[AgentTrack],
    tracks: Sequence[LabelledTrack],
    fast: Sequence[AgentTrack],
    rate_hz: float,
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Scores on uncut recordings, the main two at other frame rates, and the losses at each."""
    usual = _scores(recogniser, tracks)
    alike = _scores(
        recogniser,
        [
            one[
                : int(np.searchsorted(one.track.times_ns, other.observations.times_ns[-1], "right"))
            ]
            for one, other in zip(tracks, fast, strict=True)
        ],
    )
    at = {
        rate: _scores(recogniser, [one.tracked(rate) for one in recordings])
        for rate in _SLOWER_HZ
        if rate < rate_hz
    }
    at[FAST_HZ] = _scores(recogniser, [one.tracked() for one in fast])
    by_fps = {
        f"{rate:g}": {name: row[name] for name in _MAIN}
        for rate, row in sorted({**at, rate_hz: usual}.items())
    }
    lost = {
        f"{rate:g}": {
            name: (alike if rate == FAST_HZ else usual)[name] - row[name] for name in _MAIN
        }
        for rate, row in at.items()
    }
    return usual, by_fps, lost


def contradictions(
    recogniser: TimelineModel, tracks: Sequence[LabelledTrack]
) -> dict[str, dict[str, Any]]:
    """Number of bouts that contradict their printed definition, as in the table `bouts`.

    Returns:
        `unchecked` and `checked` (as in `liex run`), each with the numbers of `bouts`, of
        `contradicting` ones, and of these `by_word`.
    """
    meanings = vocabulary.printed_meanings(recogniser.skeleton, recogniser.definitions)
    tables: dict[str, list[pd.DataFrame]] = {"unchecked": [], "checked": []}
    for one in tracks:
        frames = Rows(one.track, np.arange(one.track.n_frames), "", "").frames_table
        moved = kinematics(frames, Joints.of_track(one.track))
        for name, found in (
            ("unchecked", recogniser.recognise(one.track, one.wall_mm)),
            ("checked", recognise(recogniser, one.track, one.wall_mm, moved)),
        ):
            bouts = bout_rows(found.ethogram, frames, "")
            tables[name].append(measure_bouts(bouts, moved, meanings))
    counted = {}
    for name, some in tables.items():
        wrong = [word for bouts in some for word in bouts["action"][bouts["contradicts"] != ""]]
        counted[name] = {
            "bouts": sum(map(len, some)),
            "contradicting": len(wrong),
            "by_word": {word: wrong.count(word) for word in sorted(set(wrong))},
        }
    return counted


def track_error_mm(tracks: Sequence[LabelledTrack]) -> float:
    """Mean distance of the tracked from the true joints, mm, over the measured frames."""
    off = [
        np.linalg.norm(one.track.joints_mm - np.asarray(one.truth), axis=-1)[one.track.observed]
        for one in tracks
    ]
    return float(np.concatenate(off).mean())


def one_hour(
    recogniser: TimelineModel, one: LabelledTrack, hour_s: float = 3600.0
) -> dict[str, float]:
    """Seconds for features and recognition of an hour's track, made by repeating a given one.

    Args:
        recogniser: a trained recogniser.
        one: the track that is repeated.
        hour_s: length of the long track, s.

    Returns:
        `frames`, elapsed `seconds`, `core_seconds` of this process, and `cores` of the machine.
    """
    usual = float(np.median(np.diff(one.track.times_ns))) * 1e-9
    n = round(hour_s / usual)
    hour = replace(
        one[np.arange(n) % len(one)].track,
        times_ns=np.round(np.arange(n) * usual * 1e9).astype(np.int64),
    )
    wall = None if one.wall_mm is None else one.wall_mm[np.arange(n) % len(one)]
    recognise(recogniser, one.track, one.wall_mm)  # compiles
    began = time.perf_counter()
    worked = time.process_time()
    recognise(recogniser, hour, wall)
    return {
        "frames": n,
        "seconds": time.perf_counter() - began,
        "core_seconds": time.process_time() - worked,
        "cores": float(os.cpu_count() or 1),
    }


def _scores(recogniser: TimelineModel, tracks: Sequence[LabelledTrack]) -> dict[str, Any]:

    return timeline_scores(
        (
            (one, recognise(recogniser, one.track, one.wall_mm).ethogram.words(one.track.times_ns))
            for one in tracks
        ),
        recogniser.words,
    )


def speed_only(
    train: Sequence[LabelledTrack], test: Sequence[LabelledTrack], recogniser: TimelineModel
) -> float:
    """Macro F1 of a decision tree on the current speed alone.

    It shows that the task is not solved by speed alone. The tree has depth 8 and at least 50
    samples per leaf, and classes are balanced.
    """
    (x, y), (asked, true) = (_speeds(some, recogniser.clock_hz) for some in (train, test))
    tree = DecisionTreeClassifier(
        max_depth=8, class_weight="balanced", min_samples_leaf=50, random_state=0
    ).fit(x, y)
    return float(
        f1_score(
            true,
            tree.predict(asked),
            labels=[word for word in recogniser.words if word],
            average="macro",
            zero_division=0.0,
        )
    )


def _speeds(tracks: Sequence[LabelledTrack], clock_hz: float) -> tuple[Array, NDArray[np.str_]]:

    speeds = []
    words = []
    for one in tracks:
        time_s = one.track.times_ns * 1e-9
        column = channels.channel_names(one.track.skeleton).index("speed")
        for segment in channels.segments_of(one.track, clock_hz):
            row = np.searchsorted(time_s, segment.times_s - 0.5 / clock_hz).clip(0, len(time_s) - 1)
            speeds.append(segment.values[:, [column]])
            words.append(one.words[row])
    return np.concatenate(speeds), np.concatenate(words)


TRACKS_PROTOCOL = (
    "3D points of {n_recordings} recordings of {n_animals} animals, placed on our joints as by "
    "`liex import points`. Frame-wise F1 = 2 hits / (found + true), summed over the frames that a "
    "person gave a word; macro_f1: mean over the person's words. rules: the thresholds of "
    "[behaviour]; bundled: the recogniser trained on virtual mice. taught: a recogniser trained by "
    "these labels on all other animals, which names each frame by the most probable of the "
    "person's words; without_z: the same without heights. Intervals: 95 %, by bootstrap over "
    "recordings ({n_draws} draws), of a single animal over its minutes."
)
_WORDS = {  # our words by those of most labels
    **dict.fromkeys(("rear", "rear_supported", "rear_unsupported"), "rearing"),
    **dict.fromkeys(("walk", "run"), "walking"),
    "pause": "standing",
    "groom": "grooming",
}
_NO_WORD = ("", "na", "none", "nan")
_DRAWS = 2000


def evaluate_tracks(
    folder: str | Path, *, names: str | Path | None = None, progress: Progress = silent
) -> dict[str, Any]:
    """Score rules and recognisers against people's words in 3D points of real mice.

    Args:
        folder: files of points, see `liex_lab.exchange.points.read_points`, each with `label` (n,)
            in it, or with NAME.labels.csv or NAME.boris beside it.
        names: a table of names (TOML); its `words` and `animals` are read as well. An animal is
            the part of a file's name after its last _.
        progress: called with the stage.

    Returns:
        `rearing_f1_...` and `macro_f1_...` of rules, bundled, taught and taught_without_z;
        `interval95` of each; `per_animal` with both; the numbers of recordings and animals; and
        the protocol.

    Raises:
        LiexError: a file cannot be used, has no labels or none of the stated words, or there is one
            animal only.
    """
    table = PointNames.load(names)
    ours = table.words or _WORDS
    pairs = [
        _people(path, table)
        for path in sorted(Path(folder).glob("*"))
        if path.suffix in READERS and not path.name.endswith(".labels.csv")
    ]
    people = [one for one, _ in pairs]
    animals = sorted({one.animal for one in people})
    words = [word for word in dict.fromkeys(ours.values()) if any(word in p.words for p in people)]
    if len(animals) < 2 or ours.get("rear") not in words:
        raise LiexError(
            f"files of at least two animals with the word {ours.get('rear')} are needed, and "
            f"{folder} has {len(people)} of {len(animals)} with {', '.join(words) or 'no word'}; "
            "state animals and words in the table of names (--names)"
        )
    found = {
        "rules": [_named(one, ours) for one in people],
        "bundled": [
            *map(partial(_named, ours=ours, model=storage.load_action_model("mouse")), people)
        ],
        "taught": _taught(people, words, progress),
        "taught_without_z": _taught([flat for _, flat in pairs], words, progress),
    }
    counts = {
        name: [_counted(one, other, words) for one, other in zip(people, named, strict=True)]
        for name, named in found.items()
    }
    score = partial(_scored, rearing=words.index(ours["rear"]))
    n_all = {"n_recordings": len(people), "n_animals": len(animals)}
    return {
        **score({name: np.stack([c.sum(axis=0) for c in of]) for name, of in counts.items()}),
        "per_animal": {
            animal: score(
                {
                    name: np.concatenate(
                        [n for n, one in zip(of, people, strict=True) if one.animal == animal]
                    )
                    for name, of in counts.items()
                }
            )
            for animal in animals
        },
        "words": words,
        **n_all,
        "protocol": TRACKS_PROTOCOL.format(**n_all, n_draws=_DRAWS),
    }


def _people(path: Path, table: PointNames) -> tuple[LabelledTrack, LabelledTrack]:
    """The track of a file with people's words, and the same one without heights."""
    skeleton, plan = Skeleton.load("mouse"), Plan.load("mouse")
    points = read_points(path, table)
    words = points.words
    if words is None:
        boris, labels = path.with_suffix(".boris"), path.with_suffix(".labels.csv")
        words = words_of(read_any_labels(boris if boris.is_file() else labels), points.time_s)
    if len(words) != len(points.time_s):
        raise LiexError(
            f"{path} has {len(points.time_s)} frames and {len(words)} labels; each frame needs one"
        )
    track, other = (
        track_of_points(
            replace(points, points_mm=points.points_mm * [1.0, 1.0, height]),
            skeleton,
            table.of_joints(skeleton.names, points.names),
            plan.tracking.bridge_s,
        )
        for height in (1.0, 0.0)
    )
    check_track(track, plan)
    one = LabelledTrack(
        track,
        np.where(np.isin(words, _NO_WORD), ethogram.UNLABELLED, words),
        table.animals.get(path.stem, path.stem.rpartition("_")[2]),
        np.full(track.n_frames, np.nan),
    )
    return one, replace(one, track=other)


def _named(
    one: LabelledTrack, ours: Mapping[str, str], model: TimelineModel | None = None
) -> NDArray[np.str_]:
    """The words (n,) of a track by a recogniser, or by the rules, in the person's terms."""
    rows = Rows(one.track, np.arange(len(one)), "", "")
    named = (
        words_of(measure_rows(rows).bouts, rows.time_s)
        if model is None
        else recognise(model, one.track).ethogram.words(one.track.times_ns)
    )
    return np.array([ours.get(str(word), "") for word in named])


def _taught(
    people: Sequence[LabelledTrack], words: Sequence[str], progress: Progress
) -> list[NDArray[np.str_]]:
    """The likeliest word (n,) of each frame by a recogniser taught by the other animals."""
    found = {}
    for animal in sorted({one.animal for one in people}):
        progress(0, None, f"learning without {animal}")
        model = learning.learn([one for one in people if one.animal != animal])
        known = [k for k, word in enumerate(model.words) if word in words]
        for k, one in enumerate(people):
            if one.animal == animal:
                p = np.nan_to_num(model.recognise(one.track).probability[:, known])
                found[k] = np.array(model.words)[known][p.argmax(axis=1)]
    return [found[k] for k in range(len(people))]


def _counted(one: LabelledTrack, found: NDArray[np.str_], words: Sequence[str]) -> Array:
    """Frames (minutes, K, 3) hit, found and true of each word, of those with a person's word."""
    minute = (one.track.times_ns // 60_000_000_000).astype(int)
    return np.array(
        [
            [
                np.bincount(minute, mask)
                for mask in (hit & true, hit & (one.words != ethogram.UNLABELLED), true)
            ]
            for hit, true in ((found == word, one.words == word) for word in words)
        ],
        float,
    ).transpose(2, 0, 1)


def _scored(counts: Mapping[str, Array], rearing: int) -> dict[str, Any]:
    """Scores and their intervals from counts (units, K, 3) of each method."""
    scores: dict[str, Any] = {}
    intervals: dict[str, list[float]] = {}
    for name, of in counts.items():
        drawn = np.random.default_rng(0).integers(0, len(of), (_DRAWS, len(of)))
        sums = np.concatenate([of.sum(axis=0, keepdims=True), of[drawn].sum(axis=1)])
        with np.errstate(invalid="ignore"):
            f1 = np.where(sums[..., 2] > 0, 2.0 * sums[..., 0] / sums[..., 1:].sum(-1), np.nan)
        for kind, values in (("rearing_f1", f1[:, rearing]), ("macro_f1", np.nanmean(f1, axis=1))):
            scores[f"{kind}_{name}"] = float(values[0])
            intervals[f"{kind}_{name}"] = np.nanquantile(values[1:], (0.025, 0.975)).tolist()
    return {**scores, "interval95": intervals}


def _share(true: Sequence[str], found: Sequence[str]) -> float:
    return float(np.mean([a == b for a, b in zip(true, found, strict=True)]))
