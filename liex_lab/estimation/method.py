"""Hyperparameters of the pose estimation: the paper's variant of Lie-X, and ours.

The same code runs both variants with these numbers. The paper's values (C rounds, Kt initial poses,
trees, depths, learned metric) are those of Lie-X sections 4 and 5.2 as far as stated there.
"""

from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from liex_lab.body.skeleton import VIEWS, Skeleton
from liex_lab.errors import PlanError
from liex_lab.forests.grow import GrowthPlan

Number = Annotated[float, Field(ge=-1e12, le=1e12)]  # excludes NaN
Count = Annotated[int, Field(strict=True, ge=0, le=10_000)]


@dataclass(frozen=True)
class Method:
    """Everything in which training and estimation differ between variants.

    Angles are in rad; lengths are in mm of an animal of home size. The names of the fields are keys
    of the model files.

    Attributes:
        variant: 'default' or 'paper'.
        rounds: C, the regression rounds per joint.
        n_candidates: Kt, the initial poses per animal.
        training_candidates: K, the initial poses per training image.
        regressors: plan of the regressors' forests.
        metric: plan of the learned metric.
        reach_mm: range of the features' offsets from the joint, mm.
        axis_start: start along the animal's long axis in both directions; else at any heading.
        camera_view: heights are measured along the optical axis, as in the paper; else above the
            floor.
        session_size: the animal's size is estimated over the recording; else it is the home size.
        regress_scale: the base joint also corrects the scale of the bones.
        point_at: labels aim the bone at the true next joint, so that errors do not add up.
        keep_turned: the base learns from samples rotated by less than this, rad.
        keep_bent: other joints learn from corrections smaller than this, rad.
        keep_off_mm: other joints learn from samples within this distance of the truth, mm.
        out_of_bag: move a training sample only with trees that were not grown on its image, so that
            training errors are those of new images.
        metric_on_own: train the metric on the cascade's own candidates; else on perturbed truth.
        metric_shrinkage: shrinkage of the metric's boosting; 0 grows a plain forest.
        mean_shift_mm: bandwidth of the mode over tree votes, mm, of regressors and metric, in
            training and in estimation; 0 averages them.
        top_k: number of averaged candidates; 1 uses the best one.
        top_tau: decay of the averaging weights with the predicted error, mm.
        top_radius_mm: only candidates within this of the best one are averaged, mm.
        base_lever_mm: lever arm of the base, at which rotations weigh as much as translations, mm.
        joint_lever_mm: lever arm of the other joints' rotations, mm.
        scale_lever_mm: lever arm of the logarithm of the scale, mm.
        survivors: candidates kept after the base joint; 0: all of them.
        pruner: plan of the small metric that chooses them; None: no such metric is trained.
        settle: the chosen pose of an unbranched animal undergoes the ridge correction.
        base_reach_mm: range of offsets from the base joint, mm; 0: as from the others.
        corrector: plan of the forest correction of the chosen pose; None: no correction.
        home_turn: (3,) rotation vector of initial poses relative to the home pose, rad.
        proposals: plan of the forest that proposes initial poses, for an animal of any orientation.
        proposal_reach_mm: range of its features' offsets from the animal's centre, mm.
        base_rounds: rounds of the base joint if they differ from the others'; 0: as many.
        refine_steps: Gauss-Newton steps that fit a pose to the height map; 0: none.
        refined: candidates that are fitted in addition to the mean of the best; the best fit is
            chosen.
        explains: the metric also uses the residuals of the posed body against the height map.
        tells_facing: a head-tail classifier decides if the metric is unsure, see `refine`.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    variant: str
    rounds: Annotated[int, Field(strict=True, ge=1, le=10_000)]  # C
    n_candidates: Annotated[int, Field(strict=True, ge=1, le=10_000)]  # Kt
    training_candidates: int  # K initial poses per training image
    regressors: GrowthPlan
    metric: GrowthPlan
    reach_mm: Number  # range of the features' offsets from the joint
    axis_start: bool  # start along the animal's long axis, in both directions; else any heading
    camera_view: bool  # depth along the optical axis, as the paper; else height above the floor
    session_size: bool  # the animal's size is estimated over the recording; else home size
    regress_scale: bool  # the base joint also corrects the bones' scale
    point_at: bool  # labels aim the bone at the true next joint
    keep_turned: Number  # base: train on samples rotated by less than this
    keep_bent: Number  # other joints: train on smaller corrections than this
    keep_off_mm: Number  # other joints: train on samples within this distance
    out_of_bag: bool  # move a training sample only with trees not grown on its image
    metric_on_own: bool  # train the metric on the cascade's own candidates; else on perturbed truth
    metric_shrinkage: Number  # of each boosting stage of the metric; 0 grows a plain forest
    mean_shift_mm: Number  # bandwidth of the mode over tree votes; 0 averages them
    top_k: Annotated[
        int, Field(strict=True, ge=1, le=10_000)
    ]  # averaged candidates; 1 uses the best one
    top_tau: Number  # decay of weights with the predicted error, mm
    top_radius_mm: Number  # only candidates within this of the best one are averaged
    base_lever_mm: Number = 30.0  # rotations weigh as much as translations at this arm
    joint_lever_mm: Number = 20.0
    scale_lever_mm: Number = 50.0
    survivors: Count = 0  # candidates kept after the base joint; 0: all of them
    # of the small metric that chooses them; None: no such metric is trained
    pruner: GrowthPlan | None = None
    # ridge correction of the chosen pose of an animal that is one chain
    settle: bool = False
    # range of offsets from the base joint; 0: as from the others
    base_reach_mm: Number = 0.0
    # of the forest correction of the chosen pose; None: no correction
    corrector: GrowthPlan | None = None
    home_turn: tuple[Number, ...] = (
        0.0,
        0.0,
        0.0,
    )  # rotation vector of starts relative to the home pose
    # trees that propose starts, for an animal of any orientation
    proposals: GrowthPlan | None = None
    # range of their features' offsets from the animal's centre
    proposal_reach_mm: Number = 0.0
    # rounds of the base joint if they differ from the others'; 0: as many
    base_rounds: Count = 0
    refine_steps: Count = 0  # Gauss-Newton steps of the refinement
    # candidates refined in addition to the mean of the best; the best fit is chosen
    refined: Count = 0
    explains: bool = False  # the metric also uses the residuals of the posed body
    # a network separates head from tail if the metric is unsure, see `refine`
    tells_facing: bool = False

    def rounds_of(self, joint: int) -> int:
        """Number of regression rounds of a joint.

        Args:
            joint: number of the joint.
        """
        return self.base_rounds or self.rounds if joint == 0 else self.rounds

    def reaches(self, n_joints: int) -> NDArray[np.float64]:
        """Range (J,) of feature offsets from each joint, mm at home size.

        Args:
            n_joints: number of joints, J.
        """
        reach = np.full(n_joints, self.reach_mm)
        reach[0] = self.base_reach_mm or self.reach_mm
        return reach

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for the model file and its card.

        Unset fields that only some animals have are omitted.
        """
        return {
            name: _plain_plan(value._asdict()) if isinstance(value, GrowthPlan) else value
            for name, value in asdict(self).items()
            if name not in _UNSET or value != _UNSET[name]
        }


