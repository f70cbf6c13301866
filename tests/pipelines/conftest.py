"""One recording of a walking mouse, and its session, for every test that needs a measured one."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.session import run_session

from liex_lab.plan import Plan
from liex_lab.sessions import Session
from liex_lab.simulation.recording import FRAME_NS, RenderedRecording
from liex_lab.simulation.sensors import PRIMESENSE_QVGA_SENSOR
from liex_lab.simulation.species import MouseSpecies
from tests.recordings.writers import START_NS, write_png_folder

SPINE_MM = 65.0
N_RENDERED = 43
DROPPED = [15, 16, 31]  # frames that the camera did not deliver
KEPT = np.delete(np.arange(N_RENDERED), DROPPED)
BLANK = 28  # row of the recording that has no depth
measure = partial(run_session, report=False)
TIMES_NS = [START_NS + FRAME_NS * int(k) for k in KEPT]


@pytest.fixture(scope="session")
def mouse() -> RenderedRecording:
    return MouseSpecies().motion(9, N_RENDERED, sensor=PRIMESENSE_QVGA_SENSOR, spine_mm=SPINE_MM)


@pytest.fixture(scope="session")
def images(mouse: RenderedRecording) -> np.ndarray:
    """The delivered depth images (n, H, W) uint16."""
    depths = mouse.depths(0, N_RENDERED)[KEPT].astype(np.uint16)
    depths[BLANK] = 0
    return depths


@pytest.fixture(scope="session")
def walk(
    mouse: RenderedRecording, images: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The recording; tests copy it before they change it."""
    folder = tmp_path_factory.mktemp("recording") / "walk"
    return write_png_folder(folder, images, mouse.camera, TIMES_NS)


@pytest.fixture(scope="session")
def walked(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Its session with report and replay; tests copy it before they change it."""
    return Session.open(run_session(walk, Plan.load("mouse"), tmp_path_factory.mktemp("sessions")))
