"""2D keypoints as a detector gives them: jitter, misses, exchanged sides, other people's limbs, scores that lie."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.skeleton import FLIP, JOINTS, N_JOINTS
from understudy.synthetic.draw import Draw


@dataclass(frozen=True)
class DetectorConfig:
    """Error model of the 2D keypoints. Lengths are metres at the person's distance, for a torso of 0.5 m."""

    jitter_m: float = 0.014
    """one sigma of a well visible joint, times a factor per joint and one per detection (spread 0.45 in the log)"""
    hidden_m: float = 0.06
    """one sigma of a joint that the camera does not see but the detector gives"""
    pixel: float = 0.0012
    """tangent of the angle of one sigma that no detector gets below"""
    top_down: float = 0.5
    """share of detections by a detector that always gives all joints (BlazePose); the others leave hidden ones out"""
    miss: float = 0.03
    """share of visible joints that are not found"""
    gross: float = 0.012
    """share of joints that land somewhere else"""
    swap_person: float = 0.012
    """share of people whose sides are all exchanged; of people seen from behind, four times as many"""
    swap_limbs: float = 0.012
    """share of exchanged arms, and of exchanged legs"""
    steal: float = 0.02
    """share of limbs that are another person's, where there is another person"""


_FACTOR = {
    "nose": 0.5, "eye": 0.45, "ear": 0.6, "neck": 0.9, "shoulder": 1.1,
    "hip": 1.7, "knee": 1.1, "wrist": 1.2, "ankle": 1.2,
}  # fmt: skip
"""Jitter of a joint against the mean one; 1 where nothing is said."""
_ARMS = [i for i, n in enumerate(JOINTS) if n.endswith(("elbow", "wrist"))]
_LEGS = [i for i, n in enumerate(JOINTS) if n.endswith(("hip", "knee", "ankle"))]
_TORSO = [i for i, n in enumerate(JOINTS) if n.endswith(("neck", "shoulder", "hip"))]
_LIMBS = ((3, 4), (6, 7), (9, 10), (12, 13))


def detect(
    draw: Draw,
    config: DetectorConfig,
    xy: Float[Tensor, "b 18 2"],
    distance: Float[Tensor, " b"],
    hidden: Bool[Tensor, "b 18"],
    in_view: Bool[Tensor, "b 18"],
    from_behind: Bool[Tensor, " b"],
    other_xy: Float[Tensor, "b 18 2"],
) -> Float[Tensor, "b 18 3"]:
    """Rows (x, y, score); (0, 0, 0) for what is not found.

    xy: true positions in the plane of the root (metres). distance: of that plane (metres). hidden: what the camera
    does not see. from_behind: people who turn their backs. other_xy: another person's positions in the same plane; NaN
    where there is none.
    """
    b, device = len(xy), xy.device
    shape = (b, N_JOINTS)
    factor = torch.tensor([_FACTOR.get(n.split("_")[-1], 1.0) for n in JOINTS], device=device)
    top_down = draw.chance(config.top_down, b)[:, None]
    quality = draw.lognormal(0.45, b)[:, None]
    believed, unsure = _believed(draw, config, xy, hidden | ~in_view, from_behind, other_xy)

    sigma = config.jitter_m * quality * factor
    hidden_sigma = config.hidden_m * draw.lognormal(0.4, b)[:, None] * factor.clamp_min(0.8)
    sigma = torch.where(unsure, torch.hypot(sigma, hidden_sigma), sigma)
    sigma = torch.hypot(sigma, (config.pixel * distance)[:, None])
    common = 0.4 * draw.normal(b, 1, 2)  # what all joints of a detection share
    noise = draw.heavy(b, N_JOINTS, 2) + common
    gross = draw.chance(config.gross, *shape)
    noise = noise * sigma[..., None] + torch.where(gross[..., None], 0.25 * draw.normal(b, N_JOINTS, 2), 0.0)
    place = believed + noise

    # A top-down detector draws what it does not see where it usually is: nearer to the rest of the person.
    middle = believed[:, _TORSO].mean(1, keepdim=True)
    pull = torch.where((top_down & unsure)[..., None], draw.uniform(0, 0.15, b, N_JOINTS, 1), 0.0)
    place = place + (middle - place) * pull

    torso = torch.zeros(N_JOINTS, dtype=torch.bool, device=device)
    torso[_TORSO] = True
    score = draw.beta(9.0, 1.3, *shape)
    weak = torch.where(torso & top_down, draw.beta(9.0, 1.0, *shape), draw.beta(2.0, 2.0, *shape))
    score = torch.where(unsure, weak, score)
    score = torch.where(draw.chance(0.05, *shape), draw.beta(1.0, 1.0, *shape), score)  # scores that lie

    missed = draw.chance(config.miss, *shape) & ~top_down
    missed |= hidden & torch.where(top_down, draw.chance(0.06, *shape), draw.chance(0.6, *shape))
    missed |= ~in_view & torch.where(top_down, draw.chance(0.4, *shape), draw.chance(0.95, *shape))
    found = ~missed & (score > 0.05)
    # The neck of most detectors is the middle of their shoulders.
    neck = (place[:, 2] + place[:, 5]) / 2
    from_shoulders = draw.chance(0.7, b) & found[:, 2] & found[:, 5]
    place[:, 1] = torch.where(from_shoulders[:, None], neck, place[:, 1])
    score[:, 1] = torch.where(from_shoulders, torch.minimum(score[:, 2], score[:, 5]), score[:, 1])
    found[:, 1] |= from_shoulders
    return torch.cat([place, score[..., None]], -1) * found[..., None]


def _believed(
    draw: Draw,
    config: DetectorConfig,
    xy: Float[Tensor, "b 18 2"],
    unsure: Bool[Tensor, "b 18"],
    from_behind: Bool[Tensor, " b"],
    other_xy: Float[Tensor, "b 18 2"],
) -> tuple[Float[Tensor, "b 18 2"], Bool[Tensor, "b 18"]]:
    """Where the detector believes the joints to be, without jitter, and which of these places it sees badly.

    Sides are exchanged, and limbs are taken from another person.
    """
    flip = torch.as_tensor(FLIP, device=xy.device)
    b = len(xy)
    swap = draw.chance(config.swap_person, b) | (from_behind & draw.chance(3 * config.swap_person, b))
    arms, legs = draw.chance(config.swap_limbs, b), draw.chance(config.swap_limbs, b)
    believed = xy.clone()
    for rows, chosen in ((list(range(N_JOINTS)), swap), (_ARMS, arms), (_LEGS, legs)):
        whole = torch.zeros(unsure.shape, dtype=torch.bool, device=xy.device)
        whole[:, rows] = True
        exchange = whole & chosen[:, None]
        believed = torch.where(exchange[..., None], believed[:, flip], believed)
        unsure = torch.where(exchange, unsure[:, flip], unsure)
    for limb in _LIMBS:
        taken = draw.chance(config.steal, b) & other_xy[:, limb].isfinite().all(-1).all(-1)
        taken &= (other_xy[:, limb[0]] - xy[:, limb[0]]).norm(dim=-1) < 1.2
        for j in limb:
            believed[:, j] = torch.where(taken[:, None], other_xy[:, j], believed[:, j])
    return believed, unsure
