"""Quality control of a session: warnings by weight, account of all frames, suspected flips.

Thresholds of the warnings: 2 % of the frames lost, 5 % doubtful, a predicted joint error of 10 % of
the length, a speed noise as large as the pause threshold.
"""

from __future__ import annotations

import numpy as np

from liex_lab.sessions import Session
from liex_lab.sessions.correcting import disagreements

from ..units import counted, shown

_LOST_SHARE = 0.02
_DOUBTFUL_SHARE = 0.05
_ERROR_SHARE = 0.1
_NOISE_SHARE = 1.0


def warnings(session: Session) -> list[str]:
    """Warnings as sentences, those of the recording first; empty if there are none."""
    return [
        *session.metadata["problems"],
        *_of_company(session),
        *_of_frames(session),
        *_of_flips(session),
        *disagreements(session),
        *_of_measures(session),
        *_of_names(session),
    ]


def _of_company(session: Session) -> list[str]:
    """Warns that other animals are in view that are not tracked."""
    n = int((session.metadata.get("verdict") or {}).get("n_animals", 1))
    if n < 2:
        return []
    return [
        f"{n} animals are in view, and only one of them is followed; nothing is measured of the "
        f"{'other' if n == 2 else 'others'}. Record one animal at a time, or look in the replay "
        "whether it is the same one throughout."
    ]


def _of_names(session: Session) -> list[str]:
    """Bouts that a person named or a correction changed, and that contradict their definition."""
    if "contradicts" not in session.bouts:
        return []
    wrong = session.bouts[session.bouts["contradicts"].fillna("") != ""]
    if not len(wrong):
        return []
    return [
        f"{counted(len(wrong), 'bout contradicts', 'bouts contradict')} the definition of the "
        "name, which was left as it is; see the list below."
    ]


def refusal_rows(session: Session) -> list[tuple[str, str, str, str, str]]:
    """Bouts that contradict their definition: the renamed ones first, then the unchanged ones.

    Returns:
        (from, to, name, what was done, contradiction), times in s.
    """
    found = [
        (
            f"{one['start_s']:.2f}",
            f"{one['stop_s']:.2f}",
            str(one["action"]),
            str(one["named"]) or "unlabelled",
            str(one["why"]),
        )
        for one in (session.metadata.get("refused_bouts") or {}).get("bouts", [])
    ]
    if "contradicts" not in session.bouts:
        return found
    wrong = session.bouts[session.bouts["contradicts"].fillna("") != ""]
    return found + [
        (
            f"{row.start_s:.2f}",
            f"{row.stop_s:.2f}",
            str(row.action),
            f"left, by {row.source}",
            str(row.contradicts),
        )
        for row in wrong.itertuples()
    ]


def _of_frames(session: Session) -> list[str]:
    frames = session.metadata["frames"]
    found = []
    n = frames["n_frames"]
    lost = frames["n_frames"] - frames["n_observed"]
    doubtful = int(frames["flags"].get("doubtful", 0))
    if frames["n_missing"]:
        found.append(
            f"The camera did not deliver {counted(frames['n_missing'], 'frame')}, in "
            f"{counted(frames['n_gaps'], 'gap')}; no speed or distance is measured across them."
        )
    hidden = int(frames["flags"].get("hidden", 0))
    if hidden:
        found.append(
            f"The animal is behind or under something in {counted(hidden, 'frame')} "
            f"({hidden / n:.1%} of {n:,}), which have no pose; the table gaps says since when and "
            "where it was last seen."
        )
    lost -= hidden
    if lost > _LOST_SHARE * n:
        found.append(
            f"{counted(lost, 'frame has', 'frames have')} no pose ({lost / n:.1%} of {n:,}); times "
            "and shares are of the rest."
        )
    if doubtful > _DOUBTFUL_SHARE * n:
        found.append(
            f"{counted(doubtful, 'frame is', 'frames are')} doubtful ({doubtful / n:.1%} of "
            f"{n:,}): the predicted error is large, or the depth image contradicts the pose."
        )
    # only two columns: the dashboard reads them for every session of a study
    error, spine = session.table("frames", ["predicted_error_mm", "spine_mm"]).median()
    if np.isfinite(error) and np.isfinite(spine) and error > _ERROR_SHARE * spine:
        found.append(
            f"The predicted joint error is {error:.1f} mm in the median, {error / spine:.0%} of "
            "the animal's length."
        )
    return found


