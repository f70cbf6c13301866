"""A fish whose every number is known: its place, its heading and its tail's beat are given as
functions of time.
"""

from dataclasses import dataclass, field

import numpy as np
import pandas as pd

JOINTS = ("head", *(f"spine_{k:02d}" for k in range(1, 20)), "tail_tip")
LENGTH_MM = 30.0


@dataclass(frozen=True)
class SwimmingFish:
    """times_s of the frames. The body's centre goes round a circle at turn_rad_s, its height as
    climb_mm_s.

    beat_hz, beat_rad: frequency and largest turn at one joint of the wave that runs down the tail,
    from the head to the tip in wave_s; lost: rows without a pose.
    """

    times_s: np.ndarray
    radius_mm: float = 10.0
    turn_rad_s: float = 2.0
    climb_mm_s: float = 0.0
    height_mm: float = 60.0
    beat_hz: float = 0.0
    beat_rad: float = 0.08
    wave_s: float = 0.15
    still_until_s: float = 0.0
    sd_mm: float = 0.2
    lost: tuple[int, ...] = field(default=())

    def tables(self) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Its tables `frames` and `poses`."""
        n, time = len(self.times_s), self.times_s
        xyz = self.joints()
        xyz[list(self.lost)] = np.nan
        frames = pd.DataFrame(
            {
                "session_id": "swim",
                "individual": "fish_1",
                "frame_index": np.arange(n),
                "time_s": time,
                "dt_s": np.append(np.nan, np.diff(time)),
                "flag": "",
                "zone": "",
                "spine_mm": LENGTH_MM,
                "wall_distance_mm": np.nan,
            }
        )
        flat = xyz.reshape(-1, 3)
        poses = pd.DataFrame(
            {
                "frame_index": np.repeat(np.arange(n), len(JOINTS)),
                "joint": np.tile(JOINTS, n),
                "x_mm": flat[:, 0],
                "y_mm": flat[:, 1],
                "z_mm": flat[:, 2],
                "sd_mm": np.where(np.isfinite(flat[:, 0]), self.sd_mm, np.nan),
            }
        )
        return frames, poses

    def joints(self) -> np.ndarray:
        """(n, 21, 3) mm: bones of equal length behind the head; the mean of the front half lies on
        the circle.
        """
        time = self.times_s
        turned = self.turn_rad_s * time
        heading = turned + np.pi / 2
        share = np.arange(1, 20) / 20.0
        late = (time[:, None] - self.still_until_s) - self.wave_s * share
        # the wave grows from nothing at the head, whose front quarter is stiff, to the tail
        turns = (
            self.beat_rad
            * np.clip(share - 0.25, 0, 1)
            / 0.75
            * np.sin(2 * np.pi * self.beat_hz * late)
        )
        turns = np.where(late > 0, turns, 0.0)
        direction = (
            heading[:, None]
            + np.pi
            - np.concatenate([np.zeros((len(time), 1)), np.cumsum(turns, axis=1)], axis=1)
        )
        bone = (
            LENGTH_MM
            / 20.0
            * np.stack([np.cos(direction), np.sin(direction), 0 * direction], axis=-1)
        )
        joints = np.concatenate([np.zeros((len(time), 1, 3)), np.cumsum(bone, axis=1)], axis=1)
        centre = np.stack(
            [
                self.radius_mm * np.cos(turned),
                self.radius_mm * np.sin(turned),
                self.height_mm + self.climb_mm_s * time,
            ],
            axis=-1,
        )
        return joints + (centre - joints[:, :11].mean(axis=1))[:, None]


def uneven(seconds: float, fps: float, seed: int = 3) -> np.ndarray:
    """Times of a camera whose clock is off by up to a fifth of a frame each time."""
    rng = np.random.default_rng(seed)
    times = (
        np.arange(round(seconds * fps)) / fps + rng.uniform(-0.2, 0.2, round(seconds * fps)) / fps
    )
    return times - times[0]
