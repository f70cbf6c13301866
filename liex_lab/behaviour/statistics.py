"""Permutation test, linear mixed model, Welch's t interval and Hedges' g for two groups of animals.

All of them use the units of a design (`Units`: cages, animals or an animal's own difference), never
sessions or bouts.

- Permutation test (Fisher 1935, Pitman 1937): the groups are reassigned to the units as the design
  allows, p = share of the arrangements with |difference| >= the observed one; exact up to
  `MOST_EXACT` arrangements, beyond that Monte Carlo with p = (1 + b) / (1 + m) (Phipson and Smyth
  2010). For paired units the signs are flipped; blocks are permuted separately.
- Linear mixed model (Laird and Ware 1982): value ~ group + (1 | cage) or (1 | animal), by
  restricted maximum likelihood (REML), t with units - 2 degrees of freedom.
- Confidence interval: Welch's t with Welch and Satterthwaite's degrees of freedom, a paired t, or
  least squares with a mean per block. A bootstrap is not used, because its intervals are far too
  short for three to six units, which are common.
- Hedges' g (1981): J x difference / pooled sd, with J = 1 - 3 / (4 df - 1).

`liex_lab.behaviour.cohort` calls all of them.
"""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb, prod
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.arrays import Array, ArrayLike, NDArray


class NotComparable(Exception):
    """Raised if the design does not allow a test; the message is one sentence for the reader."""


def _require(holds: bool, sentence: str) -> None:
    """Refuse a comparison with a sentence for the reader unless a condition holds."""
    if not holds:
        raise NotComparable(sentence)


@dataclass(frozen=True)
class Units:
    """The n units of one comparison of two groups.

    Attributes:
        unit: cage, animal, or an animal's own difference (`PAIRED`).
        values: (n,) value of each unit, in the measure's own unit; second group minus first if
            paired.
        second: (n,) whether the unit is in the second group; all True if paired.
        block: (n,) number of the block within which the unit may be exchanged.
        n_animals: (n,) number of animals in each value.
    """

    unit: str
    values: Array
    second: NDArray[np.bool_]
    block: NDArray[np.int64]
    n_animals: NDArray[np.int64]

    @property
    def paired(self) -> bool:
        """Whether every animal was in both groups."""
        return self.unit == PAIRED


CAGE = "cage"
ANIMAL = "animal"
PAIRED = "animal, in both groups"


def find_units(
    rows: pd.DataFrame, groups: tuple[str, str], blocks: Sequence[str] = ("batch",)
) -> Units:
    """The units of a comparison of two groups, from one row per session.

    Sessions are averaged per animal. Animals in both groups give paired differences. If all cages
    contain one group each, they become the units; if a cage contains both groups, cages are blocks,
    like the known columns of `blocks`.

    Args:
        rows: one row per session: subject_id, group, cage, value, and the columns named in
            `blocks`; an empty cage or block is unknown. Rows of other groups or without a value are
            left out.
        groups: names of the first and the second group.
        blocks: columns within which animals are exchanged; unknown or constant ones are ignored.

    Raises:
        NotComparable: sessions do not name their animal, only some animals were in both groups, a
            group has fewer than two animals, only some cages are known, an animal or cage is in
            more than one block, or group and block cannot be distinguished.
    """
    rows = rows[rows["group"].isin(groups) & np.isfinite(rows["value"].to_numpy(float))]
    nameless = int((rows["subject_id"] == "").sum())
    _require(
        nameless == 0,
        f"{nameless} sessions have no subject_id; state it in the study",
    )
    of_animal = rows.groupby("subject_id")["group"].nunique()
    both = [str(name) for name in of_animal.index[of_animal > 1]]
    if both and len(both) == len(of_animal):
        return _own_differences(rows, groups)
    _require(
        not both,
        f"{len(both)} of {len(of_animal)} animals ({', '.join(both[:3])}) were in both groups and "
        "the others in one; compare those within themselves, or the others with each other",
    )
    animals = _animals(rows, blocks)
    second = (animals["group"] == groups[1]).to_numpy()
    for group, number in ((groups[0], int((~second).sum())), (groups[1], int(second.sum()))):
        _require(
            number >= 2,
            f"the group {group} has {number} animals with a value, and a comparison needs two",
        )
    cage = animals["cage"].to_numpy(str)
    unknown = int((cage == "").sum())
    _require(
        unknown in (0, len(cage)),
        f"the cage of {unknown} of {len(cage)} animals is not stated; state it for all or none",
    )
    crowded = len(set(cage)) < len(cage) and bool(cage[0])
    mixed = crowded and _hold_both(cage, second)
    block = _blocks(animals, [*(["cage"] if mixed else []), *blocks], second)
    if crowded and not mixed:
        return _whole_cages(animals, second, block)
    ones = np.ones(len(animals), np.int64)
    return Units(ANIMAL, animals["value"].to_numpy(float), second, block, ones)


