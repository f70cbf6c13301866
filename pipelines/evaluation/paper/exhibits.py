"""Every table and figure of Lie-X for one page: what was made of it, and a sentence on each.

The sentences say what is the same as in the paper, what is not, and why. Figures of the paper that
are drawings or photographs measure nothing; they are listed as such.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .deviations import HAND
from .further import Further
from .table_text import error_table, mean_table, origin_table, rate_table, words

if TYPE_CHECKING:
    from .results import Results

Table = tuple[str, Sequence[str], Sequence[Sequence[str]]]

_RENDERED = (
    "The paper's recordings are real and were labelled by hand, and were not published; ours are "
    "rendered with exact truth."
)
DRAWINGS = {
    "1": "the pose manifold: a pose is a point in it, a track a curve, an action a part of a curve",
    "2": "the skeletons of fish, mouse and hand",
    "3": "the steps of the pose estimation on a mouse; Fig. 16 shows them measured",
    "4": "one step of the particle filter",
    "5": "the cameras over tank and arena, photographs",
    "6": "the 14 of the hand's joints that the NYU protocol counts",
}
_SENTENCES = {
    "Table 1": "Same: the methods, and the mean joint error in mm of frames taken one by one. Not "
    "the same: our own row is added, medians with intervals stand first, and every row is given "
    "the same object and size. " + _RENDERED,
    "Table 2": "Same: the methods on hands. Not the same: the first table is of rendered hands, 23 "
    "joints with the root estimated; the published numbers are of NYU frames, 14 points. By the "
    "paper's own protocol the second table counts NYU frames, where the data was given. " + HAND,
    "Table 3": "Same: frames per second, foreground included. Not the same: the machine, the size "
    "of the pictures, and that frames lie in memory; compare the ratios to the default, which was "
    "timed beside each row.",
    "Fig. 7": "Same: the five numbers that the paper varies, one at a time; a red dot marks the "
    "one in use. Not the same: each point is a model of few images, so only the course of a curve "
    "counts, not its height; ours is drawn beside the paper's variant. Of ours of the hand, rounds "
    "are those of the other joints: its base has 6 at every point.",
    "Fig. 8": "Same: the share of frames within an error, by method. Not the same: one panel a "
    "test split; published curves of other authors are not drawn, for they are of NYU frames.",
    "Fig. 9": "Same: fish and mice with the poses of all methods beside the truth. Not the same: "
    "the frames are not chosen for what they show: of each split the middle frame of the first "
    "recording and of that halfway; and the view from the side is added. " + _RENDERED,
    "Fig. 10": "Same: hands with the poses of Lie-X, RF and CNN beside the truth. Not the same: "
    "rendered hands that show any side, whole instead of with magnified parts; frames chosen as in "
    "Fig. 9.",
    "Fig. 11": "Same: the hands of Fig. 10 again, with all methods. Not the same: ours are seen "
    "from the side, and poses of Tompson, Oberweger and Zhou are missing, which nobody can make "
    "for other pictures than NYU's.",
    "Fig. 12": "Same: ten NYU hands, the poses of Lie-X and of others beside the labels. Not the "
    "same: the frames are evenly spaced over the test set instead of chosen, the others are those "
    "whose answers are with the data, and the pictures, which may not be passed on, are not drawn; "
    "our own pose is there only where the frame's picture lies in the folder.",
    "Fig. 13": "Same: the candidates of one fish, ranked by the learned metric, with true rank and "
    "error. Not the same: candidates of our default model, which proposes others and fewer than "
    "the paper's 40; the picture is that with the median error.",
    "Fig. 14": "As Fig. 13, of a mouse.",
    "Fig. 15": "As Fig. 13, of a hand.",
    "Fig. 16": "Same: a pose after joints and rounds, from the start to the end. Not the same: of "
    "our default model, for every animal and not only the mouse, and with the errors of many "
    "pictures below.",
    "Fig. 17": "Same: frames in which the method fails. Not the same: the paper picks common "
    "errors by eye; these are the largest, the worst frames of two recordings of each split. The "
    "paper's variant is there where it was measured in the same run or its row keeps them.",
    "Fig. 18": "Same: error over time of tracking beside single frames, and the worst moments. Not "
    "the same: a rendered sequence instead of two real mice; single frames are those of our "
    "default, and Algorithm 3 runs on our parts. The paper's own comparison, 8.42 to 7.19 mm with "
    "its own parts, is `liex evaluate tracking --paper`, which trains its variant first. It is not "
    "reproduced on rendered mice, with noise that was searched: see the manual's page Evidence.",
    "Fig. 19": "Same: key frames and path of the nine actions of fish, surface and dive from the "
    "side. Not the same: the fish act by kinematic definitions; the grey points are what the "
    "virtual camera sees, the lines the true skeletons.",
    "Fig. 20": "Same: 426 sequences of nine actions to learn from and 173 to test on, tangent "
    "vectors against joint positions (91.33 and 79.19 % in the paper). Not the same: generated "
    "behaviour of five and two virtual fish, where the paper has seven real ones; the third matrix "
    "is ours, which learned from other and more data. The intervals take the sequences as "
    "independent, though they are of two fish.",
}
_QUICK_ACTIONS = " This run has {n_train} sequences to learn from and {n_test} to test on."
_PICTURES = {
    "Fig. 7": "fig07_*.png",
    "Fig. 8": "fig08_*.png",
    "Fig. 9": "fig09_*.png",
    "Fig. 10": "fig10_*.png",
    "Fig. 11": "fig11_*.png",
    "Fig. 12": "fig12_*.png",
    "Fig. 13": "fig13_candidates_fish.png",
    "Fig. 14": "fig13_candidates_mouse.png",
    "Fig. 15": "fig13_candidates_hand.png",
    "Fig. 16": "fig16_*.png",
    "Fig. 17": "fig17_*.png",
    "Fig. 18": "fig18_*.png",
    "Fig. 19": "fig19_*.png",
    "Fig. 20": "fig20_*.png",
}
TITLES = {
    "Table 1": "Joint error of fish and mice",
    "Table 2": "Joint error of hands",
    "Table 3": "Frames per second",
    "Fig. 7": "Sensitivity to the method's five numbers",
    "Fig. 8": "Cumulative error",
    "Fig. 9": "Poses of all methods: fish and mouse",
    "Fig. 10": "Poses of all methods: hand",
    "Fig. 11": "The same hands from the side",
    "Fig. 12": "NYU hands with published poses",
    "Fig. 13": "Ranked candidates: fish",
    "Fig. 14": "Ranked candidates: mouse",
    "Fig. 15": "Ranked candidates: hand",
    "Fig. 16": "Convergence",
    "Fig. 17": "Failures",
    "Fig. 18": "Tracking and single frames",
    "Fig. 19": "Key frames and path of each action",
    "Fig. 20": "Confusions of actions",
}
_NEEDED = {
    "Fig. 10": "hand",
    "Fig. 11": "hand",
    "Fig. 13": "fish",
    "Fig. 14": "mouse",
    "Fig. 15": "hand",
}
_PART = {"Fig. 18": "tracking", "Fig. 19": "actions", "Fig. 20": "actions"}


def exhibits(
    results: Sequence[Results], further: Further, files: Sequence[Path], quick: bool
) -> list[dict[str, Any]]:
    """Tables 1 to 3 and Figures 1 to 20 in the paper's order.

    Args:
        results: what was measured, by animal.
        further: what other verbs measured.
        files: the figures that were drawn.
        quick: the run trained on next to nothing, so nothing is said of the order of methods.

    Returns:
        Of each `label`, `title`, `said` (what is the same, what not, and why), `tables` of caption,
        head and rows, `notes` in sentences, `pictures`, and `missing`: why there is nothing.
    """
    tables = {
        "Table 1": [table for r in results if r.animal != "hand" for table in _error_tables(r)],
        "Table 2": [
            *(table for r in results if r.animal == "hand" for table in _error_tables(r)),
            *_nyu_table(further),
        ],
        "Table 3": [
            ("", *rate_table(results)),
            ("How each row of Tables 1 to 3 was made", *origin_table(results)),
        ],
        "Fig. 18": _tracking_table(further),
        "Fig. 20": _actions_table(further),
    }
    notes = {
        "Table 1": [
            f"{r.animal}: {said}" for r in results if r.animal != "hand" for said in words(r, quick)
        ],
        "Table 2": [
            *(said for r in results if r.animal == "hand" for said in words(r, quick)),
            *([further.nyu["labels_used"]] if further.nyu else []),
            *([f"NYU: {further.missing['nyu']}."] if "nyu" in further.missing else []),
        ],
    }
    found = []
    for label in ("Table 1", "Table 2", "Table 3", *(f"Fig. {k}" for k in range(1, 21))):
        number = label.split()[1]
        if label.startswith("Fig.") and number in DRAWINGS:
            said = f"A drawing, not a measurement: {DRAWINGS[number]}."
            found.append(_exhibit(label, "Drawing", said))
            continue
        pattern = _PICTURES.get(label)
        pictures = [path for path in files if pattern and path.match(pattern)]
        said = _SENTENCES[label]
        if label == "Fig. 20" and further.actions:
            said += _QUICK_ACTIONS.format(**further.actions)
        one = _exhibit(label, TITLES[label], said)
        one |= {
            "tables": tables.get(label, []),
            "notes": notes.get(label, []),
            "pictures": pictures,
        }
        if not one["tables"] and not pictures:
            one["missing"] = _why_missing(label, results, further)
        found.append(one)
    return found


def _exhibit(label: str, title: str, said: str) -> dict[str, Any]:
    return {
        "label": label,
        "title": title,
        "said": said,
        "tables": [],
        "notes": [],
        "pictures": [],
        "missing": "",
    }


def _why_missing(label: str, results: Sequence[Results], further: Further) -> str:
    """Why nothing stands under a label."""
    animals = {r.animal for r in results}
    if (part := _PART.get(label)) in further.missing:
        return f"Not made: {further.missing[part or '']}."
    if label == "Fig. 7":
        told = [
            f"{r.animal}, {name.removeprefix('Fig. 7, ')}: {why}"
            for r in results
            for name, why in r.missing.items()
            if name.startswith(label)
        ]
        return "Not made. " + "; ".join(told) + "."
    if label == "Fig. 12":
        return "Not made: the folder of the NYU hand data was not named with --nyu."
    needed = _NEEDED.get(label)
    if needed is not None and needed not in animals:
        return f"Not made: the {needed} was not asked for; `--animal {needed}` makes it."
    return "Not made: no animal that it shows was asked for; without --animal all are."


def _error_tables(results: Results) -> list[Table]:
    """Medians of one animal, and its means."""
    return [
        (f"{results.animal}, rendered: median error, mm", *error_table(results)),
        (f"{results.animal}, rendered: mean error, mm", *mean_table(results)),
    ]


def _nyu_table(further: Further) -> list[Table]:
    """Published answers and ours on NYU frames."""
    if not further.nyu:
        return []
    rows = []
    ours = {"liex_lab": further.nyu["ours"]}
    same = {
        f"{name}, the frames of ours": {"method": f"{name}, on the frames of ours alone", **row}
        for name, row in further.nyu["same_frames"].items()
    }
    for name, row in {**further.nyu["published"], **same, **ours}.items():
        told = [str(row.get("method", name)), str(row["n_frames"])]
        for column in ("root_given_mm_14", "root_estimated_mm_14"):
            value = row.get(column)
            told.append("" if value is None else f"{value:.2f}")
        rows.append(told)
    head = ["method", "frames", "14 points, root given, mm", "14 points, root estimated, mm"]
    return [("NYU hands", head, rows)]


def _tracking_table(further: Further) -> list[Table]:
    """Errors of the rows of tracking."""
    told = further.tracking
    if not told:
        return []
    rows = [
        [
            told["row_names"][name],
            *(_shown(row.get(key)) for key in ("mean_joint_error_mm", "p95_joint_error_mm")),
            _shown(row.get("ratio_to_single")),
            _shown(row.get("lost_rate")),
        ]
        for name, row in told["rows"].items()
    ]
    caption = f"{told['animal']}, {told['sequence']} sequence, {told['n_frames']} frames"
    return [(caption, ["", "mean, mm", "95 %, mm", "ratio to single frames", "lost"], rows)]


def _actions_table(further: Further) -> list[Table]:
    """Accuracies of the recognisers on cut-out actions."""
    told: Mapping[str, Any] = further.actions
    if not told:
        return []
    rows = []
    for name, key, kind, published in (
        ("the paper's, tangent vectors", "tangent_accuracy", "tangent", "91.33 %"),
        ("the paper's, joint positions", "joint_accuracy", "joints", "79.19 %"),
        ("ours", "default_accuracy", "default", ""),
    ):
        low, high = told["accuracy_interval95"][kind]
        interval = f"{100 * low:.1f} to {100 * high:.1f} %"
        rows.append([name, f"{100 * told[key]:.1f} %", interval, published])
    head = ["recogniser", "accuracy", "95 % interval of sequences", "published, real fish"]
    return [("", head, rows)]


def _shown(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"
