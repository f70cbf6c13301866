"""Cache of evaluation results whose models take long to train: JSON in `datasets/kept_results`.

Each row is kept with how it was made (recipe, method, command, version) and with hashes of code,
training pictures, models, test pictures and foreground; it is used again where those but of the
models agree with what would be measured now. Code, recipe and method must. The hashes of pictures
change with the last digit of a float, and so with the kind of processor: a row that was kept on
another one is used where what it was given agrees in numbers (`given`), and the tables say so.
Anything else is refused with the reason. A model that training gave here in another file is
compared by its poses (`kept_examples`). The files are part of the repository, so they hold what the
page needs and no more, a list a line.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.catalog import kept_results_folder
from liex_lab.errors import LiexError

from .fingerprints import fingerprint_of
from .given import Given, processor, training_differs
from .results import ELSEWHERE
from .rows import SWEPT

if TYPE_CHECKING:
    from .common_view import CommonView

SCHEMA = 3
_DIGITS = 6  # significant ones of a measured number
_LINE = 160  # characters of a value that stands on one line


def kept_results(animal: str, folder: Path | None = None) -> dict[str, Any]:
    """What is kept for an animal: `rows` and `sensitivity` by variant, empty where nothing is.

    Args:
        animal: name of the skeleton.
        folder: where results are kept; None takes datasets/kept_results.

    Raises:
        LiexError: the file is no JSON, or of another schema.
    """
    path = (folder or kept_results_folder()) / f"{animal}.json"
    if not path.is_file():
        return {"rows": {}, "sensitivity": {}}
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise LiexError(
            f"the kept results {path} should be JSON, but: {error}; install liex_lab again"
        ) from None
    if kept.get("schema") != SCHEMA:
        raise LiexError(
            f"the kept results {path} are of schema {kept.get('schema')}, not {SCHEMA}; use --fresh"
        )
    described = kept.pop("given", {})
    for row in kept["rows"].values():
        for numbers in row["splits"].values():
            if numbers["fingerprint"] in described:
                numbers["given"] = described[numbers["fingerprint"]]
    return dict(kept)


def keep_results(
    folder: Path, animal: str, rows: Mapping[str, Any], sensitivity: Mapping[str, Any]
) -> Path:
    """Write results in the form in which they are kept.

    Copied into datasets/kept_results they are used again.

    Args:
        folder: where `ANIMAL.json` is written; it is made where it is missing.
        animal: name of the skeleton.
        rows: figures by variant. Of `default`, which is measured each time, nothing is kept, and
            failures only of the variants that Fig. 17 shows.
        sensitivity: curves by variant.

    Returns:
        The path of the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{animal}.json"
    content = {
        "schema": SCHEMA,
        "animal": animal,
        "rows": {name: _kept(name, row) for name, row in rows.items() if name != "default"},
        "sensitivity": dict(sensitivity),
        "given": _given(rows),
    }
    path.write_text(_a_list_a_line(content) + "\n", encoding="utf-8")
    return path


def _kept(variant: str, row: Mapping[str, Any]) -> dict[str, Any]:
    """What is kept of a row."""
    # what it was made from is compared to the last digit, and is not rounded
    splits = {
        split: {key: _rounded(value) for key, value in numbers.items() if key != "given"}
        for split, numbers in row["splits"].items()
    }
    return {
        **{key: value for key, value in row.items() if key != "failures" or variant in SWEPT},
        "splits": splits,
        "rate": _rounded(row["rate"]),
    }


def _given(rows: Mapping[str, Any]) -> dict[str, Any]:
    """What the kept rows were given, by the fingerprint of a split: mostly all were given alike."""
    return {
        numbers["fingerprint"]: numbers["given"]
        for name, row in rows.items()
        if name != "default"
        for numbers in row["splits"].values()
        if "given" in numbers
    }


def _rounded(value: Any) -> Any:
    """Plain values with their numbers rounded."""
    if isinstance(value, Mapping):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def _a_list_a_line(value: Any, indent: str = "") -> str:
    """JSON with sorted keys in which a short value, a pose and a list of anything but poses take
    one line.
    """
    short = json.dumps(value, sort_keys=True, allow_nan=False)
    inner = indent + " "
    if isinstance(value, Mapping) and len(short) > _LINE and not _is_pose(value):
        items = [f"{json.dumps(k)}: {_a_list_a_line(value[k], inner)}" for k in sorted(value)]
    elif isinstance(value, list) and value and _is_pose(value[0]):
        items = [_a_list_a_line(one, inner) for one in value]
    else:
        return short
    opened, closed = "{}" if isinstance(value, Mapping) else "[]"
    return opened + ",".join(f"\n{inner}{item}" for item in items) + f"\n{indent}{closed}"


