"""Groups are compared by the unit that the design has, and refused where it has none."""

from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
import pytest
from liex_lab.pipelines.evaluation.statistics import PLANS, StudyPlan, error_rates, power

from liex_lab.behaviour.cohort import (
    STATS,
    compare,
    counted_units,
    methods,
    result,
    unified,
)
from liex_lab.behaviour.statistics import (
    CAGE,
    MOST_EXACT,
    PAIRED,
    NotComparable,
    Units,
    arrangements,
    estimate,
    find_units,
    permutation,
    smallest_p,
)

RNG = np.random.default_rng(0)


def study(
    n: int, *, cage: list[str] | None = None, batch: list[str] | None = None, values: Any = None
) -> pd.DataFrame:
    """n animals in each of the groups a and b, a session each."""
    return pd.DataFrame(
        {
            "subject_id": [f"m{k}" for k in range(2 * n)],
            "group": ["a"] * n + ["b"] * n,
            "cage": cage or [""] * (2 * n),
            "batch": batch or [""] * (2 * n),
            "speed": np.random.default_rng(1).normal(size=2 * n) if values is None else values,
            "observed_s": 60.0,
        }
    )


def only(table: pd.DataFrame, **options: Any) -> dict[str, Any]:
    """The one row of a comparison of the speed."""
    (row,) = compare(table, ["speed"], **options).to_dict("records")
    return {str(name): value for name, value in row.items()}


def units_of(table: pd.DataFrame) -> Units:
    return find_units(table.assign(value=table["speed"]), ("a", "b"))


def test_the_permutation_is_the_count_a_reader_would_make():
    table = study(5)
    y = table["speed"].to_numpy()
    observed = abs(y[5:].mean() - y[:5].mean())
    ways = [np.isin(np.arange(10), chosen) for chosen in combinations(range(10), 5)]
    slow = np.mean([abs(y[way].mean() - y[~way].mean()) >= observed - 1e-12 for way in ways])
    row = only(table)
    assert row["p"] == pytest.approx(slow)
    assert row["estimate"] == pytest.approx(y[5:].mean() - y[:5].mean())
    assert (row["unit"], row["n_group"], row["n_animals"], row["n_sessions"]) == (
        "animal",
        5,
        10,
        10,
    )


def test_within_blocks_the_permutation_agrees_with_the_loop_a_reader_would_write():
    table = study(4, batch=["x", "x", "y", "y"] * 2)
    units = units_of(table)
    assert arrangements(units) == 36
    y, second, block = units.values, units.second, units.block

    def difference(way):  # of the groups' means in each batch, both of two animals
        return np.mean(
            [y[way & (block == b)].mean() - y[~way & (block == b)].mean() for b in (0, 1)]
        )

    slow = []
    for first in combinations(np.flatnonzero(block == 0), 2):
        for other in combinations(np.flatnonzero(block == 1), 2):
            slow.append(abs(difference(np.isin(np.arange(8), [*first, *other]))))
    expected = np.mean(np.array(slow) >= abs(difference(second)) - 1e-12)
    assert permutation(units, RNG) == pytest.approx(expected)
    assert estimate(units)[0] == pytest.approx(difference(second))


def test_many_arrangements_are_drawn_and_few_gone_through():
    table = study(12, values=np.random.default_rng(5).normal(size=24) + np.repeat([0.0, 0.8], 12))
    units = units_of(table)
    assert arrangements(units) > 2_000_000
    drawn = [permutation(units, np.random.default_rng(seed)) for seed in range(3)]
    from scipy.stats import ttest_ind

    t = ttest_ind(units.values[units.second], units.values[~units.second]).pvalue
    np.testing.assert_allclose(drawn, t, atol=0.01)
    assert only(table)["p"] == only(table)["p"]  # seeded


