"""The bundled sample: what its card says, what a camera would have written, and the same whenever
it is made.
"""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines import sample

from liex_lab import catalog
from liex_lab.catalog import DEMO
from liex_lab.recordings import open_recording
from liex_lab.sessions.provenance import package_version

REMAKE = "the rendering has changed; make the sample again, datasets/README.md says how"


@pytest.fixture(scope="module")
def card() -> dict[str, object]:
    return tomllib.loads(catalog.find_sample(DEMO).with_suffix(".toml").read_text(encoding="utf-8"))


def test_the_sample_is_what_its_card_says_and_small(card: dict[str, object]) -> None:
    path = catalog.find_sample(DEMO)
    assert catalog.sha256(path) == card["sha256"]
    assert path.stat().st_size == card["bytes"]
    assert path.stat().st_size <= 2_500_000


def test_the_sample_is_a_recording_with_gaps_and_a_camera(card: dict[str, object]) -> None:
    with open_recording(catalog.find_sample(DEMO), strict=True) as recording:
        assert (recording.name, recording.format, recording.problems) == ("mouse_walk", "mcap", [])
        assert len(recording) == card["n_frames"] == 150
        assert (recording.width, recording.height, recording.camera.fx) == (320, 240, 287.9)
        assert [gap.n_frames_missing for gap in recording.gaps] == [1, 3]
        assert recording.metadata == {}, "no date is claimed for what was never recorded"
        assert recording.rate_hz == pytest.approx(30.0, abs=0.01)


def test_the_mouse_of_the_sample_walks_turns_and_rears() -> None:
    mouse = sample.virtual_mouse()
    rump, neck, nose = (mouse.joints_arena[:, k] for k in (0, 3, 4))
    middle = mouse.joints_arena[:, :-1, :2].mean(axis=1)
    heading = np.unwrap(np.arctan2(*(neck - rump)[:, 1::-1].T))
    assert np.linalg.norm(np.diff(middle, axis=0), axis=1).sum() > 5 * mouse.spine_mm
    assert np.degrees(np.ptp(heading)) > 120
    assert 10 < ((nose - rump)[:, 2] > 0.6 * mouse.spine_mm).sum() < 75
    np.testing.assert_array_equal(np.diff(mouse.times_ns), 33_333_333)


@pytest.mark.nightly
def test_the_job_makes_the_sample_again(tmp_path: Path, card: dict[str, object]) -> None:
    made = sample.write_sample(tmp_path / DEMO)
    with open_recording(made) as again, open_recording(catalog.find_sample(DEMO)) as bundled:
        np.testing.assert_array_equal(again.times_ns, bundled.times_ns)
        # another processor may round the last digit of a depth the other way
        differing = [np.mean(a.depth != b.depth) for a, b in zip(again, bundled, strict=True)]
        assert np.mean(differing) < 1e-4, REMAKE
    if np.any(differing) or card["made_with"] != f"zstandard {package_version('zstandard')}":
        return
    # the file's header names the version that wrote it, and nothing else may differ
    bundled_bytes = catalog.find_sample(DEMO).read_bytes()
    version = re.compile(rb"liex_lab \d+\.\d+\.\d+")
    assert catalog.sha256(catalog.find_sample(DEMO)) == card["sha256"]
    assert version.sub(b"", made.read_bytes(), 1) == version.sub(b"", bundled_bytes, 1), REMAKE
    made_card = tomllib.loads(made.with_suffix(".toml").read_text())
    assert made_card | {"sha256": card["sha256"]} == card
