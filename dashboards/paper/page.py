"""Tables 1 to 3 of the Lie-X paper as CSV and Markdown, and index.html with every table and figure.

The data come from `liex evaluate tables`, the sentences from `templates`. The page embeds its
figures and loads nothing from the network.
"""

import base64
import json
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import pandas as pd
from markupsafe import Markup, escape

from liex_lab.evaluation.scores import POSE_PROTOCOL, plain
from liex_lab.runtime.durable import write_whole
from liex_lab.sessions.provenance import package_version

from ..units import page
from .figures import draw_paper
from .published import DEVIATIONS, HAND, OTHERS_FPS, OTHERS_MM, PUBLISHED_FPS, PUBLISHED_MM, TITLES

Results = Mapping[str, Any]  # results of one animal, by the job's names
Table = Sequence[Mapping[str, str]]  # rows, by the heads of their columns

_TEMPLATES = Path(__file__).parent / "templates"
_SPLIT_COLUMNS = (  # of a table's row that differ by split
    *("split", "median_mm", "mean_mm", "interval95", "mean_interval95", "wrong_object"),
    *("wrong_object_alone", "mean_joint_error_mm", "median_joint_error_mm", "p95_joint_error_mm"),
    *("flip_rate", "lost_rate", "n_frames", "n_recordings"),
)
_COLUMNS = (
    *("animal", "split", "method", "variant", *_SPLIT_COLUMNS[1:], "training_images", "seeds"),
    *("frames_per_s", "ratio_to_default", "published_mean_joint_error_mm"),
    *("published_frames_per_s", "origin", "processor", "other_processor", "seed", "version"),
    "command",
)
_JSON_COLUMNS = (
    *("median_mm", "mean_mm", "interval95", "mean_interval95", "run_median_mm", "wrong_object"),
    *("wrong_object_alone", "lost_rate", "n_frames", "n_recordings", "training_images", "seeds"),
    *("origin", "processor", "other_processor"),
)
_LABELS = (*(f"Table {k}" for k in (1, 2, 3)), *(f"Fig. {k}" for k in range(1, 21)))
_FIGURES = {  # by label, names of the files
    **{f"Fig. {k}": f"fig{k:02d}_*.png" for k in (7, 8, 9, 10, 11, 12, 16, 17, 18, 19, 20)},
    "Fig. 13": "fig13_candidates_fish.png",
    "Fig. 14": "fig13_candidates_mouse.png",
    "Fig. 15": "fig13_candidates_hand.png",
}
_ANIMAL = {
    **dict.fromkeys(("Fig. 10", "Fig. 11", "Fig. 15"), "hand"),
    "Fig. 13": "fish",
    "Fig. 14": "mouse",
}


def write_paper(
    folder: Path, results: Sequence[Results], further: Mapping[str, Any], quick: bool
) -> list[Path]:
    """Write the tables as CSV, Markdown and JSON, the figures, and the page that contains them all.

    Args:
        folder: where the files are written.
        results: by animal; the hand goes into Table 2, all others into Table 1.
        further: results of other verbs, see `liex_lab.pipelines.evaluation.paper.run`.
        quick: the rows were trained on very little data; the text states this and draws no
            conclusions.

    Returns:
        The paths of the files.
    """
    table = frame(results)
    hand = table["animal"] == "hand"
    rates = table.drop_duplicates(["animal", "variant"]).drop(columns=[*_SPLIT_COLUMNS])
    written = []
    for number, part in ((1, table[~hand]), (2, table[hand]), (3, rates)):
        if len(part):
            written.append(folder / f"table{number}.csv")
            part = part.reindex(columns=[*_COLUMNS]).dropna(axis=1, how="all")
            part.to_csv(written[-1], index=False, lineterminator="\r\n")
    by_split = json.dumps(_by_split(table), indent=1, allow_nan=False)
    figures = draw_paper(results, further, folder)
    shown = {
        "quick": quick,
        "sealed": any(r["sealed"] for r in results),
        "differences": DEVIATIONS,
        "hand": HAND,
        "protocol": POSE_PROTOCOL,
        "animals": [_in_markdown(r, quick) for r in results],
        "rates": _grid(rate_table(results)),
        "origins": _grid(origin_table(results)),
        "actions": further["actions"],
        "exhibits": exhibits(results, further, figures, quick),
    }
    texts = {
        "tables.json": by_split + "\n",
        "tables.md": page(_TEMPLATES / "tables.md.j2", **shown),
        "index.html": page(_TEMPLATES / "page.html.j2", **shown),
    }
    for name, text in texts.items():
        write_whole(folder / name, text)
    return [*written, *figures, *(folder / name for name in texts)]


