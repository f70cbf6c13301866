"""Opening what may or may not be a recording."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings import Recording, open_recording


def refusal(path: Path, **how: Any) -> str:
    """The one sentence with which a recording is refused."""
    with pytest.raises(RecordingError) as error:
        open_recording(path, **how)
    sentence = str(error.value)
    assert "\n" not in sentence
    return sentence


def opened_or_refused(path: Path) -> tuple[Recording | None, str]:
    """The recording, or else the sentence; any other error goes on."""
    try:
        return open_recording(path), ""
    except RecordingError as error:
        return None, str(error)


def depths_in(path: Path, **how: Any) -> NDArray[np.float32]:
    """The depths (n, H, W) mm of a recording."""
    with open_recording(path, **how) as recording:
        return np.array([frame.depth for frame in recording])


def facts_in(path: Path | str, **how: Any) -> Recording:
    """A recording that is closed again: what it states of itself."""
    with open_recording(path, **how) as recording:
        return recording


def exact(path: Path, expected: NDArray[Any], **how: Any) -> Recording:
    """A recording that holds exactly these depths (n, H, W) mm, closed again."""
    with open_recording(path, **how) as recording:
        np.testing.assert_array_equal([frame.depth for frame in recording], expected)
        return recording
