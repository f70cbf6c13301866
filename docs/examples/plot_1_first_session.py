"""
A first session
===============

The bundled sample is measured, and its tables are read. The sample is a rendered mouse that walks,
turns and rears for five seconds. Your own recording is measured in the same way:
``liex_lab.run_session("recording.mcap", out="results")``.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import liex_lab
from liex_lab.api import run_demo

folder = Path("results/mouse_walk.liex")
if not folder.exists():
    folder = run_demo("results")
session = liex_lab.Session.open(folder)
session

# %%
# Read the verdict first. The same sentence ends ``liex run`` and opens the report.
print(session.metadata["verdict"]["sentence"])

# %%
# Every table is a pandas data frame. One row for every frame, with or without a pose:
session.frames[["frame_index", "time_s", "predicted_error_mm", "flag"]].head()

# %%
# One row for every frame and joint. A mouse is five points on its midline:
session.poses[session.poses.frame_index == 10][["joint", "x_mm", "y_mm", "z_mm", "sd_mm"]]

# %%
# The ethogram:
session.bouts[["action", "start_s", "stop_s", "path_mm", "peak_speed_mm_s"]]

# %%
# And what is used most: the path over the floor and the speed. Empty values are frames without
# a measurement, and the curve has a gap there.
frames, kinematics = session.frames, session.kinematics
figure, (way, speed) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
way.plot(frames.centroid_x_mm, frames.centroid_y_mm)
way.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal", title="Path over the floor")
speed.plot(kinematics.time_s, kinematics.speed_mm_s)
noise = float(session.summary.speed_noise_mm_s.iloc[0])
speed.axhline(noise, color="0.6", linewidth=1)
speed.set(xlabel="time (s)", ylabel="speed (mm/s)", title="Below the grey line: noise at rest")
plt.show()

# %%
# What a column means, in which unit and by which formula, is in the session, too:
columns = session.columns.set_index(["table", "name"])
print(columns.loc[("kinematics", "speed_mm_s"), "meaning"])
