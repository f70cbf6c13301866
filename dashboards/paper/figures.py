"""Figures 7 to 20 of the Lie-X paper, and the scenes of `liex evaluate scenes`, as PNG.

Nothing is computed here except the errors printed next to the poses.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from liex_lab.arrays import Array, NDArray
from liex_lab.evaluation.scores import Followed, MeasuredIndividual
from liex_lab.recordings.formats.images.nyu import POINTS
from liex_lab.simulation.recording import RenderedRecording, TrueAnimal

Results = Sequence[Mapping[str, Any]]

METHODS = {  # variant: (name in the legend, colour, line)
    "default": ("liex_lab", "#AA3377", "-"),
    "paper": ("Lie-X, the paper's variant", "#4477AA", "-"),
    "paper-one-pose": ("one initial pose", "#4477AA", ":"),
    "paper-no-metric": ("no learned metric", "#4477AA", "--"),
    "rf": ("RF", "#228833", "-"),
    "cnn": ("CNN", "#CCBB44", "-"),
}
_NYU_METHODS = {
    "liex_lab": "liex_lab",
    "liex": "Lie-X, palm on\nthe true palm",
    "v2v_posenet": "V2V-PoseNet",
    "generalized_feedback": "Generalized\nFeedback",
    "deepprior": "DeepPrior",
}
_NYU_EDGES = [
    (list(POINTS).index(a), list(POINTS).index(b))
    for a, b in (
        *((f"{finger}_tip", f"{finger}_mid") for finger in ("pinky", "ring", "middle", "index")),
        *((f"{finger}_mid", "palm") for finger in ("pinky", "ring", "middle", "index")),
        *(("thumb_tip", "thumb_mid"), ("thumb_mid", "thumb_base"), ("thumb_base", "palm")),
        *(("wrist_a", "palm"), ("wrist_b", "palm")),
    )
]
_TRACKERS = {  # row: (name in the legend, colour, width)
    "single": ("single frames", "#999999", 1.0),
    "algorithm3": ("Algorithm 3 on our parts", "#4477AA", 0.8),
    "smoothed": ("smoothed", "#AA3377", 1.6),
}
_RECOGNISERS = {  # (name in the numbers, in accuracies): title
    ("tangent", "tangent"): "paper's, tangent vectors",
    ("joints", "joint"): "paper's, joint positions",
    ("default", "default"): "default",
}
_TRUE = "#33AADD"
_POSE = "#CC3311"
_GREEN = "#228833"
_SCENE_MOMENTS = (0.08, 0.4, 0.62, 0.95)  # share of the recording's length
_MOMENTS = 6  # of a tracked sequence
_APART = 12  # least distance between two of them, frames


def draw_paper(results: Results, further: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write every figure for which there are results.

    Returns:
        Paths of the figures.
    """
    written = [
        draw_cumulative(results, folder / "fig08_cumulative_error.png"),
        draw_joint_errors(results, folder / "error_per_joint.png"),
    ]
    if any(one["sensitivity"] for one in results):
        written.append(draw_sensitivity(results, folder / "fig07_sensitivity.png"))
    for one in results:
        animal, shown, examples = one["animal"], one["illustration"], one["examples"]
        written.append(draw_candidates(shown, folder / f"fig13_candidates_{animal}.png"))
        written.append(draw_convergence(shown, folder / f"fig16_convergence_{animal}.png"))
        hand = animal == "hand"
        for rows, name, where in (
            (examples, f"fig{'10' if hand else '09'}_poses_{animal}.png", "from the camera"),
            (examples, f"fig{'11' if hand else '09'}_poses_{animal}_side.png", "from the side"),
            (one["failures"], f"fig17_failures_{animal}.png", "the largest errors"),
        ):
            if rows:
                title = f"{animal}, {where}: truth, blue; pose of each method, red; dot: base"
                written.append(draw_poses(title, rows, folder / name, where == "from the side"))
    if further["actions"]:
        written.append(draw_key_frames(further["key_frames"], folder / "fig19_key_frames.png"))
        written.append(draw_confusions(further["actions"], folder / "fig20_confusions.png"))
    return [*written, *further["figures"]]


def _sheet(
    n_rows: int, n_columns: int, width: float, height: float, margin: tuple[float, float] = (0, 0)
) -> tuple[Figure, list[list[Axes]]]:
    """A figure with a grid of panels of `width` x `height` inches, and a margin around them."""
    figure = Figure(
        figsize=(width * n_columns + margin[0], height * n_rows + margin[1]), layout="constrained"
    )
    return figure, figure.subplots(n_rows, n_columns, squeeze=False).tolist()


