"""
Intervals against the truth
===========================

Every joint comes with a standard deviation, and every frame with an expected error. This example
measures a virtual mouse, whose joints are known, and counts how often the truth lies inside.
"""

import matplotlib.pyplot as plt
import numpy as np

import liex_lab

ADDRESS = "synthetic:walk?seed=3&frames=150&sensor=primesense-qvga"
plan = liex_lab.Plan.load("mouse").with_settings(["replay.depth=false"])
folder = liex_lab.run_session(ADDRESS, plan, "results", overwrite=True)
session = liex_lab.Session.open(folder)

# %%
# The truth of a virtual recording, carried into the frame of the arena that the session found:
truth = liex_lab.open_recording(ADDRESS)
true_mm = session.T_arena_camera @ truth.joints_camera
n_joints = len(truth.skeleton.names)
poses = session.poses
measured = poses[["x_mm", "y_mm", "z_mm"]].to_numpy().reshape(-1, n_joints, 3)
sd = poses.sd_z_mm.to_numpy().reshape(-1, n_joints)

# %%
# The nose's height, with the band that should hold it nine times in ten (1.64 standard deviations
# to either side), and the truth.
nose = list(truth.skeleton.names).index("nose")
time = session.frames.time_s
low, high = (measured[:, nose, 2] + sign * 1.64 * sd[:, nose] for sign in (-1, 1))
figure, axis = plt.subplots(figsize=(8, 3.2), layout="constrained")
axis.fill_between(time, low, high, color="#56B4E9", alpha=0.4, label="90 % interval")
axis.plot(time, measured[:, nose, 2], color="#0072B2", label="measured")
axis.plot(time, true_mm[:, nose, 2], color="#D55E00", linestyle="--", label="truth")
axis.set(xlabel="time (s)", ylabel="height of the nose (mm)")
axis.legend(frameon=False, ncols=3)
plt.show()

# %%
# How often the interval holds the truth here, coordinate by coordinate. This is one recording of
# one animal: frames of one recording err together, so that it may well be 75 or 100 per cent. For
# many recordings see docs/evidence.md.
inside = np.abs(measured - true_mm) <= 1.64 * sd[:, :, None]
for name, share in zip(truth.skeleton.names, inside.mean(axis=(0, 2)), strict=True):
    print(f"{name:8}{share:.0%}")
error = np.linalg.norm(measured - true_mm, axis=2).mean(axis=1)
print(f"mean joint error {np.nanmean(error):.1f} mm")
print(f"expected         {session.metadata['verdict']['expected_error_mm']:.1f} mm")

# %%
# An interval describes the position of a joint in one frame, not the animal's behaviour or your
# group. It is calibrated on the errors in the training images; for a build or fur that was not
# among them it is too narrow (docs/concepts/how-it-fails.md).
