"""Constants of the sample recording: sensors, people and file places. Metres, seconds, radians.

World frame: x to the right of the camera, y into the room, z up, floor at z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SEED = 20250
FRAMES = 12
FPS = 10.0
OUT = Path(__file__).resolve().parents[2] / "src" / "understudy" / "samples" / "room"
WORK = Path("/tmp/make_sample")

COLOR_SIZE = (960, 540)
COLOR_F, COLOR_CX, COLOR_CY = 540.7, 479.5, 269.5
DEPTH_SIZE = (512, 424)
DEPTH_F, DEPTH_CX, DEPTH_CY = 365.5, 255.5, 211.5
DEPTH_UNIT = 0.001
DEPTH_MAX = 8.0
CAMERA_HEIGHT = 1.4
CAMERA_PITCH = np.radians(8.0)
SOLE = 0.018  # thickness of every shoe's sole

JOINTS = [
    "nose",
    "neck",
    "RShoulder",
    "RElbow",
    "RWrist",
    "LShoulder",
    "LElbow",
    "LWrist",
    "RHip",
    "RKnee",
    "RAnkle",
    "LHip",
    "LKnee",
    "LAnkle",
    "REye",
    "LEye",
    "REar",
    "LEar",
]
FACE_JOINTS = (0, 14, 15, 16, 17)


def intrinsics(f: float, cx: float, cy: float) -> Array:
    """Pinhole matrix with square pixels."""
    return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])


COLOR_K = intrinsics(COLOR_F, COLOR_CX, COLOR_CY)
DEPTH_K = intrinsics(DEPTH_F, DEPTH_CX, DEPTH_CY)


def rodrigues(axis: Array, angle: float) -> Array:
    """Rotation by `angle` about `axis`."""
    a = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def color_to_world() -> Array:
    """4x4 pose of the colour camera's optical frame in the world."""
    s, c = np.sin(CAMERA_PITCH), np.cos(CAMERA_PITCH)
    pose = np.eye(4)
    pose[:3, 0] = (1, 0, 0)
    pose[:3, 1] = (0, -s, -c)
    pose[:3, 2] = (0, c, -s)
    pose[:3, 3] = (0, 0, CAMERA_HEIGHT)
    return pose


def depth_to_color() -> Array:
    """T_color_depth: 52 mm beside the colour camera and turned by 0.3 degree."""
    pose = np.eye(4)
    pose[:3, :3] = rodrigues(np.array([0.3, 1.0, 0.2]), np.radians(0.3))
    pose[:3, 3] = (0.052, -0.0005, 0.001)
    return pose


@dataclass(frozen=True)
class Person:
    """Build, colours and clothes of one person; linear RGB colours."""

    name: str
    stature: float
    phenotype: dict[str, float]
    skin: tuple[float, float, float]
    hair: tuple[float, float, float]
    eyes: tuple[float, float, float]
    lips: tuple[float, float, float]
    shirt: tuple[float, float, float]
    shirt2: tuple[float, float, float]
    pattern: str
    trousers: tuple[float, float, float]
    shoes: tuple[float, float, float]
    sleeve: float  # 0..1 down the upper arm, 1..2 down the forearm
    hair_style: str
    trouser_room: float = 1.0
    face: dict[str, float] = field(default_factory=dict)


PEOPLE = (
    Person(
        "A",
        1.78,
        {
            "gender": 0.0,
            "age": 0.70,
            "muscle": 0.55,
            "weight": 0.48,
            "proportions": 0.6,
            "cupsize": 0.5,
            "firmness": 0.5,
            "african": 0.1,
            "asian": 0.15,
            "caucasian": 0.75,
        },
        skin=(0.56, 0.31, 0.20),
        hair=(0.022, 0.013, 0.008),
        eyes=(0.10, 0.055, 0.03),
        lips=(0.42, 0.16, 0.13),
        shirt=(0.60, 0.66, 0.74),
        shirt2=(0.045, 0.12, 0.34),
        pattern="check",
        trousers=(0.20, 0.145, 0.085),
        shoes=(0.06, 0.032, 0.02),
        sleeve=1.93,
        hair_style="short",
        trouser_room=1.35,
        face={"mouthClose": 0.0, "browInnerUp": 0.1},
    ),
    Person(
        "B",
        1.66,
        {
            "gender": 1.0,
            "age": 0.70,
            "muscle": 0.42,
            "weight": 0.46,
            "proportions": 0.6,
            "cupsize": 0.45,
            "firmness": 0.6,
            "african": 0.35,
            "asian": 0.25,
            "caucasian": 0.40,
        },
        skin=(0.44, 0.225, 0.135),
        hair=(0.035, 0.016, 0.009),
        eyes=(0.06, 0.035, 0.02),
        lips=(0.38, 0.09, 0.09),
        shirt=(0.56, 0.10, 0.055),
        shirt2=(0.56, 0.10, 0.055),
        pattern="plain",
        trousers=(0.035, 0.06, 0.15),
        shoes=(0.62, 0.60, 0.57),
        sleeve=0.62,
        hair_style="bob",
        face={"mouthSmileLeft": 0.35, "mouthSmileRight": 0.35},
    ),
)
