"""Evaluation on foreign bodies, which do not come from the generator of the training images.

`liex evaluate pose --split foreign` measures the project's own foreign bodies
(`simulation.foreign`), or recordings beside which truth files lie (docs/reference/truth.md), as
`liex run` does. Their joints were placed by their author, so the distance between joints has little
meaning. The tables are compared with what a depth image contains: across the body, along it after a
constant per joint, and in depth with the middle between upper and lower skin.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from scipy.optimize import linear_sum_assignment

from liex_lab.body.skeleton import Array, Skeleton
from liex_lab.errors import LiexError, expecting, refuse
from liex_lab.evaluation.scores import (
    FAR,
    MeasuredIndividual,
    along_body,
    error_of,
    interval95,
    is_flipped,
)
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent
from liex_lab.simulation.foreign import KINDS, SEALED_BODY, TRUTH_FORM, ForeignRecording, truth_of
from liex_lab.simulation.recording import TrueAnimal

from ..build import plan_of
from .scenes import run_product

FOREIGN_SEEDS: Final = (1, 953_200_601)  # of motion, scene and noise; the second is sealed
FOREIGN_PROTOCOL = (
    "Bodies that do not come from the generator of the training images, each recording measured as "
    "`liex run` does and its tables read back; compared in the camera frame. The truth's joints "
    "are not ours: its curve is resampled at the shares of length at which our joints lie. Over "
    "frames with a pose in which at least half of the animal is visible. across_mm: median over "
    "frames of the mean over joints of the distance across the body (xy, perpendicular to the "
    "local direction of the spine). along_constant_mm: for each joint, the median distance along "
    "the body over frames that are not flipped, towards the tip positive; where a joint lies along "
    "a body is a convention, so this constant is subtracted before everything below. along_mm: the "
    "remainder. depth_mm: distance from surface_mm + thickness_mm / 2, and depth_bias_mm its "
    "signed median, too deep positive. error_mm: median over frames of the mean over joints of the "
    "3D distance. size_percent: median of our length over the true one - 1. flips: share of poses "
    "whose base-to-tip direction is more than 90 degrees off in xy. interval90_x, _y, _z: share of "
    "joint coordinates within 1.645 sd (sd_xy_mm, sd_z_mm) in the arena. expected_over_true: "
    "median of predicted_error_mm over error_mm. trusted: share of all frames without a flag. "
    "trusted_and_wrong: of those, the share whose error is beyond 10 mm (mouse) or 15 % of the "
    "length (others). found: share of frames with a pose. Of several animals in a recording, which "
    "are measured with animal.count, each is a row; individuals are assigned by their median "
    "distance, and exchanged is the share of frames nearer to another true animal. summary: median "
    "over bodies, and with 95 its 95 % interval, bodies drawn with replacement."
)
_NO_RECORDINGS = (".npz", ".liex", ".json", ".toml", ".csv", ".md", ".txt")
Foreign = tuple[Recording, dict[str, TrueAnimal]]  # by letter; joints as of `truth_of`


def evaluate_foreign(
    animal: str = "mouse",
    *,
    truth: str | Path | None = None,
    n_frames: int | None = None,
    sealed: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Errors, intervals and trust on foreign bodies; `liex evaluate pose --split foreign`.

    Args:
        animal: the plan by which all are measured; own bodies are `mouse` and `fish`.
        truth: folder of recordings NAME.* with truth files NAME_truth.npz, or one truth file; None
            for the project's own bodies.
        n_frames: length of each recording of an own body; None is 150.
        sealed: the sealed bodies of the project's own.
        progress: called recording by recording.

    Returns:
        `rows` of results by recording, `summary` over bodies, the protocol, and in `skipped` a
        sentence on each that was not measured.

    Raises:
        LiexError: there is no recording to measure, or a truth file does not fit its recording.
    """
    plan = plan_of(animal)
    skeleton = Skeleton.load(plan.animal.skeleton)
    refuse(
        LiexError,
        (
            not skeleton.is_chain,
            f"the split foreign is of animals whose joints are one chain, not of '{animal}'; "
            "measure it on another split",
        ),
        (
            truth is not None and (n_frames is not None or sealed),
            "--frames and --sealed belong to the project's own bodies; leave them out",
        ),
        (
            truth is not None and not Path(truth).exists(),
            f"there is no folder or truth file {truth}; check the path",
        ),
        (
            truth is None and animal not in KINDS,
            f"the project's own foreign bodies are of {' and '.join(KINDS)}, not of '{animal}'; "
            "give recordings with truth files by --truth",
        ),
    )
    shares = skeleton.reach / skeleton.length
    cases, skipped = (
        (own_cases(animal, n_frames or 150, sealed, shares), [])
        if truth is None
        else given_cases(Path(truth), plan, shares)
    )
    rows: dict[str, dict[str, Any]] = {}
    for k, (recording, bodies) in enumerate(cases):
        progress(k, len(cases), f"measuring {recording.name}")
        with recording:
            count = [f"animal.count={len(bodies)}"] if len(bodies) > 1 else []
            individuals, messages, exit_code = run_product(recording, plan.with_settings(count))
        skipped += [] if individuals else [f"{recording.name}: {'; '.join(messages)}"]
        found = _assigned([*bodies.values()], individuals)
        for number, (letter, body) in enumerate(bodies.items()):
            own: dict[str, Any] = {"found": 0.0, "trusted": 0.0}
            if number in found:
                one, exchanged = found[number]
                own = body_figures(body, one, skeleton)
                own |= {"exchanged": exchanged} if len(bodies) > 1 else {}
            name = f"{recording.name} {letter}".rstrip()
            rows[name] = {**own, "said": messages, "exit_code": exit_code}
    summary: dict[str, Any] = {"n_bodies": len(rows)}
    for name in dict.fromkeys(k for row in rows.values() for k in row if isinstance(row[k], float)):
        values = np.array([row.get(name, np.nan) for row in rows.values()])
        summary[name] = float(np.nanmedian(values))
        summary[f"{name}95"] = interval95(values, np.arange(len(values)))
    return {
        "animal": animal,
        "split": "foreign",
        "rows": rows,
        "summary": summary,
        "skipped": skipped,
        "bodies": "given" if truth is not None else "sealed" if sealed else "own",
        "protocol": FOREIGN_PROTOCOL,
    }