def _save(figure: Figure, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    return path


def _bones(
    panel: Axes,
    points: Array,
    edges: Sequence[tuple[int, int]],
    colour: str,
    width: float,
    dot: int | None = 0,
) -> None:
    """A skeleton of points (J, 2), with a dot on one joint."""
    panel.plot(
        *np.moveaxis(points[np.array(edges).T], -1, 0),
        "-",
        color=colour,
        lw=width,
        solid_capstyle="round",
    )
    if dot is not None:
        panel.plot(*points[dot], "o", color=colour, ms=2.5 * width)


def _depth(panel: Axes, depth: NDArray[Any], low: float, high: float, colours: str) -> None:
    """A depth image or height map without axes; unread pixels stay empty."""
    panel.imshow(
        np.where(depth > 0, depth, np.nan).astype(float),
        cmap=colours,
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    panel.set(xticks=[], yticks=[])


def _around(panel: Axes, middle: Sequence[float] | Array, half: float) -> None:
    """Show the square around a point; y goes down."""
    panel.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] + half, middle[1] - half))


def draw_sensitivity(results: Results, path: Path) -> Path:
    """Fig. 7: the error over each of the five parameters; a red dot marks the value in use."""
    curves = [curve for one in results for curve in one["sensitivity"].values()]
    numbers = list(dict.fromkeys(number for curve in curves for number in curve["curves"]))
    figure, grid = _sheet(len(numbers), len(results), 3.8, 2.4)
    for column, one in enumerate(results):
        grid[0][column].set_title(one["animal"])
        for line, number in zip(grid, numbers, strict=True):
            panel = line[column]
            for variant, curve in one["sensitivity"].items():
                name, colour, _ = METHODS[variant]
                if number in curve.get("left_out", {}):
                    panel.text(
                        0.04,
                        0.04,
                        fill(f"{name} {curve['left_out'][number]}", 48),
                        fontsize=6,
                        transform=panel.transAxes,
                    )
                    continue
                points = {p["value"]: p["mean_mm"] for p in curve["curves"].get(number, [])}
                panel.plot([*points], [*points.values()], ".-", color=colour, label=name)
                chosen = curve["chosen"][number]
                panel.plot(chosen, points.get(chosen, np.nan), "o", color=_POSE, ms=6)
            panel.locator_params(axis="x", integer=True)
            panel.margins(y=0.1)
            panel.set(xlabel=number, ylabel="mm", ylim=(0, None))
            panel.grid(alpha=0.3)
    grid[0][0].legend(fontsize=7)
    return _save(figure, path)


def _by_split(
    results: Results, width: float
) -> tuple[Figure, list[tuple[Axes, Mapping[str, Any], dict[tuple[str, str, str], Any]]]]:
    """A sheet with a panel for each animal and split, its animal's results, and, by method, the
    numbers on this split.
    """
    figure, grid = _sheet(len(results), max(len(one["splits"]) for one in results), width, 3.2)
    panels = []
    for line, one in zip(grid, results, strict=True):
        for panel, split in zip(line, one["splits"], strict=False):
            panel.set_title(f"{one['animal']}, {split}")
            panel.grid(alpha=0.3)
            panels.append(
                (
                    panel,
                    one,
                    {METHODS[name]: row["splits"][split] for name, row in one["rows"].items()},
                )
            )
    return figure, panels


def draw_cumulative(results: Results, path: Path) -> Path:
    """Fig. 8: share of frames with at most so many mm mean joint error; lost frames never count."""
    figure, panels = _by_split(results, 4.2)
    for panel, _, rows in panels:
        farthest = 0.0
        for (name, colour, style), numbers in rows.items():
            error = np.array(numbers["error_quantiles_mm"])
            if len(error):
                share = np.linspace(0, 100 * (1 - numbers["lost_rate"]), len(error))
                panel.plot(error, share, style, color=colour, label=name, lw=1.6)
                farthest = max(farthest, float(error[round(0.85 * (len(error) - 1))]))
        panel.set(xlim=(0, farthest), ylim=(0, 100), ylabel="frames, %")
        panel.set_xlabel("mean joint error within, mm")
    panels[0][0].legend(fontsize=7, loc="lower right")
    return _save(figure, path)


