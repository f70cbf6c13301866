"""
Corrections
===========

What you know better is kept beside a session, never over it, and can be taken back.
"""

import shutil
from pathlib import Path

import matplotlib.pyplot as plt

import liex_lab
from liex_lab.api import correct_session, run_demo
from liex_lab.sessions.correcting import flip_span, rename_bout

folder = Path("results/mouse_walk.liex")
if not folder.exists():
    folder = run_demo("results")
copy = shutil.copytree(folder, "results/corrected.liex", dirs_exist_ok=True)
session = liex_lab.Session.open(copy)

# %%
# Exchange head and tail between 1.0 and 1.5 s (here they were right: watch what it does), and give
# the bout at 4 s another name.
correct_session(
    copy, [flip_span(session, 1.0, 1.5), rename_bout(session, 4.0, "rear_supported")], author="me"
)
corrected = liex_lab.Session.open(copy)
corrected

# %%
figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
axis.plot(
    corrected.kinematics.time_s,
    corrected.kinematics.heading_rad,
    color="#D55E00",
    label="corrected",
)
axis.plot(
    session.kinematics.time_s, session.kinematics.heading_rad, color="#0072B2", label="measured"
)
axis.set(xlabel="time (s)", ylabel="heading (rad)")
axis.legend(frameon=False)
plt.show()
corrected.bouts[["action", "start_s", "stop_s", "source"]]

# %%
# Each log entry has an author, a time and the correction. ``raw=True`` opens the measured tables.
# Undo an entry by its number.
for entry in corrected.log.entries:
    print(entry.number, entry.author, type(entry.what).__name__)
correct_session(copy, undo=[entry.number for entry in corrected.log.entries])
again = liex_lab.Session.open(copy)
print(again.bouts.equals(liex_lab.Session.open(copy, raw=True).bouts))