def _assigned(
    bodies: Sequence[TrueAnimal], individuals: Sequence[MeasuredIndividual]
) -> dict[int, tuple[MeasuredIndividual, float]]:
    """The individual of each true animal, and the share of its frames nearer to another animal."""
    joints = [one.joints_camera for one in individuals]
    distance = np.array(
        [[error_of(ours, body.joints_camera) for ours in joints] for body in bodies]
    )
    if not distance.size:
        return {}
    distance = np.nan_to_num(distance, nan=1e6)  # (T, K, n)
    pairs = zip(*linear_sum_assignment(np.median(distance, axis=2)), strict=True)
    nearest = distance.argmin(axis=0)
    posed = [np.isfinite(ours).all(axis=(1, 2)) for ours in joints]
    return {t: (individuals[k], float((nearest[k] != t)[posed[k]].mean())) for t, k in pairs}


def own_cases(animal: str, n_frames: int, sealed: bool, shares: Array) -> list[Foreign]:
    """The project's own foreign bodies, each in its recording; `shares` as in `truth_of`."""
    cases: list[Foreign] = []
    for body in np.arange(KINDS[animal]["n_bodies"]) + SEALED_BODY * sealed:
        recording = ForeignRecording(animal, int(body), FOREIGN_SEEDS[sealed], n_frames)
        name = f"{recording.name} {n_frames}"  # determines the content, which need not be hashed
        recording.files.known_digest = hashlib.sha256(name.encode()).hexdigest()
        cases.append((recording, {"": recording.animal(shares)}))
    return cases


