"""Default recogniser of uncut recordings: MLP on window features, then hidden semi-Markov decoding.

1. Channels on a fixed clock, in seconds and body lengths, from any frame rate between 15 and 120
   per second (`channels`).
2. Features over windows around each tick (`window_features`).
3. An ensemble of small networks gives p(word | tick); scores = sharpness (log p - log prior), a
   scaled likelihood (hybrid of network and Markov model, Bourlard and Morgan 1994).
4. A semi-Markov model of durations and transitions is decoded by Viterbi, with posteriors by
   forward-backward (`SemiMarkovModel`).

This method is our own; the recogniser of Lie-X section 4.3 names cut-out sequences only
(`recogniser`).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.special import softmax

from liex_lab.actions import _semi_markov_kernels as kernels
from liex_lab.actions.channels import (
    Segment,
    channel_names,
    feature_blocks,
    segments_of,
    window_features,
)
from liex_lab.actions.ethogram import UNLABELLED, Ethogram, frame_stops, runs_of
from liex_lab.actions.labels import LabelledTrack
from liex_lab.actions.vocabulary import FASTEST
from liex_lab.arrays import Array, NDArray
from liex_lab.mlp import Network
from liex_lab.recordings.timestamps import median_step
from liex_lab.runtime.memory import Allocator, blocks, check_shapes, in_windows, release_pages
from liex_lab.tracking.track import Track

_DECODED_PIECE = 8192  # ticks per block of probabilities ...
_MARGIN = 512  # ... and its margin on either side


# The hidden semi-Markov model. A bout of action k lasts d_k + Geometric ticks: at least the
# shortest usual length (8 % quantile of the labelled bouts), on average the mean length; then
# action j follows with probability follow[k, j], estimated with half a pseudo-count. Decoding is by
# Viterbi, posteriors by forward-backward over expanded states (`_semi_markov_kernels`; Yu 2010).


@dataclass(frozen=True)
class SemiMarkovModel:
    """Durations and transitions of K actions.

    Attributes:
        shortest_s: (K,) shortest duration, s.
        mean_s: (K,) mean duration, s.
        follow: (K, K) probability that one follows another, 0 on the diagonal, rows sum to 1.
    """

    shortest_s: Array
    mean_s: Array
    follow: Array

    @staticmethod
    def learn(runs: Sequence[Sequence[tuple[int, float]]], n_words: int) -> "SemiMarkovModel":
        """The model of labelled bouts; words without bouts get default durations (0.1 s and 0.5 s).

        Args:
            runs: for each recording, the bouts (word, length in s) in order.
            n_words: size K of the vocabulary, at least 2.
        """
        lengths: list[list[float]] = [[] for _ in range(n_words)]
        counts = np.full((n_words, n_words), 0.5)
        for run in runs:
            for word, length in run:
                lengths[word].append(length)
            for (before, _), (after, _) in pairwise(run):
                counts[before, after] += 1.0
        np.fill_diagonal(counts, 0.0)
        # quantile of an action's lengths that counts as the shortest
        shortest = np.array([np.quantile(some, 0.08) if some else 0.1 for some in lengths])
        mean = np.array([np.mean(some) if some else 0.5 for some in lengths])
        return SemiMarkovModel(
            shortest, np.maximum(mean, shortest), counts / counts.sum(axis=1, keepdims=True)
        )

    def _terms(self, step_s: float) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """The kernels' `first`, `stay`, `leave` and `switch` on a clock with this step."""
        least = np.maximum(np.round(self.shortest_s / step_s).astype(np.int64), 1)
        more = np.maximum(
            self.mean_s / step_s - least, 0.5
        )  # ticks spent in the last state beyond the first
        go = more / (1.0 + more)
        with np.errstate(divide="ignore"):
            switch = np.maximum(np.log(self.follow), -1e30)
        return np.concatenate([[0], np.cumsum(least)]), np.log(go), np.log1p(-go), switch

    def decode(
        self, scores: Array, step_s: float, allocate: Allocator = np.empty
    ) -> NDArray[np.int64]:
        """The most probable sequence of words (Viterbi).

        Args:
            scores: (m, K) log scores of each tick.
            step_s: step of the clock, s.
            allocate: allocator of the back-pointers, (m, K) twice.

        Returns:
            (m,) int64 index of the word of every tick.
        """
        scores = np.ascontiguousarray(scores)
        terms = self._terms(step_s)
        check_shapes("a recording", ("scores", scores, ("m", len(terms[0]) - 1)))
        value = np.empty(terms[0][-1])
        label = np.zeros(len(scores), np.int64)
        came_from = allocate(scores.shape, np.int16)
        stayed = allocate(scores.shape, np.bool_)
        for ticks in blocks(len(scores), _DECODED_PIECE):
            kernels.go_on(ticks.start, ticks.stop, scores, *terms, value, came_from, stayed)
        kernels.trace_back(terms[0], value, came_from, stayed, label)
        return label

    def probabilities(self, scores: Array, step_s: float, allocate: Allocator = np.empty) -> Array:
        """The posterior of each word at every tick (forward-backward).

        Computed in blocks of 8192 ticks with a margin of 512 on either side.

        Args:
            scores: (m, K) log scores of each tick.
            step_s: step of the clock, s.
            allocate: allocator of the result.

        Returns:
            (m, K) probabilities, rows sum to 1.
        """
        terms = self._terms(step_s)
        check_shapes("a recording", ("scores", scores, ("m", len(terms[0]) - 1)))
        out = allocate(scores.shape, float)
        for ticks in blocks(len(scores), _DECODED_PIECE):
            low = max(0, ticks.start - _MARGIN)
            high = min(len(scores), ticks.stop + _MARGIN)
            piece = np.empty((high - low, scores.shape[1]))
            kernels.probabilities(np.ascontiguousarray(scores[low:high]), *terms, piece)
            out[ticks] = piece[ticks.start - low : ticks.stop - low]
        return out


