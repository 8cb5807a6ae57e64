"""The network's joints and the 2D keypoints become one skeleton. Each way of doing so is a function of ASSEMBLIES."""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType
from typing import Final

import numpy as np
from jaxtyping import Float, Float32

from understudy.skeleton import JOINT, N_JOINTS
from understudy.voxelposenet.predictor import Prediction
from understudy.voxels import PersonView

_SIGMA_2D = 0.04  # metres at the person: of a 2D keypoint with full score
_SIGMA_UNSURE = 0.1  # more, for a score of 0
_GATE = 0.8  # standard deviations beyond which 2D and network do not speak of the same place

_LIMBS = (("shoulder", "elbow", 0.282), ("elbow", "wrist", 0.26), ("hip", "knee", 0.403), ("knee", "ankle", 0.412))
_ENDS = np.array([[JOINT[f"{s}_{a}"], JOINT[f"{s}_{b}"]] for a, b, _ in _LIMBS for s in ("right", "left")])
_LENGTHS = np.array([length for *_, length in _LIMBS for _ in "rl"])  # metres, mean of adults (ANSUR II)
_SIGMA_LENGTH = 0.12  # share of its length by which a bone differs from the mean
_SIGMA_SIDES = 0.03  # share by which a bone differs from the other side's
_SPREAD = 0.3  # the distribution's spread over the error's sigma that it stands for
_ROUNDS = 4
_LONGEST_STEP = 0.15  # metres

Rows = Float32[np.ndarray, "18 3"]
"""2D keypoints as the network gets them: x, y (metres, view coordinates), score; zeros where not found"""
Joints = Float[np.ndarray, "18 3"]
"""view coordinates, metres"""


def of_network(said: Prediction, rows: Rows, view: PersonView) -> Joints:
    """The network's joints as they are."""
    return said.joints


def of_paper(said: Prediction, rows: Rows, view: PersonView) -> Joints:
    """The paper's rule: the 2D keypoint at the network's depth, where its score exceeds the network's confidence."""
    out = said.joints.copy()
    use = rows[:, 2] > said.confidence
    out[use, :2] = rows[use, :2]
    return out


def by_uncertainty(said: Prediction, rows: Rows, view: PersonView) -> Joints:
    """The network's joint, drawn to the 2D keypoint as far as each is sure of itself and the camera sees the joint (of
    a hidden one the keypoint is a guess, which the network has weighed), and to bones of human length.
    """
    network = said.spread[:, :2].mean(1)
    keypoint = _SIGMA_2D + _SIGMA_UNSURE * (1 - rows[:, 2].astype(np.float64)) ** 2
    gap = rows[:, :2] - said.joints[:, :2]
    agree = (rows[:, 2] > 0) & (np.linalg.norm(gap, axis=1) < _GATE * np.hypot(network, keypoint))
    share = said.seen * np.where(agree, network**2 / (network**2 + keypoint**2), 0.0)
    fused = said.joints.copy()
    fused[:, :2] += share[:, None] * gap
    spread = said.spread.copy()
    spread[:, :2] *= np.sqrt(1 - share)[:, None]
    return view.from_view_frame(with_human_bones(view.to_view_frame(fused), _SPREAD * spread))


def with_human_bones(joints: Float[np.ndarray, "18 3"], sigma: Float[np.ndarray, "18 3"]) -> Float[np.ndarray, "18 3"]:
    """The most likely skeleton, of joints that are known up to `sigma` and bones that are about as long as humans'.

    joints, sigma: metres, one sigma along each axis. The mean over a joint's possible places lies between them, so a
    limb whose depth is unsure comes out too short; unsure joints give way until arms and legs have their lengths and
    the two sides are alike. Gauss-Newton on the squared deviations.
    """
    certainty = 1 / np.maximum(sigma, 0.01) ** 2
    x = joints.copy()
    diagonal = np.diag(certainty.ravel())
    for _ in range(_ROUNDS):
        residual, jacobian = _bones(x)
        normal = diagonal + jacobian.T @ jacobian
        gradient = (certainty * (joints - x)).ravel() - jacobian.T @ residual
        step = np.linalg.solve(normal, gradient).reshape(x.shape)
        x = x + step.clip(-_LONGEST_STEP, _LONGEST_STEP)
    return x


def _bones(x: Float[np.ndarray, "18 3"]) -> tuple[Float[np.ndarray, "12"], Float[np.ndarray, "12 54"]]:
    """How far bones are from their mean lengths, and from the other side's, in sigmas; and the derivatives."""
    bone = x[_ENDS[:, 0]] - x[_ENDS[:, 1]]
    length = np.maximum(np.linalg.norm(bone, axis=1), 0.02)
    along = bone / length[:, None]
    n = len(_ENDS)
    ends = np.zeros((n, N_JOINTS, 3))
    row = np.arange(n)
    ends[row, _ENDS[:, 0]] = along
    ends[row, _ENDS[:, 1]] = -along
    slope = ends.reshape(n, -1)
    sides = _SIGMA_SIDES * _LENGTHS[::2]
    residual = [(length - _LENGTHS) / (_SIGMA_LENGTH * _LENGTHS), (length[::2] - length[1::2]) / sides]
    jacobian = [slope / (_SIGMA_LENGTH * _LENGTHS)[:, None], (slope[::2] - slope[1::2]) / sides[:, None]]
    return np.concatenate(residual), np.concatenate(jacobian)


Assembly = Callable[[Prediction, Rows, PersonView], Joints]
ASSEMBLIES: Final = MappingProxyType[str, Assembly](
    {"uncertainty": by_uncertainty, "paper": of_paper, "network": of_network}
)
"""Name -> how the network's joints and the 2D keypoints become one; view coordinates."""
