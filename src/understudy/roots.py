"""Where a person is: the root of the voxel grid, from whatever 2D and depth evidence there is. Nobody is dropped.

The paper takes the depth at the neck, else at a hip. That puts the root on whatever stands in front of that one joint.
Here all torso joints and places between them vote, and so does the apparent size: a person of whom all bones come out
far too short has had the depth of something nearer to the camera. Whom the depth camera did not measure is placed by
apparent size and by the joints' heights over the floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from understudy.apparent_size import distance_of, size_log_likelihood
from understudy.camera import Camera
from understudy.floor import Floor
from understudy.lifting import nearest_depths
from understudy.skeleton import JOINT, N_JOINTS, TORSO, rows
from understudy.standing import floor_log_likelihood
from understudy.types import Keypoints2D, RegisteredDepth

_USUAL = 2.5  # metres: the distance of a person of whom nothing tells it
# Places on the trunk: shares of (neck, right shoulder, left shoulder, right hip, left hip).
_PLACES = np.array(
    [
        [1, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1],
        [0, 0.3, 0.3, 0.2, 0.2], [0, 0.5, 0.2, 0.2, 0.1], [0, 0.2, 0.5, 0.1, 0.2], [0, 0.1, 0.1, 0.4, 0.4],
    ]
)  # fmt: skip
_AGREE = 0.22  # metres: depths of one torso lie within
_LIMBS = np.array([i for i in range(N_JOINTS) if i not in TORSO])
# Votes: of the places on the trunk, of the depth component, of the limbs (thin: what is behind them is near), of size.
_WEIGHTS = np.concatenate([np.ones(len(_PLACES)), [3.0], np.full(len(_LIMBS), 0.15), [0.25]])
_SIZE_NEAR, _SIZE_FAR = 0.45, 0.2  # least sigma of the log of depth over the depth that the apparent size asks for
_RIVAL = 0.1  # share of the winner's votes that makes a second place worth a look
_ENOUGH = 3.0  # votes; fewer do not support a place fully, even when all agree
_MOST = 3
_APART = 0.45  # metres between two places that are worth a look
_INSIDE = 0.08  # metres from the trunk's surface to its middle
_NECK_TO_CENTER = 0.25  # metres from the neck down to the middle of the trunk
_HIPS = rows("right_hip", "left_hip")


@dataclass(frozen=True)
class Root:
    """The middle of a person's trunk."""

    point: Float[np.ndarray, "3"]
    """metres, colour camera's frame"""
    support: float
    """share of the votes, 0 to 1: depths at the person that agree with it, and how credible it makes the size"""
    evidence: str
    """`depth`, or `size`: no depth was near the person that its apparent size (and the floor under it) allows"""
    floor_likelihood: Float[np.ndarray, "140"] | None = None
    """of `size`, where there is a floor: how likely the trunk is at each distance, see `standing`"""


def find_roots(
    person: Keypoints2D,
    depth: RegisteredDepth,
    camera: Camera,
    min_score: float = 0.2,
    floor: Floor | None = None,
) -> list[Root]:
    """Where the person may be, the likeliest place first; nearly always one. Empty only without 2D keypoints.

    min_score: keypoints with a lower score are not used, unless there are no others. floor: the measured one; it
    helps to place somebody whom no depth fits.
    """
    found = person.found & np.isfinite(camera.normalized(person.uv)).all(1)
    usable = found & (person.score >= min_score)
    if usable.sum() < 2:
        usable = found
    if not usable.any():
        return []
    uv = np.where(usable[:, None], person.uv, np.nan)
    ray = camera.normalized(uv)
    trunk = np.median(nearest_depths(depth, camera, _on_trunk(uv)), axis=1)
    limbs = np.median(nearest_depths(depth, camera, uv[_LIMBS]), axis=1)
    measured = np.concatenate([trunk, [person.torso_z or np.nan], limbs])
    places = _elected(measured, *_unmeasured_depth(ray))
    floor_likelihood = None
    if any(kind == "size" for *_, kind in places) and floor is not None:
        floor_likelihood = floor_log_likelihood(ray, floor)
        places = _elected(measured, *_unmeasured_depth(ray, floor_likelihood))
    if not places:  # nothing to measure the keypoints by: any depth is better than none
        values = nearest_depths(depth, camera, uv, k=1, radius=0.1)
        near = values[np.isfinite(values)]
        places = [(float(np.median(near)), 1.0, "depth") if len(near) else (_USUAL, 0.0, "size")]
    return [
        Root(
            _behind_surface(np.append(_center(ray, z) * z, z)),
            share,
            kind,
            floor_likelihood if kind == "size" else None,
        )
        for z, share, kind in places
    ]


