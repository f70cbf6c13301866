"""A small network as arrays: what scikit-learn has trained, run by numpy alone, with the same bits on any number of
cores.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LIMIT = 6.0  # standard deviations beyond which a feature tells nothing more


@dataclass(frozen=True)
class Network:
    """Layers (weights, bias) on standardised features, rectified between: weights as they are multiplied, no code."""

    centre: NDArray[np.float32]
    scale: NDArray[np.float32]
    layers: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]

    def logits(self, features: NDArray[np.floating]) -> Array:
        """(m, K) of features (m, F): the same bits on any number of cores, which products of BLAS's threads are not."""
        from threadpoolctl import threadpool_limits

        x = np.clip((features - self.centre) / self.scale, -LIMIT, LIMIT)
        with threadpool_limits(1, user_api="blas"):
            for k, (weights, bias) in enumerate(self.layers):
                x = x @ weights + bias
                if k + 1 < len(self.layers):
                    x = np.maximum(x, 0.0)
        return x.astype(np.float64)
