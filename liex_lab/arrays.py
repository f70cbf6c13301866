"""Types of the arrays that most modules share."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["Array", "Mask", "NDArray"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
