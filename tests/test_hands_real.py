"""Palms of a real hand before a depth camera (SR305, no colour): `shared/data/lada_hand_depth`.

No truth is known. The joints were marked by hand in each picture; the palm's own plane, fitted robustly to the depth in
the middle of the palm, is the judge, which knows nothing of the network. That palms, not backs, are seen is what the
pictures show.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from understudy.camera import Camera
from understudy.hands import HandNormalEstimator
from understudy.hands.estimator import LEAST_CONFIDENCE
from understudy.hands.smoothing import smooth_rotations
from understudy.skeleton import JOINT, N_JOINTS
from understudy.types import Keypoints2D, Person, RegisteredDepth, RegisteredFrame

CAMERA = Camera(640, 480, np.array([[476.007, 0, 313.683], [0, 476.007, 242.755], [0, 0, 1.0]]))
UNIT = 0.000125
BODY = {"right_shoulder": (400, 310), "left_shoulder": (570, 310), "neck": (480, 295), "nose": (488, 205)}
ASIDE = {name: (u - 80, v) for name, (u, v) in BODY.items()}  # in one frame all stand elsewhere


class Seen(NamedTuple):
    """One picture."""

    number: int
    frame: RegisteredFrame
    person: Person
    plane: np.ndarray
    """unit normal of the palm's own plane"""


@dataclass(frozen=True)
class Marks:
    """Where the raised right hand is, its palm seen; pixels, marked by hand in the picture."""

    wrist: tuple[int, int]
    forearm: tuple[int, int]
    """somewhere on it, towards the elbow"""
    palm: tuple[int, int] | None = None
    """its middle; None: 5.5 cm beyond the wrist, along the forearm"""
    body: Mapping[str, tuple[int, int]] = field(default_factory=lambda: BODY)
    """what else is seen of the body"""


UPRIGHT = {
    number: Marks(wrist, forearm, body=ASIDE if number == 0 else BODY)
    for number, wrist, forearm in (
        (0, (270, 342), (262, 468)), (20, (328, 345), (330, 435)), (40, (318, 355), (322, 450)),
        (60, (318, 355), (325, 460)), (80, (325, 350), (328, 460)), (100, (322, 345), (328, 465)),
        (140, (325, 342), (330, 462)), (160, (330, 342), (332, 462)), (180, (335, 345), (340, 455)),
        (200, (335, 345), (342, 450)), (220, (330, 335), (312, 468)),
    )
}  # fmt: skip
"""20210326-231615: the hand is held up and turned to and fro"""
ROUND = {
    30: Marks((343, 312), (389, 296), (307, 320),
              {"right_shoulder": (384, 149), "left_shoulder": (531, 149), "neck": (470, 100), "nose": (465, 50)}),
    50: Marks((340, 284), (413, 284), (294, 279),
              {"right_shoulder": (413, 149), "left_shoulder": (568, 149), "neck": (490, 95), "nose": (487, 50)}),
    70: Marks((328, 309), (393, 325), (312, 263),
              {"right_shoulder": (402, 173), "left_shoulder": (540, 149), "neck": (451, 108), "nose": (442, 59)}),
    90: Marks((296, 307), (341, 304), (300, 250),
              {"right_shoulder": (390, 165), "left_shoulder": (537, 149), "neck": (431, 111), "nose": (420, 67)}),
    110: Marks((237, 242), (163, 229), (302, 245),
               {"right_shoulder": (212, 188), "left_shoulder": (416, 180), "neck": (340, 160), "nose": (343, 106)}),
    130: Marks((220, 171), (136, 90), (282, 229),
               {"right_shoulder": (160, 180), "neck": (255, 155), "nose": (291, 106)}),
    150: Marks((291, 155), (247, 65), (312, 212), {"nose": (242, 139)}),
    170: Marks((325, 171), (346, 65), (276, 229), {"nose": (276, 147)}),
}  # fmt: skip
"""20210326-230536: the arm goes round, the fingers point to all sides"""


def _at(z: np.ndarray, uv: tuple[float, float]) -> np.ndarray:
    u, v = uv
    patches = (z[max(v - r, 0) : v + r + 1, max(u - r, 0) : u + r + 1] for r in (6, 12, 24, 48))
    near = next(patch for patch in patches if (patch > 0).sum() > 20)
    return CAMERA.unproject(np.array([[float(u), float(v)]]), float(np.median(near[near > 0])) + 0.015)[0]


