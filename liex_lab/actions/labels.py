"""Human labels as words of frames, and scores of recognised words and of raters against them.

Labels are tables of bouts (CSV or parquet; action, start_s, stop_s). A track with its labels
(`LabelledTrack`) is what recognisers are trained on and evaluated with.

F1 = 2 TP / (found + true), by frames or by bouts; a bout is correct if its intersection over union
with a true bout of its action is at least 0.5 (segmental F1@50, Lea et al. 2017). The 95 % interval
of a share is Wilson's (1927).
"""

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.actions.ethogram import UNLABELLED, frame_words
from liex_lab.arrays import Array, NDArray
from liex_lab.errors import LiexError, expecting
from liex_lab.runtime.memory import Rows
from liex_lab.runtime.text_files import clock_s, number, read_texts
from liex_lab.tracking.track import Track, spans

HUMAN = "human"
_NEEDED = ("action", "start_s", "stop_s")
_NORMAL = 1.959964  # of a 95 % interval


def read_labels(path: str | Path) -> pd.DataFrame:
    """Bouts from a table, checked and in order of time.

    Args:
        path: our bouts.parquet, or a table as CSV or saved by a spreadsheet with the columns
            action, start_s, stop_s and, for several recordings, session_id.

    Returns:
        The table, with the column source set to human.

    Raises:
        LiexError: the file cannot be read, lacks a column, or has a bout that does not stop after
            it starts.
    """
    source = Path(path)
    with expecting(
        LiexError, f"{source} should be a table of bouts, as CSV or parquet", OSError, ValueError
    ):
        table = pd.read_parquet(source) if source.suffix == ".parquet" else read_texts(source)
    lacking = [name for name in _NEEDED if name not in table]
    if lacking:
        raise LiexError(
            f"{source} should have the columns {', '.join(_NEEDED)} (session_id, too, for several "
            f"recordings); it lacks {', '.join(lacking)}"
        )
    return checked(table.assign(source=HUMAN), str(source))


def checked(table: pd.DataFrame, origin: str) -> pd.DataFrame:
    """A table of bouts in order of time, its times as numbers and its actions as text.

    Args:
        table: columns action, start_s and stop_s at least.
        origin: the table's name in errors.

    Returns:
        A copy, sorted by start_s.

    Raises:
        LiexError: a bout does not start before it stops, in seconds; the message names the first.
    """
    times = pd.DataFrame({name: _numbers(table[name]) for name in ("start_s", "stop_s")})
    start, stop = (times[name].to_numpy() for name in ("start_s", "stop_s"))
    wrong = np.flatnonzero(~np.isfinite(start) | ~np.isfinite(stop) | (stop <= start))
    if len(wrong):
        row = {name: " ".join(str(table[name].iloc[wrong[0]]).split())[:80] for name in _NEEDED}
        raise LiexError(
            f"{origin}: each bout starts before it stops, in seconds or as hh:mm:ss, without "
            f"separators of thousands; the one of {row['action']} in row {wrong[0] + 1} has "
            f"start_s={row['start_s']} and stop_s={row['stop_s']}"
        )
    out = table.reset_index(drop=True).assign(
        action=table["action"].to_numpy().astype(str), **times
    )
    return out.sort_values("start_s", kind="stable").reset_index(drop=True)


def _numbers(column: pd.Series) -> NDArray[np.float64]:
    """A column (n,) of seconds or times as hh:mm:ss as numbers; NaN if not a number."""
    texts = [str(cell) for cell in column]
    commas = [text for text in texts if "," in text]
    # next to 950, 1,034 is not a decimal number
    thousands = len(commas) < len(texts) and all(
        map(re.compile(r"[1-9]\d{0,2},\d{3}").fullmatch, commas)
    )
    return np.array([np.nan if thousands and "," in text else _seconds(text) for text in texts])


def _seconds(text: str) -> float:
    """Seconds, or a time as hh:mm:ss in seconds; NaN if neither."""
    with suppress(ValueError):
        return float(clock_s(text) if ":" in text else number(text))
    return float("nan")


def sessions_named(table: pd.DataFrame) -> set[str]:
    """The values of session_id in a table of labels; empty without that column."""
    return set(table["session_id"].astype(str)) if "session_id" in table else set()


def words_of(
    table: pd.DataFrame, time_s: NDArray[np.float64], session_id: str = ""
) -> NDArray[np.str_]:
    """The word of each frame, by the bouts of a session.

    Args:
        table: bouts, checked.
        time_s: (n,) s since the first frame, increasing.
        session_id: only bouts of this session; '' or a table without that column uses all.

    Returns:
        (n,) words, `UNLABELLED` outside all bouts; if bouts overlap, the later one.
    """
    if "session_id" in table and session_id:
        table = table[table["session_id"].astype(str) == session_id]
    # a frame at a bout's start belongs to it, one at its stop does not, despite rounded seconds
    spans = np.searchsorted(time_s, table[["start_s", "stop_s"]].to_numpy(float) - 1e-6)
    return frame_words(list(table["action"]), spans, len(time_s))


@dataclass(frozen=True)
class LabelledTrack(Rows):
    """A track and the word of each of its frames.

    Attributes:
        track: one animal's track.
        words: (n,) '' if a frame has none.
        animal: the animal's name.
        wall_mm: (n,) distance of the animal's middle from the nearest wall, mm, NaN if unknown.
        truth: (n, J, 3) mm, true joints of a rendered animal; None otherwise.
    """

    track: Track
    words: NDArray[np.str_]
    animal: str
    wall_mm: Array
    truth: Array | None = field(default=None, repr=False)

    def __len__(self) -> int:
        """The number of frames."""
        return len(self.words)