def draw_joint_errors(results: Results, path: Path) -> Path:
    """Mean error of each joint, by method."""
    figure, panels = _by_split(results, 4.6)
    for panel, one, rows in panels:
        for (name, colour, style), numbers in rows.items():
            if numbers["joint_mm"]:
                panel.plot(numbers["joint_mm"], style, marker=".", color=colour, label=name)
        panel.set_xticks(
            range(len(one["joints"])),
            one["joints"],
            rotation=60 if len(one["joints"]) > 6 else 0,
            fontsize=7,
        )
        panel.set(ylabel="mean error, mm", ylim=(0, None))
    panels[0][0].legend(fontsize=7)
    return _save(figure, path)


def draw_poses(
    title: str,
    rows: Mapping[str, Sequence[Mapping[str, Any]]],
    path: Path,
    side: bool = False,
) -> Path:
    """Figs. 9 to 12 and 17: poses in some frames with the truth, a row per method.

    Args:
        title: of the figure.
        rows: by method, frames with `head`, `truth` (J, 3) mm, camera frame, `pose` (None if
            nothing was found, absent if it was not kept), and, to draw a depth image, `depth`,
            `camera`, `edges` and `spine_mm`.
        path: the PNG to write.
        side: view along the image's rows instead of along the optical axis.
    """
    figure, grid = _sheet(len(rows), max(1, *map(len, rows.values())), 1.65, 2.1, (1.3, 0.6))
    for line, (name, frames) in zip(grid, rows.items(), strict=True):
        line[0].set_ylabel(
            _NYU_METHODS.get(
                name, METHODS[name][0].replace(", ", ",\n") if name in METHODS else name
            ),
            fontsize=8,
        )
        for panel in line[len(frames) :]:
            panel.set_axis_off()
        for panel, one in zip(line, frames, strict=False):
            _pose(panel, one, side)
    figure.suptitle(fill(f"{title}; mean error in mm", int(14 * figure.get_figwidth())), fontsize=9)
    return _save(figure, path)


def _pose(panel: Axes, one: Mapping[str, Any], side: bool) -> None:
    """One frame with its truth and a pose."""
    truth: Array = one["truth"]
    camera: Any = one.get("camera")
    low, high = truth.min(axis=0), truth.max(axis=0)
    panel.set(xticks=[], yticks=[])
    if camera is not None and not side:
        middle, reach = float(truth[:, 2].mean()), 0.55 * one["spine_mm"]
        _depth(panel, one["depth"], middle - 1.6 * reach, middle + reach, "gray")
        panel.set_facecolor("#dfe3e6")
        flat = camera.project
        ends_px = [flat(truth).min(axis=0), flat(truth).max(axis=0)]
        _around(
            panel, np.mean(ends_px, axis=0), max(0.85 * float(np.ptp(ends_px, axis=0).max()), 12.0)
        )
    else:
        plane = [0, 2] if side else [0, 1]
        half = (0.75 if side else 0.65) * max(float((high - low)[: 3 if side else 2].max()), 1.0)
        panel.set_aspect("equal")
        _around(panel, 0.5 * (low + high)[plane], half)

        def flat(points: Array) -> Array:
            return points[:, plane]

    if side:
        v, u = np.nonzero(one["depth"] > 0)
        points = camera.unproject(np.stack([u, v], -1), one["depth"][v, u].astype(float))
        near = (abs(points - 0.5 * (low + high)) < half).all(axis=1)
        panel.plot(*flat(points[near]).T, ".", color="#8a8f94", ms=1.6, alpha=0.7)
    edges, pose = one.get("edges", _NYU_EDGES), one.get("pose")
    _bones(panel, flat(truth), edges, _TRUE, 1.4)
    result = "nothing found" if "pose" in one else "not kept"
    if pose is not None:
        _bones(panel, flat(pose), edges, _POSE, 1.4)
        result = f"{np.linalg.norm(pose - truth, axis=-1).mean():.1f} mm"
    panel.set_title(f"{one['head']}\n{result}", fontsize=8)


def _height_map(panel: Axes, shown: Mapping[str, Any], joints_px: Array) -> None:
    """The illustrated animal with its truth and a candidate."""
    heights = shown["heights"]
    rows, columns = np.nonzero(heights > 0)
    tallest = heights[rows, columns]
    _depth(panel, heights, tallest.min() - 0.5 * np.ptp(tallest), tallest.max(), "gray")
    middle = 0.5 * (columns.min() + columns.max()), 0.5 * (rows.min() + rows.max())
    _around(panel, middle, 0.75 * max(np.ptp(rows), np.ptp(columns)))
    _bones(panel, shown["true_px"], shown["edges"], _TRUE, 1.0)
    _bones(panel, joints_px, shown["edges"], "#EE6677", 1.5)