def _person(z: np.ndarray, marks: Marks) -> Person:
    joints = np.full((N_JOINTS, 3), np.nan)
    for name, uv in marks.body.items():
        joints[JOINT[name]] = _at(z, uv)
    joints[JOINT["right_wrist"]] = _at(z, marks.wrist)
    arm = _at(z, marks.forearm) - joints[JOINT["right_wrist"]]
    joints[JOINT["right_elbow"]] = joints[JOINT["right_wrist"]] + 0.25 * arm / np.linalg.norm(arm)
    for side, x in (("right", -0.12), ("left", 0.12)):
        joints[JOINT[f"{side}_hip"]] = joints[JOINT["neck"]] + [x, 0.5, 0.0]
    return Person(Keypoints2D(np.zeros((N_JOINTS, 2)), np.zeros(N_JOINTS)), joints, np.ones(N_JOINTS),
                  np.full(N_JOINTS, 0.02), ("observed",) * N_JOINTS)  # fmt: skip


def _plane(z: np.ndarray, person: Person, palm: tuple[int, int] | None) -> np.ndarray:
    """Unit normal, towards the camera, of the plane through the depths within 3.5 cm of the palm's middle."""
    wrist, elbow = person.keypoints[JOINT["right_wrist"]], person.keypoints[JOINT["right_elbow"]]
    middle = wrist + 0.055 * (wrist - elbow) / np.linalg.norm(wrist - elbow) if palm is None else _at(z, palm)
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


def _frames(recording: str, marks: Mapping[int, Marks]) -> list[Seen]:
    folder = Path(__file__).resolve().parents[2] / "shared" / "data" / "lada_hand_depth"
    if not folder.is_dir():
        pytest.skip(f"the real recording {folder} is not on this machine")
    out = []
    for number, each in sorted(marks.items()):
        raw = cv2.imread(str(folder / f"datasets_custom_{recording}_{number}.png"), cv2.IMREAD_UNCHANGED)
        z = (raw * UNIT).astype(np.float32)
        person = _person(z, each)
        frame = RegisteredFrame(np.zeros((480, 640, 3), np.uint8), CAMERA, RegisteredDepth(z, CAMERA), number)
        out.append(Seen(number, frame, person, _plane(z, person, each.palm)))
    return out


@pytest.fixture(scope="module")
def upright() -> list[Seen]:
    return _frames("20210326-231615", UPRIGHT)


def _errors(seen: list[Seen], least_confidence: float = LEAST_CONFIDENCE) -> np.ndarray:
    """Degrees between each palm's normal and its plane; all palms must be there."""
    estimator = HandNormalEstimator(color=False, least_confidence=least_confidence)
    palms = [estimator.estimate(each.frame, each.person)["right"] for each in seen]
    assert all(palm is not None for palm in palms)
    error = np.degrees([np.arccos(palm.normal @ each.plane) for palm, each in zip(palms, seen, strict=True)])
    print("degrees to the palm's plane:", error.round(1), "confidence:", [round(p.confidence, 2) for p in palms])
    return error


def test_open_palms_face_the_way_their_surface_does(upright):
    error = _errors(upright)
    assert np.median(error) < 20 and error.max() < 45  # no palm is taken for a back


def test_open_palms_whose_fingers_point_to_all_sides():
    """Also the least sure ones. Of two, whose forearms point at the camera, the back is believed to be seen."""
    error = _errors(_frames("20210326-230536", ROUND), least_confidence=0)
    assert np.median(error) < 20 and np.sort(error)[-3] < 20


def test_open_palms_are_steady(upright):
    """The estimate keeps its distance to the palm's plane from frame to frame, and smoothing calms it."""
    estimator = HandNormalEstimator(color=False)
    R = np.stack([estimator.estimate(each.frame, each.person)["right"].R_cam_hand for each in upright])
    off = np.stack([palm[:, 2] - each.plane for palm, each in zip(R, upright, strict=True)])
    print("degrees of the normal off the plane, sigma along each axis:", np.degrees(off.std(axis=0)).round(1))
    assert np.degrees(off.std(axis=0)).max() < 15
    smooth = smooth_rotations(np.array([each.number / 30 for each in upright]), R, sigma_s=1.0)
    turns = [Rotation.from_matrix(r[:-1]).inv() * Rotation.from_matrix(r[1:]) for r in (R, smooth.R)]
    assert turns[1].magnitude().mean() < 0.7 * turns[0].magnitude().mean()
