"""Opening what may not be a recording."""

from pathlib import Path
from typing import Any

import pytest

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
