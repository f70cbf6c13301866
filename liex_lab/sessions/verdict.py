"""The verdict on a session: its quality in one sentence, and whether it needs review.

A run that measured the wrong object has tables like any other. So a session reports the share of
frames with an animal in view that was measured and is trusted, whether the scene fits the plan, and
other doubts: on the terminal, in `verdict` of session.json, at the top of the report, and in the
session list of a study.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.tracking.observations import Observations
from liex_lab.tracking.track import DOUBTFUL, Tracked

NEEDS_REVIEW = "needs review"
CAUTION = "note"
OTHER_ANIMAL = "the recording names another animal"  # start of that caution


@dataclass(frozen=True)
class Verdict:
    """Quality of a session; `verdict` of session.json contains these fields and `sentence`.

    Attributes:
        n_frames: frames recorded.
        n_in_view: frames with an object of the animal's size in view.
        n_posed: frames with a measured pose.
        n_trusted: frames with a measured pose that nothing contradicts.
        expected_error_mm: median predicted joint error of the measured poses, mm; None without any.
        n_animals: animals in view at once; 0 if no frame has a pose.
        reasons: why the session needs review, such as a scene that does not fit the plan; empty if
            it does not.
        cautions: further doubts.
        accepted: whether the plan accepts misfits (`estimation.accept_misfit`).
        n_hidden: frames in which the animal is behind or under something.
        n_animals_share: share of the frames with an animal in view that show this number.
        n_measured: how many of them are measured, each in a session of its own.
    """

    n_frames: int
    n_in_view: int
    n_posed: int
    n_trusted: int
    expected_error_mm: float | None
    n_animals: int
    reasons: tuple[str, ...] = ()
    cautions: tuple[str, ...] = ()
    accepted: bool = False
    n_hidden: int = 0
    n_animals_share: float = 1.0
    n_measured: int = 1

    @staticmethod
    def of(
        tracked: Tracked,
        observations: Observations,
        *,
        misfits: Sequence[str] = (),
        doubts: Sequence[str] = (),
        n_measured: int = 1,
        cautions: Sequence[str] = (),
        accepted: bool = False,
    ) -> "Verdict":
        """The verdict on a track.

        Args:
            tracked: the track, and how many animals are in view.
            observations: the observations.
            misfits: how the scene does not fit the plan.
            doubts: why its scene or its clock is unreliable.
            n_measured: how many animals of the recording are measured.
            cautions: further doubts.
            accepted: whether the plan accepts misfits.
        """
        track = tracked.track
        n_hidden = int(track.flagged("hidden").sum())
        n_depth = (
            int(observations.has_depth.sum()) - n_hidden
        )  # there is a reason for the missing pose
        n_in_view = min(int(observations.known.any(axis=1).sum()), n_depth)
        n_posed = int(track.observed.sum())
        n_trusted = int((track.observed & track.flagged("")).sum())
        n_doubtful = int(track.flagged(*DOUBTFUL).sum())
        errors = track.predicted_error_mm[track.observed]
        reasons = [*misfits, *doubts]
        crowded = int((track.n_animals > n_measured).sum())
        if tracked.n_animals > n_measured:
            measured = "1 is" if n_measured == 1 else f"{n_measured} are"
            reasons.append(
                f"{tracked.n_animals} animals are in view at once, and {measured} measured: in "
                f"{crowded:,} frames it is unknown which, and no pose is trusted (set animal.count)"
            )
        # of all frames with depth
        elif n_trusted < 0.2 * n_depth:
            reasons.append(f"an animal is measured in {n_trusted} of {n_depth} frames only")
        # of the frames with an object of the animal's size in view
        elif n_trusted < 0.5 * n_in_view:
            reasons.append(
                f"only {n_trusted} of the {n_in_view} frames with an object of its size in view "
                "are measured and trusted"
            )
        notes = list(cautions)
        if 0 < tracked.n_animals < n_measured:
            notes.append(
                f"animal.count is {n_measured}, but {tracked.n_animals} stand apart at once"
            )
        if n_hidden:
            notes.append(f"the animal is hidden in {n_hidden:,} frames")
        if n_doubtful > max(0.05 * track.n_frames, crowded):
            notes.append(f"{n_doubtful} poses are doubtful")
        return Verdict(
            track.n_frames,
            n_in_view,
            n_posed,
            n_trusted,
            float(np.median(errors)) if len(errors) else None,
            tracked.n_animals if n_posed else 0,
            tuple(reasons),
            tuple(notes),
            accepted,
            n_hidden,
            round(tracked.n_animals_share, 3),
            n_measured,
        )

    @property
    def needs_review(self) -> bool:
        """Whether the session needs review before it is used."""
        return bool(self.reasons)

    @property
    def sentence(self) -> str:
        """The verdict in one line."""
        share = f"{self.n_posed / self.n_frames:.0%}" if self.n_frames else "none"
        parts = [
            f"{self.n_frames:,} frames, {self.n_posed:,} with a pose ({share}), "
            f"{self.n_trusted:,} of them trusted"
        ]
        if self.expected_error_mm is not None:
            parts[0] += f", expected error {self.expected_error_mm:.1f} mm"
        if self.reasons:
            accepted = " (accepted)" if self.accepted else ""
            parts.append(f"{NEEDS_REVIEW}{accepted}: {'; '.join(self.reasons)}")
        if self.cautions:
            parts.append(f"{CAUTION}: {'; '.join(self.cautions)}")
        return ". ".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """The fields and the sentence, as in session.json."""
        return {
            **asdict(self),
            "reasons": list(self.reasons),
            "cautions": list(self.cautions),
            "look_at_it": self.needs_review,
            "sentence": self.sentence,
        }


def verdict_in(document: Mapping[str, Any]) -> Mapping[str, Any]:
    """The verdict in the content of a session.json, or a default for earlier versions.

    Returns:
        At least `look_at_it`, `accepted`, `reasons`, `cautions` and `sentence` ("" if absent).
    """
    default = {
        "look_at_it": False,
        "accepted": False,
        "reasons": [],
        "cautions": [],
        "sentence": "",
    }
    found = document.get("verdict")
    stated = found.items() if isinstance(found, Mapping) else ()
    return default | {
        name: value for name, value in stated if isinstance(value, type(default.get(name, value)))
    }


# Entry of a study's session list, shared by jobs and views.


SUBJECT = ("subject_id", "group", "cage", "sex", "batch")
ALSO = ("species", "age")  # also required by archives; not used for grouping


@dataclass(frozen=True)
class Entry:
    """A session in the list of a study.

    Attributes:
        key: its name in the study.
        state: done, failed, new, begun, changed or excluded.
        reason: why it is in this state.
        remedy: how to resolve it.
        folder: the session folder; None if it was not measured.
        subject: the known ones of `SUBJECT` (subject, group, cage, sex, batch).
    """

    key: str
    state: str
    reason: str = ""
    remedy: str = ""
    folder: Path | None = None
    subject: dict[str, str] = field(default_factory=dict)


def state_in_words(state: str, reason: str) -> str:
    """The state of a session for people; a finished one may need review or have cautions.

    Args:
        state: done, failed, new, begun, changed or excluded.
        reason: why it is in this state, or why it needs review although it is done.
    """
    if state == "done" and reason.startswith(NEEDS_REVIEW):
        return f"done, {NEEDS_REVIEW}"
    return "done with cautions" if state == "done" and reason.startswith(CAUTION) else state
