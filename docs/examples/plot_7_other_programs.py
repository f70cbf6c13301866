"""
Into other programs
===================

One session as CSV, Excel, DeepLabCut's tables, movement's netCDF and a BORIS project.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd

import liex_lab
from liex_lab.api import run_demo
from liex_lab.exchange import TARGETS, export

folder = Path("results/mouse_walk.liex")
if not folder.exists():
    folder = run_demo("results")
session = liex_lab.Session.open(folder)
place = Path(tempfile.mkdtemp())

# %%
# ``nwb`` needs the time of day at which the recording began, which the sample does not have:
# ``liex describe SESSION session_start_time=2026-08-21T10:00:00+02:00`` states it.
for to in ("csv", "xlsx", "dlc", "movement", "sleap", "boris"):
    path = export(session, to, place)
    print(f"{to:9} {path.name:28} {TARGETS[to][2]}")

# %%
# DeepLabCut's header, in millimetres:
pd.read_csv(place / "mouse_walk_dlc" / "poses_3d.csv", header=[0, 1, 2], index_col=0).iloc[:3, :8]

# %%
# movement's data set, which xarray opens and movement's functions take:
import xarray  # noqa: E402

with xarray.open_dataset(place / "mouse_walk.nc") as data:
    print(data)
    nose = data.position.sel(keypoints="nose").squeeze()
    figure, axis = plt.subplots(figsize=(4, 4), layout="constrained")
    axis.plot(nose.sel(space="x"), nose.sel(space="y"))
    axis.set(
        xlabel="x (mm)",
        ylabel="y (mm)",
        aspect="equal",
        title="Path of the nose, from movement's file",
    )
    plt.show()
