"""The job `liex evaluate statistics`: how often the group test is wrong where there is no effect,
and its power.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.runtime.progress import Progress, silent

ALPHA = 0.05
_AT_ONCE = 50  # studies that are compared in one go, as measures of the same animals


@dataclass(frozen=True)
class StudyPlan:
    """A simulated study: so many cages per group, animals per cage and sessions per animal, and how
    much each varies.

    Standard deviations are of a cage's mean, of an animal in its cage and of a session of its
    animal. within: every cage holds both groups. effect: what the second group has more, in
    standard deviations between animals.
    """

    name: str
    n_cages: int
    n_animals: int
    n_sessions: int
    sd_cage: float = 0.5
    sd_animal: float = 1.0
    sd_session: float = 0.7
    within: bool = False
    caged: bool = True
    effect: float = 0.0

    def draw(self, rng: np.random.Generator, n_studies: int) -> pd.DataFrame:
        """As many independent studies of the same design: a row per session, and the columns
        study_0, study_1, ...
        """
        n_cages = self.n_cages if self.within else 2 * self.n_cages
        n_animals = n_cages * self.n_animals
        cage = np.repeat(np.arange(n_cages), self.n_animals)
        treated = np.arange(n_animals) % 2 == 1 if self.within else cage >= self.n_cages
        sd = np.hypot(self.sd_cage, self.sd_animal)
        mean = rng.normal(0, self.sd_cage, (n_cages, n_studies))[cage]
        mean += (
            rng.normal(0, self.sd_animal, (n_animals, n_studies))
            + self.effect * sd * treated[:, None]
        )
        animal = np.repeat(np.arange(n_animals), self.n_sessions)
        values = mean[animal] + rng.normal(0, self.sd_session, (len(animal), n_studies))
        who = pd.DataFrame(
            {
                "subject_id": [f"m{k:03d}" for k in animal],
                "cage": [f"c{k:02d}" if self.caged else "" for k in cage[animal]],
                "group": np.where(treated[animal], "treated", "control"),
            }
        )
        return who.join(pd.DataFrame(values, columns=[f"study_{k}" for k in range(n_studies)]))


PLANS = (
    StudyPlan("4 cages of 3 per group, 2 sessions", 4, 3, 2),
    StudyPlan("8 cages of 3 per group, 2 sessions", 8, 3, 2),
    StudyPlan("8 cages of 3 per group, cages differ as much as animals", 8, 3, 2, sd_cage=1.0),
    StudyPlan("6 cages of 4, both groups in each", 6, 4, 2, within=True),
    StudyPlan("8 animals per group, 3 sessions", 8, 1, 3, caged=False),
    StudyPlan("5 animals per group", 5, 1, 1, caged=False),
)


def evaluate_statistics(
    n_studies: int = 2000, effect: float = 1.0, seed: int = 0, progress: Progress = silent
) -> dict[str, Any]:
    """Share of p <= 5 % in `n_studies` simulated studies of each kind: without an effect, and with
    one.

    effect: in standard deviations between animals. Beside it what a t test would do that takes
    every session for a unit; the interval's coverage of the true difference; and how often the
    mixed model was used.
    """
    found: dict[str, Any] = {
        "alpha": ALPHA,
        "n_studies": n_studies,
        "effect_size": effect,
        "seed": seed,
    }
    for k, plan in enumerate(PLANS):
        progress(k, len(PLANS), plan.name)
        rng = np.random.default_rng([seed, k])
        found[plan.name] = {
            **error_rates(plan, n_studies, rng),
            "power": power(plan, effect, n_studies // 4 + 1, rng),
        }
    return found


def error_rates(plan: StudyPlan, n_studies: int, rng: np.random.Generator) -> dict[str, float]:
    """Of studies without an effect: shares with p <= 5 %, with an interval around 0, tested by the
    model.
    """
    from scipy.stats import ttest_ind

    tests = []
    naive = []
    for n in _portions(n_studies):
        studies = plan.draw(rng, n)
        tests.append(_compared(studies, rng))
        values = studies.filter(like="study_").to_numpy()
        treated = (studies["group"] == "treated").to_numpy()
        naive.append(ttest_ind(values[treated], values[~treated]).pvalue <= ALPHA)
    table = pd.concat(tests)
    return {
        "type_1": _share(table["p"] <= ALPHA),
        "type_1_sessions_as_units": _share(np.concatenate(naive)),
        "coverage": _share((table["ci_low"] <= 0.0) & (table["ci_high"] >= 0.0)),
        "mixed_model": _share(table["test"].str.startswith("mixed")),
    }


def power(plan: StudyPlan, effect: float, n_studies: int, rng: np.random.Generator) -> float:
    """Share of studies with this effect in which it is found."""
    real = replace(plan, effect=effect)
    return _share(
        pd.concat([_compared(real.draw(rng, n), rng) for n in _portions(n_studies)])["p"] <= ALPHA
    )


def _compared(studies: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    from liex_lab.behaviour.cohort import compare

    measures = [str(name) for name in studies.columns if str(name).startswith("study_")]
    return compare(studies, measures, seed=int(rng.integers(2**31)))


def _portions(n: int) -> list[int]:
    return [min(_AT_ONCE, n - start) for start in range(0, n, _AT_ONCE)]


def _share(of: Any) -> float:
    return round(float(np.mean(of)), 4)