def test_cages_of_one_group_are_the_unit_and_their_animals_are_not():
    cage = [
        "c1",
        "c1",
        "c2",
        "c2",
        "c3",
        "c3",
        "c4",
        "c4",
        "c5",
        "c5",
        "c6",
        "c6",
        "c7",
        "c7",
        "c8",
        "c8",
    ]
    row = only(study(8, cage=cage))
    assert (row["unit"], row["n_group"], row["n_reference"]) == (CAGE, 4, 4)
    assert (row["n_animals"], row["n_cages"]) == (16, 8)
    assert row["smallest_p"] == pytest.approx(2 / 70)
    assert row["test"] == "permutation of cages (exact, all 70 arrangements)"


def test_cages_with_both_groups_are_blocks():
    row = only(study(6, cage=["c1", "c1", "c2", "c2", "c3", "c3"] * 2))
    assert (row["unit"], row["n_cages"]) == ("animal", 3)
    assert row["smallest_p"] == pytest.approx(2 / 6**3)
    assert "within blocks" in row["test"]


def test_an_animal_s_sessions_are_one_value():
    table = study(5)
    doubled = pd.concat(
        [table.assign(speed=table["speed"] - 0.3), table.assign(speed=table["speed"] + 0.3)]
    )
    one, two = only(table), only(doubled, engine="permutation")
    assert two["p"] == one["p"]
    assert (two["n_sessions"], two["n_animals"]) == (20, 10)


def test_animals_that_were_in_both_groups_are_compared_with_themselves():
    rng = np.random.default_rng(3)
    own = rng.normal(0, 5, 8)
    table = pd.DataFrame(
        {
            "subject_id": [f"m{k}" for k in range(8)] * 2,
            "group": ["a"] * 8 + ["b"] * 8,
            "speed": np.concatenate([own, own + 1 + rng.normal(0, 0.1, 8)]),
        }
    )
    row = only(table)
    assert row["unit"] == PAIRED
    assert row["p"] == pytest.approx(2 / 2**8)
    assert row["estimate"] == pytest.approx(1.0, abs=0.2)
    assert row["ci_low"] > 0.8
    assert row["effect_size"] < 0.5  # animals differ much more than that


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        (study(3), "3 b and 3 a animals can be arranged in 20 ways, so p cannot be below 0.1"),
        (study(1), "the group a has 1 animals with a value"),
        (study(5).assign(subject_id=""), "10 sessions have no subject_id"),
        (study(5, values=[1.0] * 10), "every unit has the same value"),
        (study(5, values=[np.nan] * 5 + [1.0] * 5), "the group a has 0 animals"),
        (study(5, cage=["c1"] * 4 + [""] * 6), "the cage of 6 of 10 animals is not stated"),
        (study(5, batch=["x"] * 5 + ["y"] * 5), "every batch has animals of one group only"),
        (study(4, cage=["c1"] * 4 + ["c2"] * 4), "1 b and 1 a cages can be arranged in 2 ways"),
        (
            pd.concat([study(4), study(4).head(1).assign(group="b")], ignore_index=True),
            "1 of 8 animals (m0) were in both groups",
        ),
    ],
)
def test_what_the_design_does_not_allow_is_refused_with_the_reason(table, reason):
    row = only(table)
    assert reason in row["refused"]
    assert np.isnan(row["p"])
    assert row["test"] == ""


def test_a_refused_comparison_still_shows_its_difference_and_its_numbers():
    row = only(study(3, values=[1.0, 2.0, 3.0, 2.0, 3.0, 4.0]))
    assert row["estimate"] == pytest.approx(1.0)
    assert row["effect_size"] == pytest.approx(0.8)  # J of 4 degrees of freedom
    assert row["ci_low"] < 1.0 < row["ci_high"]
    assert row["n_group"] == 3
    assert "1 higher in b than in a (95 % CI of b - a: " in result(row, "")
    assert "No test of speed, b - a: 3 b and 3 a animals" in result(row, "")


