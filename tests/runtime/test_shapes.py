"""Arrays are checked at the door: what fits passes, and what does not is told in a sentence."""

import numpy as np
import pytest

from liex_lab.runtime.memory import check_index, check_shapes


def test_arrays_that_fit_together_pass() -> None:
    check_shapes("poses", ("a", np.zeros((3, 5, 3)), ("n", "J", 3)), ("b", np.zeros(3), ("n",)))
    check_index("rows", np.array([0, 2]), 3)
    check_index("rows", np.zeros(0, int), 0)


@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 2), (3, 5, 3, 1), (4, 5, 3)])
def test_another_shape_is_refused_with_both(shape: tuple[int, ...]) -> None:
    wanted = ("n", "J", 3)
    with pytest.raises(ValueError, match="joints of poses should have the shape") as told:
        check_shapes("poses", ("seconds", np.zeros(3), ("n",)), ("joints", np.zeros(shape), wanted))
    assert f"({', '.join(map(str, shape))})" in str(told.value)
    assert "(3, J, 3)" in str(told.value)


@pytest.mark.parametrize("rows", [[-1], [0, 3], [2**40]])
def test_rows_that_are_not_there_are_refused(rows: list[int]) -> None:
    with pytest.raises(ValueError, match="should be 0 to 2"):
        check_index("rows", np.array(rows), 3)
