"""Blinded review: clips of a study in random order, labelled by raters blind to origin.

A review is one JSON file with the drawn clips, each rater's labels, and the program's label for the
middle of each clip. It is rewritten, as a whole, with every answer, so that an interrupted review
can resume. Each rater gets the clips in an individual order, derived from the review's seed and the
rater's name.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import field, replace
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter
from pydantic.dataclasses import dataclass

from liex_lab.actions.labels import RaterAgreement, cohens_kappa
from liex_lab.errors import SessionError, one_line, refuse
from liex_lab.runtime import durable
from liex_lab.sessions.corrections import UNREADABLE
from liex_lab.sessions.session import Session

FOLDER = "reviews"
ENDING = ".review.json"
SCHEMA_VERSION = 1
NO_NAME = ""  # time without an action
PROGRAM = "the program"
MOST_CLIPS = 500
_NAME_LENGTH = 60


@dataclass(frozen=True)
class Clip:
    """A moment of a session to label, with some time before and after it.

    Attributes:
        session: the session's name in the study; hidden from raters.
        at_s: the moment, s since the session's first frame.
        start_s: start of the clip, s.
        stop_s: its stop, s.
        program: the program's label for the moment; "" for no name.
    """

    session: str
    at_s: float
    start_s: float
    stop_s: float
    program: str


@dataclass(frozen=True)
class Review:
    """The clips of a review, and the labels of its raters.

    Attributes:
        name: name of the review.
        seed: determines the clips and their orders.
        words: the possible labels, besides NO_NAME.
        clips: the clips, in the order in which they were drawn.
        answers: rater -> number of the clip -> word.
        made_at: time of creation, ISO 8601.
    """

    name: str
    seed: int
    words: tuple[str, ...]
    clips: tuple[Clip, ...]
    answers: Mapping[str, Mapping[int, str]] = field(default_factory=dict)
    made_at: str = ""

    def order(self, rater: str) -> list[int]:
        """Numbers of the clips in the order for a rater."""
        mark = hashlib.sha256(f"{self.seed}\n{rater}".encode()).digest()
        rng = np.random.default_rng(int.from_bytes(mark[:8], "little"))
        return [int(k) for k in rng.permutation(len(self.clips))]

    def done_by(self, rater: str) -> bool:
        """Whether a rater has labelled every clip."""
        return len(self.answers.get(rater, {})) == len(self.clips)

    def answered(self, rater: str, clip: int, word: str) -> "Review":
        """The review with one answer added or replaced.

        Args:
            rater: the rater's name.
            clip: number of the clip.
            word: one of the review's words, or "" for no name.

        Raises:
            SessionError: the name, the clip or the word is invalid.
        """
        rater = checked_name(rater, "a rater")
        refuse(
            SessionError,
            (rater == PROGRAM, f"'{PROGRAM}' rates already; take another name"),
            (
                not 0 <= clip < len(self.clips),
                f"there is no clip {clip}; the review has {len(self.clips)}",
            ),
            (
                word not in (*self.words, NO_NAME),
                f"the review has no word '{word}'; known are {', '.join(self.words)}",
            ),
        )
        own = {**self.answers.get(rater, {}), clip: word}
        return replace(self, answers={**self.answers, rater: own})

    def agreements(self) -> list[tuple[str, str, RaterAgreement]]:
        """Agreement between raters that have finished, and of each with the program."""
        program = {k: clip.program for k, clip in enumerate(self.clips)}
        raters = [name for name in self.answers if self.done_by(name)]
        labels = {**{name: self.answers[name] for name in raters}, PROGRAM: program}
        found = []
        for a, b in combinations(labels, 2):
            both = sorted(set(labels[a]) & set(labels[b]))
            found.append((a, b, cohens_kappa(*([labels[one][k] for k in both] for one in (a, b)))))
        return found

    def to_json(self) -> str:
        """The content of the review's file."""
        document = {"schema_version": SCHEMA_VERSION, **_REVIEW.dump_python(self, mode="json")}
        return json.dumps(document, indent=1, ensure_ascii=False) + "\n"

    @staticmethod
    def from_json(text: str) -> "Review":
        """Inverse of `to_json`.

        Args:
            text: the content of a review's file.

        Raises:
            ValueError: a value is missing, invalid or of another type.
            KeyError: the version is missing.
            TypeError: the content is not an object.
        """
        found = json.loads(text)
        if int(found["schema_version"]) > SCHEMA_VERSION:
            raise ValueError("it was written by a newer liex_lab")
        return _REVIEW.validate_python(found)


_REVIEW = TypeAdapter(Review)


