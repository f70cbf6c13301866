"""movement's and SLEAP's own readers open what we write; collected where both are installed."""

from pathlib import Path

import numpy as np
import sleap_io
import xarray
from movement.io import load_poses
from movement.validators.datasets import ValidPosesInputs

from liex_lab.exchange import export
from tests.sessions.pair import NAMES, write_pair
from tests.test_pages import BLOCK, PAGES


def test_movement_takes_the_netcdf_for_its_own(session, tmp_path):
    data = xarray.load_dataset(export(session, "movement", tmp_path), engine="h5netcdf")
    ValidPosesInputs.validate(data)
    import movement.kinematics as kin

    speed = kin.compute_speed(data["position"])
    assert speed.sel(keypoints="rump").notnull().sum() > 100


def test_movement_reads_our_deeplabcut_sleap_and_nwb_files(session, tmp_path):
    poses = session.pose_arrays()
    dlc = load_poses.from_dlc_file(export(session, "dlc", tmp_path) / "poses_2d.csv")
    np.testing.assert_allclose(
        dlc["position"][..., 0].transpose("time", "keypoints", "space"), poses.uv_px, rtol=1e-6
    )
    sleap = load_poses.from_sleap_file(export(session, "sleap", tmp_path))
    np.testing.assert_allclose(
        sleap["position"][..., 0].transpose("time", "keypoints", "space"), poses.uv_px, rtol=1e-6
    )
    nwb = load_poses.from_nwb_file(export(session, "nwb", tmp_path))
    np.testing.assert_allclose(
        nwb["position"]
        .sel(keypoints=list(poses.joints))[..., 0]
        .transpose("time", "keypoints", "space"),
        poses.xyz_mm,
        rtol=1e-6,
    )


def test_sleap_io_reads_the_analysis_file(session, tmp_path):
    poses = session.pose_arrays()
    labels = sleap_io.load_file(str(export(session, "sleap", tmp_path)))
    assert [node.name for node in labels.skeletons[0].nodes] == list(poses.joints)
    assert len(labels.skeletons[0].edges) == len(poses.bones)
    np.testing.assert_allclose(labels.numpy()[:, 0], poses.uv_px, rtol=1e-6)


def test_movement_and_sleap_io_read_derived_points(session, tmp_path):
    path = export(session, "movement", tmp_path, points=True)
    data = xarray.load_dataset(path, engine="h5netcdf")
    ValidPosesInputs.validate(data)
    folder = export(session, "dlc", tmp_path, points=True)
    dlc = load_poses.from_dlc_file(folder / "poses_2d.csv")
    assert list(dlc["keypoints"].values) == list(data["keypoints"].values)
    labels = sleap_io.load_file(str(export(session, "sleap", tmp_path, points=True)))
    assert [node.name for node in labels.skeletons[0].nodes] == list(data["keypoints"].values)


def test_movement_and_sleap_io_read_the_animals_of_an_arena_as_individuals(tmp_path, monkeypatch):
    pair = write_pair(tmp_path)
    ValidPosesInputs.validate(
        xarray.load_dataset(export(pair, "movement", tmp_path), engine="h5netcdf")
    )
    monkeypatch.chdir(export(pair, "dlc", tmp_path))
    exec(dict(BLOCK.findall(PAGES["docs/howto/deeplabcut.md"]))["python"], {})  # to .h5
    dlc = [load_poses.from_dlc_file(Path(f"poses_2d.{kind}")) for kind in ("csv", "h5")]
    path = export(pair, "sleap", tmp_path)
    sleap, labels = load_poses.from_sleap_file(path), sleap_io.load_file(str(path))
    assert [track.name for track in labels.tracks] == list(NAMES)
    for k, session in enumerate(pair):
        uv_px = session.pose_arrays().uv_px
        np.testing.assert_allclose(labels.numpy()[:, k], uv_px, rtol=1e-6)
        for data in (*dlc, sleap):
            own = data["position"].sel(individuals=NAMES[k])
            np.testing.assert_allclose(
                own.transpose("time", "keypoints", "space"), uv_px, rtol=1e-6
            )
