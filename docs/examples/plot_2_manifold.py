"""
Means, directions and steps on a manifold
=========================================

A pose is where the animal is, which way it faces, and how each joint is bent. Angles are no
ordinary numbers: halfway between 170 degrees and -170 degrees lies 180, not 0. And bones do not
change their length. liex_lab therefore computes with poses as points of a curved space (a manifold,
here products of the groups SE(3) and SO(3)), and all its means, speeds and smoothed curves follow
that space.
"""

import matplotlib.pyplot as plt
import numpy as np

from liex_lab.geometry import SE3, so3

# %%
# A bone of 40 mm that turns by 160 degrees. Halfway, the mean of the two end points has lost most
# of the bone's length; the point on the manifold has not.
bone = np.array([40.0, 0.0, 0.0])
start = SE3.identity()
turned = SE3(so3.exp([0.0, 0.0, np.radians(160.0)]), np.zeros(3))
shares = np.linspace(0.0, 1.0, 9)
straight = [(1 - s) * (start @ bone) + s * (turned @ bone) for s in shares]
curved = [start.geodesic(turned, s) @ bone for s in shares]

figure, axes = plt.subplots(1, 2, figsize=(8, 3.6), layout="constrained", sharey=True)
for axis, points, title in zip(
    axes, (straight, curved), ("mean of positions", "on the manifold"), strict=True
):
    for x, y, _ in points:
        axis.plot([0, x], [0, y], color="#0072B2", alpha=0.7)
    lengths = [np.linalg.norm(point) for point in points]
    axis.set(
        title=f"{title}: {min(lengths):.0f} to {max(lengths):.0f} mm",
        xlabel="x (mm)",
        aspect="equal",
    )
axes[0].set_ylabel("y (mm)")
plt.show()

# %%
# Directions: three headings around the back of the circle. The ordinary mean points forwards, the
# mean on the manifold points backwards, where all three do.
headings = np.radians([170.0, -170.0, 175.0])
rotations = so3.exp(np.stack([0 * headings, 0 * headings, headings], axis=-1))
mean = so3.log(so3.mean(rotations))
print(f"ordinary mean {np.degrees(headings.mean()):.0f} degrees")
print(f"on the manifold {np.degrees(mean[2]):.0f} degrees")

# %%
# A movement is a tangent vector: three numbers of turning (rad) and three of shifting (mm). One
# animal that goes 30 mm forwards while it turns by 90 degrees goes along an arc:
step = np.array([0.0, 0.0, np.pi / 2, 30.0, 0.0, 0.0])
print(SE3.exp(step))
