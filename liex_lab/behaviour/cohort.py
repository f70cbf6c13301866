"""Comparison of groups of animals: Hedges' g, permutation test or mixed model, Benjamini-Hochberg.

One row per session becomes one row per measure and contrast, with n at every level. `statistics`
finds the units (no pseudoreplication) and computes tests, t intervals and Hedges' g; the p values
of the whole table are corrected by Benjamini and Hochberg's procedure. Every requested measure is
in the table, significant or not, tested or refused. `liex compare` and the dashboard's group page
show it.
"""

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.behaviour.interactions import PAIR, arena_measures
from liex_lab.behaviour.statistics import (
    ANIMAL,
    CAGE,
    FEWEST_FOR_MODEL,
    MOST_EXACT,
    PAIRED,
    Estimate,
    NotComparable,
    Units,
    animal_means,
    arrangements,
    check_reachable,
    estimate,
    false_discovery,
    find_units,
    mixed_model,
    permutation,
    smallest_p,
    spread_of_animals,
)
from liex_lab.plan.study import alike, one_animal, references_first
from liex_lab.tables.schema import SessionTables, shown, table_columns, titled, to_pandas
from liex_lab.tracking.identity import CERTAIN

SUBJECT = ("subject_id", "group", "cage", "sex", "batch")
ENGINES = ("auto", "permutation", "mixed")
_ESTIMATES = ("estimate", "ci_low", "ci_high")
_EFFECTS = ("effect_size", "effect_low", "effect_high")
_USUAL = (
    "distance_m",
    "mean_speed_mm_s",
    "mean_abs_yaw_rate_rad_s",
    "turn_bias",
    "outer_half_share",
    "top_third_share",
    "tail_beat_hz",
    "dark_minus_light_mm_per_h",
    "relative_amplitude",
    "interdaily_stability",
    "intradaily_variability",
)
_OF_DAYS = (  # of the table `rhythm`; hours of the clock are circular, and cannot be averaged
    "light_mm_per_h",
    "dark_mm_per_h",
    "dark_minus_light_mm_per_h",
    "light_sleep_by_immobility_share",
    "dark_sleep_by_immobility_share",
    "m10_mm_per_h",
    "l5_mm_per_h",
    "relative_amplitude",
    "interdaily_stability",
    "intradaily_variability",
    "period_h",
)

STATS = table_columns("stats")


def collect(sessions: Iterable[SessionTables]) -> pd.DataFrame:
    """One row per session and animal: its subject, its summary, and its number of bouts.

    Args:
        sessions: opened sessions with a summary.

    Returns:
        Columns of the tables `sessions` and `summary`, and n_bouts; a column of both tables has the
            suffix `_summary` for the second. Sessions of plans that state the light have measures
            of their rhythm, and of plans that state periods the difference of each period from the
            first one, such as `after_minus_baseline_rear_share`. Animals of one arena also have its
            name, `arena`, whether they may have been exchanged, `exchanged`, and its
            `arena_measures`.
    """
    rows = [
        session.table("sessions")
        .merge(session.summary, on=["session_id", "individual"], suffixes=("", "_summary"))
        .assign(n_bouts=len(session.table("bouts", ["action"])), **_of_parts(session))
        .assign(**_together(session))
        for session in sessions
    ]
    return pd.concat(rows or [pd.DataFrame(columns=["session_id", *SUBJECT])], ignore_index=True)


def _of_parts(session: SessionTables) -> dict[str, float]:
    """How the parts of a session differ: the measures of its rhythm, and of each period minus those
    of the first one (only what does not grow with a period's length); nothing without the tables.
    """
    files = session.metadata.get("files", {})
    found = {}
    if "rhythm.parquet" in files:
        found = {
            name: float(value)
            for name, value in zip(
                _OF_DAYS, session.table("rhythm")[[*_OF_DAYS]].iloc[0], strict=True
            )
        }
    if "periods.parquet" in files:
        first, *others = session.table("periods").to_dict("records")
        found |= {
            f"{one['period']}_minus_{first['period']}_{name}": float(one[name] - first[name])
            for one, name in product(others, map(str, first))
            if name in _USUAL[1:] or name.endswith(("_share", "_per_min", "_height_mm"))
        }
    return found