def drawn_review(
    name: str, sessions: Mapping[str, Session], n: int, seed: int, around_s: float = 1.0
) -> Review:
    """A review with clips drawn from some sessions.

    The program's words, including "no name", take turns as long as they have bouts left. For each
    turn a bout of the word is drawn at random from all sessions; the moment is random in the middle
    half of the bout. Rare actions are thus represented, and kappa refers to this sample, not to all
    of the time.

    Args:
        name: name of the review.
        sessions: the opened sessions by their names in the study.
        n: number of clips.
        seed: of the random draw.
        around_s: time shown before and after the moment, s.

    Raises:
        SessionError: the name or the number is invalid, or there are fewer bouts.
    """
    if not 1 <= n <= MOST_CLIPS:
        raise SessionError(f"a review has 1 to {MOST_CLIPS} clips, got {n}")
    rng = np.random.default_rng(seed)
    bouts: dict[str, list[tuple[str, float, float, float]]] = {}
    words: dict[str, None] = {}
    for key, session in sessions.items():
        words |= dict.fromkeys(session.metadata.get("actions") or {})
        for word, start_s, stop_s, last_s in _bouts_of(session):
            bouts.setdefault(word, []).append((key, start_s, stop_s, last_s))
    left = {word: [own[k] for k in rng.permutation(len(own))] for word, own in bouts.items()}
    turns = [sorted(left)[k] for k in rng.permutation(len(left))]
    clips: list[Clip] = []
    while len(clips) < n and any(left.values()):
        for word in turns:
            if left[word] and len(clips) < n:
                key, start_s, stop_s, last_s = left[word].pop()
                at_s = float(start_s + (0.25 + 0.5 * rng.random()) * (stop_s - start_s))
                from_s = round(max(at_s - around_s, 0.0), 4)
                to_s = round(min(at_s + around_s, last_s), 4)
                clips.append(Clip(key, round(at_s, 4), from_s, to_s, word))
    if len(clips) < n:
        raise SessionError(
            f"these sessions have {len(clips)} bouts, and {n} clips were asked for; ask for fewer"
        )
    shuffled = tuple(clips[k] for k in rng.permutation(n))
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return Review(checked_name(name, "a review"), seed, tuple(words), shuffled, {}, now)


def _bouts_of(session: Session) -> list[tuple[str, float, float, float]]:
    """Word, start, stop and the session's end, s; time between bouts has no name."""
    table = session.bouts.sort_values("start_s")
    last_s = float(session.frames["time_s"].iloc[-1])
    found = []
    at_s = 0.0
    for word, start_s, stop_s in [
        *table[["action", "start_s", "stop_s"]].itertuples(index=False, name=None),
        ("", last_s, last_s),
    ]:
        # shorter intervals between bouts are not drawn
        if start_s - at_s > 0.3:
            found.append((NO_NAME, at_s, float(start_s), last_s))
        if word:
            found.append((str(word), float(start_s), float(stop_s), last_s))
        at_s = max(at_s, float(stop_s))
    return found


def checked_name(name: str, of: str) -> str:
    """A name, stripped and validated.

    Args:
        name: the name as typed.
        of: the named object, for the error message.

    Raises:
        SessionError: it is empty, too long, or not printable.
    """
    plain = name.strip()
    if not plain or len(plain) > _NAME_LENGTH or not plain.isprintable():
        raise SessionError(f"{of} has a name of up to {_NAME_LENGTH} letters, got {name!r}")
    return plain


def write_review(folder: Path, review: Review) -> Path:
    """Write or replace a review; returns its file.

    Args:
        folder: the study's folder of reviews; created if needed.
        review: the review.
    """
    folder.mkdir(exist_ok=True)
    path = durable.inside(folder, review.name, ENDING)
    durable.write_whole(path, review.to_json())
    return path


def read_review(folder: Path, name: str) -> Review:
    """Read a review.

    Args:
        folder: the study's folder of reviews.
        name: its name.

    Raises:
        SessionError: it does not exist, or is damaged.
    """
    path = durable.inside(folder, name, ENDING)
    try:
        return Review.from_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SessionError(f"there is no review '{name}' in {folder}") from None
    except UNREADABLE as error:
        raise SessionError(
            f"{path} is damaged ({type(error).__name__}: {one_line(error)}); put back a copy of it"
        ) from None


def review_names(folder: Path) -> Sequence[str]:
    """Names of the readable reviews in a folder.

    Args:
        folder: the study's folder of reviews; it may not exist.
    """
    found = []
    for path in sorted(folder.glob(f"*{ENDING}")):
        with suppress(*UNREADABLE):
            found.append(Review.from_json(path.read_text(encoding="utf-8")).name)
    return found
