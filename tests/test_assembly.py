"""The network's joints and the 2D keypoints become one skeleton."""

import numpy as np
import pytest

from understudy.assembly import ASSEMBLIES, by_uncertainty, of_network, of_paper, with_human_bones
from understudy.assembly import _bones as bones
from understudy.skeleton import JOINT, JOINTS, N_JOINTS
from understudy.voxelposenet.predictor import Prediction
from understudy.voxels import PersonView

VIEW = PersonView(np.eye(3), 3.0)
LENGTHS = {"shoulder_elbow": 0.282, "elbow_wrist": 0.26, "hip_knee": 0.403, "knee_ankle": 0.412}


def standing() -> np.ndarray:
    """A person with mean bones who stands 3 m before the camera, arms hanging; metres, view's frame."""
    x = np.zeros((N_JOINTS, 3))
    for sign, side in ((-1, "right"), (1, "left")):
        for names, half, top in ((("shoulder", "elbow", "wrist"), 0.18, -0.4), (("hip", "knee", "ankle"), 0.1, 0.1)):
            y = top
            for a, b in zip(names, (*names[1:], ""), strict=True):
                x[JOINT[f"{side}_{a}"]] = (sign * half, y, 0)
                y += LENGTHS.get(f"{a}_{b}", 0)
        for name, half in (("eye", 0.03), ("ear", 0.08)):
            x[JOINT[f"{side}_{name}"]] = (sign * half, -0.7, 0)
    x[JOINT["neck"]], x[JOINT["nose"]] = (0, -0.4, 0), (0, -0.67, -0.1)
    return x + (0, 0, 3.0)


def said(joints: np.ndarray, spread: float | np.ndarray = 0.05, confidence: float = 0.8) -> Prediction:
    ones = np.ones(N_JOINTS)
    return Prediction(
        VIEW.from_view_frame(joints), np.ones((N_JOINTS, 3)) * spread, 0.1 * ones, confidence * ones, ones
    )


def rows(joints: np.ndarray, score: float = 0.9) -> np.ndarray:
    return np.column_stack([VIEW.from_view_frame(joints)[:, :2], np.full(N_JOINTS, score)]).astype(np.float32)


def test_a_sound_skeleton_stays():
    x = standing()
    for assemble in ASSEMBLIES.values():
        out = VIEW.to_view_frame(assemble(said(x), rows(x), VIEW))
        np.testing.assert_allclose(out, x, atol=1e-4)


def test_an_unsure_wrist_gives_way_until_the_forearm_is_long_enough():
    x = standing()
    short = x.copy()
    short[JOINT["left_wrist"]] = x[JOINT["left_elbow"]] + (0, 0.1, 0.02)
    sigma = np.full((N_JOINTS, 3), 0.01)
    sigma[JOINT["left_wrist"]] = 0.2
    out = with_human_bones(short, sigma)
    length = np.linalg.norm(out[JOINT["left_wrist"]] - out[JOINT["left_elbow"]])
    assert length == pytest.approx(0.26, abs=0.02)
    others = [i for i, name in enumerate(JOINTS) if name != "left_wrist"]
    assert np.abs(out - short)[others].max() < 0.01
    sure = with_human_bones(short, np.full((N_JOINTS, 3), 0.01))
    assert np.abs(sure - short).max() < 0.06 < 0.1 < np.abs(out - short).max()  # who is sure of a joint keeps it


def test_derivatives_of_the_bones():
    rng = np.random.default_rng(0)
    x = standing() + 0.05 * rng.normal(size=(N_JOINTS, 3))
    _, jacobian = bones(x)
    numeric = np.empty_like(jacobian)
    for i in range(x.size):
        step = np.zeros(x.size)
        step[i] = 1e-6
        numeric[:, i] = (bones(x + step.reshape(x.shape))[0] - bones(x - step.reshape(x.shape))[0]) / 2e-6
    np.testing.assert_allclose(jacobian, numeric, atol=1e-5)


def test_papers_rule_takes_the_ray_of_the_better_score():
    x = standing()
    seen = rows(x + (0.1, 0, 0), score=0.9)
    seen[JOINT["nose"], 2] = 0.5
    out = of_paper(said(x, confidence=0.8), seen, VIEW)
    np.testing.assert_allclose(out[:, 2], said(x).joints[:, 2])  # the network's depth
    moved = np.linalg.norm(out - said(x).joints, axis=1) > 0.05
    assert not moved[JOINT["nose"]] and moved.sum() == N_JOINTS - 1
    np.testing.assert_array_equal(of_network(said(x), seen, VIEW), said(x).joints)


def test_keypoints_count_as_far_as_they_are_sure_and_agree():
    x = standing()
    wrist = JOINT["right_wrist"]

    def shift(by: float, spread: float, score: float) -> float:
        seen = rows(x, score=0.0)
        seen[wrist] = (*VIEW.from_view_frame(x[wrist] + (by, 0, 0))[:2], score)
        return float(
            (by_uncertainty(said(x, spread), seen, VIEW) - by_uncertainty(said(x, spread), 0 * seen, VIEW))[wrist, 0]
        )

    assert shift(0.05, 0.1, 1.0) > 1.4 * shift(0.05, 0.1, 0.3) > 0  # a lower score, a weaker pull
    assert shift(0.05, 0.1, 1.0) > 1.5 * shift(0.05, 0.04, 1.0)  # a surer network, too
    assert shift(0.5, 0.1, 1.0) == 0  # they speak of different places