def unit_of(measure: str, units: Mapping[str, str]) -> str:
    """The unit of a measure; a difference of two periods has that of its column.

    Args:
        measure: a column of `collect`.
        units: unit of every column of the sessions.
    """
    of = [name for name in units if "_minus_" in measure and measure.endswith(f"_{name}")]
    return units.get(measure) or units.get(max(of, key=len, default=""), "")


def _together(session: SessionTables) -> dict[str, Any]:
    """What the rows of the animals of one arena also have; nothing for one animal."""
    about = session.metadata
    names = (about.get("interactions") or {}).get("individuals", ())
    if len(names) < 2:
        return {}
    own = str(about["session_id"])
    name = own.removesuffix(f"-{about['individual']}")
    name = ", ".join(names) if name == own else name  # of a study: each has a name of its own
    known = "crossings.parquet" in about.get("files", {})
    swaps = session.table("crossings")["p_swap"].to_numpy(float) if known else np.empty(0)
    return {
        "arena": f"{name} {str(about['input']['sha256'])[:6]}",
        "exchanged": bool(np.prod(1.0 - swaps) < CERTAIN),
        **arena_measures(session.table("interaction_totals")),
    }


def usual_measures(table: pd.DataFrame) -> list[str]:
    """The default measures: the usual ones with values, the share of every action and zone, how
    often the animals of an arena interact, and the differences of these between periods.

    Args:
        table: one row per session, see `collect`.

    Returns:
        Names of columns of `table` with at least one value.
    """
    shares = [
        str(name)
        for name in table.columns
        if str(name).endswith("_share")
        and (str(name).removesuffix("_share") + "_count" in table or str(name).startswith("zone_"))
    ]
    pairs = [
        str(name)
        for name in table.columns
        if str(name).startswith(PAIR) and str(name).endswith("_per_min")
    ]
    changes = [  # between periods
        str(name)
        for name in table.columns
        if "_minus_" in str(name)
        and str(name).endswith(tuple(f"_{one}" for one in (*_USUAL, *shares)))
    ]
    return [
        name
        for name in dict.fromkeys((*_USUAL, *shares, *pairs, *changes))
        if name in table and table[name].notna().any()
    ]


def compare(
    table: pd.DataFrame,
    measures: Sequence[str],
    reference: str | None = None,
    *,
    engine: str = "auto",
    blocks: Sequence[str] = ("batch",),
    alpha: float = 0.05,
    family: str = "all measures and contrasts",
    seed: int = 0,
) -> pd.DataFrame:
    """The table `stats`: every measure and pair of groups with effect size, interval, p and n.

    Args:
        table: one row per session, see `collect`; missing columns of `SUBJECT` count as unknown.
        measures: columns of `table` to compare; a missing one is refused in its row.
        reference: compare each group with this one only; None compares all pairs of groups.
        engine: permutation, mixed, or auto, which uses the mixed model if the units are nested,
            each group has at least `FEWEST_FOR_MODEL` units and the random variance is not zero. If
            the model cannot be fitted, mixed uses permutation as well.
        blocks: columns within which animals are exchanged.
        alpha: a permutation test that cannot reach this level is refused.
        family: name of the family of tests, written to the table.
        seed: of the random arrangements; each row has its own stream.

    Returns:
        One row per measure and contrast with the columns `STATS`; p_fdr is corrected over all tests
            of the table (Benjamini-Hochberg). Estimate, interval and effect size are those of the
            mixed model if it was fitted, else those of `estimate`.
    """
    texts = {
        name: table[name].fillna("").astype(str) if name in table else ""
        for name in (*SUBJECT, *blocks)
    }
    table = unified(table.assign(**texts))[0]
    groups = references_first(set(table["group"]) - {""})
    pairs: Iterable[tuple[str, str]] = combinations(groups, 2)
    if reference is not None:
        pairs = ((reference, one) for one in groups if one != reference and reference in groups)
    rows = [
        _compare_one(table, *asked, engine, blocks, alpha, np.random.default_rng([seed, k]))
        for k, asked in enumerate(product(measures, pairs))
    ]
    corrected = false_discovery([row["p"] for row in rows])
    n_family = int(np.isfinite(corrected).sum())
    for row, p in zip(rows, corrected, strict=True):
        row |= {"p_fdr": p, "family": family, "n_family": n_family}
    return to_pandas(STATS, {column.name: [row[column.name] for row in rows] for column in STATS})


