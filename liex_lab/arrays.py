"""Types of the arrays that most modules share."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Array", "ArrayLike", "Mask", "NDArray"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
