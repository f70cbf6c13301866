"""Tests and effect sizes for the units of a design: a permutation restricted by it, and a mixed
model.

Whatever tests, the interval is that of the units' means (Welch's t, or a paired or blocked one). A
bootstrap of three to six units, which is what many studies have, gives intervals that are far too
short.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import combinations
from math import comb, prod

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.behaviour.design import CAGE, NotComparable, Units

Array = NDArray[np.float64]

MOST_EXACT = 20_000  # arrangements that are gone through one by one; of more, so many are drawn
FEWEST_FOR_MODEL = 6  # units per group; with fewer, a model's variances are guesses


@dataclass(frozen=True)
class Estimate:
    """Second group minus first: the difference, its 95 % interval, and how the interval was
    made.
    """

    difference: float
    low: float
    high: float


def estimate(units: Units, level: float = 0.95) -> Estimate:
    """The difference of the groups in the measure's own unit."""
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
            return Estimate(float(b.mean() - a.mean()), np.nan, np.nan)
        va = a.var(ddof=1) / len(a)
        vb = b.var(ddof=1) / len(b)
        difference = b.mean() - a.mean()
        error = np.sqrt(va + vb)
        total = va**2 / (len(a) - 1) + vb**2 / (len(b) - 1)
        freedom = (va + vb) ** 2 / total if total > 0 else float(len(y) - 2)
    reach = float(t.ppf(0.5 + level / 2.0, max(freedom, 1.0))) * float(error)
    return Estimate(float(difference), float(difference) - reach, float(difference) + reach)


def _within_blocks(units: Units) -> tuple[float, float, float]:
    """Least squares with a mean for each block: difference, its standard error, degrees of
    freedom.
    """
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
    """Standard deviation between animals within their groups, and Hedges' correction for so few of
    them.
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
    """In how many ways the groups could have been given to the units."""
    if units.paired:
        return int(2 ** len(units.values))
    sizes = [
        (int((units.block == b).sum()), int(units.second[units.block == b].sum()))
        for b in np.unique(units.block)
    ]
    return prod(comb(n, k) for n, k in sizes)


def smallest_p(units: Units) -> float:
    """The smallest two-sided p that a permutation can give."""
    even = units.paired or all(
        2 * int(units.second[units.block == b].sum()) == int((units.block == b).sum())
        for b in np.unique(units.block)
    )
    return (2.0 if even else 1.0) / arrangements(units)


def permutation(units: Units, rng: np.random.Generator) -> float:
    """Two-sided p: how often a difference at least as large comes from giving the groups anew, as
    the design allows.
    """
    weight = _weights(units)
    observed = abs(float(weight @ units.values) if not units.paired else float(units.values.sum()))
    n_ways = arrangements(units)
    least = (
        observed * (1.0 - 1e-9) - 1e-12
    )  # the same difference in another order of adding up is the same
    if n_ways <= MOST_EXACT:
        return float(np.mean(np.abs(_all_differences(units)) >= least))
    drawn = np.abs(_some_differences(units, rng))
    return float((1 + (drawn >= least).sum()) / (1 + len(drawn)))


def _weights(units: Units) -> Array:
    """(n,) so that their product with the values is the blocked difference of the groups, as least
    squares gives it.
    """
    out = np.zeros(len(units.values))
    for block in np.unique(units.block):
        inside = units.block == block
        b = inside & units.second
        n = int(inside.sum())
        k = int(b.sum())
        if 0 < k < n:
            out[b] = (n - k) / n
            out[inside & ~units.second] = -k / n
    return out


def _all_differences(units: Units) -> Array:
    """The statistic for every arrangement."""
    y = units.values
    if units.paired:
        signs = 1 - 2 * ((np.arange(2 ** len(y))[:, None] >> np.arange(len(y))) & 1)
        return np.asarray(signs @ y)
    total = np.zeros(1)
    for block in np.unique(units.block):
        inside = np.flatnonzero(units.block == block)
        k = int(units.second[inside].sum())
        ways = np.array(list(combinations(range(len(inside)), k)), np.int64).reshape(-1, k)
        # sum of weights x values: k of n values get (n - k) / n and the others -k / n, which is sum
        # - k x mean
        differences = y[inside][ways].sum(axis=1) - k * y[inside].mean()
        total = (total[:, None] + differences).ravel()
    return total


def _some_differences(units: Units, rng: np.random.Generator) -> Array:
    """The statistic for `MOST_EXACT` arrangements drawn at random."""
    y = units.values
    if units.paired:
        return np.asarray(rng.choice([-1.0, 1.0], (MOST_EXACT, len(y))) @ y)
    total = np.zeros(MOST_EXACT)
    for block in np.unique(units.block):
        inside = np.flatnonzero(units.block == block)
        k = int(units.second[inside].sum())
        if 0 < k < len(inside):
            order = rng.random((MOST_EXACT, len(inside))).argpartition(k - 1, axis=1)[:, :k]
            total += y[inside][order].sum(axis=1) - k * y[inside].mean()
    return total


@dataclass(frozen=True)
class ModelResult:
    """What a mixed model found: difference, its 95 % interval and p; which random intercept
    it had.
    """

    found: Estimate
    p: float
    random: str


def mixed_model(rows: pd.DataFrame, units: Units, groups: tuple[str, str]) -> ModelResult | None:
    """The model value ~ group + (1 | cage) on the animals' means, or (1 | animal) on the sessions'
    values.

    rows: as for `find_units`. None where the model does not fit, or its random variance lies at
    zero, so that its errors are not to be trusted. p is of t with as many degrees of freedom as
    there are units beyond the fixed effects.
    """
    from scipy.stats import t

    data = rows[rows["group"].isin(groups) & np.isfinite(rows["value"].to_numpy(float))]
    if units.paired:
        return None
    if units.unit == CAGE:
        data = (
            data.groupby("subject_id")
            .agg({"value": "mean", "group": "first", "cage": "first"})
            .reset_index()
        )
    clusters = data["cage" if units.unit == CAGE else "subject_id"].to_numpy(str)
    if len(np.unique(clusters)) == len(clusters) or len(np.unique(units.block)) > 1:
        # nothing is nested, or animals are shuffled within blocks: the permutation says it all
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
    return ModelResult(
        Estimate(difference, difference - reach, difference + reach),
        p,
        "cage" if units.unit == CAGE else "animal",
    )


def _fit(values: Array, second: Array, clusters: NDArray[np.str_]) -> tuple[float, float] | None:
    """Difference and standard error of the restricted likelihood's fit, or None."""
    from statsmodels.regression.mixed_linear_model import MixedLM

    scale = float(values.std())
    if scale <= 0:
        return None
    exog = np.column_stack([np.ones(len(values)), second])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # whether it converged is asked below; lbfgs fails on singular matrices
            result = MixedLM(values / scale, exog, clusters).fit(reml=True, method=["powell"])
    except (np.linalg.LinAlgError, ValueError):
        return None
    error = float(result.bse_fe[1])
    variance = float(np.asarray(result.cov_re)[0, 0])
    if (
        not result.converged
        or not np.isfinite(error)
        or error <= 0
        or variance < 1e-4 * float(result.scale)
    ):
        return None
    return float(result.fe_params[1]) * scale, error * scale


def check_reachable(units: Units, alpha: float) -> None:
    """Refuse a test that cannot come out significant. Raises NotComparable."""
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
        sizes = f"{int((~units.second).sum())} against {int(units.second.sum())} {what}"
    raise NotComparable(
        f"{sizes} can be arranged in {n_ways} ways, so p cannot be below {least:.2g}; more "
        f"{units.unit.split(',')[0]}s are needed"
    )
