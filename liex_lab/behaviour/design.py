"""How animals came to their groups, read from who is where; and whether that allows a comparison at
all.

What was assigned to a group is what a test may shuffle: whole cages where every cage is of one
group, animals within their cage where a cage holds both groups, animals where nothing is known of
cages, and the two halves of an animal's own sessions where every animal was in both groups.
Sessions and bouts are never units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[np.float64]


class NotComparable(Exception):
    """Why the design does not allow a test; the text is one sentence for the table's reader."""


@dataclass(frozen=True)
class Units:
    """The units of one comparison: values (n,), whether each is of the second group (n,), its block
    (n,).

    unit: cage, animal, or animal's own difference (values are then second minus first, `second` is
    all True). parent (n,): for units that are animals within cages, their cage. n_animals (n,):
    animals that each value stands for.
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
    """The units of a comparison of two groups from one row per session.

    rows: subject_id, group, cage, value and the columns named in `blocks`; an empty cage or block
    is not known. Raises NotComparable.
    """
    rows = rows[rows["group"].isin(groups) & np.isfinite(rows["value"].to_numpy(float))]
    nameless = int((rows["subject_id"] == "").sum())
    if nameless:
        raise NotComparable(
            f"{nameless} sessions do not say which animal they are of; state subject_id in the "
            "study"
        )
    of_animal = rows.groupby("subject_id")["group"].nunique()
    both = [str(name) for name in of_animal.index[of_animal > 1]]
    if both and len(both) == len(of_animal):
        return _own_differences(rows, groups)
    if both:
        raise NotComparable(
            f"{len(both)} of {len(of_animal)} animals ({', '.join(both[:3])}) were in both groups "
            "and the others in one; compare those within themselves, or the others with each other"
        )
    animals = _animals(rows, blocks)
    second = (animals["group"] == groups[1]).to_numpy()
    for group, number in ((groups[0], int((~second).sum())), (groups[1], int(second.sum()))):
        if number < 2:
            raise NotComparable(
                f"the group {group} has {number} animals with a value, and a comparison needs two"
            )
    cage = animals["cage"].to_numpy(str)
    _check_cages(cage)
    crowded = len(set(cage)) < len(cage) and bool(cage[0])
    mixed = crowded and _holds_both(cage, second)
    block = _blocks(animals, [*(["cage"] if mixed else []), *blocks], second)
    if crowded and not mixed:
        return _whole_cages(animals, second, block)
    ones = np.ones(len(animals), np.int64)
    return Units(ANIMAL, animals["value"].to_numpy(float), second, block, ones)


def _animals(rows: pd.DataFrame, blocks: Sequence[str]) -> pd.DataFrame:
    """One row per animal, its value the mean of its sessions'."""
    animal, names = pd.factorize(rows["subject_id"], sort=True)
    first = np.unique(animal, return_index=True)[1]
    columns: dict[str, Any] = {
        "subject_id": names,
        "value": animal_means(rows["value"].to_numpy(float), animal),
    }
    for name in ("group", "cage", *(block for block in blocks if block in rows)):
        of_session = rows[name].to_numpy(str)
        columns[name] = of_session[first]
        if (columns[name][animal] != of_session).any():
            raise NotComparable(f"some animals are in more than one {name}; give each animal one")
    return pd.DataFrame(columns)


def animal_means(values: Array, animal: NDArray[np.int64]) -> Array:
    """(k,) the mean of the values (n,) of each animal, numbered from 0."""
    return np.bincount(animal, values) / np.bincount(animal)


def _check_cages(cage: NDArray[np.str_]) -> None:
    unknown = int((cage == "").sum())
    if 0 < unknown < len(cage):
        raise NotComparable(
            f"the cage of {unknown} of {len(cage)} animals is not stated; state it for all, or for "
            "none"
        )


def _holds_both(cage: NDArray[np.str_], second: NDArray[np.bool_]) -> bool:
    """Whether any cage holds animals of both groups."""
    return any(0 < second[cage == name].sum() < (cage == name).sum() for name in np.unique(cage))


def _blocks(
    animals: pd.DataFrame, names: Sequence[str], second: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """(n,) the block of each animal: what it may be exchanged within.

    A block of one group is no use; if all are so, group and block cannot be told apart, and the
    comparison is refused.
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
    if known and not any(
        0 < second[block == b].sum() < (block == b).sum() for b in np.unique(block)
    ):
        raise NotComparable(
            f"every {' and '.join(known)} has animals of one group only, so a difference may be "
            f"that of the {known[0]}; record both groups in each"
        )
    return block


def _whole_cages(
    animals: pd.DataFrame, second: NDArray[np.bool_], block: NDArray[np.int64]
) -> Units:
    """One value per cage, the mean of its animals'."""
    table = animals.assign(second=second, block=block)
    cages = table.groupby("cage", sort=True).agg(
        value=("value", "mean"),
        second=("second", "first"),
        block=("block", "first"),
        n=("value", "size"),
        blocks=("block", "nunique"),
    )
    if (cages["blocks"] > 1).any():
        raise NotComparable("some cages are in more than one batch; give each cage one")
    return Units(
        CAGE,
        cages["value"].to_numpy(float),
        cages["second"].to_numpy(bool),
        cages["block"].to_numpy(np.int64),
        cages["n"].to_numpy(np.int64),
    )


def _own_differences(rows: pd.DataFrame, groups: tuple[str, str]) -> Units:
    """One value per animal: the mean of its sessions in the second group minus that of those in the
    first.
    """
    means = rows.groupby(["subject_id", "group"])["value"].mean().unstack("group")
    values = (means[groups[1]] - means[groups[0]]).to_numpy(float)
    if len(values) < 2:
        raise NotComparable("only one animal was in both groups, and a comparison needs two")
    n = len(values)
    return Units(PAIRED, values, np.ones(n, bool), np.zeros(n, np.int64), np.ones(n, np.int64))
