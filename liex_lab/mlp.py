"""Multilayer perceptron: trained by scikit-learn's Adam, run by NumPy alone.

    x_0 = clip((x - centre) / scale, +-LIMIT),   x_{k+1} = max(0, x_k W_k + b_k)

with rectified linear units between the layers and none after the last, which gives logits. Training
and prediction give the same bits on any number of cores.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.runtime.processes import serial_products

_AT_ONCE = 2048  # samples in memory
LIMIT = 6.0  # standard deviations at which features are clipped


@dataclass(frozen=True)
class Network:
    """A trained multilayer perceptron: plain weights, no code.

    Attributes:
        centre: (F,) float32 mean of each feature.
        scale: (F,) float32 standard deviation of each feature.
        layers: (weights (before, after), bias (after,)) of each layer, float32; rectified between.
    """

    centre: NDArray[np.float32]
    scale: NDArray[np.float32]
    layers: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]

    @staticmethod
    def plain(layers: Iterable[Sequence[NDArray[np.float32]]]) -> "Network":
        """A network of these layers whose features are not standardised."""
        packed = tuple((weights, bias) for weights, bias in layers)
        n = len(packed[0][0])
        return Network(np.zeros(n, np.float32), np.ones(n, np.float32), packed)

    def logits(self, features: NDArray[np.floating]) -> Array:
        """Logits of samples, identical on any number of cores, unlike products of threaded BLAS.

        Args:
            features: (m, F) features; beyond LIMIT standard deviations they are clipped.

        Returns:
            (m, K) logits.
        """
        found = []
        with serial_products():
            for begin in range(0, max(1, len(features)), _AT_ONCE):
                some = features[begin : begin + _AT_ONCE]
                x = np.clip((some - self.centre) / self.scale, -LIMIT, LIMIT)
                for k, (weights, bias) in enumerate(self.layers):
                    x = x @ weights + bias
                    if k + 1 < len(self.layers):
                        x = np.maximum(x, 0.0)
                found.append(x)
        return np.concatenate(found, dtype=np.float64)


def check_layers(network: Network, n_outputs: int) -> None:
    """Check that the layers of a network from a file match.

    Args:
        network: the network.
        n_outputs: expected number of logits.

    Raises:
        ValueError: the error, as a part of a sentence.
    """
    before: tuple[int, ...] = np.shape(network.centre)
    sound = len(before) == 1 and np.shape(network.scale) == before and len(network.layers) > 0
    for weights, bias in network.layers:
        sound = sound and np.ndim(weights) == 2 and np.shape(weights)[:1] == before
        before = np.shape(bias)
        sound = sound and np.shape(weights)[1:] == before
    if not sound or before != (n_outputs,):
        raise ValueError(f"the layers of a network do not lead to {n_outputs} numbers")
    numbers = [network.centre, network.scale, *(part for layer in network.layers for part in layer)]
    if not all(part.dtype.kind == "f" and np.isfinite(part).all() for part in numbers):
        raise ValueError("a network's weights are not all finite numbers")


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
    """Train a multilayer perceptron classifier by Adam with a cosine-annealed learning rate.

    scikit-learn's `MLPClassifier` is trained epoch by epoch on the cross-entropy loss; the rate of
    epoch e is least_rate + rate (1 + cos(pi e / epochs)) / 2. The result has the same bits on any
    number of cores.

    Args:
        inputs: (m, F) features.
        labels: (m,) class labels.
        hidden: neurons of each hidden layer.
        epochs: passes over all samples.
        batch: samples of a step.
        rate: learning rate of the first epoch, less least_rate.
        least_rate: final learning rate of the schedule.
        weight_decay: L2 penalty of the weights.
        seed: of the initial weights and of the order of samples.

    Returns:
        (weights, bias) of each layer; the last layer has one output for two labels, else one for
        each label.
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