Broken = Callable[[int, int, str], str]


# The recogniser.


@dataclass(frozen=True)
class Refused:
    """A bout found by network and chain that contradicts its definition.

    Attributes:
        rows: its frames.
        action: the refused word.
        named: the word of most of its frames instead, '' if unlabelled.
        why: the contradicted part of the definition.
    """

    rows: slice
    action: str
    named: str
    why: str


# ticks per second of an animal's recogniser
CLOCKS_HZ = {"fish": 50.0}
CLOCK_HZ = 30.0
# ticks per block of features
_PIECE = 16_384
_AT_ONCE = 2048  # and of these, ticks whose features are in memory
# half window of the speed; tolerances of its limits; penalty beyond them, nats
_SLACK = 1.25
_STILL = 0.1
_UNSEEN = 6.0
_BOUTS = 256  # measured between two releases of memory


@dataclass(frozen=True)
class TimelineModel:
    """A trained recogniser.

    Attributes:
        skeleton: name of the animal's skeleton.
        clock_hz: ticks per second.
        words: (K) its vocabulary, including `UNLABELLED`.
        share: (K,) share of the training time of each word, the prior.
        networks: the ensemble, whose probabilities are averaged.
        chain: durations and transitions of the words.
        sharpness: weight of one tick in the chain, because neighbouring ticks are correlated.
        speeds: (K, 2) range of each word's speed in the training data, body lengths per second,
            because a network does not extrapolate.
        peaks: (K,) least peak speed of the bouts of a fast word, body lengths per second.
        definitions: word -> definition.
        card: facts on the training, and the file's sha256.
    """

    skeleton: str
    clock_hz: float
    words: tuple[str, ...]
    share: Array
    networks: tuple[Network, ...]
    chain: SemiMarkovModel
    sharpness: float
    speeds: Array
    peaks: Array
    definitions: dict[str, str] = field(default_factory=dict)
    card: dict[str, Any] = field(default_factory=dict)

    def log_probabilities(
        self, segment: Segment, names: Sequence[str], speed: Array
    ) -> Iterator[tuple[slice, Array]]:
        """Yield the log probability of each word at each single tick, in blocks.

        Words whose speeds do not fit lose 6 nats.

        Args:
            segment: channels of an unbroken segment of m ticks.
            names: of its channels.
            speed: (m,) `steady_speed` of the segment.

        Yields:
            A slice of consecutive ticks, and their log probabilities (ticks, K).
        """
        margin = round(1.5 * self.clock_hz)
        m = len(segment.times_s)
        for ticks in blocks(m, _PIECE):
            low = max(0, ticks.start - margin)
            high = min(m, ticks.stop + margin)
            around = Segment(segment.times_s[low:high], segment.values[low:high])
            named = [
                np.mean(
                    [softmax(network.logits(some), axis=1) for network in self.networks], axis=0
                )
                for some in feature_blocks(around, names, _AT_ONCE)
            ]
            p = np.concatenate(named)[ticks.start - low : ticks.stop - low]
            now = speed[ticks, None]
            beyond = (now < self.speeds[:, 0] / _SLACK) | (
                now > self.speeds[:, 1] * _SLACK + _STILL
            )
            yield ticks, np.log(np.maximum(p, 1e-6)) - _UNSEEN * beyond

    def scores(
        self, segment: Segment, names: Sequence[str], speed: Array, allocate: Allocator = np.empty
    ) -> Array:
        """Log scores for the semi-Markov model: evidence of each tick relative to the prior.

        Args:
            segment: channels of an unbroken segment of m ticks.
            names: of its channels.
            speed: (m,) `steady_speed` of the segment.
            allocate: allocator of the result.

        Returns:
            (m, K) sharpness times (log probability minus log prior).
        """
        scores = allocate((len(segment.times_s), len(self.words)), float)
        for ticks, log_p in self.log_probabilities(segment, names, speed):
            scores[ticks] = self.sharpness * (log_p - np.log(np.maximum(self.share, 1e-3)))
        return scores

    def recognise(
        self,
        track: Track,
        wall_mm: Array | None = None,
        allocate: Allocator = np.empty,
        broken: Broken | None = None,
    ) -> "Recognised":
        """The ethogram of a track, and the probability of each word in each of its frames.

        Args:
            track: one animal's track of n frames.
            wall_mm: (n,) distance of the animal from the nearest wall, mm; None if unknown.
            allocate: allocator of large intermediate arrays and of the probabilities.
            broken: returns the contradicted part of a word's definition, '' for none; such a bout
                is refused and the track decoded again, in the end without a name. None refuses only
                bouts slower than their word's peak speed.

        Returns:
            Ethogram, probabilities, what the frame rate cannot resolve, and refused bouts.
        """
        n = track.n_frames
        probability = allocate((n, len(self.words)), float)
        score = np.zeros(n)
        code = np.full(n, self.words.index(UNLABELLED), np.int32)
        part = np.full(n, -1, np.int32)
        for rows in blocks(n, _PIECE):
            probability[rows] = np.nan
        time_s = (track.times_ns - track.times_ns[:1]) * 1e-9
        names = channel_names(track.skeleton)
        step = 1.0 / self.clock_hz
        refused: list[tuple[slice, int, str]] = []
        broken = None if broken is None else cache(broken)
        for number, segment in enumerate(segments_of(track, self.clock_hz, wall_mm, allocate)):
            speed = steady_speed(segment, names)
            scores = self.scores(segment, names, speed, allocate)
            begin = segment.times_s[0]
            first, last = np.searchsorted(time_s, [begin - 1e-6, segment.times_s[-1] + step])
            tick = np.clip(
                np.round((time_s[first:last] - begin) / step).astype(int), 0, len(scores) - 1
            )
            row = first + np.searchsorted(tick, np.arange(len(scores) + 1))
            decoded = self._decode(scores, speed, allocate, row, broken, refused)
            certain = self.chain.probabilities(scores, step, allocate)
            for piece in blocks(last - first, _PIECE):
                rows = slice(first + piece.start, first + piece.stop)
                certainty = certain[tick[piece]]
                code[rows] = decoded[tick[piece]]
                probability[rows] = certainty
                part[rows] = number
                score[rows] = np.take_along_axis(certainty, code[rows, None], axis=1)[:, 0]
        if broken is not None and n:
            self._unname(code, part, broken, refused)
        ethogram = Ethogram.of_words(
            code, track.times_ns, self.definitions, score, part, names=self.words
        )
        return Recognised(
            ethogram,
            self.words,
            probability,
            self.unresolved(track.times_ns),
            tuple(
                Refused(
                    rows, self.words[word], self.words[int(np.bincount(code[rows]).argmax())], why
                )
                for rows, word, why in refused
            ),
        )

    def _unname(
        self,
        code: NDArray[np.int32],
        part: NDArray[np.int32],
        broken: Broken,
        refused: list[tuple[slice, int, str]],
    ) -> None:
        """Remove the name of bouts of frames that contradict it and were not found by ticks.

        A slow camera may have no frame between two bouts of one word.
        """
        nothing = self.words.index(UNLABELLED)
        starts, stops, _ = runs_of(code + len(self.words) * part)
        for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
            word = int(code[start])
            if word != nothing and (why := broken(start, stop, self.words[word])):
                refused.append((slice(start, stop), word, why))
                code[start:stop] = nothing

    def _decode(
        self,
        scores: Array,
        speed: Array,
        allocate: Allocator,
        row: NDArray[np.int64],
        broken: Broken | None,
        refused: list[tuple[slice, int, str]],
    ) -> NDArray[np.int64]:
        """The most probable words (m,), whose bouts satisfy their definitions.

        Scores (m, K) of bouts that do not are lowered in place and decoded again, at most six
        times; a bout that still contradicts its definition becomes unlabelled. `refused` gets the
        frames, word and reason of each contradicting bout; `row` (m + 1,) is the first frame at or
        after each tick.
        """
        nothing = self.words.index(UNLABELLED)
        for left in reversed(range(6)):
            decoded = self.chain.decode(scores, 1.0 / self.clock_hz, allocate)
            starts, stops, words = runs_of(decoded)
            slow = np.maximum.reduceat(speed, starts) < self.peaks[words] / _SLACK
            false = np.zeros(len(starts), bool)
            for k, (start, stop, word) in enumerate(zip(starts, stops, words, strict=True)):
                if k % _BOUTS == 0:
                    release_pages()  # of the columns that are measured
                a, b = int(row[start]), int(row[stop])
                if broken is None or word == nothing or a == b:
                    continue
                why = broken(a, b, self.words[word])
                if why:
                    false[k] = True
                    if not any(
                        word == w and a < other.stop and other.start < b for other, w, _ in refused
                    ):
                        refused.append((slice(a, b), int(word), why))
                    if not left:
                        decoded[start:stop] = nothing
            wrong = slow | false
            if not wrong.any():
                break
            for start, stop, word in zip(starts[wrong], stops[wrong], words[wrong], strict=True):
                scores[start:stop, word] -= 10.0
        return decoded

    def unresolved(self, times_ns: NDArray[np.int64]) -> dict[str, str]:
        """Per word, what this frame rate cannot resolve.

        Bouts shorter than four frames, and parts of an action that are too fast for the camera
        (`vocabulary.FASTEST`).

        Args:
            times_ns: (n,) timestamps.

        Returns:
            Word -> reason, affected words only.
        """
        if len(times_ns) < 2:
            return {}
        rate = 1e9 / median_step(times_ns)
        fastest = FASTEST.get(self.skeleton, {})
        found = {}
        for word, shortest in zip(self.words, self.chain.shortest_s, strict=True):
            reasons = []
            # within a detectable bout: fewer than four frames are not enough
            if word != UNLABELLED and shortest * rate < 3.5:
                reasons.append(
                    f"its shortest bouts last {shortest:.2f} s, {shortest * rate:.1f} frames at "
                    f"{rate:.0f} per second, and may be missed"
                )
            part = fastest.get(word)
            # deviation of a camera from its nominal rate
            if part is not None and rate < part.least_hz - 1.0:
                reasons.append(
                    f"{part.what} takes about {part.seconds:.2f} s, {part.seconds * rate:.1f} "
                    f"frames at {rate:.0f} per second: the action is found, but how fast, how "
                    f"often and when exactly needs {part.least_hz:.0f} per second"
                )
            if reasons:
                found[word] = "; ".join(reasons)
        return found

    def name(self, track: Track, wall_mm: Array | None = None) -> str:
        """The word that fits a cut-out sequence best: the largest sum of log likelihood ratios.

        Args:
            track: the sequence, n frames.
            wall_mm: (n,) distance of the animal from the nearest wall, mm; None if unknown.

        Returns:
            A word; `UNLABELLED` only if nothing was measured.
        """
        total = np.zeros(len(self.words))
        names = channel_names(track.skeleton)
        for segment in segments_of(track, self.clock_hz, wall_mm):
            for _, log_p in self.log_probabilities(segment, names, steady_speed(segment, names)):
                total += (log_p - np.log(np.maximum(self.share, 1e-3))).sum(axis=0)
        if not total.any():
            return UNLABELLED
        named = [k for k, word in enumerate(self.words) if word != UNLABELLED]
        return self.words[named[int(np.argmax(total[named]))]]


