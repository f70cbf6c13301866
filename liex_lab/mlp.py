"""A small network as arrays: what scikit-learn has trained, run by numpy alone, with the same bits
on any number of cores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.runtime.threads import serial_products

Array = NDArray[np.float64]

LIMIT = 6.0  # standard deviations beyond which a feature tells nothing more


@dataclass(frozen=True)
class Network:
    """Layers (weights, bias) on standardised features, rectified between: weights as they are
    multiplied, no code.
    """

    centre: NDArray[np.float32]
    scale: NDArray[np.float32]
    layers: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]

    def logits(self, features: NDArray[np.floating]) -> Array:
        """(m, K) of features (m, F): the same bits on any number of cores, which products of BLAS's
        threads are not.
        """
        x = np.clip((features - self.centre) / self.scale, -LIMIT, LIMIT)
        with serial_products():
            for k, (weights, bias) in enumerate(self.layers):
                x = x @ weights + bias
                if k + 1 < len(self.layers):
                    x = np.maximum(x, 0.0)
        return x.astype(np.float64)


def descend(
    inputs: NDArray[np.floating],
    labels: NDArray[Any],
    hidden: Sequence[int],
    *,
    epochs: int,
    batch: int,
    rate: float,
    least_rate: float,
    weight_decay: float,
    seed: int,
) -> list[tuple[Array, Array]]:
    """Layers (weights, bias) that tell the labels (m,) of inputs (m, F), by scikit-learn's
    stochastic gradient descent (Adam), whose rate falls with a cosine; the last gives one number
    where there are two labels, else one for each. The same bits on any number of cores.
    """
    from sklearn.neural_network import MLPClassifier

    classifier = MLPClassifier(
        tuple(hidden),
        alpha=weight_decay,
        batch_size=batch,
        learning_rate_init=rate,
        max_iter=1,
        warm_start=True,
        random_state=seed,
    )
    present = np.unique(labels)
    with serial_products():
        for epoch in range(epochs):
            classifier.learning_rate_init = (
                rate * 0.5 * (1.0 + np.cos(np.pi * epoch / epochs)) + least_rate
            )
            classifier.partial_fit(inputs, labels, classes=present if epoch == 0 else None)
    return list(zip(classifier.coefs_, classifier.intercepts_, strict=True))