# Scores of recognised actions: frame-wise F1, segmental F1@50, confusion matrix.


def timeline_scores(
    pairs: Iterable[tuple[LabelledTrack, NDArray[np.str_]]], words: Sequence[str]
) -> dict[str, Any]:
    """Scores of recognised words against the labels of their tracks.

    Args:
        pairs: labelled tracks, each with its recognised words (n,).
        words: the vocabulary, with or without `UNLABELLED`.

    Returns:
        macro_f1: mean over the labelled actions of their frame-wise F1; segment_f1_50: F1 of bouts,
            correct if the intersection over union with a true bout of the action is at least 0.5;
            per_action: F1, precision and recall of frames, segment F1, and number of bouts. NaN if
            the denominator is zero.
    """
    named = [word for word in words if word != UNLABELLED]
    hits, found, true = (dict.fromkeys(named, 0) for _ in range(3))
    frames = {word: np.zeros(3, np.int64) for word in words}
    for one, recognised in pairs:
        for word in words:
            a = one.words == word
            b = recognised == word
            frames[word] += [int((a & b).sum()), int(b.sum()), int(a.sum())]
        for word in named:
            counted = match_bouts(one.words == word, recognised == word)
            for total, n in zip((hits, found, true), counted, strict=True):
                total[word] += n
    per_action = {
        word or "unlabelled": {
            "f1": _f1(*frames[word]),
            "precision": _share(frames[word][0], frames[word][1]),
            "recall": _share(frames[word][0], frames[word][2]),
            **(
                {"segment_f1_50": _f1(hits[word], found[word], true[word]), "bouts": true[word]}
                if word
                else {}
            ),
        }
        for word in words
    }
    labelled = [word for word in named if frames[word][2] > 0]
    return {
        "macro_f1": float(np.mean([per_action[word]["f1"] for word in labelled]))
        if labelled
        else float("nan"),
        "segment_f1_50": _f1(sum(hits.values()), sum(found.values()), sum(true.values())),
        "per_action": per_action,
    }


def match_bouts(
    true: NDArray[np.bool_], found: NDArray[np.bool_], overlap: float = 0.5
) -> tuple[int, int, int]:
    """The number of found bouts that match a true one; each true bout counts once.

    Args:
        true: (n,) bool, frames of the action by the labels.
        found: (n,) bool, frames of the action as recognised.
        overlap: least intersection over union of a match.

    Returns:
        Matches, bouts found, true bouts.
    """
    bouts = spans(true)
    guesses = spans(found)
    taken = set()
    hits = 0
    for start, stop in guesses:
        shares = [
            (min(stop, b) - max(start, a)) / (max(stop, b) - min(start, a))
            if min(stop, b) > max(start, a)
            else 0.0
            for a, b in bouts
        ]
        best = int(np.argmax(shares)) if shares else -1
        if best >= 0 and shares[best] >= overlap and best not in taken:
            taken.add(best)
            hits += 1
    return hits, len(guesses), len(bouts)


def _share(part: int, whole: int) -> float:
    return float(part / whole) if whole else float("nan")


def _f1(hits: int, found: int, true: int) -> float:
    return float(2.0 * hits / (found + true)) if found + true else float("nan")


def confusion(true: Sequence[str], found: Sequence[str], words: Sequence[str]) -> list[list[int]]:
    """Confusion matrix (K, K) as lists; rows: true words; columns: recognised words.

    Args:
        true: (n) true word of each, all of them in `words`.
        found: (n) recognised words; those not in `words` are left out.
        words: the K words, in the order of rows and columns.
    """
    from sklearn.metrics import confusion_matrix

    return [[int(n) for n in row] for row in confusion_matrix(true, found, labels=list(words))]


def interval95(hits: float, n: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share of hits out of n.

    Args:
        hits: number of hits, or a sum of shares.
        n: number of trials, at least 1.

    Returns:
        Lower and upper limit, 0 to 1.
    """
    z, p = _NORMAL, hits / n
    middle = p + z * z / (2 * n)
    half = z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return float((middle - half) / (1 + z * z / n)), float((middle + half) / (1 + z * z / n))


# Agreement of two raters beyond chance: Cohen's kappa with its interval.


@dataclass(frozen=True)
class RaterAgreement:
    """Agreement of two raters.

    Attributes:
        n: number of items rated by both.
        observed: share of items with the same rating.
        kappa: agreement beyond chance, relative to its maximum: 1 for perfect agreement, 0 for
            chance; NaN if undefined.
        low: lower limit of its 95 % interval; NaN if undefined.
        high: upper limit.
    """

    n: int
    observed: float
    kappa: float
    low: float
    high: float


def cohens_kappa(first: Sequence[str], second: Sequence[str]) -> RaterAgreement:
    """Agreement of two raters of the same items.

    Args:
        first: the first rater's words.
        second: the second rater's words.
    """
    from statsmodels.stats.inter_rater import cohens_kappa as fleiss_cohen_everitt

    n, words, nan = len(first), sorted({*first, *second}), float("nan")
    if len(words) < 2:
        return RaterAgreement(n, 1.0 if n else nan, nan, nan, nan)
    table = np.array(confusion(first, second, words))
    with np.errstate(all="ignore"):  # a test of kappa = 0, which is not used, may divide by 0
        found = fleiss_cohen_everitt(table)
    reach = _NORMAL * float(np.sqrt(max(found.var_kappa, 0.0)))
    low, high = max(found.kappa - reach, -1.0), min(found.kappa + reach, 1.0)
    return RaterAgreement(n, float(table.trace() / n), float(found.kappa), float(low), float(high))
