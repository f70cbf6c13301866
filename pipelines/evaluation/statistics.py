"""Monte Carlo evaluation of the group test: type I error, coverage and power on simulated studies.

`liex evaluate statistics` draws studies from a nested normal model (cage, animal within cage,
session within animal) in six designs, `PLANS`, and compares their groups as `liex compare` does.
The results are shares of studies: p <= 5 % without an effect (the type I error); the same for a t
test with sessions as units; 95 % intervals that contain the true difference; use of the mixed
model; and the power at an effect in standard deviations between animals.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import ttest_ind

from liex_lab.behaviour.cohort import compare
from liex_lab.runtime.progress import Progress, silent

ALPHA = 0.05
_AT_ONCE = 50  # studies per comparison, as measures of the same animals


@dataclass(frozen=True)
class StudyPlan:
    """A simulated study: its design, and the variation at each level.

    Attributes:
        name: of the design.
        n_cages: cages per group, or in all if `within`.
        n_animals: animals per cage.
        n_sessions: sessions per animal.
        sd_cage: standard deviation of a cage's mean.
        sd_animal: of an animal within its cage.
        sd_session: of a session of its animal.
        within: every cage has animals of both groups.
        caged: whether the table states the cages.
        effect: difference of the second group, in standard deviations between animals.
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
        """Independent studies of the design: a row per session, a column study_k per study."""
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
        animals = pd.DataFrame(
            {
                "subject_id": [f"m{k:03d}" for k in animal],
                "cage": [f"c{k:02d}" if self.caged else "" for k in cage[animal]],
                "group": np.where(treated[animal], "treated", "control"),
            }
        )
        return animals.join(pd.DataFrame(values, columns=[f"study_{k}" for k in range(n_studies)]))


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
    """Error rates and power of the group test in every design; `liex evaluate statistics`.

    Args:
        n_studies: simulated studies of each design without an effect; about a quarter as many with
            one.
        effect: in standard deviations between animals.
        seed: of the draws.
        progress: called design by design.

    Returns:
        By the designs' names `type_1`, `type_1_sessions_as_units` (a t test with sessions as
        units), `coverage` of the true difference, `mixed_model` (how often it was used) and
        `power`; and alpha, n_studies, effect_size and seed.
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
    """Shares of studies without an effect: p <= 5 %, interval contains 0, mixed model used."""
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
    """Share of studies in which the test detects an effect, p <= 5 %.

    The effect is in standard deviations between animals.
    """
    real = replace(plan, effect=effect)
    return _share(
        pd.concat([_compared(real.draw(rng, n), rng) for n in _portions(n_studies)])["p"] <= ALPHA
    )


def _compared(studies: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:

    measures = [str(name) for name in studies.columns if str(name).startswith("study_")]
    return compare(studies, measures, seed=int(rng.integers(2**31)))


def _portions(n: int) -> list[int]:
    return [min(_AT_ONCE, n - start) for start in range(0, n, _AT_ONCE)]


def _share(of: Any) -> float:
    return round(float(np.mean(of)), 4)
