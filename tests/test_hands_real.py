"""Palms of a real hand before a depth camera (SR305, no colour): `shared/data/lada_hand_depth`.

No truth is known. The joints were marked by hand in each picture; the palm's own plane, fitted robustly to the depth in
the middle of the palm, is the judge, which knows nothing of the network.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from understudy.camera import Camera
from understudy.hands import HandNormalEstimator
from understudy.hands.smoothing import smooth_rotations
from understudy.skeleton import JOINT, N_JOINTS
from understudy.types import Keypoints2D, Person, RegisteredDepth, RegisteredFrame

CAMERA = Camera(640, 480, np.array([[476.007, 0, 313.683], [0, 476.007, 242.755], [0, 0, 1.0]]))
UNIT = 0.000125
RECORDING = "datasets_custom_20210326-231615"
MARKS = {
    0: ((270, 342), (262, 468)), 100: ((322, 345), (328, 465)), 140: ((325, 342), (330, 462)),
    160: ((330, 342), (332, 462)), 180: ((335, 345), (340, 455)), 20: ((328, 345), (330, 435)),
    200: ((335, 345), (342, 450)), 220: ((330, 335), (312, 468)), 40: ((318, 355), (322, 450)),
    60: ((318, 355), (325, 460)), 80: ((325, 350), (328, 460)),
}  # fmt: skip
"""Frame -> wrist and a place on the forearm towards the elbow (pixels) of the raised right hand; its palm is seen."""
BODY = {"right_shoulder": (400, 310), "left_shoulder": (570, 310), "neck": (480, 295), "nose": (488, 205)}


def _at(z: np.ndarray, uv: tuple[float, float]) -> np.ndarray:
    u, v = uv
    patches = (z[max(v - r, 0) : v + r + 1, max(u - r, 0) : u + r + 1] for r in (6, 12, 24, 48))
    near = next(patch for patch in patches if (patch > 0).sum() > 20)
    return CAMERA.unproject(np.array([[float(u), float(v)]]), float(np.median(near[near > 0])) + 0.015)[0]


def _person(z: np.ndarray, wrist: tuple[int, int], below: tuple[int, int]) -> Person:
    joints = np.full((N_JOINTS, 3), np.nan)
    for name, (u, v) in BODY.items():
        joints[JOINT[name]] = _at(z, (u - 80 if wrist[0] < 300 else u, v))  # in one frame all stand aside
    joints[JOINT["right_wrist"]] = _at(z, wrist)
    arm = _at(z, below) - joints[JOINT["right_wrist"]]
    joints[JOINT["right_elbow"]] = joints[JOINT["right_wrist"]] + 0.25 * arm / np.linalg.norm(arm)
    for side, x in (("right", -0.12), ("left", 0.12)):
        joints[JOINT[f"{side}_hip"]] = joints[JOINT["neck"]] + [x, 0.5, 0.0]
    return Person(Keypoints2D(np.zeros((N_JOINTS, 2)), np.zeros(N_JOINTS)), joints, np.ones(N_JOINTS),
                  np.full(N_JOINTS, 0.02), ("observed",) * N_JOINTS)  # fmt: skip


def _plane(z: np.ndarray, person: Person) -> np.ndarray:
    """Unit normal, towards the camera, of the plane through the depths within 3.5 cm of the palm's middle."""
    wrist, elbow = person.keypoints[JOINT["right_wrist"]], person.keypoints[JOINT["right_elbow"]]
    middle = wrist + 0.055 * (wrist - elbow) / np.linalg.norm(wrist - elbow)
    v, u = np.nonzero(z > 0)
    points = CAMERA.unproject(np.column_stack([u, v]).astype(float), z[v, u].astype(float))
    aside = np.linalg.norm((points - middle)[:, :2], axis=1)
    near = points[(aside < 0.035) & (np.abs(points[:, 2] - middle[2]) < 0.06)]
    weight = np.ones(len(near))
    for _ in range(20):
        center = np.average(near, axis=0, weights=weight)
        normal = np.linalg.svd((near - center) * np.sqrt(weight)[:, None], full_matrices=False)[2][2]
        weight = 1 / (1 + ((near - center) @ normal / 0.003) ** 2)
    return -normal * np.sign(normal[2])


@pytest.fixture(scope="module")
def frames() -> list[tuple[int, RegisteredFrame, Person, np.ndarray]]:
    folder = Path(__file__).resolve().parents[2] / "shared" / "data" / "lada_hand_depth"
    if not folder.is_dir():
        pytest.skip(f"the real recording {folder} is not on this machine")
    out = []
    for number in sorted(MARKS):
        raw = cv2.imread(str(folder / f"{RECORDING}_{number}.png"), cv2.IMREAD_UNCHANGED)
        z = (raw * UNIT).astype(np.float32)
        person = _person(z, *MARKS[number])
        frame = RegisteredFrame(np.zeros((480, 640, 3), np.uint8), CAMERA, RegisteredDepth(z, CAMERA), number)
        out.append((number, frame, person, _plane(z, person)))
    return out


def test_open_palms_face_the_way_their_surface_does(frames):
    estimator = HandNormalEstimator(color=False)
    palms = [estimator.estimate(frame, person)["right"] for _, frame, person, _ in frames]
    assert all(palm is not None for palm in palms)
    error = np.degrees([np.arccos(palm.normal @ plane) for palm, (*_, plane) in zip(palms, frames, strict=True)])
    print("degrees to the palm's plane:", error.round(1), "confidence:", [round(p.confidence, 2) for p in palms])
    assert np.median(error) < 20 and error.max() < 45  # no palm is taken for a back


def test_open_palms_are_steady(frames):
    """How the estimate turns from frame to frame is how the palm's plane turns, and smoothing keeps that."""
    estimator = HandNormalEstimator(color=False)
    R = np.stack([estimator.estimate(frame, person)["right"].R_cam_hand for _, frame, person, _ in frames])
    off = np.stack([palm[:, 2] - plane for palm, (*_, plane) in zip(R, frames, strict=True)])
    assert np.degrees(off.std(axis=0)).max() < 15
    smooth = smooth_rotations(np.array([number / 30 for number, *_ in frames]), R, sigma_s=1.0)
    turns = [Rotation.from_matrix(r[:-1]).inv() * Rotation.from_matrix(r[1:]) for r in (R, smooth.R)]
    assert turns[1].magnitude().mean() < 0.7 * turns[0].magnitude().mean()