def _behind_surface(point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return point * (1 + _INSIDE / np.linalg.norm(point))


def _on_trunk(uv: Float[np.ndarray, "18 2"]) -> Float[np.ndarray, "9 2"]:
    """Image points on the trunk; NaN where the joints that make them are missing."""
    corners = uv[TORSO]
    return np.where(_PLACES[..., None] > 0, _PLACES[..., None] * corners, 0.0).sum(1)


def _unmeasured_depth(
    ray: Float[np.ndarray, "18 2"], floor_likelihood: np.ndarray | None = None
) -> tuple[float, float]:
    """z of the trunk at the person's apparent distance, and one sigma of its log; NaN where nothing tells it.

    floor_likelihood: log likelihood of `LOG_DISTANCES` by what the floor says.
    """
    said = [likely for likely in (size_log_likelihood(ray), floor_likelihood) if likely is not None]
    if not said:
        return np.nan, np.nan
    distance, sigma = distance_of(np.sum(said, axis=0))
    torso = ray[TORSO]
    torso = torso[np.isfinite(torso).all(1)]
    middle = torso.mean(0) if len(torso) else np.nanmean(ray, axis=0)
    return distance / float(np.sqrt(1 + middle @ middle)), sigma


def _elected(measured: np.ndarray, sized: float, sigma: float) -> list[tuple[float, float, str]]:
    """The depths on which most of all agree, their share of the votes, and the evidence; the best first.

    sized: the depth at the apparent distance, with one sigma of its log.

    Each value votes for those near it. What would make the person a dwarf or a giant counts less, so that a few depths
    of an occluder or of the background do not outvote the rest, but many that agree win over a wrong size. A bone may
    look too short because it points along the view; it has no such excuse for looking too long.
    """
    values = np.append(measured, sized)
    valid = np.isfinite(values)
    chosen, weights = values[valid], _WEIGHTS[valid]
    is_measured = np.arange(len(values))[valid] < len(measured)
    credible = np.ones(len(chosen))
    if valid[-1]:
        off = np.log(chosen / values[-1])
        credible = np.exp(-0.5 * (off / np.maximum(sigma, np.where(off < 0, _SIZE_NEAR, _SIZE_FAR))) ** 2)
    near = np.abs(chosen[:, None] - chosen) < _AGREE
    votes = (near @ weights) * credible
    support = votes / max(weights.sum(), _ENOUGH)
    places: list[tuple[float, float, str]] = []
    least = _RIVAL * votes.max(initial=0)
    while len(places) < _MOST and len(votes) and votes.max() > least:
        best = int(np.argmax(votes))
        voters = near[best] & is_measured
        z = float(np.median(chosen[voters]) if voters.any() else chosen[best])
        places.append((z, float(support[best]), "depth" if voters.any() else "size"))
        votes = np.where(np.abs(chosen - places[-1][0]) < _APART, -1.0, votes)
    return places


def _center(ray: Float[np.ndarray, "18 2"], z: float) -> Float[np.ndarray, "2"]:
    """Ray (z = 1) through the middle of the trunk, from neck and hips, or from what there is of them."""
    neck, hips = ray[JOINT["neck"]], ray[_HIPS]
    hips = hips[np.isfinite(hips).all(1)]
    down = np.array([0.0, _NECK_TO_CENTER / z])
    if np.isfinite(neck).all():
        return (neck + hips.mean(0)) / 2 if len(hips) else neck + down
    if len(hips):
        return hips.mean(0) - down
    torso = ray[TORSO]
    torso = torso[np.isfinite(torso).all(1)]
    return torso.mean(0) + 0.7 * down if len(torso) else np.nanmean(ray, axis=0)
