"""Components in a box are those of the whole picture, in the same order."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from liex_lab.scene.worn import components


@pytest.mark.parametrize("density", [0.01, 0.2, 0.45, 0.7])
@pytest.mark.parametrize("box", [(0, 60, 0, 80), (7, 52, 13, 71), (8, 9, 3, 80), (59, 60, 79, 80)])
def test_components_are_those_of_the_whole_picture(
    density: float, box: tuple[int, int, int, int]
) -> None:
    rng = np.random.default_rng(int(100 * density) + sum(box))
    mask = np.zeros((60, 80), np.uint8)
    inside = (slice(*box[:2]), slice(*box[2:]))
    mask[inside] = rng.random(mask[inside].shape) < density
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    found = components(mask)
    np.testing.assert_array_equal(found.labels, labels)
    np.testing.assert_array_equal(found.stats[1:], stats[1:])


def test_an_empty_mask_has_no_component() -> None:
    found = components(np.zeros((5, 7), np.uint8))
    assert not found.labels.any()
    assert len(found.stats) == 1
