"""Shapes of arrays, checked once before compiled code reads them.

A kernel does not check its indices: a row that is narrower than it reads gives the numbers behind
it, and no error. So whoever hands arrays to a kernel asks here first, or takes a record that has
asked when it was made.
"""

from __future__ import annotations

from numpy.typing import NDArray


def check_shapes(whose: str, *wanted: tuple[str, NDArray, tuple[int | str, ...]]) -> None:
    """Refuse arrays of another shape than is read.

    Args:
        whose: names what takes the arrays, for the sentence.
        *wanted: name, array and shape of each; a number is that length, and a letter is any length,
            the same one wherever the letter stands.

    Raises:
        ValueError: an array has other dimensions, or two lengths of one letter differ.
    """
    lengths: dict[int | str, int] = {}
    for name, array, shape in wanted:  # some forty arrays of a live frame come by here
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
    """Refuse row numbers that are none of n rows.

    Args:
        whose: names what the rows are of, for the sentence.
        index: row numbers, of any shape.
        n: how many rows there are.

    Raises:
        ValueError: a number is below 0 or not below n.
    """
    if index.size and not 0 <= int(index.min()) <= int(index.max()) < n:
        raise ValueError(
            f"row numbers of {whose} should be 0 to {n - 1}, but are {int(index.min())} to "
            f"{int(index.max())}; number the rows that were given"
        )
