"""Two colours that mean two things are told apart by colour-blind people, too."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from liex_lab.actions.vocabulary import NO_POSE, PREDICTED_ERROR, WORDS, action_colours

# Machado, Oliveira and Fernandes 2009, severity 1.0, of linear RGB
BLINDNESS = {
    "none": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}


def lab(colour: str, seen_by: str) -> np.ndarray:
    """CIE L*a*b* of a colour as somebody sees it."""
    srgb = np.array([int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)])
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    turned = np.clip(np.asarray(BLINDNESS[seen_by]) @ linear, 0.0, 1.0)
    back = np.where(turned <= 0.0031308, 12.92 * turned, 1.055 * turned ** (1 / 2.4) - 0.055)
    pixel = back.astype(np.float32).reshape(1, 1, 3)
    return np.asarray(cv2.cvtColor(pixel, cv2.COLOR_RGB2Lab)).reshape(3)


@pytest.mark.parametrize("seen_by", BLINDNESS)
def test_no_pose_and_the_predicted_error_are_told_apart(seen_by: str) -> None:
    apart = np.linalg.norm(lab(NO_POSE, seen_by) - lab(PREDICTED_ERROR, seen_by))
    assert apart > 20.0  # of which 2.3 can just be noticed


@pytest.mark.parametrize("animal", WORDS)
def test_no_action_has_the_colour_of_a_lost_frame_or_of_an_error(animal: str) -> None:
    taken = {colour.upper() for colour in action_colours(list(WORDS[animal])).values()}
    assert not taken & {NO_POSE.upper(), PREDICTED_ERROR.upper()}
