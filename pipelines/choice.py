"""Which plan a recording fits: the named one, another one, or none.

The scene is learned and the animal's size estimated as in a run; `sample_fit` of the sampled frames
decides. If the named plan does not fit, or none was named and the usual one does not, every other
bundled plan is tried on a few frames. Left and right hands are distinguished similarly: the
recording and its mirror image are both tried, and the wrong one's predicted error is about twice as
large.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from liex_lab.errors import EstimationError, LiexError, MisfitError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.plan import Plan, known_plans
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.rectify import mirrored
from liex_lab.runtime.progress import Progress, silent
from liex_lab.scene import background_segmenter, hand_segmenter
from liex_lab.tracking.residual import SampleFit
from liex_lab.tracking.tracker import FrameTracker

from .build import animal_of, build_tracker

USUAL = "mouse"  # tried first if no plan is named
# of the unmirrored images' predicted error: below it the mirror image fits a hand better
_MIRRORED_BELOW = 0.75


@dataclass(frozen=True)
class Fitted:
    """A plan in use, and its tracker.

    Attributes:
        recording: the recording, mirrored if needed.
        plan: the plan, completed with what was found.
        tracker: the tracker of the recording, prepared.
        misfits: evidence against the plan's animal, if accepted all the same.
        notes: notes for the user on what was found.
    """

    recording: Recording
    plan: Plan
    tracker: FrameTracker
    misfits: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlanFit:
    """How well a plan fits a few frames.

    Attributes:
        name: of the plan.
        fit: statistics of the frames; None if no animal was found.
        misfits: evidence against the plan; empty if it fits.
    """

    name: str
    fit: SampleFit | None
    misfits: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class Proposal:
    """Which plan a recording fits, for display.

    Attributes:
        plan: name of the bundled plan, or of the given plan's animal; None if no plan fits.
        summary: how it fits, or the evidence against each plan.
        n_animals: objects of the animal's size in view at once; None if no plan fits.
        problems: sentences about several animals, and about a given plan that does not fit.
        is_given: whether the plan that fits is the given one.
    """

    plan: str | None
    summary: str
    n_animals: int | None = None
    problems: tuple[str, ...] = ()
    is_given: bool = False


def propose_plan(recording: Recording, plan: Plan | None = None) -> Proposal:
    """Find the plan that a recording fits, from a few frames; tries `plan`, or the usual one,
    first.
    """
    first = try_plan(recording, plan or USUAL)
    fits = [first]
    if first.misfits:
        given = plan or Plan.load(USUAL)
        fits += [try_plan(recording, name) for name in known_plans() if not _is(given, name)]
    found = best(fits)
    if found is None or found.fit is None:
        summary = ". ".join(f"{one.name}: {', '.join(one.misfits)}" for one in fits)
        return Proposal(None, f"none fits. {summary}")
    fit = found.fit
    summary = (
        f"{found.name} fits: {fit.spine_mm:.0f} mm long, expected error {fit.error_mm:.1f} mm, its "
        f"body covers {fit.covered:.0%} of what is visible"
    )
    problems = list(_other_hand(recording, found, plan))
    if plan is not None and found is not first:
        problems.append(
            f"the plan of the {first.name} does not fit: {', and '.join(first.misfits)}; use "
            f"--plan {found.name}"
        )
    if fit.n_animals > 1:
        problems.append(
            f"{fit.n_animals} animals are in view at once and a run follows one of them, whose "
            "poses are then not trusted; measure them all with --set animal.count=auto"
        )
    given_fits = plan is not None and found is first
    return Proposal(found.name, summary, fit.n_animals, tuple(problems), given_fits)


def _other_hand(recording: Recording, found: PlanFit, plan: Plan | None) -> tuple[str, ...]:
    """A problem if the hand is a left one or its images are mirrored; () otherwise."""
    stated = plan is not None and plan.recording.mirrored is not None
    if found.name != "hand" or stated or found.fit is None:
        return ()
    other = try_plan(mirrored(recording, lent=True), found.name).fit
    if other is None or other.error_mm > _MIRRORED_BELOW * found.fit.error_mm:
        return ()
    return (
        "it is a left hand, or the images are mirrored: the expected error is "
        f"{found.fit.error_mm:.1f} mm as they are and {other.error_mm:.1f} mm mirrored; a run "
        "finds that by itself, and --set recording.mirrored=true states it",
    )


def fit_plan(
    recording: Recording,
    plan: Plan,
    estimator_of: Callable[[], PoseEstimator] | None = None,
    *,
    settings: Sequence[str] | None = None,
    progress: Progress = silent,
) -> Fitted:
    """The tracker of a recording by its plan, or by the bundled plan that fits if none was named.

    Args:
        recording: an open recording.
        plan: the named plan, or the usual one.
        estimator_of: waits for the plan's estimator; None makes it.
        settings: if no plan was named, the settings to change in any plan; None if `plan` was
            named.
        progress: called with the current step.

    Raises:
        MisfitError: the recording does not show the plan's animal, and the plan does not accept
            that.
        EstimationError: no animal is found, and no other plan fits.
    """
    tracker = None
    cause: EstimationError | None = None
    try:
        tracker = build_tracker(recording, plan, estimator_of)
        misfits = misfits_of(tracker.sample_fit, plan)
        misfits = (*tracker.scene.doubts, *misfits) if misfits else ()
    except EstimationError as error:
        cause = error
        misfits = (str(error).partition("; ")[0],)
    accepted = plan.estimation.accept_misfit
    if tracker is not None:
        found = _right_way_round(Fitted(recording, plan, tracker, misfits), progress)
        if not found.misfits:
            return found
        if accepted:  # but none of its poses is trusted
            return replace(found, tracker=replace(found.tracker, doubtful_mm=0.0))
    if cause is not None and accepted:
        raise cause
    progress(0, None, "checking which plan fits")
    fitting = best([try_plan(recording, name) for name in known_plans() if not _is(plan, name)])
    if fitting is not None and settings is not None:
        chosen = Plan.load(fitting.name).with_settings(settings)
        note = f"no plan was named, and {fitting.name} fits"
        found = Fitted(recording, chosen, build_tracker(recording, chosen), (), (note,))
        return _right_way_round(found, progress)
    if fitting is None and cause is not None:
        raise cause
    if fitting is None and tracker is not None and not _shows_an_animal(tracker):
        raise MisfitError(
            "no animal was found in the recording: nothing of an animal's size moves, and what "
            "stands out from the floor is not like one; check that the animal is in view, or add "
            "--accept to measure it all the same"
        ) from None
    raise MisfitError(_refusal(plan, misfits, fitting)) from None


def _shows_an_animal(tracker: FrameTracker) -> bool:
    """Whether anything moved, or the body covers enough of what rises above the floor."""
    scene = tracker.scene
    fit = tracker.sample_fit
    if (
        not isinstance(scene, background_segmenter.BackgroundSubtraction)
        or scene.support_plane is None
        or fit is None
    ):
        return True
    # if nothing moves, the body has to cover some of what rises above the floor
    return scene.support_plane.moves or fit.covered >= 0.25


def try_plan(recording: Recording, plan: Plan | str) -> PlanFit:
    """Fit a plan, or the bundled plan of that name, to a few frames."""
    name = plan if isinstance(plan, str) else animal_of(plan).name
    chosen = Plan.load(plan) if isinstance(plan, str) else plan
    plan = chosen.with_settings(["foreground.n_background_frames=24"])
    try:
        fit = build_tracker(recording, plan).sample_fit
    except LiexError as error:
        return PlanFit(name, None, (str(error).partition("; ")[0],))
    return PlanFit(name, fit, misfits_of(fit, plan))


def best(fits: Sequence[PlanFit]) -> PlanFit | None:
    """The plan that fits; of several, the one with the least error over its animal's length."""
    fitting = [one for one in fits if one.fit is not None and not one.misfits]
    return min(fitting, key=_error_share, default=None)