def _animals(rows: pd.DataFrame, blocks: Sequence[str]) -> pd.DataFrame:
    """One row per animal, with the mean of its sessions' values."""
    animal, names = pd.factorize(rows["subject_id"], sort=True)
    first = np.unique(animal, return_index=True)[1]
    columns: dict[str, Any] = {
        "subject_id": names,
        "value": animal_means(rows["value"].to_numpy(float), animal),
    }
    for name in ("group", "cage", *(block for block in blocks if block in rows)):
        of_session = rows[name].to_numpy(str)
        columns[name] = of_session[first]
        _require(
            bool((columns[name][animal] == of_session).all()),
            f"some animals are in more than one {name}; give each animal one",
        )
    return pd.DataFrame(columns)


def animal_means(values: Array, animal: NDArray[np.int64]) -> Array:
    """(k,) mean of the values of each animal.

    Args:
        values: (n,) one value per session.
        animal: (n,) number of each session's animal, 0 to k - 1.
    """
    return np.bincount(animal, values) / np.bincount(animal)


def _hold_both(names: NDArray[Any], second: NDArray[np.bool_]) -> bool:
    """Whether any of the cages or blocks contains animals of both groups."""
    return any(0 < second[names == one].sum() < (names == one).sum() for one in np.unique(names))


