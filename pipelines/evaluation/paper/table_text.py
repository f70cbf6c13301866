"""Tables 1 to 3 of Lie-X as CSV, Markdown and JSON, published numbers beside ours.

Table 1 is fish and mouse, Table 2 the hand (median and mean joint error, mm, by split and method),
Table 3 frames per second; `tables.json` has the figures by animal, split and method. Published
numbers are of real recordings with other cameras and other animals: they show the order of the
methods. Where ours come out in another order, and the 95 % intervals do not overlap, a sentence
says so.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.evaluation.pose import POSE_PROTOCOL, plain
from liex_lab.sessions.provenance import package_version

from .deviations import DEVIATIONS, HAND
from .kept import processor
from .published import OTHERS_FPS, OTHERS_MM, PUBLISHED_FPS, PUBLISHED_MM, TITLES

if TYPE_CHECKING:
    from .results import Results

_COLUMNS = (
    "animal",
    "split",
    "method",
    "variant",
    "median_mm",
    "mean_mm",
    "interval95",
    "mean_interval95",
    "wrong_object",
    "wrong_object_alone",
    "mean_joint_error_mm",
    "median_joint_error_mm",
    "p95_joint_error_mm",
    "flip_rate",
    "lost_rate",
    "n_frames",
    "n_recordings",
    "training_images",
    "seeds",
    "frames_per_s",
    "ratio_to_default",
    "published_mean_joint_error_mm",
    "published_frames_per_s",
    "origin",
    "processor",
    "other_processor",
    "seed",
    "version",
    "command",
)
_FLAT = (
    "median_mm",
    "mean_mm",
    "interval95",
    "mean_interval95",
    "run_median_mm",
    "wrong_object",
    "wrong_object_alone",
    "lost_rate",
    "n_frames",
    "n_recordings",
)
_WRONG = "another object measured (alone)"
QUICK = (
    "**A quick run: few frames, and every row but the default trained on next to nothing. Its "
    "numbers say that everything runs, and nothing about the methods.**"
)
HOW = (
    "The test frames are rendered, with arenas and animals that no model has seen; the cameras of "
    "other-camera (and of a quarter of sealed) have focal lengths and resolutions that no model "
    "was trained on, those of the other splits are of the makes that all learned from, at places "
    "of their own. Every row measures the same object in a frame, of the same size: background, "
    "floor, object and size are found by the product, and our default model chooses for all. "
    "*Another object measured* is the share of frames in which that object is not the animal; "
    "*alone*: in which it would not be for the paper's variant and the baselines, which choose by "
    "area and volume. *Flips*: head and tail are exchanged; *lost*: without a pose. "
    "Median first, with its 95 % interval by bootstrap over recordings: frames of one recording "
    "are not independent. Rows of the paper's variant are of three trainings, their numbers over "
    "all of them. Published numbers are means on real recordings, other cameras and other "
    "animals: they show the order of the methods, and are not to be compared with ours in "
    "millimetres. A row is *measured* in this run, or *kept*: measured earlier, with the command, "
    "seeds and version below; the notes name each one of another version of the program. A row of "
    "*another processor* was measured on another machine than this run's, where pictures and "
    "models can differ in the last digit of a number. Frames/s count the foreground too, on frames "
    "in memory; those of a kept row are of another run, so compare its ratio to "
    "the default, which was timed beside it."
)
SEALED = (
    "**The sealed split.** Its recordings are looked at once, when an issue ends: whoever chooses "
    "anything by these numbers breaks the seal for everybody."
)


def write_tables(folder: Path, results: Sequence[Results], quick: bool) -> list[Path]:
    """Write table1.csv to table3.csv, tables.md, tables.json and results.json into a folder.

    Args:
        folder: where they are written.
        results: what was measured, by animal; the hand goes into Table 2, all others into Table 1.
        quick: the run trained on next to nothing; the text says so, and draws no conclusion.

    Returns:
        The paths of the files.
    """
    first = [r for r in results if r.animal != "hand"]
    second = [r for r in results if r.animal == "hand"]
    written = []
    for number, part, only_rates in (
        (1, first, False),
        (2, second, False),
        (3, list(results), True),
    ):
        if part:
            rows = [row for r in part for row in _rows(r, only_rates)]
            written.append(_write_csv(folder / f"table{number}.csv", rows))
    text = [
        "# Tables 1 to 3 of Lie-X, on rendered test frames",
        *([QUICK] if quick else []),
        *([SEALED] if any(r.sealed for r in results) else []),
        HOW,
        POSE_PROTOCOL,
    ]
    for number, part in ((1, first), (2, second)):
        for r in part:
            text += [
                f"## Table {number}: {r.animal}, joint error in mm",
                _grid(*error_table(r)),
                _grid(*mean_table(r)),
                *([HAND] if r.animal == "hand" else []),
                *words(r, quick),
            ]
    text += [
        "## Table 3: frames per second",
        _grid(*rate_table(results)),
        "## How each row was made",
        _grid(*origin_table(results)),
        "## What differs from the paper",
        "\n".join(f"- {sentence}" for sentence in DEVIATIONS),
    ]
    (folder / "tables.md").write_text("\n\n".join(text) + "\n", encoding="utf-8")
    # the poses are with the rows; what is drawn of them holds pictures
    content = plain(
        {
            r.animal: {
                name: value
                for name, value in vars(r).items()
                if name not in ("examples", "failures")
            }
            for r in results
        }
    )
    (folder / "results.json").write_text(
        json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8"
    )
    flat = {r.animal: _by_split(r) for r in results}
    (folder / "tables.json").write_text(
        json.dumps(plain(flat), indent=1, allow_nan=False) + "\n", encoding="utf-8"
    )
    return [*written, *(folder / name for name in ("tables.md", "tables.json", "results.json"))]


def _by_split(results: Results) -> dict[str, dict[str, dict[str, Any]]]:
    """The figures of `tables.json`: by split and variant."""
    return {
        split: {
            variant: {
                **{name: row["splits"][split].get(name) for name in _FLAT},
                "training_images": row["made"]["training_images"],
                "seeds": row["made"]["seeds"],
                "origin": row["origin"],
                "processor": row["made"].get("processor"),
                "other_processor": _other_processor(row),
            }
            for variant, row in results.rows.items()
        }
        for split in results.splits
    }


def _other_processor(row: dict[str, Any]) -> str | None:
    """The processor of a row that was measured on another one than this run's."""
    known = row["made"].get("processor")
    return None if known == processor() else known


