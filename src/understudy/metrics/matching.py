"""Who is who: predicted people to true people, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment


@dataclass(frozen=True)
class MatchRule:
    """When a predicted person may be a true person, and which true people count.

    The gate is wide on purpose: a person lifted badly must stay matched, so that the bad joints enter the errors
    instead of leaving as one miss. Three near joints are enough; the others may lie metres away, on the wall behind.
    """

    near_m: float = 0.5
    """joint distances are clipped here; a joint nearer than this is 'near'"""
    min_near: int = 3
    """a pair needs this many near joints; a predicted or true person with fewer joints than this cannot be matched"""
    min_in_view: int = 1
    """a true person with fewer joints inside the image is not counted: neither as missed nor, if found, as false"""

    @property
    def definition(self) -> str:
        """The rule in words."""
        return (
            "Per frame, predicted and true people are paired so that the sum of costs is smallest (Hungarian method). "
            f"A pair costs the mean 3D distance of the joints that both have, each clipped at {self.near_m:g} m, and "
            f"needs at least {self.min_near} joints within {self.near_m:g} m; an unmatched person costs "
            f"{self.near_m:g} m. A true person counts with at least {self.min_in_view} joint(s) in view and "
            f"{self.min_near} joints with truth."
        )


DEFAULT_RULE: Final = MatchRule()


def joint_distances(
    predicted: Float[np.ndarray, "p 18 3"], truth: Float[np.ndarray, "t 18 3"]
) -> Float[np.ndarray, "p t 18"]:
    """Distances (metres) of every predicted to every true person's joints; NaN where either has none."""
    return np.asarray(np.linalg.norm(predicted[:, None] - truth[None], axis=-1))


def match_people(
    predicted: Float[np.ndarray, "p 18 3"], truth: Float[np.ndarray, "t 18 3"], rule: MatchRule = DEFAULT_RULE
) -> Int[np.ndarray, "m 2"]:
    """Pairs (row of predicted, row of truth), ordered by truth. Metres; NaN rows where there is no joint.

    An inadmissible pair costs as much as one whose joints are all clipped, so that a good pair is not broken to make
    two bad ones.
    """
    distances = joint_distances(predicted, truth)
    common = ~np.isnan(distances)
    clipped = np.where(common, np.minimum(distances, rule.near_m), 0.0)
    near = common & (clipped < rule.near_m)
    admissible = near.sum(axis=-1) >= rule.min_near
    cost = np.where(admissible, clipped.sum(axis=-1) / np.maximum(common.sum(axis=-1), 1), rule.near_m)
    pairs = np.column_stack(linear_sum_assignment(cost)).astype(np.int64)
    pairs = pairs[admissible[pairs[:, 0], pairs[:, 1]]]
    return pairs[np.argsort(pairs[:, 1])]