def draw_candidates(shown: Mapping[str, Any], path: Path) -> Path:
    """Figs. 13 to 15: candidates ranked by the learned metric, with predicted and true error."""
    ranked = shown["ranked"]
    n = min(len(ranked["score_mm"]), 40)  # at most 40 candidates
    columns = min(n, 10 if n > 10 else 5)
    figure, grid = _sheet(-(-n // columns), columns, 1.7, 2.25)
    true_rank = np.argsort(np.argsort(ranked["error_mm"], kind="stable")) + 1
    panels = [panel for line in grid for panel in line]
    for panel in panels[n:]:
        panel.set_axis_off()
    for k, panel in enumerate(panels[:n]):
        _height_map(panel, shown, ranked["joints_px"][k])
        above = f"{k + 1}: {ranked['score_mm'][k]:.2f} mm"
        panel.set_title(above, color="#117733", fontsize=8)
        panel.set_xlabel(f"{true_rank[k]}: {ranked['error_mm'][k]:.2f} mm", color=_POSE, fontsize=8)
    figure.suptitle(
        f"{shown['animal']}: candidates of one image, red; truth, blue. Above: rank and predicted "
        "error; below: true rank and error.\nRank correlation of the two, mean of "
        f"{shown['n_images']} images: {shown['rank_correlation']:.2f}",
        fontsize=8,
    )
    return _save(figure, path)


def draw_convergence(shown: Mapping[str, Any], path: Path) -> Path:
    """Fig. 16: one candidate from start to end, and all errors after every joint and round."""
    steps = shown["steps"]
    n = len(steps["names"])
    stages = np.unique(np.linspace(0, n - 1, min(8, n)).round().astype(int))  # at most eight stages
    figure = Figure(figsize=(1.7 * len(stages), 5.0), layout="constrained")
    grid = figure.add_gridspec(2, len(stages), height_ratios=[1, 1.6])
    for k, step in enumerate(stages):
        panel = figure.add_subplot(grid[0, k])
        _height_map(panel, shown, steps["joints_px"][step])
        panel.set_title(steps["names"][step], fontsize=8)
        panel.set_xlabel(f"{steps['example_mm'][step]:.1f} mm", fontsize=8)
    panel = figure.add_subplot(grid[1, :])
    blue, purple = METHODS["paper"][1], METHODS["default"][1]
    half: dict[str, Any] = {"label": "middle half of all candidates", "alpha": 0.2, "lw": 0}
    panel.fill_between(range(n), steps["low_mm"], steps["high_mm"], color=blue, **half)
    panel.plot(steps["median_mm"], color=blue, label="median of all candidates")
    panel.plot(steps["best_mm"], color=purple, label="the candidate ranked first, mean")
    ticks = range(0, n, -(-n // 40))
    panel.set_xticks(ticks, [steps["names"][k] for k in ticks], rotation=60, fontsize=7, ha="right")
    panel.set(ylabel="mean joint error, mm", ylim=(0, None))
    panel.set_title(
        f"{shown['animal']}: after every joint and round, {shown['n_images']} images", fontsize=8
    )
    panel.legend(fontsize=7)
    panel.grid(alpha=0.3)
    return _save(figure, path)


def draw_tracking(sequence: RenderedRecording, rows: Mapping[str, Followed], path: Path) -> Path:
    """Fig. 18: tracking error over time compared with single frames, and the worst moments.

    Args:
        sequence: the sequence with its truth.
        rows: `single` (frames by themselves), `algorithm3` and `smoothed`.
        path: the PNG to write; its folder is created.
    """
    figure = Figure(figsize=(13.0, 6.4), layout="constrained")
    grid = figure.add_gridspec(2, _MOMENTS, height_ratios=(1.3, 1.0))
    panel = figure.add_subplot(grid[0, :])
    seconds = (sequence.times_ns - sequence.times_ns[0]) * 1e-9
    top = panel.get_xaxis_transform()
    for event in sequence.events:
        if event.kind not in ("hidden", "dropped"):
            start, stop = seconds[event.start], seconds[event.stop - 1]
            panel.axvspan(start, stop, color="#000000", alpha=0.05, lw=0)
            panel.text(start, 0.98, event.kind, fontsize=7, va="top", transform=top)
    for name, (label, colour, width) in _TRACKERS.items():
        mean = float(np.nanmean(rows[name].error_mm))
        label = f"{label}: mean {mean:.2f} mm"
        panel.plot(seconds, rows[name].error_mm, color=colour, lw=width, label=label)
        panel.axhline(mean, color=colour, lw=width, ls="--")
    panel.set(xlabel="time, s", ylabel="mean joint error, mm", yscale="log")
    panel.margins(x=0.0)
    panel.legend(loc="upper right", fontsize=8)
    for k, frame in enumerate(worst_moments(rows["single"].error_mm)):
        _moment(figure.add_subplot(grid[1, k]), sequence, rows, frame)
    return _save(figure, path)


def worst_moments(error: Array) -> list[int]:
    """At most six frames with the largest errors (n,), none within twelve frames of another."""
    left = np.nan_to_num(error, nan=-1.0)
    chosen: list[int] = []
    while len(chosen) < _MOMENTS and left.max() >= 0:
        chosen.append(int(np.argmax(left)))
        left[max(0, chosen[-1] - _APART) : chosen[-1] + _APART] = -1.0
    return sorted(chosen)


def _moment(
    panel: Axes, sequence: RenderedRecording, rows: Mapping[str, Followed], frame: int
) -> None:
    """The depth around the animal with the true and the estimated skeletons."""
    spine, camera = sequence.spine_mm, sequence.camera
    middle = sequence.joints_camera[frame].mean(axis=0)
    _depth(
        panel,
        sequence.depths(frame, frame + 1)[0],
        middle[2] - 0.6 * spine,
        middle[2] + 0.6 * spine,
        "Greys",
    )
    _around(panel, camera.project(middle), 0.9 * spine * camera.fx / middle[2])
    skeletons = {_GREEN: sequence.joints_arena} | {
        _TRACKERS[name][1]: rows[name].joints for name in ("single", "smoothed")
    }
    for colour, joints in skeletons.items():
        points = camera.project(sequence.T_arena_camera.inverse() @ joints[frame])
        _bones(panel, points, sequence.skeleton.edges, colour, 2.0, -1)
    alone, tracked = (rows[name].error_mm[frame] for name in ("single", "smoothed"))
    panel.set_title(f"frame {frame}: {alone:.0f} mm, smoothed {tracked:.0f} mm", fontsize=8)


def draw_key_frames(acts: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Fig. 19: key frames and path of each action.

    Args:
        acts: for each action `word`, `side`, `path_mm`, `bodies_mm`, `skeletons_mm`, `edges` and
            `seconds`.
        path: the PNG to write; its folder is created.
    """
    figure, grid = _sheet(-(-len(acts) // 3), 3, 3.6, 3.5, (0.0, 0.4))
    panels = [panel for line in grid for panel in line]
    for panel in panels[len(acts) :]:
        panel.set_axis_off()
    for panel, act in zip(panels, acts, strict=False):
        along, bodies, skeletons = act["path_mm"], act["bodies_mm"], act["skeletons_mm"]
        panel.plot(*np.concatenate(bodies).T, ".", color="#b9bfc5", ms=1.6, alpha=0.6)
        for joints in skeletons:
            _bones(panel, joints, act["edges"], "#3a4046", 0.9, None)
        panel.scatter(
            along[:, 0],
            along[:, 1],
            c=np.linspace(0, 1, len(along)),
            cmap="coolwarm",
            s=9,
            zorder=3,
        )
        everything = np.concatenate([along, *bodies, *skeletons])
        low, high = everything.min(axis=0), everything.max(axis=0)
        half = 0.5 * float((high - low).max()) + 8.0  # square, in any direction
        x, y = 0.5 * (low + high) - half
        panel.plot([x + 2.0, x + 22.0], [y + 2.0] * 2, "-", color="#000000", lw=2)
        panel.set(xlim=(x, x + 2 * half), ylim=(y, y + 2 * half), xticks=[], yticks=[])
        panel.set_aspect("equal")
        where = "from the side" if act["side"] else "from above"
        name = act["word"].replace("_", " ")
        panel.set_title(f"{name}, {1000 * act['seconds']:.0f} ms, {where}", fontsize=9)
    figure.suptitle(
        "Key frames of the fish's actions, and the path of the middle of its body from blue to "
        "red; bar: 20 mm",
        fontsize=9,
    )
    return _save(figure, path)


def draw_confusions(result: Mapping[str, Any], path: Path) -> Path:
    """Fig. 20: confusion matrices of cut-out actions, in per cent; rows are the true actions.

    Args:
        result: from `evaluate_actions`: confusion, accuracies and their 95 % intervals.
        path: the PNG to write; its folder is created.
    """
    words = [str(word).replace("_", " ") for word in result["confusion"]["words"]]
    side = 1.6 + 0.42 * len(words)
    figure, (panels,) = _sheet(1, len(_RECOGNISERS), side, side + 0.4)
    turned: dict[str, Any] = {"rotation": 60, "ha": "right", "rotation_mode": "anchor"}
    for panel, ((name, key), title) in zip(panels, _RECOGNISERS.items(), strict=True):
        low, high = (100 * bound for bound in result["accuracy_interval95"][name])
        accuracy = result[f"{key}_accuracy"]
        panel.set_title(f"{title}: {accuracy:.1%} ({low:.1f} to {high:.1f})", fontsize=9)
        counts = np.asarray(result["confusion"][name], float)
        share = 100.0 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
        panel.imshow(share, cmap="Blues", vmin=0.0, vmax=100.0)
        for row, column in zip(*np.nonzero(counts), strict=True):
            value = share[row, column]
            where: dict[str, Any] = {
                "ha": "center",
                "va": "center",
                "color": ("white" if value > 55.0 else "black"),
            }
            panel.text(column, row, f"{value:.0f}", fontsize=7, **where)
        panel.set_xticks(range(len(words)), words, fontsize=7, **turned)
        panel.set_yticks([])
        panel.set_xlabel("recognised as", fontsize=8)
    panels[0].set_yticks(range(len(words)), words, fontsize=7)
    panels[0].set_ylabel("true action", fontsize=8)
    return _save(figure, path)


def draw_scene(
    name: str,
    recording: RenderedRecording,
    truths: Sequence[TrueAnimal],
    individuals: Sequence[MeasuredIndividual],
    folder: Path,
) -> Path:
    """Frames of a scene with true and measured skeletons: the whole depth image, and a close-up.

    Args:
        name: of the scene and of the file.
        recording: the scene's frames.
        truths: true animals, drawn in green.
        individuals: measured individuals, purple if trusted, orange otherwise.
        folder: of the PNG; it is created.
    """
    figure, panels = _sheet(2, len(_SCENE_MOMENTS), 3.75, 3.6)
    camera, skeleton = recording.camera, recording.skeleton
    for whole, near, share in zip(*panels, _SCENE_MOMENTS, strict=True):
        frame = min(int(share * len(recording)), len(recording) - 1)
        depth = recording.depths(frame, frame + 1)[0]
        read = depth[depth > 0]
        low, high = np.quantile(read, [0.01, 0.99]) if len(read) else (0.0, 1.0)
        shown = [(truth.joints_camera[frame], _GREEN, 2.2) for truth in truths]
        shown += [
            (one.joints_camera[frame], "#AA3377" if one.trusted[frame] else "#EE7733", 1.2)
            for one in individuals
        ]
        for panel in (whole, near):
            _depth(panel, depth, low, high, "viridis_r")
            panel.set_facecolor("black")
            for joints, colour, width in shown:
                if not np.isfinite(joints).all():
                    continue
                points = camera.project(joints)
                if len(joints) == skeleton.n_joints:
                    _bones(panel, points, skeleton.edges, colour, width, skeleton.tip)
                else:  # of another animal than the recording's
                    panel.plot(*points.T, ".", color=colour, ms=3.0)
            panel.set(xlim=(-0.5, recording.width - 0.5), ylim=(recording.height - 0.5, -0.5))
        view = ", ".join(f"{100 * truth.visible[frame]:.0f} %" for truth in truths)
        whole.set_title(f"{name}, frame {frame}, in view: {view or 'none'}", fontsize=8)
        if truths and np.isfinite(truths[0].joints_camera[frame]).all():
            middle, spine = truths[0].joints_camera[frame].mean(axis=0), truths[0].spine_mm
            near.images[0].set_clim(middle[2] - 0.8 * spine, middle[2] + 0.8 * spine)
            _around(near, camera.project(middle), 1.6 * spine * camera.fx / middle[2])
    return _save(figure, folder / f"{name}.png")
