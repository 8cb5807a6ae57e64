"""How far away a person is whom the depth camera did not measure, when it measured the floor: by how high the joints
would be over it at each distance."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from understudy.apparent_size import LOG_DISTANCES, distance_of
from understudy.floor import Floor
from understudy.skeleton import JOINTS, TORSO

HEIGHT_SIGMA: Final = 0.07
"""metres: one sigma of a joint's height about that of the most alike of the known people"""
NETWORK_SIGMA: Final = 0.06
"""of the log of the distance at which the network puts somebody whom the depth camera did not measure"""

_PARTS = ("nose", "neck", "shoulder", "hip", "knee", "ankle")
_USED = np.array([i for i, n in enumerate(JOINTS) if n.split("_")[-1] in _PARTS])
_POWER = -0.4  # heights of one person err together: n of them count as n ** (1 - 0.4)
_ELSEWHERE = 0.03 / 2  # density (1 / m) of the height of a misplaced joint
_LEAST_LEVEL = 0.2  # a camera that looks down on people more steeply sees heights too badly


def floor_log_likelihood(ray: Float[np.ndarray, "18 2"], floor: Floor) -> Float[np.ndarray, "140"] | None:
    """How likely the trunk is at each distance of `LOG_DISTANCES` (from the camera), by the joints' heights there.

    ray: x/z, y/z of the keypoints to go by; NaN for others. All joints are taken to be as far away along the floor as
    the trunk. Postures are those of a few hundred simulated people (who stand, sit, crouch, reach ...;
    `tools/make_heights.py`). None where no joint tells anything.
    """
    direction = np.concatenate([ray, np.ones((len(ray), 1))], axis=1)
    trunk = direction[TORSO]
    trunk = trunk[np.isfinite(trunk).all(1)]
    used = np.isfinite(direction[_USED]).all(1)
    if not used.any():
        return None
    middle = trunk.mean(0) if len(trunk) else direction[_USED[used]].mean(0)
    level = _level(middle[None], floor)[0] / np.linalg.norm(middle)
    joints = direction[_USED[used]]
    slope = joints @ floor.up / np.maximum(_level(joints, floor), 1e-6)
    if level < _LEAST_LEVEL:
        return None
    along = np.exp(LOG_DISTANCES) * level  # metres along the floor
    heights = along[:, None] * slope - floor.height
    off = (heights[:, None] - _known_heights()[None, :, _USED[used]]) / HEIGHT_SIGMA
    density = 0.97 * np.exp(-0.5 * off**2) / (HEIGHT_SIGMA * np.sqrt(2 * np.pi)) + _ELSEWHERE
    # densities of what is measured, the slopes: the farther away, the more metres are in an angle
    n = used.sum()
    each = np.log(density).sum(2) + n * np.log(along)[:, None]
    likely: Float[np.ndarray, "140"] = n**_POWER * logsumexp(each, axis=1)
    return likely


def stood(joints: Float[np.ndarray, "18 3"], floor_likelihood: Float[np.ndarray, "140"]) -> Float[np.ndarray, "18 3"]:
    """A person (metres, colour camera's frame) as far away as both the floor and the network say.

    floor_likelihood: `floor_log_likelihood`. The network goes by how large people are, and is told the floor, too, but
    finds its distance less well than the heights of all joints do; to its distance, `NETWORK_SIGMA` is one sigma. All
    joints move along their rays: the person grows or shrinks.
    """
    trunk = float(np.linalg.norm(joints[TORSO].mean(0)))
    distance, _ = distance_of(floor_likelihood - 0.5 * ((LOG_DISTANCES - np.log(trunk)) / NETWORK_SIGMA) ** 2)
    return joints * (distance / trunk)


def _level(points: Float[np.ndarray, "n 3"], floor: Floor) -> Float[np.ndarray, " n"]:
    """Their lengths along the floor."""
    return np.linalg.norm(points - (points @ floor.up)[..., None] * floor.up, axis=-1)


@cache
def _known_heights() -> Float[np.ndarray, "people 18"]:
    """Metres over the floor."""
    with files("understudy").joinpath("heights.npz").open("rb") as file, np.load(file) as data:
        return data["heights"].astype(np.float64)