def frame(results: Sequence[Results]) -> pd.DataFrame:
    """Every row on every split of every animal, with its provenance and the published values."""
    return pd.DataFrame(
        [
            {
                "animal": r["animal"],
                "method": TITLES[variant],
                "variant": variant,
                "origin": row["origin"],
                "other_processor": row["other_processor"],
                **row["made"],
                **row["rate"],
                "published_mean_joint_error_mm": PUBLISHED_MM.get(r["animal"], {}).get(variant),
                "published_frames_per_s": _published_rate(r, variant),
                "split": split,
                **numbers,
            }
            for r in results
            for variant, row in r["rows"].items()
            for split, numbers in row["splits"].items()
        ],
        dtype=object,
    )


def _published_rate(results: Results, variant: str) -> float | None:
    return PUBLISHED_FPS.get(results["animal"]) if variant == "paper" else None


def _by_split(table: pd.DataFrame) -> dict[str, Any]:
    """The numbers of tables.json by animal, split and variant."""
    found: dict[str, Any] = {}
    for row in table.to_dict("records"):
        of_split = found.setdefault(row["animal"], {}).setdefault(row["split"], {})
        of_split[row["variant"]] = {name: row.get(name) for name in _JSON_COLUMNS}
    return plain(found)


def _in_markdown(results: Results, quick: bool) -> dict[str, Any]:
    """The tables and notes of one animal for tables.md."""
    hand = results["animal"] == "hand"
    return {
        "animal": results["animal"],
        "number": 2 if hand else 1,
        "tables": [_grid(error_table(results)), _grid(mean_table(results))],
        "notes": [
            Markup(note)  # nosec B704: Markdown of our own sentences, not HTML
            for note in [*([HAND] if hand else []), *notes_of(results, quick)]
        ],
    }


def _cells(table: Table) -> tuple[list[str], list[list[str]]]:
    """Head and rows of a table."""
    head = list(dict.fromkeys(name for row in table for name in row))
    return head, [[row.get(name, "") for name in head] for row in table]


def _grid(table: Table) -> Markup:
    """A table in Markdown."""
    head, rows = _cells(table)
    lines = (f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *rows))
    return Markup("\n".join(lines))  # nosec B704: Markdown of our own numbers, not HTML