def _blocks(
    animals: pd.DataFrame, names: Sequence[str], second: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """(n,) number of each animal's block, within which it may be exchanged.

    A block of one group carries no information; if all blocks are such, group and block cannot be
    distinguished, and the comparison is refused.
    """
    known = [
        name
        for name in names
        if name in animals and (animals[name] != "").all() and animals[name].nunique() > 1
    ]
    block = np.zeros(len(animals), np.int64)
    for name in known:
        block = np.unique(
            np.stack([block, pd.factorize(animals[name])[0]]), axis=1, return_inverse=True
        )[1].ravel()
    if known and not _hold_both(block, second):
        raise NotComparable(
            f"every {' and '.join(known)} has animals of one group only, so a difference may be "
            f"that of the {known[0]}; record both groups in each"
        )
    return block


def _whole_cages(
    animals: pd.DataFrame, second: NDArray[np.bool_], block: NDArray[np.int64]
) -> Units:
    """One value per cage, the mean of its animals' values."""
    cages = (
        animals.assign(second=second, block=block)
        .groupby("cage", sort=True)
        .agg(
            value=("value", "mean"),
            second=("second", "first"),
            block=("block", "first"),
            n=("value", "size"),
            blocks=("block", "nunique"),
        )
    )
    _require(
        bool((cages["blocks"] == 1).all()),
        "some cages are in more than one batch; give each cage one",
    )
    return Units(
        CAGE,
        cages["value"].to_numpy(float),
        cages["second"].to_numpy(bool),
        cages["block"].to_numpy(np.int64),
        cages["n"].to_numpy(np.int64),
    )


def _own_differences(rows: pd.DataFrame, groups: tuple[str, str]) -> Units:
    """One value per animal: its mean in the second group minus its mean in the first."""
    means = rows.groupby(["subject_id", "group"])["value"].mean().unstack("group")
    values = (means[groups[1]] - means[groups[0]]).to_numpy(float)
    _require(len(values) >= 2, "only one animal was in both groups, and a comparison needs two")
    n = len(values)
    return Units(PAIRED, values, np.ones(n, bool), np.zeros(n, np.int64), np.ones(n, np.int64))


MOST_EXACT = 20_000  # arrangements of an exact test, or random ones beyond that number
FEWEST_FOR_MODEL = 6  # units per group; with fewer, a model's variances are guesses


# Second group minus first group in the measure's own unit, with the lower and upper limit of its
# interval, which are NaN if a group has fewer than two units.
Estimate = tuple[float, float, float]


def estimate(units: Units, level: float = 0.95) -> Estimate:
    """Difference of the two groups with its t interval, in the measure's own unit.

    Paired units: the mean of the animals' own differences, t with n - 1 degrees of freedom. More
    than one block: least squares with a mean per block. Otherwise Welch's t with Welch and
    Satterthwaite's degrees of freedom: (va + vb)^2 / (va^2 / (na - 1) + vb^2 / (nb - 1)), v =
    variance / n.

    Args:
        units: the units of the comparison, see `find_units`.
        level: coverage of the interval, 0 to 1.

    Returns:
        The estimate; its interval is NaN if an unpaired, unblocked group has fewer than two units.
    """
    from scipy.stats import t

    y = units.values
    second = units.second
    if units.paired:
        difference = y.mean()
        error = y.std(ddof=1) / np.sqrt(len(y))
        freedom = float(len(y) - 1)
    elif len(np.unique(units.block)) > 1:
        difference, error, freedom = _within_blocks(units)
    else:
        a = y[~second]
        b = y[second]
        if min(len(a), len(b)) < 2:
            return float(b.mean() - a.mean()), np.nan, np.nan
        va = a.var(ddof=1) / len(a)
        vb = b.var(ddof=1) / len(b)
        difference = b.mean() - a.mean()
        error = np.sqrt(va + vb)
        total = va**2 / (len(a) - 1) + vb**2 / (len(b) - 1)
        freedom = (va + vb) ** 2 / total if total > 0 else float(len(y) - 2)
    reach = float(t.ppf(0.5 + level / 2.0, max(freedom, 1.0))) * float(error)
    return float(difference), float(difference) - reach, float(difference) + reach


def _within_blocks(units: Units) -> tuple[float, float, float]:
    """Least squares with a mean per block: difference, standard error, degrees of freedom."""
    design = np.concatenate(
        [units.second[:, None], units.block[:, None] == np.unique(units.block)], axis=1
    ).astype(float)
    found, _, rank, _ = np.linalg.lstsq(design, units.values, rcond=None)
    freedom = len(units.values) - int(rank)
    if freedom < 1:
        return float(found[0]), np.inf, 1.0
    residual = units.values - design @ found
    variance = float(residual @ residual) / freedom
    return (
        float(found[0]),
        float(np.sqrt(variance * np.linalg.pinv(design.T @ design)[0, 0])),
        float(freedom),
    )


def spread_of_animals(values: Array, second: NDArray[np.bool_]) -> tuple[float, float]:
    """Pooled standard deviation between animals within groups, and Hedges' correction factor J.

    J = 1 - 3 / (4 df - 1) with df = n - 2 removes most of the bias of Cohen's d with few animals
    (Hedges 1981).

    Args:
        values: (n,) one mean per animal; an animal in both groups counts in both.
        second: (n,) bool, whether the animal is in the second group.

    Returns:
        The pooled standard deviation, in the measure's own unit (NaN without degrees of freedom),
            and J, which is 1 with fewer than two degrees of freedom.
    """
    a = values[~second]
    b = values[second]
    freedom = len(a) + len(b) - 2
    pooled = (
        np.sqrt((((a - a.mean()) ** 2).sum() + ((b - b.mean()) ** 2).sum()) / freedom)
        if freedom > 0
        else np.nan
    )
    return float(pooled), 1.0 - 3.0 / (4.0 * freedom - 1.0) if freedom > 1 else 1.0


def arrangements(units: Units) -> int:
    """Number of possible assignments of the groups to the units.

    2^n for n paired units; otherwise the product over the blocks of C(n, k), where k of a block's n
    units are in the second group.
    """
    if units.paired:
        return int(2 ** len(units.values))
    return prod(comb(len(inside), k) for inside, k in _mixed_blocks(units))


def _mixed_blocks(units: Units) -> Iterator[tuple[NDArray[np.int64], int]]:
    """The units of each block that contains both groups, and the number of the second group."""
    for block in np.unique(units.block):
        inside = np.flatnonzero(units.block == block)
        k = int(units.second[inside].sum())
        if 0 < k < len(inside):
            yield inside, k


def smallest_p(units: Units) -> float:
    """The smallest possible two-sided p of a permutation test of these units.

    It is 2 / `arrangements` if every arrangement has a mirror image (paired units, or equal numbers
    of both groups in every block that has both), else 1 / `arrangements`. A block of one group has
    one arrangement and does not count. For random arrangements it is at least 1 / (1 +
    `MOST_EXACT`).
    """
    even = units.paired or all(2 * k == len(inside) for inside, k in _mixed_blocks(units))
    n_ways = arrangements(units)
    if n_ways > MOST_EXACT:
        return max((2.0 if even else 1.0) / n_ways, 1.0 / (1 + MOST_EXACT))
    return min(1.0, (2.0 if even else 1.0) / n_ways)


def permutation(units: Units, rng: np.random.Generator) -> float:
    """Two-sided p of the permutation test that the design allows (Fisher 1935, Pitman 1937).

    The statistic is the blocked difference of the groups, as in least squares, or for paired units
    the sum of the differences, whose signs are flipped. Up to `MOST_EXACT` arrangements, all are
    enumerated; beyond that, m = `MOST_EXACT` are drawn and p = (1 + b) / (1 + m), where b of them
    are at least as large as the observed one.

    Args:
        units: the units of the comparison.
        rng: draws the random arrangements; unused in an exact test.

    Returns:
        p, 0 to 1: probability of a difference at least as large if the groups are reassigned.
    """
    weight = _weights(units)
    observed = abs(float(weight @ units.values) if not units.paired else float(units.values.sum()))
    n_ways = arrangements(units)
    least = observed * (1.0 - 1e-9) - 1e-12  # tolerance for rounding in another order of summation
    if n_ways <= MOST_EXACT:
        return float(np.mean(np.abs(_differences(units, None)) >= least))
    drawn = np.abs(_differences(units, rng))
    return float((1 + (drawn >= least).sum()) / (1 + len(drawn)))


def _weights(units: Units) -> Array:
    """Weights (n,) whose product with the values is the blocked difference, up to a factor."""
    out = np.zeros(len(units.values))
    for inside, k in _mixed_blocks(units):
        n = len(inside)
        out[inside] = np.where(units.second[inside], (n - k) / n, -k / n)
    return out


def _differences(units: Units, rng: np.random.Generator | None) -> Array:
    """The statistic for every arrangement; with a generator, for `MOST_EXACT` random ones."""
    y = units.values
    if units.paired:
        if rng is not None:
            return np.asarray(rng.choice([-1.0, 1.0], (MOST_EXACT, len(y))) @ y)
        signs = 1 - 2 * ((np.arange(2 ** len(y))[:, None] >> np.arange(len(y))) & 1)
        return np.asarray(signs @ y)
    total = np.zeros(1 if rng is None else MOST_EXACT)
    for inside, k in _mixed_blocks(units):
        # sum of weights x values: k of n values get (n - k) / n and the others -k / n, which is
        # sum - k x mean
        expected = k * y[inside].mean()
        if rng is None:
            ways = np.array(list(combinations(range(len(inside)), k)), np.int64)
            total = (total[:, None] + (y[inside][ways].sum(axis=1) - expected)).ravel()
        else:
            order = rng.random((MOST_EXACT, len(inside))).argpartition(k - 1, axis=1)[:, :k]
            total += y[inside][order].sum(axis=1) - expected
    return total


def mixed_model(
    rows: pd.DataFrame, units: Units, groups: tuple[str, str]
) -> tuple[Estimate, float, str] | None:
    """Linear mixed model of a group difference, fitted by restricted maximum likelihood (REML).

    value ~ group + (1 | cage) on the animals' means if whole cages were assigned, otherwise value ~
    group + (1 | animal) on the sessions' values. p and interval use t with the number of clusters
    minus two degrees of freedom.

    Args:
        rows: one row per session, as for `find_units`.
        units: the result of `find_units` for these rows.
        groups: names of the first and the second group.

    Returns:
        The fixed effect of the group with its 95 % interval, its two-sided p, and the factor with a
            random intercept: cage or animal. None for paired units, if nothing is nested or the
            units are exchanged within blocks (the permutation test is sufficient), and if the model
            does not converge or its random variance is zero, which makes its errors unreliable.
    """
    from scipy.stats import t

    if units.paired:
        return None
    data = rows[rows["group"].isin(groups) & np.isfinite(rows["value"].to_numpy(float))]
    random = units.unit if units.unit == CAGE else ANIMAL
    if random == CAGE:
        animals = data.groupby("subject_id")
        data = animals.agg({"value": "mean", "group": "first", "cage": "first"}).reset_index()
    clusters = data["cage" if random == CAGE else "subject_id"].to_numpy(str)
    if len(np.unique(clusters)) == len(clusters) or len(np.unique(units.block)) > 1:
        # nothing is nested, or animals are exchanged within blocks: permutation is sufficient
        return None
    fitted = _fit(
        data["value"].to_numpy(float), (data["group"] == groups[1]).to_numpy(float), clusters
    )
    if fitted is None:
        return None
    difference, error = fitted
    freedom = len(np.unique(clusters)) - 2
    reach = float(t.ppf(0.975, freedom)) * error
    p = float(2.0 * t.sf(abs(difference) / error, freedom))
    return (difference, difference - reach, difference + reach), p, random


def _fit(values: Array, second: Array, clusters: NDArray[np.str_]) -> tuple[float, float] | None:
    """Difference and standard error of the REML fit; None if unreliable."""
    from statsmodels.regression.mixed_linear_model import MixedLM

    scale = float(values.std())
    if scale <= 0:
        return None
    exog = np.column_stack([np.ones(len(values)), second])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # convergence is checked below; lbfgs fails on singular matrices
            result = MixedLM(values / scale, exog, clusters).fit(reml=True, method=["powell"])
    except (np.linalg.LinAlgError, ValueError):
        return None
    error = float(result.bse_fe[1])
    if (
        not result.converged
        or not np.isfinite(error)
        or error <= 0
        or float(np.asarray(result.cov_re)[0, 0]) < 1e-4 * float(result.scale)
    ):
        return None
    return float(result.fe_params[1]) * scale, error * scale


def check_reachable(units: Units, alpha: float, groups: tuple[str, str]) -> None:
    """Refuse a permutation test that cannot be significant, however large the difference is.

    Args:
        units: the units of the comparison.
        alpha: level of significance.
        groups: names of the first and the second group.

    Raises:
        NotComparable: the smallest possible p is above `alpha`; the message states the number of
            units and that more are needed.
    """
    least = smallest_p(units)
    if least <= alpha:
        return
    n_ways = arrangements(units)
    if units.paired:
        sizes = f"{len(units.values)} animals that were in both groups"
    else:
        what = f"{units.unit}s" + (
            " within their blocks" if len(np.unique(units.block)) > 1 else ""
        )
        first, second = int((~units.second).sum()), int(units.second.sum())
        sizes = f"{second} {groups[1]} and {first} {groups[0]} {what}"
    raise NotComparable(
        f"{sizes} can be arranged in {n_ways} ways, so p cannot be below {least:.2g}; more "
        f"{units.unit.split(',')[0]}s are needed"
    )


# Benjamini and Hochberg's step-up procedure: control of the false discovery rate of many tests.


def false_discovery(p: ArrayLike) -> NDArray[np.float64]:
    """Benjamini and Hochberg's corrected p of a family of tests.

    Args:
        p: (n,) p values; NaN, a test not done, does not belong to the family.

    Returns:
        (n,) corrected p, 0 to 1; NaN where `p` is NaN.
    """
    values = np.asarray(p, float)
    out = np.full(values.shape, np.nan)
    known = np.flatnonzero(np.isfinite(values))
    if len(known) == 0:
        return out
    order = known[np.argsort(values[known])]
    scaled = values[order] * len(order) / np.arange(1, len(order) + 1)
    out[order] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    return out
