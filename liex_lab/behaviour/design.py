"""Units of analysis of a two-group design (cage, animal or paired), against pseudoreplication.

What was assigned to a group is what a test may exchange (Hurlbert 1984; restricted permutation):
whole cages where every cage is of one group, animals within their cage where a cage holds both
groups, animals where nothing is known of cages, and an animal's own difference where every animal
was in both groups. Sessions and bouts are never units: they are averaged per animal. How the
animals came to their groups is read from who is where; `NotComparable` says where that allows no
comparison.
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
    """The n units of one comparison of two groups.

    Attributes:
        unit: what a unit is: cage, animal, or an animal's own difference (`PAIRED`).
        values: (n,) value of each unit, in the measure's own unit; second group minus first where
            paired.
        second: (n,) whether the unit is of the second group; all True where paired.
        block: (n,) number of the block within which the unit may be exchanged.
        n_animals: (n,) animals that each value stands for.
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

    Sessions are averaged per animal. Animals in both groups give paired differences; cages of one
    group each become the units; where a cage holds both groups it is a block, as are the known
    columns of `blocks`.

    Args:
        rows: one row per session: subject_id, group, cage, value, and the columns named in
            `blocks`; an empty cage or block is not known. Rows of other groups or without a value
            are left out.
        groups: names of the first and the second group.
        blocks: columns within which animals are exchanged; those unknown or constant are ignored.

    Raises:
        NotComparable: sessions do not name their animal, only some animals were in both groups, a
            group has fewer than two animals, cages are known for some only, an animal or cage is in
            more than one block, or group and block cannot be told apart.
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
    """One row per animal, its value the mean of its sessions' values."""
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
    """(k,) mean of the values of each animal.

    Args:
        values: (n,) one value per session.
        animal: (n,) number of each session's animal, 0 to k - 1.
    """
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
    """(n,) number of the block of each animal: what it may be exchanged within.

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
    """One value per cage, the mean of its animals' values."""
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
    """One value per animal: its mean in the second group minus its mean in the first."""
    means = rows.groupby(["subject_id", "group"])["value"].mean().unstack("group")
    values = (means[groups[1]] - means[groups[0]]).to_numpy(float)
    if len(values) < 2:
        raise NotComparable("only one animal was in both groups, and a comparison needs two")
    n = len(values)
    return Units(PAIRED, values, np.ones(n, bool), np.zeros(n, np.int64), np.ones(n, np.int64))
