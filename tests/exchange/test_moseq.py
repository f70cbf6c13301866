"""An old study of MoSeq measured again: its scalars, and its syllables."""

from __future__ import annotations

from pathlib import Path

import cv2
import h5py
import ndx_pose
import numpy as np
import pandas as pd
import pynwb
import pytest
from liex_lab.pipelines.correct import edited_bouts
from liex_lab.pipelines.session import run_session
from liex_lab.pipelines.training.action_model import read_any_labels

from liex_lab.errors import LiexError
from liex_lab.exchange.export import export
from liex_lab.exchange.moseq import scalars_moseq
from liex_lab.recordings.open import open_recording
from liex_lab.sessions import Session
from liex_lab.sessions.correcting import labelled_bouts
from tests.recordings.moseq_results import write_results

EIGHTEEN = {
    *(f"{name}_{unit}" for name in ("centroid_x", "centroid_y") for unit in ("px", "mm")),
    *(f"velocity_{n}_{unit}" for n in ("2d", "3d") for unit in ("px", "mm")),
    *(f"{name}_{unit}" for name in ("length", "width", "area") for unit in ("px", "mm")),
    *("height_ave_mm", "angle", "velocity_theta", "dist_to_center_px"),
}


@pytest.mark.slow
def test_a_session_of_an_extraction_keeps_its_scalars(tmp_path: Path) -> None:
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
    for name, values in stored.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-5, atol=1e-4, err_msg=name)
    assert set(session.table("moseq")) == {"session_id", "individual", "frame_index", *stored}
    np.testing.assert_allclose(
        found["velocity_2d_mm_s"][1:],
        (found["velocity_2d_mm"] / session.frames["dt_s"])[1:],
        rtol=1e-4,  # the file holds 32 bits
    )
    middle = found[["centroid_x_px", "centroid_y_px"]].to_numpy() - (214.5, 202)  # of its region
    np.testing.assert_allclose(found["dist_to_center_px"], np.hypot(*middle.T))
    # on the floor, MoSeq's x is short by the share of the angle in its tangent
    true = np.ptp(found["centroid_x_true_mm"]) / np.ptp(found["centroid_x_mm"])
    assert true == pytest.approx(415.5 / 365, rel=0.06)


@pytest.mark.slow
def test_a_real_study_measured_again_agrees_with_its_frames_and_with_moseq(
    reference_data: Path, tmp_path: Path
) -> None:
    home = reference_data / "mouse_kinect2"
    truth = pd.read_csv(home / "reference.csv")[13:133]  # all of them reliable
    background = np.asarray(cv2.imread(str(home / "background.png"), -1), float)
    roi = np.zeros(background.shape, np.bool_)
    roi[99:351, 115:370] = True  # the box of MoSeq's region
    truth = truth.assign(
        centroid_x_px=truth["centroid_x_px"] - 115, centroid_y_px=truth["centroid_y_px"] - 99
    )
    truth = truth.rename(columns={"height_mm": "height_ave_mm", "angle_rad": "angle"})
    own = [name for name in truth if name in EIGHTEEN]
    with open_recording(home / "session_20170125.tar.gz") as whole:
        recording = whole[13:133]
        defined = write_results(
            tmp_path / "results_00.h5",
            [frame.depth for frame in recording],
            background,
            roi,
            recording.times_ns / 1e6,
            places=truth[["centroid_x_px", "centroid_y_px", "angle"]].to_numpy(),
            floor=673.5,
            stored={name: truth[name].to_numpy() for name in own},
        )
        full = Session.open(run_session(recording, out=tmp_path, report=False))
    again = Session.open(run_session(tmp_path / "results_00.h5", out=tmp_path, report=False))
    apart = np.linalg.norm(full.pose_arrays().xyz_mm - again.pose_arrays().xyz_mm, axis=2)
    assert np.nanmedian(apart) < 1.0
    assert np.nanpercentile(apart, 95) < 3.0
    # those of the file, whatever its cut-outs still show
    kept = scalars_moseq(again)[own].to_numpy()
    np.testing.assert_allclose(kept, truth[own].to_numpy(), rtol=1e-6, atol=1e-3)
    # those of the frames, by MoSeq's definitions with its own background
    found = scalars_moseq(full)
    for name in ("length_px", "width_px", "area_px", "height_ave_mm", "length_mm", "width_mm"):
        assert np.median(np.abs(found[name] / defined[name] - 1)) < 0.01, name
    for name, corner in {"centroid_x_px": 115, "centroid_y_px": 99}.items():
        assert np.median(np.abs(found[name] - corner - truth[name].to_numpy())) < 0.1
    turned = np.degrees(np.abs(np.angle(np.exp(2j * (found["angle"] - defined["angle"]))) / 2))
    assert np.median(turned) < 1  # known without its direction only