@dataclass(frozen=True)
class Recognised:
    """The result of recognising a recording.

    Attributes:
        ethogram: the bouts.
        words: (K) the vocabulary.
        probability: (n, K) of each word in every frame, NaN without a pose.
        unresolved: word -> what the frame rate cannot resolve of it, and why.
        refused: bouts that contradict their word's definition.
    """

    ethogram: Ethogram
    words: tuple[str, ...]
    probability: Array
    unresolved: dict[str, str]
    refused: tuple[Refused, ...] = ()


@dataclass(frozen=True)
class Examples:
    """Training data of a recogniser: m ticks of all recordings, and their bouts.

    Attributes:
        features: (m, F) float32, see `window_features`.
        code: (m,) index of each tick's word.
        speed: (m,) `steady_speed`, body lengths per second.
        recording: (m,) the recording's number.
        runs: of every recording, its bouts (word, s) in order.
    """

    features: NDArray[np.float32]
    code: NDArray[np.int64]
    speed: Array
    recording: NDArray[np.int64]
    runs: list[list[tuple[int, float]]]


def steady_speed(segment: Segment, names: Sequence[str]) -> Array:
    """The speed around each tick, regardless of direction: a moving average over 0.4 s.

    Args:
        segment: channels of an unbroken segment of m ticks.
        names: of its channels, including 'speed'.

    Returns:
        (m,) body lengths per second.
    """
    from scipy.ndimage import uniform_filter1d

    width = 2 * max(1, round(0.2 / (segment.times_s[1] - segment.times_s[0]))) + 1
    at, values = names.index("speed"), segment.values
    speed = in_windows(len(values), 0, lambda ticks: values[ticks, at])
    return np.asarray(uniform_filter1d(speed, width, mode="nearest"))


