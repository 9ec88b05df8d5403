"""Evaluation (sec. IV): a pair, its judgement, metrics, the paper's waypoints, statistics, ablation, budget, claims."""

from study.evaluation.ablation import (
    AS_AUTHORS,
    PROTOCOL,
    RIGID,
    TRUE_IN_PLANE,
    Option,
    ablate,
    beyond_luck,
    changes,
    options,
)
from study.evaluation.budget import Budget, Scanned, error_budget
from study.evaluation.claim_questions import GRAPH
from study.evaluation.claims import CLAIMS, claims_table, differences, with_minutes
from study.evaluation.comparisons import protocol_and_truth
from study.evaluation.controls import (
    STEPS,
    TRUE_ERRORS,
    DecidingPoint,
    agreement_summary,
    deciding_point,
    rank_agreement,
    truth_floor,
    truth_free_measures,
)
from study.evaluation.distances import (
    CloudDistances,
    directed_distances_mm,
    hausdorff_mm,
    point_errors_mm,
    sampling_floor_mm,
    waypoint_errors_mm,
)
from study.evaluation.intervals import (
    Interval,
    difference_intervals,
    interval_text,
    mean_intervals,
    over_people,
    paired_intervals,
)
from study.evaluation.judgement import Judgement
from study.evaluation.metrics import METRICS, Metric, Unit, judge
from study.evaluation.pair import TRUTH, Pair, align_pair, in_order, perfect
from study.evaluation.poses import PoseCheck, PoseTrial, check_pose, random_pose, try_poses
from study.evaluation.statistics import population_sd
from study.evaluation.way import LEFT_OUT, ON_THE_WAY, Step, walk, way_to_best
from study.evaluation.waypoints import intercostal_waypoints

__all__ = [
    "AS_AUTHORS",
    "CLAIMS",
    "GRAPH",
    "LEFT_OUT",
    "METRICS",
    "ON_THE_WAY",
    "PROTOCOL",
    "RIGID",
    "STEPS",
    "TRUE_ERRORS",
    "TRUE_IN_PLANE",
    "TRUTH",
    "Budget",
    "CloudDistances",
    "DecidingPoint",
    "Interval",
    "Judgement",
    "Metric",
    "Option",
    "Pair",
    "PoseCheck",
    "PoseTrial",
    "Scanned",
    "Step",
    "Unit",
    "ablate",
    "agreement_summary",
    "align_pair",
    "beyond_luck",
    "changes",
    "check_pose",
    "claims_table",
    "deciding_point",
    "difference_intervals",
    "differences",
    "directed_distances_mm",
    "error_budget",
    "hausdorff_mm",
    "in_order",
    "intercostal_waypoints",
    "interval_text",
    "judge",
    "mean_intervals",
    "options",
    "over_people",
    "paired_intervals",
    "perfect",
    "point_errors_mm",
    "population_sd",
    "protocol_and_truth",
    "random_pose",
    "rank_agreement",
    "sampling_floor_mm",
    "truth_floor",
    "truth_free_measures",
    "try_poses",
    "walk",
    "way_to_best",
    "waypoint_errors_mm",
    "with_minutes",
]
