"""How far away a person is, by how long their bones look: what is left where a depth camera measured nothing."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.special import softmax

from understudy.skeleton import JOINT

DISTANCES: Final = (0.5, 8.0)
"""metres: of people from the camera"""

_LENGTHS: Final = {
    ("right_shoulder", "left_shoulder"): (0.28, 0.25, 0.40),
    ("neck", "right_hip"): (0.43, 0.18, 0.25),
    ("neck", "left_hip"): (0.43, 0.18, 0.25),
    ("right_hip", "left_hip"): (0.21, 0.30, 0.40),
    ("right_shoulder", "right_elbow"): (0.27, 0.20, 0.30),
    ("left_shoulder", "left_elbow"): (0.27, 0.20, 0.30),
    ("right_elbow", "right_wrist"): (0.245, 0.22, 0.35),
    ("left_elbow", "left_wrist"): (0.245, 0.22, 0.35),
    ("right_hip", "right_knee"): (0.38, 0.20, 0.30),
    ("left_hip", "left_knee"): (0.38, 0.20, 0.30),
    ("right_knee", "right_ankle"): (0.39, 0.20, 0.30),
    ("left_knee", "left_ankle"): (0.39, 0.20, 0.30),
    ("right_ear", "left_ear"): (0.13, 0.30, 0.60),
    ("right_eye", "left_eye"): (0.064, 0.30, 0.40),
    ("right_eye", "right_ear"): (0.094, 0.30, 0.40),
    ("left_eye", "left_ear"): (0.094, 0.30, 0.40),
    ("neck", "nose"): (0.215, 0.25, 0.40),
    ("neck", "right_ear"): (0.205, 0.25, 0.30),
    ("neck", "left_ear"): (0.205, 0.25, 0.30),
}
"""Of the length that a bone shows across the line of sight: the likeliest (metres), and how fast others become unlikely
in the log: one sigma of a Gaussian above, the decay of an exponential below (a bone that points along the view looks
short, none looks long). Fitted to the detections of 1 800 simulated people (`understudy.synthetic`)."""

_ENDS = np.array([[JOINT[a], JOINT[b]] for a, b in _LENGTHS])
_MODE, _ABOVE, _BELOW = np.array(list(_LENGTHS.values())).T
_MODE = 0.95 * _MODE  # jitter lengthens bones; that of the fit was more than BlazePose's, and than no jitter at all
_NORM = _ABOVE * np.sqrt(np.pi / 2) + _BELOW
_WRONG = 0.03 / 4  # density of a bone with a misplaced end
_POWER = -0.4  # bones of one person err together: n of them count as n ** (1 - 0.4)
LOG_DISTANCES: Final = np.linspace(np.log(DISTANCES[0]), np.log(DISTANCES[1]), 140)
"""where likelihoods of a distance are tabulated: logarithms of metres"""


def distance_of_size(ray: Float[np.ndarray, "18 2"]) -> tuple[float, float] | None:
    """Metres from the camera to a person, from the keypoints' rays (x/z, y/z; NaN where not found), and one sigma of
    its logarithm.

    Mean and standard deviation of the posterior of the log distance, all distances of `DISTANCES` being equally likely
    before. None where no bone has both ends. On simulated detections of most of the body, off by 12 % (one sigma).
    """
    likely = size_log_likelihood(ray)
    return None if likely is None else distance_of(likely)


def distance_of(log_likelihood: Float[np.ndarray, "140"]) -> tuple[float, float]:
    """Metres at the mean of the log distance, and one sigma of its logarithm; given at `LOG_DISTANCES`."""
    share = softmax(log_likelihood)
    mean = (share * LOG_DISTANCES).sum()
    return float(np.exp(mean)), float(np.sqrt((share * (LOG_DISTANCES - mean) ** 2).sum()))


def size_log_likelihood(ray: Float[np.ndarray, "18 2"]) -> Float[np.ndarray, "140"] | None:
    """How likely the bones look as they do from each of `LOG_DISTANCES`; None where no bone has both ends.

    ray: as for `distance_of_size`.
    """
    direction = np.concatenate([ray, np.ones((len(ray), 1))], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    angle = np.linalg.norm(direction[_ENDS[:, 0]] - direction[_ENDS[:, 1]], axis=1)
    ok = angle > 0  # False for NaN
    if not ok.any():
        return None
    off = np.log(angle[ok])[:, None] + LOG_DISTANCES - np.log(_MODE[ok])[:, None]
    density = np.exp(np.where(off > 0, -0.5 * (off / _ABOVE[ok, None]) ** 2, off / _BELOW[ok, None]))
    density /= _NORM[ok, None]
    likely: Float[np.ndarray, "140"] = ok.sum() ** _POWER * np.log(0.97 * density + _WRONG).sum(0)
    return likely