def given_cases(where: Path, plan: Plan, shares: Array) -> tuple[list[Foreign], list[str]]:
    """Recordings with a truth file beside them, and a sentence for each that is left out.

    Args:
        where: a folder, or one truth file.
        plan: bodies of a length that it does not expect are left out.
        shares: as in `truth_of`.

    Raises:
        LiexError: nothing is left, a recording is missing, or a truth file does not fit it.
    """
    cases: dict[Path, Foreign] = {}
    skipped: list[str] = []
    low, high = plan.animal.spine_min_mm, plan.animal.spine_max_mm
    for path in sorted(where.glob("*_truth*.npz")) if where.is_dir() else [where]:
        name, _, letter = path.stem.rpartition("_truth")
        beside = sorted(
            one
            for one in path.parent.glob("*")
            if one.name.startswith(f"{name or path}.") and one.suffix not in _NO_RECORDINGS
        )
        if not beside:
            raise LiexError(
                f"there is no recording beside {path}; give NAME_truth.npz the same NAME as its "
                "recording, such as NAME.mcap"
            )
        recording, bodies = cases.get(beside[0]) or (open_recording(beside[0]), {})
        with (
            expecting(
                LiexError,
                f"{path} should be a truth file",
                OSError,
                ValueError,
                EOFError,
                TypeError,
                BadZipFile,
                advice=TRUTH_FORM,
            ),
            np.load(path, allow_pickle=False) as file,
        ):
            body = truth_of(dict(file), path.name, recording, shares)
        if low <= body.spine_mm <= high:
            bodies[letter.strip("_")] = body
            cases[beside[0]] = recording, bodies
        else:
            skipped.append(
                f"{path.name}: {body.spine_mm:.3g} mm long, and a {plan.animal.name} has {low:g} "
                f"to {high:g} mm; another animal is stated by --animal"
            )
    if not cases:
        raise LiexError(
            f"{where} has no recording with a truth file to score: "
            f"{'; '.join(skipped) or 'check the path'}"
        )
    return [*cases.values()], skipped


def body_figures(truth: TrueAnimal, one: MeasuredIndividual, skeleton: Skeleton) -> dict[str, Any]:
    """Results of one recording, see `FOREIGN_PROTOCOL`; fewer without a pose.

    Args:
        truth: of its n frames, see `truth_of`.
        one: the measured animal.
        skeleton: of the plan.
    """
    posed = np.asarray(np.isfinite(one.joints_camera).all(axis=(1, 2)))
    figures: dict[str, Any] = {
        "length_mm": truth.spine_mm,
        "n_frames": len(posed),
        "found": float(posed.mean()),
        "trusted": float(one.trusted.mean()),
    }
    # in depth a part is enough: a ray may miss a thin tail
    finite = np.isfinite(truth.joints_camera)
    known = posed & finite[..., :2].all(axis=(1, 2)) & finite[..., 2].any(axis=1)
    rows = truth.visible[known] >= 0.5
    if not rows.any():
        return figures
    joints, true, expected = (
        each[known] for each in (one.joints_camera, truth.joints_camera, one.expected_mm)
    )
    off = joints - true
    flipped = is_flipped(joints[..., :2], true[..., :2], skeleton.tip)
    usual = rows & ~flipped if (rows & ~flipped).any() else rows
    way, along, constant = along_body(joints, true, usual)
    across = np.abs(off[..., 0] * way[..., 1] - off[..., 1] * way[..., 0])
    off[..., :2] -= constant[:, None] * way
    error = np.nanmean(np.linalg.norm(off, axis=-1), axis=1)
    inside = np.abs(off @ one.R_arena_camera.T) <= 1.645 * one.sd_mm[known]
    inside = inside[np.isfinite(off).all(axis=-1) & rows[:, None]].mean(axis=0)
    ours = np.linalg.norm(np.diff(joints[rows], axis=1), axis=-1).sum(axis=1)
    wrong = error[one.trusted[known]] > (10.0 if skeleton.name == "mouse" else FAR * truth.spine_mm)
    return figures | {
        "size_percent": 100.0 * float(np.median(ours) / truth.spine_mm - 1.0),
        "across_mm": float(np.median(across[rows].mean(axis=1))),
        "along_mm": float(np.median(np.abs(along - constant)[rows].mean(axis=1))),
        "depth_mm": float(np.median(np.nanmean(np.abs(off[rows, :, 2]), axis=1))),
        "depth_bias_mm": float(np.median(np.nanmean(off[rows, :, 2], axis=1))),
        "error_mm": float(np.median(error[rows])),
        "flips": float(flipped[rows].mean()),
        **{f"interval90_{axis}": float(inside[k]) for k, axis in enumerate("xyz")},
        "expected_over_true": float(np.median(expected[rows]) / np.median(error[rows])),
        "trusted_and_wrong": float(wrong.mean()) if len(wrong) else 0.0,
        "along_constant_mm": dict(zip(skeleton.names, constant.tolist(), strict=True)),
    }
