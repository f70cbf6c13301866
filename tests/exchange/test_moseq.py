"""An old study of MoSeq measured again: its scalars, and its syllables."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from liex_lab.pipelines.session import run_session

from liex_lab.exchange.export import export
from liex_lab.exchange.moseq import scalars_moseq
from liex_lab.recordings.open import open_recording
from liex_lab.sessions import Session
from tests.recordings.moseq_results import write_results

EIGHTEEN = {
    *(f"{name}_{unit}" for name in ("centroid_x", "centroid_y") for unit in ("px", "mm")),
    *(f"velocity_{n}_{unit}" for n in ("2d", "3d") for unit in ("px", "mm")),
    *(f"{name}_{unit}" for name in ("length", "width", "area") for unit in ("px", "mm")),
    *("height_ave_mm", "angle", "velocity_theta", "dist_to_center_px"),
}


@pytest.mark.slow
def test_a_session_of_an_extraction_has_its_scalars(tmp_path: Path) -> None:
    with open_recording("synthetic:walk?seed=5&frames=200") as virtual:
        frames = [virtual.frame(k).depth for k in range(0, 200, 4)]
        times_ms = virtual.times_ns[::4] / 1e6
    background = np.percentile(np.stack(frames), 95, axis=0)
    roi = np.zeros(background.shape, np.bool_)
    roi[10:415, 40:470] = True
    stored = write_results(tmp_path / "results_00.h5", frames, background, roi, times_ms)
    session = Session.open(run_session(tmp_path / "results_00.h5", out=tmp_path, report=False))
    found = pd.read_csv(export(session, "moseq", tmp_path))
    assert set(found) > EIGHTEEN
    for name, most in {
        "centroid_x_px": 0.01,
        "centroid_y_mm": 0.03,
        "length_mm": 0.03,
        "width_px": 0.03,
        "area_px": 0.05,
        "height_ave_mm": 0.05,
    }.items():
        relative = np.abs(found[name] / stored[name] - 1)
        assert np.nanmedian(relative) < most, name
    turned = np.degrees(np.abs(np.angle(np.exp(2j * (found["angle"] - stored["angle"]))) / 2))
    assert np.nanmedian(turned) < 3  # known without its direction only
    np.testing.assert_allclose(
        found["velocity_2d_mm_s"][1:], (found["velocity_2d_mm"] / session.frames["dt_s"])[1:]
    )
    # on the floor, MoSeq's x is short by the share of the angle in its tangent
    true = np.ptp(found["centroid_x_true_mm"]) / np.ptp(found["centroid_x_mm"])
    assert true == pytest.approx(415.5 / 365, rel=0.06)


@pytest.mark.slow
def test_a_real_study_measured_again_agrees_with_its_frames_and_with_moseq(
    reference_data: Path, tmp_path: Path
) -> None:
    home = reference_data / "mouse_kinect2"
    truth = pd.read_csv(home / "reference.csv")[13:133]  # all of them reliable
    background = cv2.imread(str(home / "background.png"), cv2.IMREAD_UNCHANGED).astype(float)
    roi = np.zeros(background.shape, np.bool_)
    roi[99:351, 115:370] = True  # the box of MoSeq's region
    places = truth[["centroid_x_px", "centroid_y_px", "angle_rad"]].to_numpy() - (115, 99, 0)
    with open_recording(home / "session_20170125.tar.gz") as whole:
        recording = whole[13:133]
        frames = [frame.depth for frame in recording]
        write_results(
            tmp_path / "results_00.h5",
            frames,
            background,
            roi,
            recording.times_ns / 1e6,
            places=places,
            floor=673.5,
        )
        full = Session.open(run_session(recording, out=tmp_path, report=False))
    again = Session.open(run_session(tmp_path / "results_00.h5", out=tmp_path, report=False))
    apart = np.linalg.norm(full.pose_arrays().xyz_mm - again.pose_arrays().xyz_mm, axis=2)
    assert np.nanmedian(apart) < 1.0
    assert np.nanpercentile(apart, 95) < 3.0
    # the frames are a reconstruction: MoSeq's own program finds lengths 0.3 px, widths 0.4 px off
    for session, more, corner in ((full, 1.0, (0, 0)), (again, 2.0, (115, 99))):
        found = scalars_moseq(session).set_axis(truth.index)
        for k, axis in enumerate("xy"):
            off = found[f"centroid_{axis}_px"] + corner[k] - truth[f"centroid_{axis}_px"]
            assert np.median(np.abs(off)) < 0.2
        for ours, theirs, most in (
            ("area_px", "area_px", 0.01),
            ("height_ave_mm", "height_mm", 0.01),
            ("length_mm", "length_mm", 0.012),
            ("width_mm", "width_mm", 0.022),
        ):
            assert np.median(np.abs(found[ours] / truth[theirs] - 1)) < most * more, ours
    mm = found["centroid_x_mm"] - truth["centroid_x_mm"]
    assert np.median(np.abs(mm)) < 0.3
