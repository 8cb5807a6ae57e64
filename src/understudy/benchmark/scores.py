"""Numbers of a comparison: evaluations of methods on subsets of people and joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

from understudy.benchmark.comparison import Group, Lifted
from understudy.benchmark.subjects import Subjects
from understudy.metrics import Counts, Evaluation, Observations, summarise
from understudy.metrics.joints import mean, position_errors, share

DISTANCES_M: Final = (0.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0)
"""edges of the bins of distance"""
FEWEST: Final = 30
"""joints: a bin with fewer has no number"""


@dataclass(frozen=True)
class Score:
    """One method on one group. Errors in metres; NaN where there is nothing to measure."""

    epe_m: float
    hard_m: float
    visible_m: float
    occluded_m: float
    common_m: float
    """over the joints that all methods of the table give"""
    given: float
    pck: float
    auc: float
    auc_hard: float
    auc_occluded: float
    swapped: float
    failed: int
    """people without any joint"""


def evaluate_lifted(subjects: Subjects, lifted: Lifted, people: Bool[np.ndarray, " n"] | None = None) -> Evaluation:
    """All metrics over the joints in view; of some people, or of all."""
    rows = np.ones(len(subjects.frame), bool) if people is None else people
    n = int(rows.sum())
    truth = np.where(subjects.counted[..., None], subjects.truth, np.nan)[rows]
    none = np.full((n, 2, 3), np.nan)
    return summarise(
        Observations(
            lifted.keypoints[rows], truth, subjects.in_view[rows], subjects.occluded[rows],
            lifted.confidence[rows], lifted.sigma_m[rows], none, none, np.zeros((n, 2), bool),
            Counts(truth_people=n, failed=int(lifted.failed[rows].sum())),
        )
    )  # fmt: skip


def errors(subjects: Subjects, lifted: Lifted) -> Float[np.ndarray, "n 18"]:
    """Metres; NaN where not given or without truth."""
    return position_errors(lifted.keypoints, subjects.truth)


def given_by_all(subjects: Subjects, lifted: Sequence[Lifted]) -> Bool[np.ndarray, "n 18"]:
    """Counted joints for which every method has a position."""
    out = subjects.counted
    for one in lifted:
        out = out & np.isfinite(one.keypoints).all(-1)
    return np.asarray(out)


def score(subjects: Subjects, lifted: Lifted, common: Bool[np.ndarray, "n 18"]) -> Score:
    """The main table's numbers. A joint that was not given is in no mean; in PCK and AUC it is missed."""
    whole = evaluate_lifted(subjects, lifted)
    hard = evaluate_lifted(subjects, lifted, subjects.hard)
    of = whole.joints
    given_common = common & np.isfinite(lifted.keypoints).all(-1)
    return Score(
        epe_m=of["in_view"].epe_m,
        hard_m=hard.joints["in_view"].epe_m,
        visible_m=of["visible"].epe_m,
        occluded_m=of["occluded"].epe_m,
        common_m=mean(errors(subjects, lifted)[given_common]),
        given=of["in_view"].coverage,
        pck=of["in_view"].pck,
        auc=of["in_view"].auc,
        auc_hard=hard.joints["in_view"].auc,
        auc_occluded=of["occluded"].auc,
        swapped=whole.swapped,
        failed=whole.counts.failed,
    )


def scores(group: Group, keys: Mapping[str, tuple[str, str]]) -> dict[str, Score]:
    """Row's name -> score. The common joints are those that all these rows give."""
    chosen = {name: group.lifted[key] for name, key in keys.items()}
    common = given_by_all(group.subjects, list(chosen.values()))
    return {name: score(group.subjects, lifted, common) for name, lifted in chosen.items()}


def pck_over_distance(
    subjects: Subjects, lifted: Lifted, edges: Sequence[float] = DISTANCES_M, within_m: float = 0.10
) -> tuple[Float[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Per bin of the person's distance (metres): share of counted joints within 10 cm (NaN for few), their number."""
    bin_of = np.digitize(subjects.distance, edges) - 1
    right = np.nan_to_num(errors(subjects, lifted), nan=np.inf) <= within_m + 1e-9
    shares, counts = [], []
    for k in range(len(edges) - 1):
        here = subjects.counted & (bin_of == k)[:, None]
        counts.append(int(here.sum()))
        shares.append(share(right[here]) if counts[-1] >= FEWEST else float("nan"))
    return np.array(shares), np.array(counts)