def _rows(results: Results, only_rates: bool) -> Iterator[dict[str, Any]]:
    """The rows of a CSV: one for each method and split, or for its rate one for each method."""
    published = PUBLISHED_MM.get(results.animal, {})
    for variant, row in results.rows.items():
        fixed = {
            "animal": results.animal,
            "method": TITLES[variant],
            "variant": variant,
            "origin": row["origin"],
            "other_processor": _other_processor(row),
            **row["made"],
            **row["rate"],
            "published_mean_joint_error_mm": published.get(variant),
            "published_frames_per_s": PUBLISHED_FPS.get(results.animal)
            if variant == "paper"
            else None,
        }
        if only_rates:
            yield fixed
            continue
        for split, numbers in row["splits"].items():
            yield {**fixed, "split": split, **numbers}


def _write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> Path:
    with path.open("w", encoding="utf-8", newline="") as file:
        used = [name for name in _COLUMNS if any(row.get(name) is not None for row in rows)]
        writer = csv.DictWriter(file, used, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    return path


def _grid(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _number(value: float | None, digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def error_table(results: Results) -> tuple[list[str], list[list[str]]]:
    """One animal's medians: a row for each method, and one for the objects that all measured.

    Args:
        results: of the animal.

    Returns:
        The head, and the rows.
    """
    published = PUBLISHED_MM.get(results.animal, {})
    rows = []
    for variant, title in TITLES.items():
        row = results.rows.get(variant)
        cells = [""] * len(results.splits)
        if row is not None:
            cells = [_median(row["splits"][split]) for split in results.splits]
        origin = "not measured" if row is None else _origin(row)
        rows.append([title, *cells, _number(published.get(variant)), origin])
    if results.animal == "hand":
        for title, value in OTHERS_MM.items():
            rows.append([title, *[""] * len(results.splits), _number(value), "published"])
    if results.rows:
        given = next(iter(results.rows.values()))["splits"]  # what all rows are given alike
        rows.append([_WRONG, *(_wrong(given[split]) for split in results.splits), "", ""])
    head = ["method", *(f"{split}: median (95\u00a0%)" for split in results.splits)]
    return [*head, "published, other data: mean", "row"], rows


def mean_table(results: Results) -> tuple[list[str], list[list[str]]]:
    """One animal's means, frames with head and tail exchanged, and lost ones, by method and split.

    Args:
        results: of the animal.

    Returns:
        The head, and the rows.
    """
    rows = []
    for variant, row in results.rows.items():
        numbers = [row["splits"][split] for split in results.splits]
        cells = [text for one in numbers for text in (_number(one["mean_mm"]), _flips(one))]
        lost = "/".join(f"{100 * one['lost_rate']:.1f}" for one in numbers)
        n_frames = "/".join(str(one["n_frames"]) for one in numbers)
        rows.append([TITLES[variant], *cells, lost, n_frames])
    head = ["method", *(text for split in results.splits for text in (f"{split}: mean", "flips"))]
    return [*head, "lost, %", "frames"], rows


def _origin(row: dict[str, Any]) -> str:
    """Measured in this run, or kept, and then on what other processor."""
    return f"{row['origin']}{', another processor' if _other_processor(row) else ''}"


def _median(numbers: dict[str, Any]) -> str:
    """Median with its interval."""
    bounds = numbers.get("interval95")
    interval = f" ({_number(bounds[0])} to {_number(bounds[1])})" if bounds else ""
    return _number(numbers["median_mm"]) + interval


def _wrong(numbers: dict[str, Any]) -> str:
    """Share of frames in which another object was measured, and would be by area and volume."""
    return f"{100 * numbers['wrong_object']:.2f} % ({100 * numbers['wrong_object_alone']:.2f} %)"


def _flips(numbers: dict[str, Any]) -> str:
    flips = numbers["flip_rate"]
    return "" if flips is None else f"{100 * flips:.1f} %"


def words(results: Results, quick: bool) -> list[str]:
    """Which rows are missing, which were kept by another version or of other postures, and where
    the order is not the paper's.

    Of a quick run nothing is said of the order.

    Args:
        results: of one animal.
        quick: the rows were trained on next to nothing.

    Returns:
        Sentences.
    """
    sentences = [f"Test postures are {results.test_postures}."] if results.test_postures else []
    sentences += [
        f"{TITLES.get(variant, variant)} was not measured: {why}."
        for variant, why in results.missing.items()
    ]
    for name, row in results.rows.items():
        sentences += _notes(TITLES[name], row, results.test_postures)
    for name, curve in results.sensitivity.items():
        sentences += _notes(f"Fig. 7, {name},", curve, "")
    if quick:
        return sentences
    for variant in results.rows:
        if places := _where_ahead(results, variant, "default"):
            sentences.append(f"{TITLES[variant]} is ahead of the default on {places}.")
    turned = list(_turned_pairs(results))
    published = PUBLISHED_MM.get(results.animal, {})
    if not turned and published and set(published) <= set(results.rows):
        sentences.append(
            "No two methods come out in another order than the paper's with intervals apart."
        )
    return sentences + turned


def _notes(title: str, entry: dict[str, Any], test_postures: str) -> Iterator[str]:
    """What a reader has to know of a kept row or curve."""
    if entry.get("origin") != "kept":
        return
    made = entry["made"]
    postures = made.get("test_postures")
    if made["version"] != package_version("liex_lab"):
        yield f"{title} was measured by version {made['version']} with `{made['command']}`."
    if postures and postures != test_postures:
        yield f"{title} was measured with test postures {postures}."


def _where_ahead(results: Results, a: str, b: str) -> str:
    """The splits on which a variant's median is below another's and their intervals are apart."""
    if a not in results.rows or b not in results.rows:
        return ""
    found = []
    for split in results.splits:
        first, second = (results.rows[name]["splits"][split] for name in (a, b))
        intervals = first.get("interval95"), second.get("interval95")
        if None not in intervals and intervals[0][1] < intervals[1][0]:
            found.append(
                f"{split} (median {first['median_mm']:.2f} against {second['median_mm']:.2f} mm)"
            )
    return ", ".join(found)


def _turned_pairs(results: Results) -> Iterator[str]:
    """Pairs of rows whose order is not the published one on some split."""
    published = PUBLISHED_MM.get(results.animal, {})
    for a, b in combinations(published, 2):
        ahead, behind = (a, b) if published[a] < published[b] else (b, a)
        if places := _where_ahead(results, behind, ahead):
            yield (
                f"In the paper, {TITLES[ahead]} (mean {published[ahead]:.2f} mm) is ahead of "
                f"{TITLES[behind]} ({published[behind]:.2f} mm); here, on the same object and with "
                f"the differences below, {TITLES[behind]} is ahead on {places}."
            )


def rate_table(results: Sequence[Results]) -> tuple[list[str], list[list[str]]]:
    """Frames per second of each method.

    Args:
        results: of all animals.

    Returns:
        The head, and the rows.
    """
    rows = []
    for r in results:
        for variant, row in r.rows.items():
            rate = row["rate"]
            published = _number(PUBLISHED_FPS.get(r.animal) if variant == "paper" else None, 0)
            rows.append(
                [
                    r.animal,
                    TITLES[variant],
                    _number(rate["frames_per_s"], 0),
                    _number(rate["ratio_to_default"], 3),
                    rate["picture"],
                    str(rate["cores"]),
                    published,
                    _origin(row),
                ]
            )
    for title, value in OTHERS_FPS.items() if any(r.animal == "hand" for r in results) else ():
        rows.append(["hand", title, "", "", "", "", f"{_number(value, 0)} (GPU)", "published"])
    head = ["animal", "method", "frames/s", "ratio to default", "picture", "cores", "published"]
    return [*head, "row"], rows


def origin_table(results: Sequence[Results]) -> tuple[list[str], list[list[str]]]:
    """Command, seed, version and amount of training of each row.

    Args:
        results: of all animals.

    Returns:
        The head, and the rows.
    """
    rows = []
    for r in results:
        for variant, row in r.rows.items():
            made = row["made"]
            rows.append(
                [
                    r.animal,
                    TITLES[variant],
                    _origin(row),
                    str(made["training_images"] or ""),
                    f"{made['seed']} ({len(made['seeds'])})",
                    f"{made['version']}, {made['date']}",
                    ", ".join(filter(None, (made["machine"], made.get("processor")))),
                    f"`{made['command']}`",
                ]
            )
    head = ["animal", "method", "row", "training images", "seed (trainings)", "version, date"]
    return [*head, "machine", "command"], rows