def misfits_of(fit: SampleFit | None, plan: Plan) -> tuple[str, ...]:
    """Evidence that a recording does not show the plan's animal; () if `fit` is None."""
    if fit is None:
        return ()
    animal = animal_of(plan)
    stated = animal.spine_mm is not None
    return tuple(fit.misfits(animal.spine_min_mm, animal.spine_max_mm, stated))


def _error_share(one: PlanFit) -> float:
    return one.fit.error_mm / one.fit.spine_mm if one.fit is not None else float("inf")


def _is(plan: Plan, name: str) -> bool:
    """Whether a bundled plan is of the same animal as this one."""
    return Plan.load(name).animal.skeleton == plan.animal.skeleton


def _refusal(plan: Plan, misfits: Sequence[str], fitting: PlanFit | None) -> str:
    name = animal_of(plan).name
    what = f"the recording does not fit the plan of the {name}: {', and '.join(misfits)}"
    if fitting is None or fitting.fit is None:
        return (
            f"{what}; no other bundled plan fits either: check the camera's numbers and the depth "
            "unit with `liex doctor`, or add --accept (in Python the "
            "setting 'estimation.accept_misfit=true') to measure it all the same"
        )
    return (
        f"{what}, while the plan '{fitting.name}' fits ({fitting.fit.spine_mm:.0f} mm long, "
        f"expected error {fitting.fit.error_mm:.1f} mm); use --plan {fitting.name}, or add "
        "--accept (in Python the setting 'estimation.accept_misfit=true') to measure it all the "
        "same"
    )


def _right_way_round(found: Fitted, progress: Progress) -> Fitted:
    """The same, or mirrored if the images show a hand and fit better mirrored."""
    plan = found.plan
    fit = found.tracker.sample_fit
    is_hand = isinstance(found.tracker.scene, hand_segmenter.HandSegmenter)
    if not is_hand or plan.recording.mirrored is not None or fit is None:
        return found
    animal = animal_of(plan)
    if not fit.has_length(animal.spine_min_mm, animal.spine_max_mm):
        return found  # not a hand
    progress(0, None, "checking which hand it is")
    turned = mirrored(found.recording, lent=True)
    other = try_plan(turned, plan).fit
    if other is None or other.error_mm > _MIRRORED_BELOW * fit.error_mm:
        return replace(found, plan=plan.with_settings(["recording.mirrored=false"]))
    settled = plan.with_settings(["recording.mirrored=true"])
    tracker = build_tracker(turned, settled)
    note = (
        f"a left hand or mirrored images: expected error {other.error_mm:.1f} mm mirrored, "
        f"{fit.error_mm:.1f} mm as they are, so left and right were exchanged (recording.mirrored)"
    )
    return Fitted(
        turned, settled, tracker, misfits_of(tracker.sample_fit, settled), (*found.notes, note)
    )