def test_each_number_of_units_stands_beside_its_own_group():
    table = study(5).drop(index=9).replace({"a": "vehicle", "b": "drug"})
    for reference, first, other in (
        ("vehicle", "4 drug", "5 vehicle"),
        ("drug", "5 vehicle", "4 drug"),
    ):
        row = only(table, reference=reference)
        assert row["reference"] == reference
        assert counted_units(row) == f"{first}, {other} (animals)"
        assert (f"{row['n_group']} {row['group']}", f"{row['n_reference']} {reference}") == (
            first,
            other,
        )
        assert f"n = {first}, {other} (animals)" in result(row, "mm/s")
        assert row["contrast"] == f"{row['group']} - {reference}"
    assert only(table)["contrast"] == "drug - vehicle", "a control group is the reference"


def test_names_that_differ_in_capitals_or_spaces_are_one_and_this_is_told():
    table = study(5)
    spelled = table.assign(group=["a", "A", "a ", "a", "a", "b-1", "b 1", "b_1", "B1", "b 1"])
    row = only(spelled)
    assert (row["group"], row["n_group"], row["reference"], row["n_reference"]) == (
        "b 1",
        5,
        "a",
        5,
    )
    assert row["p"] == only(table)["p"]
    notes = unified(spelled)[1]
    assert notes[0] == "group 'A', 'a ' is taken for 'a'"
    assert unified(table)[1] == []
    assert only(table.assign(group=["1-12"] * 5 + ["11-2"] * 5))["n_group"] == 5


@pytest.mark.parametrize(
    "ids",
    [
        ("m01day1", "m01day2"),
        ("m01d1", "m01d2"),
        ("m01_ses-1", "m01_ses-2"),
        ("20260821", "20260822"),
    ],
)
def test_ids_that_differ_by_a_day_are_told_as_possible_pseudo_replication(ids):
    table = study(5)
    table.loc[:1, "subject_id"] = ids
    (note,) = unified(table)[1]
    assert note.startswith("possible pseudo-replication: ")
    assert all(id in note for id in ids)


@pytest.mark.parametrize("scheme", ["m{}", "s{}", "A1{}", "c2m{}", "25031{}", "mouse{}", "AM{}"])
def test_ids_of_animals_are_not_taken_for_days(scheme):
    table = study(5).assign(subject_id=[scheme.format(k) for k in range(10)])
    assert unified(table)[1] == []


def test_the_interval_without_blocks_is_welch_s():
    from scipy.stats import ttest_ind

    table = study(6)
    y = table["speed"].to_numpy()
    welch = ttest_ind(y[6:], y[:6], equal_var=False).confidence_interval()
    found = estimate(units_of(table))
    assert found[1:] == pytest.approx((welch.low, welch.high))


def test_the_mixed_model_of_balanced_cages_is_the_t_test_of_their_means():
    """Which it has to be in theory: same numbers in every cage, and a variance between cages above
    zero.
    """
    from scipy.stats import ttest_ind

    rng = np.random.default_rng(8)
    cage = np.repeat([f"c{k:02d}" for k in range(14)], 3)
    values = np.repeat(rng.normal(0, 1.5, 14), 3) + rng.normal(size=42)
    table = study(21, cage=list(cage), values=values)
    row = only(table, engine="mixed")
    means = values.reshape(14, 3).mean(axis=1)
    assert row["test"].startswith("mixed model")
    assert row["p"] == pytest.approx(ttest_ind(means[7:], means[:7]).pvalue, rel=2e-2)
    assert row["estimate"] == pytest.approx(means[7:].mean() - means[:7].mean(), rel=1e-4)