def test_keypoint_moseq_reads_the_nwb_file_in_3d(session: Session, tmp_path: Path) -> None:
    """As its loader does: the one PoseEstimation, and a series with a confidence for each node."""
    with pynwb.NWBHDF5IO(export(session, "nwb", tmp_path), "r", load_namespaces=True) as file:
        (found,) = (
            one for one in file.read().all_children() if isinstance(one, ndx_pose.PoseEstimation)
        )
        series = [found.pose_estimation_series[name] for name in found.nodes[:]]
        xyz = np.stack([one.data[()] for one in series], axis=1)
        confidence = np.stack([one.confidence[()] for one in series], axis=1)
    np.testing.assert_allclose(xyz, session.pose_arrays().xyz_mm, atol=1e-3)
    assert 0 <= np.nanmin(confidence) <= np.nanmax(confidence) <= 1


def _syllables(session: Session) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.repeat(rng.integers(0, 12, 40), rng.integers(2, 9, 40))[: len(session.frames)]


def _results(path: Path, **recordings: np.ndarray) -> Path:
    with h5py.File(path, "w") as file:
        for name, syllables in recordings.items():
            file[f"{name}/syllable"] = syllables
            file[f"{name}/heading"] = np.zeros(len(syllables))
    return path


def test_syllables_become_the_bouts_of_a_session(session: Session, tmp_path: Path) -> None:
    numbers = _syllables(session)
    other = _results(tmp_path / "results.h5", **{session.name: numbers, "other": numbers[:9]})
    table = pd.DataFrame({"syllable": numbers, "heading": 0.0})
    table.to_csv(tmp_path / f"{session.name}.csv", index=False)
    named = table.assign(name=session.name, frame_index=range(len(table)))
    named.to_csv(tmp_path / "kpms_df.csv", index=False)
    for file in (other, tmp_path / f"{session.name}.csv", tmp_path / "kpms_df.csv"):
        edits = labelled_bouts(session, read_any_labels(file, session))
        bouts = edited_bouts(session.bouts, edits, session.frames)
        assert set(bouts["source"]) == {"moseq"}
        words = np.full(len(numbers), "", object)
        index = session.frames["frame_index"].to_numpy()
        for bout in bouts.itertuples():
            words[(index >= bout.start_frame) & (index < bout.stop_frame)] = bout.action
        assert words.tolist() == [f"syllable_{number:02d}" for number in numbers]


def test_frames_without_a_syllable_have_no_name(session: Session, tmp_path: Path) -> None:
    numbers = _syllables(session)
    numbers[:3] = -5  # as MoSeq fills the lags of its model
    table = pd.DataFrame({"labels (original)": numbers, "SessionName": "a day"})
    table.to_csv(tmp_path / "moseq_df.csv", index=False)
    labels = read_any_labels(tmp_path / "moseq_df.csv", session)
    assert labels["start_s"].min() == session.frames["time_s"][3]


def test_syllables_of_other_frames_are_refused(session: Session, tmp_path: Path) -> None:
    numbers = _syllables(session)
    short = _results(tmp_path / "results.h5", any=numbers[1:])
    with pytest.raises(LiexError, match="syllables belong to frames"):
        read_any_labels(short, session)
    absent = _results(tmp_path / "results.h5", one=numbers, two=numbers)
    with pytest.raises(LiexError, match=r"holds 0 frames of .*recordings in the file: one, two"):
        read_any_labels(absent, session)
    with h5py.File(tmp_path / "results.h5", "w") as file:
        file["frames"] = np.zeros(3)
    for content in (None, b"no HDF5"):
        if content:
            (tmp_path / "results.h5").write_bytes(content)
        with pytest.raises(LiexError, match="should be the results of keypoint-MoSeq"):
            read_any_labels(tmp_path / "results.h5", session)