def _plain_plan(plan: dict[str, Any]) -> dict[str, Any]:
    """A plan's fields, without max_leaf if it has none."""
    return {name: value for name, value in plan.items() if name != "max_leaf" or value}


_UNSET: dict[str, Any] = {
    "home_turn": (0.0, 0.0, 0.0),
    "proposals": None,
    "proposal_reach_mm": 0.0,
    "base_rounds": 0,
    "refine_steps": 0,
    "refined": 0,
    "explains": False,
    "settle": False,
    "tells_facing": False,
}
_FULL_TURN = 10.0  # rad: no filter

METHODS = {
    "default": Method(
        variant="default",
        rounds=4,
        n_candidates=16,
        training_candidates=8,
        regressors=GrowthPlan(16, 18, 22, 120, 0.3, 0.15, 0.3, 0.63),
        metric=GrowthPlan(120, 10, 50, 120, 0.45, 0.1, 0.3, 0.5),
        reach_mm=22.0,
        axis_start=True,
        camera_view=False,
        session_size=True,
        regress_scale=True,
        point_at=True,
        keep_turned=1.75,
        keep_bent=1.22,
        keep_off_mm=20.0,
        out_of_bag=True,
        metric_on_own=True,
        metric_shrinkage=0.15,
        mean_shift_mm=0.0,
        top_k=10,
        top_tau=1.0,
        top_radius_mm=15.0,
        survivors=6,
        pruner=GrowthPlan(20, 8, 50, 100, 0.45, 0.2, 0.3, 0.5),
        corrector=GrowthPlan(160, 6, 40, 200, 0.4, 0.15, 0.3, 0.5),
    ),
    "paper": Method(
        variant="paper",
        rounds=3,
        n_candidates=40,
        training_candidates=2,
        # leaves of 5 examples at most: the paper's l_n
        regressors=GrowthPlan(10, 24, 1, 100, 0.0, 0.0, 0.3, 0.63, max_leaf=5),
        metric=GrowthPlan(20, 15, 1, 100, 0.0, 0.0, 0.3, 0.63, max_leaf=5),
        reach_mm=50.0,
        axis_start=False,
        camera_view=True,
        session_size=True,  # fixed bones "with proper scaling"
        regress_scale=False,
        point_at=False,
        keep_turned=_FULL_TURN,
        keep_bent=_FULL_TURN,
        keep_off_mm=1e9,
        out_of_bag=False,
        metric_on_own=False,
        metric_shrinkage=0.0,
        mean_shift_mm=10.0,
        top_k=1,
        top_tau=1.0,
        top_radius_mm=15.0,
    ),
}


