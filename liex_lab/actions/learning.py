"""Training of the default recogniser: multilayer perceptrons and a semi-Markov model.

Two networks with one hidden layer of 64 rectified units on standardised window features, trained by
Adam on cross-entropy (`mlp.descend`); durations and transitions come from counts of bouts.
Validation is leave-one-animal-out. The paper's recogniser, forests over descriptors of a sequence,
serves as the baseline.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from liex_lab.actions.ethogram import UNLABELLED, runs_of
from liex_lab.actions.labels import LabelledTrack, timeline_scores
from liex_lab.actions.timeline import (
    CLOCK_HZ,
    CLOCKS_HZ,
    Examples,
    Recognised,
    SemiMarkovModel,
    TimelineModel,
    gather,
)
from liex_lab.arrays import Array, NDArray
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3, so3
from liex_lab.mlp import LIMIT, Network, descend
from liex_lab.runtime.progress import Progress, silent
from liex_lab.tracking.track import Track

_HIDDEN = 64
_EPOCHS = 10
_BATCH = 512
# with few labels, train for more epochs: up to about so many steps, at most so many epochs
_LEAST_STEPS = 1500
_MOST_EPOCHS = 200
# quantiles that bound a word's usual speed
_USUAL = (0.005, 0.99)
_FAST = 1.0  # lengths per second, mean of a bout of a fast action
_NEVER = -30.0  # the logit of a word without training data


def learn(
    tracks: Sequence[LabelledTrack],
    *,
    seed: int = 0,
    definitions: dict[str, str] | None = None,
    sequences: Sequence[LabelledTrack] = (),
    progress: Progress = silent,
) -> TimelineModel:
    """A recogniser trained on labelled tracks.

    Args:
        tracks: labelled recordings of one kind of animal, at least one.
        seed: of the first network; the second uses the next.
        definitions: word -> definition, stored in the model.
        sequences: single cut-out actions: they train the networks, not the order and length of
            actions.
        progress: reports the stages.

    Returns:
        The model, without a card.

    Raises:
        LiexError: the labels name too few actions, see `vocabulary_of`.
    """
    words = vocabulary_of([*tracks, *sequences])
    skeleton = tracks[0].track.skeleton.name
    clock_hz = CLOCKS_HZ.get(skeleton, CLOCK_HZ)
    progress(0, 3, "features of the labelled recordings")
    examples = gather([*tracks, *sequences], words, clock_hz)
    progress(1, 3, "training the networks")
    networks = tuple(train_network(examples, len(words), seed + k) for k in range(2))
    share = np.bincount(examples.code, minlength=len(words)) / len(examples.code)
    speeds, peaks = speeds_of(examples, len(words))
    return TimelineModel(
        skeleton,
        clock_hz,
        words,
        share,
        networks,
        SemiMarkovModel.learn(examples.runs[: len(tracks)], len(words)),
        0.1,
        speeds,
        peaks,
        definitions or {},
    )


def vocabulary_of(tracks: Sequence[LabelledTrack]) -> tuple[str, ...]:
    """The K words of labelled tracks, `UNLABELLED` first, then sorted.

    Raises:
        LiexError: fewer than two actions, and no frame without one.
    """
    found = sorted({str(word) for one in tracks for word in np.unique(one.words)} - {UNLABELLED})
    if len(found) < 2 and not any((one.words == UNLABELLED).any() for one in tracks):
        raise LiexError(
            "labels of at least two actions, or of one and stretches without it, are needed; got "
            f"{found or 'none'}"
        )
    return (UNLABELLED, *found)


def speeds_of(examples: Examples, n_words: int) -> tuple[Array, Array]:
    """The range of each word's speed, and the least peak speed of its bouts.

    The range is from the 0.5 % to the 99 % quantile over the word's ticks; 0 to infinity for
    `UNLABELLED` and words without ticks. The peak is the one that 99 % of the bouts of a fast word
    exceed; a word is fast if the median over its bouts of their mean speed is above one length per
    second. Other words have 0, because another animal may be slower than all animals of the
    training data.

    Args:
        examples: the training data.
        n_words: size K of the vocabulary, `UNLABELLED` first.

    Returns:
        (K, 2) and (K,) body lengths per second.
    """
    limits, least = np.tile([0.0, np.inf], (n_words, 1)), np.zeros(n_words)
    starts, stops, codes = runs_of(examples.code + n_words * examples.recording)
    peak = np.maximum.reduceat(examples.speed, starts)
    mean = np.add.reduceat(examples.speed, starts) / (stops - starts)
    for k in range(1, n_words):  # 0 is UNLABELLED
        own = codes % n_words == k
        if own.any():
            limits[k] = np.quantile(examples.speed[examples.code == k], _USUAL)
            if np.median(mean[own]) > _FAST:
                least[k] = np.quantile(peak[own], 0.01)
    return limits, least


def train_network(examples: Examples, n_words: int, seed: int) -> Network:
    """A multilayer perceptron with one hidden layer, trained by Adam, see `descend`.

    More than 120 000 ticks are subsampled. Words without ticks get a logit of -30.

    Args:
        examples: the training data.
        n_words: size K of the vocabulary.
        seed: of the weights and of the subsample.

    Returns:
        The network, float32, with the standardisation of its features.
    """
    step = max(1, -(-len(examples.code) // 120_000))
    rows = np.arange(seed % step, len(examples.code), step)
    features = examples.features[rows]
    code = examples.code[rows]
    centre = features.mean(axis=0)
    scale = features.std(axis=0) + 1e-6
    inputs = np.clip((features - centre) / scale, -LIMIT, LIMIT)
    batch = int(np.clip(len(code) // 8, 1, _BATCH))
    epochs = max(_EPOCHS, min(_MOST_EPOCHS, _LEAST_STEPS * batch // len(code)))
    present = np.unique(code)  # of the vocabulary; unlabelled stretches may be missing
    first, (weights, bias) = descend(
        inputs,
        code,
        (_HIDDEN,),
        epochs=epochs,
        batch=batch,
        rate=1.5e-3,
        least_rate=1e-5,
        weight_decay=2e-3,
        seed=seed,
    )
    if len(present) == 2:  # one logit decides between two words
        weights = np.hstack([0 * weights, weights])
        bias = np.hstack([0 * bias, bias])
    last = np.zeros((_HIDDEN, n_words)), np.full(n_words, _NEVER)
    last[0][:, present], last[1][present] = weights, bias
    return Network(
        centre.astype(np.float32),
        scale.astype(np.float32),
        tuple((w.astype(np.float32), b.astype(np.float32)) for w, b in (first, last)),
    )


def leave_one_animal_out(
    tracks: Sequence[LabelledTrack], *, seed: int = 0, progress: Progress = silent
) -> dict[str, Any]:
    """Cross-validation: scores on each animal of a recogniser trained on the others.

    Args:
        tracks: labelled recordings.
        seed: of the networks.
        progress: reports every animal.

    Returns:
        Number of animals, macro F1 by animal, and `timeline_scores` over all; for one animal alone,
            a note instead.
    """
    animals = sorted({one.animal for one in tracks})
    if len(animals) < 2:
        return {
            "animals": len(animals),
            "note": "one animal only: nobody knows how well this works on another",
        }
    words = vocabulary_of(tracks)
    held_out: dict[str, Any] = {}
    pairs: list[tuple[LabelledTrack, NDArray[np.str_]]] = []
    for k, animal in enumerate(animals):
        progress(k, len(animals), f"learning without {animal}")
        model = learn([one for one in tracks if one.animal != animal], seed=seed)
        own = [
            (one, model.recognise(one.track, one.wall_mm).ethogram.words(one.track.times_ns))
            for one in tracks
            if one.animal == animal
        ]
        held_out[animal] = timeline_scores(own, words)["macro_f1"]
        pairs += own
    return {
        "animals": len(animals),
        "macro_f1_by_animal": held_out,
        **timeline_scores(pairs, words),
    }


def with_card(model: TimelineModel, **facts: Any) -> TimelineModel:
    """A copy of the model with more facts on its card; they replace facts of the same name."""
    return replace(model, card={**model.card, **facts})


# Active learning by uncertainty sampling: which segments of a recording to label next.


_STEP = 0.5  # between the starts of two windows, as a fraction of a window's length


def doubtful_segments(
    found: Recognised, times_ns: NDArray[np.int64], n: int, window_s: float
) -> list[dict[str, Any]]:
    """The least certain segments, in turns over the pairs of words that are confused.

    The best segment of each pair comes first, then the second best. Windows start every half of
    their length; selected windows do not overlap.

    Args:
        found: the result of recognising the recording.
        times_ns: (n,) timestamps.
        n: the maximum number of segments.
        window_s: length of a segment, s.

    Returns:
        At most n dicts of start_s, stop_s, uncertainty (mean entropy of the words' probabilities
            over its largest value, 0 to 1), guess and or_else (the two most probable words).
    """
    p = np.clip(np.nan_to_num(found.probability, nan=0.0), 1e-9, 1.0)
    known = np.isfinite(found.probability[:, 0])
    entropy = np.where(known, -(p * np.log(p)).sum(axis=1) / np.log(p.shape[1]), 0.0)
    time_s = (times_ns - times_ns[:1]) * 1e-9
    starts = np.arange(0.0, max(time_s[-1] - window_s, 0.0) + 1e-9, _STEP * window_s)
    low = np.searchsorted(time_s, starts)
    high = np.searchsorted(time_s, starts + window_s)
    total = np.concatenate([[0.0], np.cumsum(entropy)])
    mean = (total[high] - total[low]) / np.maximum(high - low, 1)
    taken = np.zeros(len(time_s), bool)
    pairs: dict[tuple[int, ...], int] = {}
    rows: list[tuple[int, float, int, dict[str, Any]]] = []
    for k in np.argsort(-mean, kind="stable"):
        a = int(low[k])
        b = int(high[k])
        if b <= a or taken[a:b].any() or mean[k] <= 0:
            continue
        first, second = np.argsort(-p[a:b].mean(axis=0))[:2]
        taken[a:b] = True
        pair = tuple(sorted((int(first), int(second))))
        pairs[pair] = pairs.get(pair, 0) + 1
        row = {
            "start_s": float(time_s[a]),
            "stop_s": float(starts[k] + window_s),
            "uncertainty": float(mean[k]),
            "guess": found.words[first] or "unlabelled",
            "or_else": found.words[second] or "unlabelled",
        }
        rows.append((pairs[pair], -float(mean[k]), len(rows), row))
        if len(rows) >= 6 * n:
            break
    return [row for *_, row in sorted(rows, key=lambda entry: entry[:3])[:n]]


# Random forest on temporal-pyramid descriptors of cut-out sequences (Lie-X section 4.3).


N_FRAMES = 32


def tangent_descriptor(track: Track) -> Array:
    """The temporal pyramid over a sequence's tangent vectors.

    Frames without a measured pose are left out; a sequence with fewer than two poses has no
    movement. The end-effector has no rotation and is left out of the hind half.

    Args:
        track: the sequence, of a skeleton that is one chain.

    Returns:
        (252,), rad and mm.
    """
    root, angles = _resampled(track)
    now, following = (
        SE3(root.rotation[part], root.translation[part])
        for part in (slice(None, -1), slice(1, None))
    )
    step = (now.inverse() @ following).log()
    base = np.concatenate([step, step[-1:]])
    change = np.diff(angles, axis=0)
    change = np.concatenate([change, change[-1:]])
    # for the fish, joints 2 to 10 and 11 to the last in the paper's count from the base
    middle = max(2, (track.skeleton.n_joints - 1) // 2)
    halves = [
        rows[:, part].mean(axis=1)
        for part in (slice(1, middle), slice(middle, -1))
        for rows in (angles, change)
    ]
    return pyramid(np.concatenate([base, *halves], axis=1))


def position_descriptor(track: Track) -> Array:
    """The temporal pyramid over a sequence's joint positions, and the base's mean pose.

    Args:
        track: the sequence.

    Returns:
        (42 J + 6,), 888 for a fish's 21 joints: mm, arena frame, then the base's mean position, mm,
            and mean rotation vector, rad; zeros if fewer than two poses were measured.
    """
    observed = track.observed
    if observed.sum() < 2:
        return np.zeros(14 * 3 * track.skeleton.n_joints + 6)
    joints = _lerp(track.joints_mm[observed], _places(observed.sum()))
    root = track[observed].root
    base = np.concatenate([root.translation.mean(axis=0), so3.log(so3.mean(root.rotation))])
    return np.concatenate([pyramid(joints.reshape(N_FRAMES, -1)), base])


def pyramid(rows: Array) -> Array:
    """Mean and standard deviation over quarters, halves and the whole.

    Args:
        rows: (32, k) features of each frame.

    Returns:
        (14 k,) for each of the 7 parts, k means and k standard deviations.
    """
    # equal parts, each described by its mean and standard deviation
    parts = [part for n in (4, 2, 1) for part in np.split(rows, n)]
    return np.concatenate([np.concatenate([part.mean(axis=0), part.std(axis=0)]) for part in parts])


def _resampled(track: Track) -> tuple[SE3, Array]:
    """Base T_arena_root (32) along geodesics and joint angles (32, J, 3) of the observed frames."""
    observed = track.observed
    n = int(observed.sum())
    if n < 2:
        return SE3.identity(N_FRAMES), np.zeros((N_FRAMES, track.skeleton.n_joints, 3))
    kept = track[observed]
    at = _places(n)
    low = np.minimum(at.astype(int), n - 2)
    before, after = (SE3(kept.root_rotation[rows], kept.root_mm[rows]) for rows in (low, low + 1))
    return before.geodesic(after, at - low), _lerp(kept.angles_rad, at)


def _places(n: int) -> Array:
    """Fractional indices (32,) of the resampled frames among n frames."""
    return np.linspace(0.0, n - 1.0, N_FRAMES)


def _lerp(values: Array, at: Array) -> Array:
    """Rows of values (n, ...) at fractional indices (32,)."""
    low = np.minimum(at.astype(int), len(values) - 2)
    share = (at - low).reshape(-1, *([1] * (values.ndim - 1)))
    return values[low] * (1.0 - share) + values[low + 1] * share


DESCRIPTORS: dict[str, Callable[[Track], Array]] = {
    "tangent": tangent_descriptor,
    "joints": position_descriptor,
}