def unified(table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """The table with one spelling of names that differ only in capitals, spaces, _ or -, and a cage
    for animals of one arena, which are not independent: theirs, or the arena if none is stated.

    Args:
        table: one row per session, see `collect`; its columns of `SUBJECT` are read.

    Returns:
        The table, and notes on such names and on animals that may be the same.
    """
    notes = []
    for column in (name for name in SUBJECT if name in table):
        for kept, *others in alike(table[column].fillna("").astype(str)):
            notes.append(f"{column} {', '.join(map(repr, others))} is taken for {kept!r}")
            table = table.assign(**{column: table[column].replace(others, kept)})
    if "arena" in table:
        cage = table.get("cage", pd.Series("", table.index)).fillna("").astype(str)
        for arena, own in cage.groupby(table["arena"]):
            stated = sorted(set(own) - {""})
            cage[own.index] = stated[0] if len(stated) == 1 else str(arena)
            if len(stated) > 1:
                notes.append(
                    f"the animals of the arena {arena} are of the cages {', '.join(stated)}: the "
                    "arena counts as their cage"
                )
        table = table.assign(cage=cage)
    known = list(table["subject_id"].fillna("").astype(str)) if "subject_id" in table else []
    notes += [
        f"possible pseudo-replication: the animals {', '.join(ids)} may be one; if they are, give "
        "all its sessions one subject_id"
        for ids in one_animal(set(known) - {""})
    ]
    return table, notes


def _compare_one(
    table: pd.DataFrame,
    measure: str,
    groups: tuple[str, str],
    engine: str,
    blocks: Sequence[str],
    alpha: float,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """One row of the table `stats`."""
    own = table[table["group"].isin(groups)]
    own = own.assign(value=own[measure].astype(float) if measure in own else np.nan)
    rows = own[np.isfinite(own["value"])]
    cages = set(rows["cage"]) - {""}
    animals = rows.groupby("group")["subject_id"].nunique()
    row: dict[str, Any] = {
        **dict.fromkeys((column.name for column in STATS if column.dtype == "float64"), np.nan),
        "measure": measure,
        "contrast": f"{groups[1]} - {groups[0]}",
        "group": groups[1],
        "n_group": int(animals.get(groups[1], 0)),
        "reference": groups[0],
        "n_reference": int(animals.get(groups[0], 0)),
        "unit": ANIMAL,
        "test": "",
        "refused": "",
        "n_animals": int(rows["subject_id"].nunique()),
        "n_cages": len(cages),
        "n_sessions": len(rows),
        "n_bouts": int(rows["n_bouts"].sum()) if "n_bouts" in rows else 0,
        "observed_min": float(rows["observed_s"].sum()) / 60.0 if "observed_s" in rows else np.nan,
        "n_without_value": len(own) - len(rows),
    }
    try:
        units = find_units(rows, groups, blocks)
        _check_together(rows, measure, units)
        row |= {"unit": units.unit, "smallest_p": smallest_p(units)}
        n, n_second = len(units.values), int(units.second.sum())
        # paired units count in both
        row["n_reference"], row["n_group"] = (n, n) if units.paired else (n - n_second, n_second)
        if float(np.ptp(units.values)) == 0.0 and not (units.paired and units.values[0] != 0.0):
            raise NotComparable("every unit has the same value, so there is nothing to compare")
        row |= _sized(estimate(units), rows, groups)
        row |= _tested(rows, units, groups, engine, alpha, rng)
    except NotComparable as reason:
        row["refused"] = str(reason)
    return row


def _check_together(rows: pd.DataFrame, measure: str, units: Units) -> None:
    """Refuse what a comparison cannot state about the animals of one arena.

    Raises:
        NotComparable: they may have been exchanged, or a measure of the arena is compared between
            its animals.
    """
    if "arena" not in rows:
        return
    if measure.startswith(PAIR):
        if units.unit != CAGE and rows["arena"].duplicated().any():
            raise NotComparable(
                "a measure of the arena is the same for all its animals, which are of both "
                "groups; compare arenas of one group each"
            )
    elif doubtful := sorted(set(rows.loc[rows["exchanged"].eq(True), "arena"])):
        raise NotComparable(
            f"the animals of {', '.join(doubtful)} may have been exchanged (see the verdicts of "
            "their sessions), too likely for statistics per animal; leave these sessions out "
            f"(--only-trusted), or compare measures of the arena ({PAIR}...)"
        )


def _sized(found: Estimate, rows: pd.DataFrame, groups: tuple[str, str]) -> dict[str, float]:
    """The difference with its interval, both also as Hedges' g."""
    animal = (
        pd.factorize(rows["subject_id"])[0] * 2 + (rows["group"] == groups[1]).to_numpy()
    )  # an animal in both groups counts in both
    subjects, number = np.unique(animal, return_inverse=True)
    sd, correction = spread_of_animals(
        animal_means(rows["value"].to_numpy(float), number), subjects % 2 == 1
    )
    effects = (correction * value / sd if sd > 0 else np.nan for value in found)
    return dict(zip((*_ESTIMATES, *_EFFECTS), (*found, *effects), strict=True))


def _tested(
    rows: pd.DataFrame,
    units: Units,
    groups: tuple[str, str],
    engine: str,
    alpha: float,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """The p and the test's name; raises NotComparable if p cannot reach alpha."""
    enough = min(int((~units.second).sum()), int(units.second.sum())) >= FEWEST_FOR_MODEL
    if engine == "mixed" or (engine == "auto" and enough):
        model = mixed_model(rows, units, groups)
        if model is not None:
            found, p, random = model
            what = "the animals' means" if random == CAGE else "the sessions' values"
            name = (
                f"mixed model of {what}, random intercept per {random}, t with units - 2 degrees "
                "of freedom"
            )
            return {"p": p, "test": name, **_sized(found, rows, groups)}
    check_reachable(units, alpha, groups)
    within = " within blocks" if len(np.unique(units.block)) > 1 else ""
    of = "signs of the animals' own differences" if units.paired else f"{units.unit}s{within}"
    n_ways = arrangements(units)
    how = f"exact, all {n_ways:,} arrangements"
    if n_ways > MOST_EXACT:
        how = f"{MOST_EXACT:,} random arrangements of {n_ways:,}"
    return {"p": permutation(units, rng), "test": f"permutation of {of} ({how})"}


def counted_units(row: Mapping[Any, Any]) -> str:
    """The number of units of each group: 4 drug, 5 vehicle (animals).

    Args:
        row: a row of the table `stats`.
    """
    if str(row["unit"]) == PAIRED:
        return f"{row['n_group']} animals, each in {row['group']} and in {row['reference']}"
    each = f"{row['n_group']} {row['group']}, {row['n_reference']} {row['reference']}"
    return f"{each} ({row['unit']}s)"


def result(row: Mapping[Any, Any], unit: str) -> str:
    """One comparison as a sentence for a paper: difference, interval, effect size, test, n.

    Args:
        row: a row of the table `stats`.
        unit: the measure's unit in the table; empty if dimensionless.
    """
    difference, low, high = (_plain(shown(float(row[name]), unit)[0]) for name in _ESTIMATES)
    g, g_low, g_high = (f"{float(row[name]):.2f}" for name in _EFFECTS)
    read = f" {shown(1.0, unit)[1]}" if unit else ""
    n = f"n = {counted_units(row)}"
    what = titled(str(row["measure"]), unit)
    refused = f"No test of {what}, {row['contrast']}: {row['refused']}"
    if not np.isfinite(row["estimate"]):
        return f"{refused}; {n}."
    way = "lower" if row["estimate"] < 0 else "higher"
    found = (
        f"{what[:1].upper()}{what[1:]} was {difference.lstrip('-')}{read} {way} in "
        f"{row['group']} than in {row['reference']}"
    )
    details = []
    if np.isfinite(row["ci_low"]):
        details.append(f"95 % CI of {row['contrast']}: {low} to {high}{read}")
    if np.isfinite(row["effect_size"]):
        details.append(f"Hedges' g = {g}, {g_low} to {g_high}")
    if not row["test"]:
        return f"{found} ({'; '.join([*details, n])}). {refused}."
    corrected = f", corrected for {row['n_family']} tests {row['p_fdr']:.2g}"
    p = f"p = {row['p']:.2g}{corrected * (row['n_family'] > 1)}"
    return f"{found} ({'; '.join([*details, p, row['test'], n])})."


def _plain(value: float) -> str:
    """Three significant digits, without an exponent."""
    return np.format_float_positional(float(f"{value:.3g}"), trim="-")


def methods(
    stats: pd.DataFrame,
    table: pd.DataFrame | None = None,
    notes: Sequence[str] = (),
    alpha: float = 0.05,
) -> str:
    """Text for a methods section: groups, units, tests, intervals, correction, software.

    Args:
        stats: the table `stats`, see `compare`.
        table: the compared sessions, see `collect`; None omits their number.
        notes: sentences on the sessions, such as which are left out.
        alpha: the significance level in the text.

    Returns:
        One paragraph; empty for an empty table.
    """
    if len(stats) == 0:
        return ""
    from jinja2 import StrictUndefined, Template

    done, refused = stats[stats["test"] != ""], stats[stats["test"] == ""]
    tests = list(dict.fromkeys(done["test"]))
    plain = [
        unit != PAIRED and "model" not in test and "blocks" not in test
        for unit, test in zip(stats["unit"], stats["test"], strict=True)
    ]
    intervals = {
        "Welch's t over the units": any(plain),
        "a paired t over the animals' own differences": PAIRED in set(stats["unit"]),
        "least squares with a mean per block": any("blocks" in test for test in tests),
        "t of the mixed model": any("model" in test for test in tests),
    }
    lines = Path(__file__).with_name("methods.j2").read_text(encoding="utf-8").split()
    text = Template(" ".join(lines), undefined=StrictUndefined).render(
        groups=[] if table is None else _of_groups(table),
        notes=notes,
        units=sorted(set(done["unit"])),
        tests=tests,
        intervals=[name for name, used in intervals.items() if used],
        n_done=len(done),
        family=stats["family"].iloc[0],
        alpha=alpha,
        n_refused=len(refused),
        refused=list(dict.fromkeys(refused["refused"])),
        version=version("liex_lab"),
    )
    return text.strip()


def _of_groups(table: pd.DataFrame) -> list[str]:
    """Animals, cages and sessions of each group."""
    texts = []
    for group, rows in table.groupby(table["group"].fillna("").astype(str)):
        cages = set(rows["cage"].fillna("")) - {""} if "cage" in rows else set()
        counts = {"animal": rows["subject_id"].nunique(), "cage": len(cages), "session": len(rows)}
        each = [f"{n} {noun}{'s' * (n > 1)}" for noun, n in counts.items() if n]
        texts.append(f"{group or 'without a group, not compared'}: {', '.join(each)}")
    return texts
