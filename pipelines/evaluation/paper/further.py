"""What other verbs measure, as small fixed measurements for the page of tables and figures.

- tracking (Fig 18): the easy mouse sequence, its first frames, without the paper's own parts;
- actions (Figs 19 and 20): the 426 cut-out sequences to learn from and the 173 to test on, named by
  the paper's recogniser with either descriptor and by ours; no uncut recordings;
- nyu (Table 2, Fig 12): the NYU hand data, where its folder is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from liex_lab.errors import PlanError
from liex_lab.runtime.progress import Progress, silent

from .drawers import Drawers

PARTS = ("tracking", "actions")
TRACKED = "mouse"
SEQUENCE = "easy"
ACTING = "fish"
_TRACKED_FRAMES = 160
_QUICK_FRAMES = 40
_QUICK_STRIDE = 12  # every so many-th cut-out sequence
_TRACKING = "fig18_tracking.png"
_KEY_FRAMES = "fig19_key_frames.png"
_CONFUSIONS = "fig20_confusions.png"
_NYU_HANDS = "fig12_nyu_hands.png"
_VERBS = {
    "tracking": f"liex evaluate tracking --animal {TRACKED} --sequence {SEQUENCE} --figure F.png",
    "actions": f"liex evaluate actions --animal {ACTING} --out DIR",
    "nyu": "liex evaluate nyu --reference FOLDER",
}


@dataclass
class Further:
    """What was measured beside the rows.

    Attributes:
        tracking: as `evaluate_tracking` returns it; empty where it was left out.
        actions: as `sequence_scores` returns it, with the numbers of sequences.
        nyu: as `evaluate_nyu` returns it.
        missing: by part, why it is not there and which command makes it.
        figures: names of the PNG files.
    """

    tracking: dict[str, Any] = field(default_factory=dict)
    actions: dict[str, Any] = field(default_factory=dict)
    nyu: dict[str, Any] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    figures: list[str] = field(default_factory=list)


def check_parts(without: Sequence[str]) -> None:
    """Refuse a name that is no part.

    Args:
        without: names of parts to be left out.

    Raises:
        PlanError: there is no such part.
    """
    if unknown := [name for name in without if name not in PARTS]:
        raise PlanError(
            f"there is no part '{unknown[0]}' to leave out; known are {', '.join(PARTS)}"
        )


def measure_further(
    folder: Path,
    *,
    without: Sequence[str] = (),
    nyu: Path | None = None,
    quick: bool = False,
    drawers: Drawers,
    progress: Progress = silent,
) -> Further:
    """Measure and draw what belongs to other verbs.

    Args:
        folder: where the PNG files are written.
        without: names of `PARTS` that are left out.
        nyu: folder of the NYU hand data; None leaves it out.
        quick: fewer frames and sequences.
        drawers: draw the figures.
        progress: told how far the work is.

    Returns:
        The numbers, and what is missing.
    """
    from .key_frames import acted_key_frames

    found = Further()
    for name in without:
        found.missing[name] = f"it was left out; `{_VERBS[name]}` makes it"
    if "tracking" not in without:
        found.tracking = _tracking(folder / _TRACKING, quick, drawers, progress)
        found.figures.append(_TRACKING)
    if "actions" not in without:
        found.actions = _actions(quick, progress)
        drawers.key_frames(acted_key_frames(), folder / _KEY_FRAMES)
        drawers.confusions(found.actions, folder / _CONFUSIONS)
        found.figures += [_KEY_FRAMES, _CONFUSIONS]
    if nyu is None:
        found.missing["nyu"] = (
            f"no folder was named with --nyu; with the data `{_VERBS['nyu']}` makes it"
        )
    else:
        from ..nyu import evaluate_nyu

        found.nyu = evaluate_nyu(
            nyu,
            draw=lambda hands: drawers.nyu_hands(hands, folder / _NYU_HANDS),
            progress=progress,
        )
        found.figures.append(_NYU_HANDS)
    return found


def _tracking(path: Path, quick: bool, drawers: Drawers, progress: Progress) -> dict[str, Any]:
    from ..tracking import evaluate_tracking

    return evaluate_tracking(
        TRACKED,
        SEQUENCE,
        n_frames=_QUICK_FRAMES if quick else _TRACKED_FRAMES,
        draw=lambda sequence, rows: drawers.tracking(sequence, rows, path),
        progress=progress,
    )


def _actions(quick: bool, progress: Progress) -> dict[str, Any]:
    from liex_lab.actions.storage import load_action_model

    from ...training.action_model import cut_sequences
    from ...training.agent_tracks import acted_tracks
    from ..actions import sequence_scores
    from ..pose import estimator_of

    stride = _QUICK_STRIDE if quick else 1
    estimator = estimator_of(ACTING, "default", progress)
    train, test = (
        acted_tracks(cut_sequences(ACTING, side)[::stride], estimator, progress)
        for side in (False, True)
    )
    progress(0, None, "naming actions")
    scores = sequence_scores(train, test, load_action_model(ACTING))
    return {**scores, "n_train": len(train), "n_test": len(test)}