def _of_flips(session: Session) -> list[str]:
    flips = session.flips
    if len(flips) == 0:
        return []
    seconds = float((flips["stop_s"] - flips["start_s"]).sum())
    undone = int(flips["applied"].astype(bool).sum())
    return [
        f"Head and tail may have been exchanged in {counted(len(flips), 'stretch', 'stretches')} "
        f"of {seconds:.{1 if seconds >= 0.1 else 2}f} s in all; "
        f"{counted(undone, 'was', 'were')} put right. "
        "See the list below, and look at the replay."
    ]


def _of_measures(session: Session) -> list[str]:
    if not session.has("summary.csv"):
        return []
    found = []
    row = session.summary.iloc[0]
    rules = session.metadata.get("rules") or {}
    noise = row.get("speed_noise_mm_s", np.nan)
    pause = rules.get("pause_below_mm_s", np.nan)
    if noise > _NOISE_SHARE * pause:
        noise, unit = shown(noise, "mm/s")
        pause, _ = shown(pause, "mm/s")
        found.append(
            f"Errors of the pose alone may look like a speed of up to {noise:.3g} {unit}, and a "
            f"pause is one below {pause:g} {unit}: pauses, and distance and speed at rest, are not "
            "to be trusted."
        )
    if session.metadata["schema_version"] < 8 and len(session.gaps):
        found.append(
            "An earlier version of liex_lab wrote this session and counted lost frames in the time "
            "of bouts: shares of actions can be too high. Run `liex run` on the recording again."
        )
    described = session.columns
    fps = session.metadata["frames"]["fps_median"] or 0.0
    slow = described[
        (described["unreliable_below_fps"] > fps) & described["table"].isin(["kinematics", "bouts"])
    ]
    if len(slow):
        names = ", ".join(dict.fromkeys(slow["name"]))
        found.append(f"At {fps:.0f} frames/s these cannot be measured and are empty: {names}.")
    return found


def frame_account(session: Session) -> list[tuple[str, float, int, str]]:
    """The classification of all frames that the camera should have taken.

    Returns:
        (class, share, number, CSS class for its colour) of trusted, doubtful, hidden, lost and
            undelivered frames; hidden ones only if present.
    """
    frames = session.metadata["frames"]
    doubtful = int(frames["flags"].get("doubtful", 0))
    hidden = int(frames["flags"].get("hidden", 0))
    lost = frames["n_frames"] - frames["n_observed"] - hidden
    parts = [
        ("trusted pose", frames["n_observed"] - doubtful, "good"),
        ("doubtful pose", doubtful, "doubt"),
        *([("hidden", hidden, "gone")] if hidden else []),
        ("no pose", lost, "lost"),
        ("not delivered", frames["n_missing"], "gone"),
    ]
    total = max(sum(count for _, count, _ in parts), 1)
    return [(what, count / total, int(count), kind) for what, count, kind in parts]


def flip_rows(session: Session) -> list[tuple[str, str, str, str]]:
    """Stretches in which head and tail may have been exchanged, at most the twelve most probable.

    Returns:
        (from, to, probability, what was done) in order of time, times in s.
    """
    shown = (
        session.flips.nlargest(12, "p_flip").sort_values("start_s")
        if len(session.flips)
        else session.flips
    )
    rows = zip(shown["start_s"], shown["stop_s"], shown["p_flip"], shown["applied"], strict=True)
    return [
        (f"{a:.2f}", f"{b:.2f}", f"{p:.2f}", "put right" if done else "left as it was")
        for a, b, p, done in rows
    ]
