"""Records of arrays with rows, and shape checks done once before compiled code reads them.

Kernels do not check indices: a row that is too narrow yields the numbers that follow it, and no
error. Callers that pass arrays to a kernel check them here, or pass a record that was checked when
it was created.
"""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray


class Rows:
    """Base of dataclasses whose arrays all have one row per item (a frame, an animal, a sample).

    Fields that are neither arrays nor such records belong to all rows, as do those in `SHARED`.
    """

    SHARED: ClassVar[tuple[str, ...]] = ()

    def __getitem__(self, index: Any) -> Self:
        """Some rows, by mask, row numbers, slice or number; a tuple for multiple batch axes."""
        columns = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        rows = {name: value[index] for name, value in columns.items() if self._has_rows(name)}
        return type(self)(**columns | rows)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Concatenate the rows of at least one part; all else is that of the first."""
        columns: dict[str, Any] = {}
        for field in fields(cls):  # type: ignore[arg-type]
            values = [getattr(part, field.name) for part in parts]
            if not parts[0]._has_rows(field.name):
                columns[field.name] = values[0]
            elif isinstance(values[0], Rows):
                columns[field.name] = type(values[0]).join(values)
            else:
                columns[field.name] = np.concatenate(values)
        return cls(**columns)

    def _has_rows(self, name: str) -> bool:
        return name not in self.SHARED and isinstance(getattr(self, name), np.ndarray | Rows)


def check_shapes(whose: str, *wanted: tuple[str, NDArray, tuple[int | str, ...]]) -> None:
    """Raise if an array does not have the expected shape.

    Args:
        whose: the consumer of the arrays, for the error message.
        *wanted: name, array and shape of each; a number is an exact length, a letter any length
            that is the same wherever the letter occurs.

    Raises:
        ValueError: an array has other dimensions, or two lengths of one letter differ.
    """
    lengths: dict[int | str, int] = {}
    for name, array, shape in wanted:  # about forty arrays per live frame
        known = [lengths.get(n, n) for n in shape]
        fits = array.ndim == len(shape)
        for n, length in zip(known, array.shape, strict=False):
            if isinstance(n, str):
                lengths[n] = length
            else:
                fits &= n == length
        if not fits:
            raise ValueError(
                f"{name} of {whose} should have the shape ({', '.join(map(str, known))}), but has "
                f"({', '.join(map(str, array.shape))}); give arrays of the same frames and animal"
            )


def check_index(whose: str, index: NDArray, n: int) -> None:
    """Raise if row numbers are out of range.

    Args:
        whose: what the rows belong to, for the error message.
        index: row numbers, of any shape.
        n: number of rows.

    Raises:
        ValueError: a number is below 0 or not below n.
    """
    if index.size and not 0 <= int(index.min()) <= int(index.max()) < n:
        raise ValueError(
            f"row numbers of {whose} should be 0 to {n - 1}, but are {int(index.min())} to "
            f"{int(index.max())}; number the rows that were given"
        )