def _number(value: float | None, digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def error_table(results: Results) -> Table:
    """One animal's medians: a row per method, and one for wrong objects, common to all methods."""
    published = PUBLISHED_MM.get(results["animal"], {})
    heads = {split: f"{split}: median (95\u00a0%)" for split in results["splits"]}
    theirs = "published, other data: mean"
    rows = []
    for variant, title in TITLES.items():
        row = results["rows"].get(variant)
        medians = {heads[s]: _median(row["splits"][s]) if row else "" for s in heads}
        rows.append(
            {
                "method": title,
                **medians,
                theirs: _number(published.get(variant)),
                "row": _origin(row),
            }
        )
    if results["animal"] == "hand":
        rows += [
            {"method": title, theirs: _number(value), "row": "published"}
            for title, value in OTHERS_MM.items()
        ]
    for row in [*results["rows"].values()][:1]:  # every row is given the same objects
        wrong = {
            head: f"{100 * one['wrong_object']:.2f} % ({100 * one['wrong_object_alone']:.2f} %)"
            for split, head in heads.items()
            for one in (row["splits"][split],)
        }
        rows.append({"method": "another object measured (alone)", **wrong})
    return rows


def mean_table(results: Results) -> Table:
    """One animal's means, flips and lost frames, by method and split."""
    rows = []
    for variant, row in results["rows"].items():
        cells = {"method": TITLES[variant]}
        numbers = {split: row["splits"][split] for split in results["splits"]}
        for split, one in numbers.items():
            flips = one["flip_rate"]
            cells[f"{split}: mean"] = _number(one["mean_mm"])
            cells[f"{split}: flips"] = "" if flips is None else f"{100 * flips:.1f} %"
        cells["lost, %"] = "/".join(f"{100 * one['lost_rate']:.1f}" for one in numbers.values())
        cells["frames"] = "/".join(str(one["n_frames"]) for one in numbers.values())
        rows.append(cells)
    return rows


def _origin(row: Mapping[str, Any] | None) -> str:
    """Whether a row was measured in this run or kept, and if kept, on another processor."""
    if row is None:
        return "not measured"
    return f"{row['origin']}{', another processor' if row['other_processor'] else ''}"


def _median(numbers: Mapping[str, Any]) -> str:
    bounds = numbers.get("interval95")
    return _number(numbers["median_mm"]) + (
        f" ({_number(bounds[0])} to {_number(bounds[1])})" if bounds else ""
    )


def rate_table(results: Sequence[Results]) -> Table:
    """Frames per second of each method."""
    hand = any(r["animal"] == "hand" for r in results)
    return [
        {
            "animal": r["animal"],
            "method": TITLES[variant],
            "frames/s": _number(row["rate"]["frames_per_s"], 0),
            "ratio to default": _number(row["rate"]["ratio_to_default"], 3),
            "image": row["rate"]["picture"],
            "cores": str(row["rate"]["cores"]),
            "published": _number(_published_rate(r, variant), 0),
            "row": _origin(row),
        }
        for r in results
        for variant, row in r["rows"].items()
    ] + [
        {"animal": "hand", "method": title, "published": f"{rate} (GPU)", "row": "published"}
        for title, rate in OTHERS_FPS.items()
        if hand
    ]


def origin_table(results: Sequence[Results]) -> Table:
    """Command, seed, version and amount of training of each row."""
    return [
        {
            "animal": r["animal"],
            "method": TITLES[variant],
            "row": _origin(row),
            "training images": str(made["training_images"] or ""),
            "seed (trainings)": f"{made['seed']} ({len(made['seeds'])})",
            "version, date": f"{made['version']}, {made['date']}",
            "machine": ", ".join(filter(None, (made["machine"], made.get("processor")))),
            "command": f"`{made['command']}`",
        }
        for r in results
        for variant, row in r["rows"].items()
        for made in (row["made"],)
    ]


def notes_of(results: Results, quick: bool) -> list[str]:
    """Notes on missing rows, other versions, other test postures, and different rankings.

    A quick run makes no claim about the order of the methods.
    """
    postures, published = results["test_postures"], PUBLISHED_MM.get(results["animal"], {})
    notes = [f"Test postures are {postures}."] if postures else []
    for variant, why in results["missing"].items():
        notes.append(f"{TITLES.get(variant, variant)} was not measured: {why}.")
    for name, row in results["rows"].items():
        notes += _kept_notes(TITLES[name], row, postures)
    for name, curve in results["sensitivity"].items():
        notes += _kept_notes(f"Fig. 7, {name},", curve, "")
    if quick:
        return notes
    for variant in results["rows"]:
        if splits := _where_ahead(results, variant, "default"):
            notes.append(f"{TITLES[variant]} is ahead of the default on {splits}.")
    turned = []
    for pair in combinations(published, 2):
        ahead, behind = sorted(pair, key=published.__getitem__)
        if splits := _where_ahead(results, behind, ahead):
            turned.append(
                f"In the paper, {TITLES[ahead]} (mean {published[ahead]:.2f} mm) is ahead of "
                f"{TITLES[behind]} ({published[behind]:.2f} mm); here, on the same object and with "
                f"the differences below, {TITLES[behind]} is ahead on {splits}."
            )
    if not turned and published and set(published) <= set(results["rows"]):
        notes.append("No two methods rank differently from the paper with disjoint intervals.")
    return notes + turned


def _kept_notes(title: str, entry: Mapping[str, Any], postures: str) -> Iterator[str]:
    """Caveats about a kept row or curve."""
    if entry.get("origin") != "kept":
        return
    made = entry["made"]
    if made["version"] != package_version("liex_lab"):
        yield f"{title} was measured by version {made['version']} with `{made['command']}`."
    if made.get("test_postures", postures) not in ("", postures):
        yield f"{title} was measured with test postures {made['test_postures']}."


def _where_ahead(results: Results, a: str, b: str) -> str:
    """The splits on which a variant's median is below another's with disjoint intervals."""
    if not {a, b} <= set(results["rows"]):
        return ""
    found = []
    for split in results["splits"]:
        first, second = (results["rows"][name]["splits"][split] for name in (a, b))
        intervals = first.get("interval95"), second.get("interval95")
        if None not in intervals and intervals[0][1] < intervals[1][0]:
            medians = f"{first['median_mm']:.2f} against {second['median_mm']:.2f} mm"
            found.append(f"{split} (median {medians})")
    return ", ".join(found)


def exhibits(
    results: Sequence[Results], further: Mapping[str, Any], figures: Sequence[Path], quick: bool
) -> dict[str, dict[str, Any]]:
    """The page's content for each label of the paper: tables, notes and figures, or why it is
    empty.
    """
    tables: dict[str, list[tuple[str, Table]]] = {label: [] for label in _LABELS}
    notes: dict[str, list[str]] = {label: [] for label in _LABELS}
    for r in results:
        hand = r["animal"] == "hand"
        label = "Table 2" if hand else "Table 1"
        tables[label].append((f"{r['animal']}, rendered: median error, mm", error_table(r)))
        tables[label].append((f"{r['animal']}, rendered: mean error, mm", mean_table(r)))
        notes[label] += [note if hand else f"{r['animal']}: {note}" for note in notes_of(r, quick)]
    tables["Table 3"].append(("", rate_table(results)))
    tables["Table 3"].append(("How each row of Tables 1 to 3 was made", origin_table(results)))
    if further["nyu"]:
        tables["Table 2"].append(("NYU hands", _nyu_table(further["nyu"])))
    else:
        notes["Table 2"].append(f"NYU: {further['missing']['nyu']}.")
    if tracking := further["tracking"]:
        caption = "{animal}, {sequence} sequence, {n_frames} frames".format_map(tracking)
        tables["Fig. 18"].append((caption, _tracking_table(tracking)))
    if further["actions"]:
        tables["Fig. 20"].append(("", _actions_table(further["actions"])))
    found = {}
    for label in _LABELS:
        pattern = _FIGURES.get(label)
        drawn = [_image(path) for path in figures if pattern and path.match(pattern)]
        empty = not tables[label] and not drawn
        found[label] = {
            "id": label.lower().replace(".", "").replace(" ", "-"),
            "tables": [_in_html(caption, table) for caption, table in tables[label]],
            "notes": [_with_code(note) for note in notes[label]],
            "figures": drawn,
            "missing": _with_code(_why_missing(label, results, further) if empty else ""),
        }
    return found


def _why_missing(label: str, results: Sequence[Results], further: Mapping[str, Any]) -> str:
    """Why a label is empty; '' for the paper's drawings."""
    part = {
        "Fig. 12": "nyu",
        "Fig. 18": "tracking",
        "Fig. 19": "actions",
        "Fig. 20": "actions",
    }.get(label, "")
    if part in further["missing"]:
        return f"Not made: {further['missing'][part]}."
    if label == "Fig. 7":
        why = [
            f"{r['animal']}, {name.removeprefix('Fig. 7, ')}: {reason}"
            for r in results
            for name, reason in r["missing"].items()
            if name.startswith(label)
        ]
        return f"Not made. {'; '.join(why)}."
    animal = _ANIMAL.get(label)
    if animal and animal not in {r["animal"] for r in results}:
        return f"Not made: the {animal} was not asked for; `--animal {animal}` makes it."
    if label not in _FIGURES:
        return ""
    return "Not made: no animal that it shows was asked for; without --animal all are."


def _nyu_table(nyu: Mapping[str, Any]) -> Table:
    """Published results and ours on NYU frames."""
    same = {
        f"{name}, the frames of ours": {"method": f"{name}, on the frames of ours alone", **row}
        for name, row in nyu["same_frames"].items()
    }
    return [
        {
            "method": str(row.get("method", name)),
            "frames": str(row["n_frames"]),
            "14 points, root given, mm": _number(row.get("root_given_mm_14")),
            "14 points, root estimated, mm": _number(row.get("root_estimated_mm_14")),
        }
        for name, row in {**nyu["published"], **same, "liex_lab": nyu["ours"]}.items()
    ]


def _tracking_table(tracking: Mapping[str, Any]) -> Table:
    """Errors of each tracker."""
    return [
        {
            "": tracking["row_names"][name],
            "mean, mm": _number(row.get("mean_joint_error_mm")),
            "95 %, mm": _number(row.get("p95_joint_error_mm")),
            "ratio to single frames": _number(row.get("ratio_to_single")),
            "lost": _number(row.get("lost_rate")),
        }
        for name, row in tracking["rows"].items()
    ]


def _actions_table(actions: Mapping[str, Any]) -> Table:
    """Accuracies of the recognisers on cut-out actions."""
    return [
        {
            "recogniser": name,
            "accuracy": f"{100 * actions[key]:.1f} %",
            "95 % interval of sequences": "{:.1f} to {:.1f} %".format(
                *(100 * bound for bound in actions["accuracy_interval95"][kind])
            ),
            "published, real fish": published,
        }
        for name, key, kind, published in (
            ("the paper's, tangent vectors", "tangent_accuracy", "tangent", "91.33 %"),
            ("the paper's, joint positions", "joint_accuracy", "joints", "79.19 %"),
            ("ours", "default_accuracy", "default", ""),
        )
    ]


def _in_html(caption: str, table: Table) -> tuple[str, Sequence[str], list[Any], list[str]]:
    """A table for the template; text columns get the class `text`, others `number`."""
    head, rows = _cells(table)
    kinds = []
    for column in zip(*rows, strict=True):
        cells = [cell for cell in column if cell]
        numbers = sum(cell[0].isdigit() or cell[0] == "-" for cell in cells)
        kinds.append("number" if cells and 2 * numbers > len(cells) else "text")
    return caption, head, [[_with_code(cell) for cell in row] for row in rows], kinds


def _with_code(text: str) -> Markup:
    """Escape a text of ours and turn what is between backticks into code."""
    return Markup(re.sub("`([^`]*)`", r"<code>\1</code>", str(escape(text))))  # nosec B704: escaped


def _image(path: Path) -> dict[str, Any]:
    """A PNG for the template."""
    content = path.read_bytes()
    (width,) = struct.unpack(">I", content[16:20])  # of the header chunk
    # letters become as large as the page's
    return {
        "name": path.stem.replace("_", " "),
        "width": round(0.72 * width),
        "data": "data:image/png;base64," + base64.b64encode(content).decode("ascii"),
    }