# a hand may show any side to the camera, and its fingers' bones are short compared with their
# distance from the base
_HAND: dict[str, Any] = {
    "camera_view": False,
    "rounds": 3,
    "base_rounds": 6,
    "n_candidates": 24,
    "training_candidates": 6,
    "regressors": GrowthPlan(10, 16, 12, 60, 0.3, 0.15, 0.4, 0.63),
    "metric": GrowthPlan(60, 9, 40, 100, 0.35, 0.3, 0.4, 0.5),
    "proposals": GrowthPlan(12, 18, 5, 100, 0.2, 0.15, 0.3, 0.63),
    "proposal_reach_mm": 100.0,
    "explains": True,
    "refine_steps": 4,
    "refined": 4,
    "corrector": None,
    "reach_mm": 60.0,
    "base_lever_mm": 65.0,
    "joint_lever_mm": 40.0,
    "scale_lever_mm": 60.0,
    "keep_turned": 1.3,
    "keep_bent": 1.6,
    "keep_off_mm": 50.0,
    "top_tau": 2.0,
    "top_radius_mm": 25.0,
    "survivors": 8,
    "pruner": GrowthPlan(20, 8, 50, 100, 0.45, 0.2, 0.3, 0.5),
}


# differences from the mouse: fields of an animal's method at home size; the rest is the mouse's,
# scaled
_OWN: dict[tuple[str, str], dict[str, Any]] = {
    ("mouse", "default"): {"tells_facing": True},
    ("fish", "default"): {
        "rounds": 2,
        "training_candidates": 6,
        "n_candidates": 12,
        "survivors": 6,
        "regressors": GrowthPlan(8, 16, 20, 80, 0.3, 0.15, 0.3, 0.63),
        "reach_mm": 12.5,
        "base_reach_mm": 30.0,
        "keep_off_mm": 4.0,
        "top_tau": 0.8,
        "top_radius_mm": 4.5,
        "base_lever_mm": 10.0,
        "regress_scale": False,
        "corrector": None,
        "settle": True,
    },
    ("fish", "paper"): {
        "rounds": 7,
        "reach_mm": 12.5,
        "regressors": GrowthPlan(3, 24, 1, 100, 0.0, 0.0, 0.3, 0.63, max_leaf=5),
    },
    ("hand", "default"): _HAND,
    ("hand", "paper"): {
        "n_candidates": 20,
        "reach_mm": 50.0,
        "metric": GrowthPlan(20, 20, 1, 100, 0.0, 0.0, 0.3, 0.63, max_leaf=5),
        "home_turn": (3.1416, 0.0, 0.0),  # the palm is shown
    },
}
_LENGTHS = (
    "reach_mm",
    "base_reach_mm",
    "keep_off_mm",
    "mean_shift_mm",
    "top_tau",
    "top_radius_mm",
    "base_lever_mm",
    "joint_lever_mm",
    "scale_lever_mm",
)


def method_of(variant: str, skeleton: Skeleton) -> Method:
    """The method of a variant for an animal.

    Lengths are the mouse's, scaled by the ratio of home lengths, unless the animal has its own. An
    animal viewed along the optical axis is so in every variant.

    Args:
        variant: 'default' or 'paper'.
        skeleton: the animal's skeleton.

    Raises:
        PlanError: there is no such variant.
    """
    if variant not in METHODS:
        raise PlanError(f"there is no variant '{variant}'; choose one of {', '.join(METHODS)}")
    method = METHODS[variant]
    scaled = {name: getattr(method, name) * skeleton.relative_size for name in _LENGTHS}
    scaled["camera_view"] = method.camera_view or skeleton.view.frame == VIEWS[1]
    return replace(method, **(scaled | _OWN.get((skeleton.name, variant), {})))
