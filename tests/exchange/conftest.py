"""One session that every format is written from; readers of other programs join where they are
installed.
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from liex_lab.sessions import Session
from tests.sessions.walking_mouse import WalkingMouse, steady, write

# these programs bring 200 packages and more than a gigabyte: `pip install -e '.[test,peers]'`
# collects their tests as well, and .ci/peers runs them
_PEERS = {
    "test_peers.py": ("movement", "sleap_io"),
    "test_boris_reads.py": ("boris",),
    "test_dandi.py": ("dandi",),
    "test_spikeinterface.py": ("spikeinterface",),
}
collect_ignore = [
    file for file, packages in _PEERS.items() if not all(find_spec(name) for name in packages)
]


@pytest.fixture(scope="package")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Four seconds before an uneven clock, frames dropped, two lost, a rear in between."""
    times = np.delete(
        steady(4.0) + np.random.default_rng(2).uniform(-0.003, 0.003, 120), slice(70, 74)
    )
    mouse = WalkingMouse(times - times[0], rear_s=(1.0, 2.2), lost=(20, 21))
    folder: Path = tmp_path_factory.mktemp("exchange") / "circle.liex"
    subject = {
        "subject_id": "m01",
        "group": "control",
        "cage": "c3",
        "sex": "female",
        "batch": "b2",
        "age": "P12W",
    }
    return write(folder, mouse, subject=subject, session_start_time="2026-08-21T10:00:00+02:00")