def test_the_false_discovery_rate_is_of_the_tests_that_were_made():
    table = study(6)
    for k in range(4):
        table[f"m{k}"] = np.random.default_rng(k).normal(size=12)
    table["flat"] = 1.0
    stats = compare(table, ["m0", "m1", "m2", "m3", "flat"], family="four and one")
    assert (stats["n_family"] == 4).all()
    assert stats["p_fdr"].notna().sum() == 4
    assert (stats["p_fdr"].dropna() >= stats["p"].dropna()).all()
    assert list(stats.columns) == [column.name for column in STATS]
    text = methods(stats)
    assert "over 4 tests (family: four and one)" in text
    assert "1 comparison was not tested: every unit has the same value" in text
    assert "Welch's t over the units" in text
    assert "exact, all 924 arrangements" in text
    assert "liex_lab" in text
    text = methods(stats[stats["test"] == ""], table)
    assert "Groups: a: 6 animals, 6 sessions; b: 6 animals, 6 sessions." in text
    assert "0 tests" not in text


def test_three_groups_are_compared_in_pairs_or_with_the_one_named():
    table = pd.concat(
        [study(5), study(5).assign(group="c", subject_id=[f"n{k}" for k in range(10)])]
    )
    assert list(compare(table, ["speed"])["contrast"]) == ["b - a", "c - a", "c - b"]
    assert list(compare(table, ["speed"], reference="b")["contrast"]) == ["a - b", "c - b"]


def test_a_strange_table_is_refused_row_by_row_and_does_not_break():
    assert len(compare(study(4).drop(columns=["cage", "batch"]), ["speed", "nothing"])) == 2
    assert len(compare(pd.DataFrame({"group": []}), ["speed"])) == 0
    with pytest.raises(NotComparable):
        find_units(study(1).assign(value=[1.0, 2.0]), ("a", "b"))


@pytest.mark.parametrize(
    "plan",
    [pytest.param(PLANS[k], marks=[pytest.mark.nightly] * (k in (2, 3))) for k in (0, 2, 3, 5)],
    ids=lambda plan: plan.name,
)
def test_studies_without_an_effect_are_rarely_called_significant(plan):
    """Forty of each kind; `liex evaluate statistics` makes two thousand. Seven or more are 0.3 %
    likely at 5 %.
    """
    rates = error_rates(plan, 40, np.random.default_rng(1))
    assert rates["type_1"] <= 0.15
    assert rates["coverage"] >= 0.85
    if "sessions" in plan.name and not plan.within:
        assert rates["type_1_sessions_as_units"] > rates["type_1"]


def test_a_large_effect_is_found():
    assert (
        power(StudyPlan("6 animals", 6, 1, 1, caged=False), 3.0, 40, np.random.default_rng(0)) > 0.9
    )


@pytest.mark.parametrize(
    "second",
    [
        {0: "0011", 1: "01"},
        {0: "0011", 1: "000"},  # a block of one group has one arrangement, which mirrors itself
        {0: "0011", 1: "111", 2: "01"},
        {0: "001", 1: "0011"},
        {0: "00111"},
        {0: "0", 1: "11"},
    ],
)
def test_the_smallest_p_is_that_of_the_largest_difference_there_can_be(second):
    """The clearest study of its design: every unit of the second group above every other."""
    block = np.concatenate([[number] * len(groups) for number, groups in second.items()])
    flags = np.array([flag == "1" for groups in second.values() for flag in groups])
    rng = np.random.default_rng(4)
    reached = []
    for _ in range(20):
        values = rng.exponential(1.0, len(flags)) + 50.0 * flags
        units = Units("animal", values, flags, block, np.ones(len(flags), np.int64))
        reached.append(permutation(units, rng))
    assert smallest_p(units) == pytest.approx(min(reached))


def test_drawn_arrangements_cannot_reach_less_than_one_in_their_number():
    n = 12
    flags = np.arange(2 * n) >= n
    units = Units(
        "animal",
        50.0 * flags.astype(np.float64),
        flags,
        np.zeros(2 * n, np.int64),
        np.ones(2 * n, np.int64),
    )
    assert smallest_p(units) == pytest.approx(permutation(units, np.random.default_rng(0)), rel=0.5)
    assert smallest_p(units) == 1.0 / (1 + MOST_EXACT)