def _is_pose(value: Any) -> bool:
    """Whether a value is what an example or a failure shows."""
    return isinstance(value, Mapping) and "joints_mm" in value


def why_refused(
    row: Mapping[str, Any],
    made_from: Mapping[str, Any],
    hashes: Mapping[str, Any],
    views: Mapping[str, Sequence[CommonView]],
    given: Mapping[str, Given],
) -> str:
    """Why a kept row must not stand for what would be measured now; empty where it may.

    Args:
        row: the kept row.
        made_from: how the row's model would be trained now.
        hashes: of today's code, training pictures and, where they are at hand, models; see
            `run.hashes_of`.
        views: what every row is given now, by split and recording; a kept row of more recordings
            does not fit.
        given: the same in numbers, by split.
    """
    made = row["made"]
    if made["from"] != json.loads(json.dumps(made_from)):
        return "the kept row is of another training or method"
    if made.get("learning_code") != hashes["learning_code"]:
        return "the kept row is of other code"
    if len(made.get("models", [])) != len(hashes["models"]):
        return "the kept row is of another number of models"
    other = _other_hash(row, hashes, views)
    if not other:
        return ""
    if apart := _other_postures(made, hashes):
        return apart
    why = f"the kept row is of {other}"
    if made.get("processor", processor()) == processor():  # or nobody knows of which
        return why
    if apart := _apart(row, hashes, given):
        return f"{why}, and its processor ({made['processor']}) does not explain that: {apart}"
    return ""


def _other_hash(
    row: Mapping[str, Any], hashes: Mapping[str, Any], views: Mapping[str, Sequence[CommonView]]
) -> str:
    """What was made with other floats than today's, by its hash; '' where nothing was."""
    made = row["made"]
    if made.get("training_pictures") != hashes["training_pictures"]:
        return "other training pictures"
    for split, ours in views.items():
        if row["splits"].get(split, {}).get("fingerprint") != fingerprint_of(ours):
            return f"other test pictures or another foreground on {split}"
    return ""


def _other_postures(made: Mapping[str, Any], hashes: Mapping[str, Any]) -> str:
    """That test postures come from elsewhere today, which alone makes other pictures; '' if not."""
    then, now = made.get("test_postures"), hashes.get("test_postures")
    if not then or then == now:
        return ""
    return (
        f"the kept row is of hands in postures {then}, and those of today are {now}; labels of "
        f"hands are looked for in the folder that LIEX_NYU names, or else beside the repository"
    )


def _apart(row: Mapping[str, Any], hashes: Mapping[str, Any], given: Mapping[str, Given]) -> str:
    """In what a row was given something else than it would be today, in numbers; '' in nothing."""
    trained = row["made"].get("training_given")
    if trained is None:
        return "nothing tells its training pictures in numbers"
    if told := training_differs(trained, hashes["training_given"]):
        return told
    for split, today in given.items():
        then = row["splits"].get(split, {}).get("given")
        if then is None:
            return f"nothing tells in numbers what it was given on {split}"
        if told := Given.from_dict(then).differs(today):
            return f"on {split}, {told}"
    return ""


def taken(
    row: Mapping[str, Any],
    hashes: Mapping[str, Any],
    views: Mapping[str, Sequence[CommonView]],
    given: Mapping[str, Given],
) -> dict[str, Any]:
    """A kept row that is not refused, as it stands in the results.

    Where every hash is today's, the row was given what is given today: it gets the numbers that say
    so, where test postures come from, and today's processor as the one on which its pictures come
    out, unless it has its own. Where one is not, the row names the processor that it is of
    (`other_processor`).

    Args:
        row: the kept row.
        hashes: of today's training pictures and models, the pictures in numbers, and where test
            postures come from.
        views: what every row is given now, by split and recording.
        given: the same in numbers, by split.
    """
    made = row["made"]
    if _other_hash(row, hashes, views):
        return {**row, ELSEWHERE: made["processor"]}
    known = {"training_given": hashes["training_given"], "processor": processor()}
    if "test_postures" in hashes:
        known["test_postures"] = hashes["test_postures"]
    splits = {
        split: {"given": given[split].to_dict(), **numbers} if split in given else numbers
        for split, numbers in row["splits"].items()
    }
    return {**row, "made": {**known, **made}, "splits": splits}