def gather(tracks: Sequence[LabelledTrack], words: Sequence[str], clock_hz: float) -> Examples:
    """The examples of labelled tracks, tick by tick.

    Args:
        tracks: labelled recordings, at least one with a pose.
        words: the vocabulary, including every word of the tracks.
        clock_hz: ticks per second.
    """
    ticks = []
    runs = []
    index = {word: k for k, word in enumerate(words)}
    for k, one in enumerate(tracks):
        names = channel_names(one.track.skeleton)
        time_s = (one.track.times_ns - one.track.times_ns[:1]) * 1e-9
        code = np.array([index[str(word)] for word in one.words], np.int64)
        for segment in segments_of(one.track, clock_hz, one.wall_mm):
            row = np.clip(
                np.searchsorted(time_s, segment.times_s - 0.5 / clock_hz), 0, len(time_s) - 1
            )
            speed = steady_speed(segment, names)
            ticks.append((window_features(segment, names), code[row], speed, np.full(len(row), k)))
        runs.append(_runs(one.words, one.track.times_ns, index))
    features, codes, speeds, recordings = zip(*ticks, strict=True)
    columns = (np.concatenate(features), np.concatenate(codes), np.concatenate(speeds))
    return Examples(*columns, np.concatenate(recordings), runs)


def _runs(
    words: NDArray[np.str_], times_ns: NDArray[np.int64], index: dict[str, int]
) -> list[tuple[int, float]]:
    """The bouts (word, s) of a recording, including unlabelled ones."""
    if not len(words):
        return []
    ends = frame_stops(times_ns)
    return [
        (index[str(word)], float(ends[b - 1] - times_ns[a]) * 1e-9)
        for a, b, word in zip(*runs_of(words), strict=True)
    ]
