"""The data that flows through the system, in the order in which it flows. Frozen; frames, units: CONVENTIONS.md."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, UInt8

from understudy.camera import Camera, RGBDCamera, check_registered
from understudy.errors import FrameError, UnderstudyError
from understudy.skeleton import JOINT, N_JOINTS

OBSERVED, INFERRED, MISSING = "observed", "inferred", "missing"
"""Values of `Person.source`."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment of an RGB-D camera, as the sensor gives it."""

    color: UInt8[np.ndarray, "h w 3"]
    """RGB"""
    depth: Float32[np.ndarray, "hd wd"]
    """z in metres in the depth camera's pixels; 0 = no measurement"""
    camera: RGBDCamera
    index: int = 0
    """number of the frame in its recording"""
    timestamp_s: float | None = None
    """seconds on the recording's clock; None where it has none"""

    def __post_init__(self) -> None:
        c, d = self.camera.color, self.camera.depth
        if self.color.dtype != np.uint8 or self.color.shape != (c.height, c.width, 3):
            raise FrameError(
                f"frame {self.index}: color must be 8-bit RGB of shape {(c.height, c.width, 3)} as its camera says, "
                f"got {self.color.dtype} {self.color.shape}"
            )
        if self.depth.dtype != np.float32 or self.depth.shape != (d.height, d.width):
            raise FrameError(
                f"frame {self.index}: depth must be float32 metres of shape {(d.height, d.width)} as its camera says, "
                f"got {self.depth.dtype} {self.depth.shape}"
            )
        if self.timestamp_s is not None:
            object.__setattr__(self, "timestamp_s", float(self.timestamp_s))
            if not np.isfinite(self.timestamp_s):
                raise FrameError(f"frame {self.index}: timestamp_s must be a finite number of seconds or None")
        if not np.isfinite(self.depth).all() or (self.depth.size and self.depth.min() < 0):
            raise FrameError(f"frame {self.index}: depth holds NaN, infinite or negative values; 'no measurement' is 0")


@dataclass(frozen=True, eq=False)
class RegisteredDepth:
    """Depth in the colour camera's frame and pixels (up to a uniform scale). Making one states that it is so."""

    z: Float32[np.ndarray, "hd wd"]
    """metres along the colour camera's z; 0 = no measurement; may be sparse"""
    camera: Camera
    """the colour camera, resized to the depth image"""

    def __post_init__(self) -> None:
        if self.z.dtype != np.float32 or self.z.shape != (self.camera.height, self.camera.width):
            raise FrameError(
                f"registered depth must be float32 metres of shape ({self.camera.height}, {self.camera.width}) as its "
                f"camera says, got {self.z.dtype} {self.z.shape}"
            )

    def scale_to(self, color: Camera) -> float:
        """Depth pixels per colour pixel."""
        return self.camera.width / color.width


@dataclass(frozen=True, eq=False)
class RegisteredFrame:
    """Colour and depth that share one viewpoint. `understudy.registration.register` makes it from a `Frame`."""

    color: UInt8[np.ndarray, "h w 3"]
    """RGB"""
    camera: Camera
    """the colour camera"""
    depth: RegisteredDepth
    index: int = 0
    timestamp_s: float | None = None

    def __post_init__(self) -> None:
        if self.color.dtype != np.uint8 or self.color.shape != (self.camera.height, self.camera.width, 3):
            raise FrameError(
                f"frame {self.index}: color must be 8-bit RGB of shape {(self.camera.height, self.camera.width, 3)} "
                f"as its camera says, got {self.color.dtype} {self.color.shape}"
            )
        check_registered(self.camera, self.depth.camera)


@dataclass(frozen=True, eq=False)
class Keypoints2D:
    """One person's keypoints in the colour image."""

    uv: Float[np.ndarray, "18 2"]
    """colour pixels; (0, 0) where not found"""
    score: Float[np.ndarray, "18"]
    """in [0, 1]; 0 where not found"""
    torso_z: float | None = None
    """metres: depth of the person's torso surface, where the detector saw one"""

    def __post_init__(self) -> None:
        if self.uv.shape != (N_JOINTS, 2) or self.score.shape != (N_JOINTS,):
            raise UnderstudyError(
                "2D keypoints are uv of shape (18, 2) and score of shape (18,), "
                f"got {self.uv.shape} and {self.score.shape}"
            )
        if not np.isfinite(self.uv).all() or not ((self.score >= 0) & (self.score <= 1)).all():
            raise UnderstudyError("2D keypoints must be finite, and their scores in [0, 1]")

    @property
    def found(self) -> np.ndarray:
        """Which joints have a 2D position; shape (18,), bool."""
        return self.score > 0

    @classmethod
    def from_rows(cls, rows: Float[np.ndarray, "18 3"]) -> Keypoints2D:
        """From rows (u, v, score); a score of 0 (or less) means not found."""
        return cls.where(rows[:, :2], rows[:, 2])

    @classmethod
    def where(cls, uv: np.ndarray, score: np.ndarray, torso_z: float | None = None) -> Keypoints2D:
        """Keypoints from any numbers: scores are clipped to [0, 1]; a joint that has no score or no finite position
        counts as not found.
        """
        finite = np.isfinite(uv).all(axis=1) & np.isfinite(score)
        clipped = np.where(finite, np.clip(np.nan_to_num(score), 0.0, 1.0), 0.0).astype(np.float64)
        return cls(np.where(clipped[:, None] > 0, uv, 0.0).astype(np.float64), clipped, torso_z)

    def rows(self) -> Float[np.ndarray, "18 3"]:
        """Rows (u, v, score)."""
        return np.column_stack([self.uv, self.score])


@dataclass(frozen=True, eq=False)
class Palm:
    """Which way a palm faces, and the hand around it; colour camera's frame."""

    normal: Float[np.ndarray, "3"]
    """unit vector out of the palm"""
    confidence: float
    """probability that the normal is within 30 degrees of the truth"""
    direction: Float[np.ndarray, "3"] | None = None
    """unit vector from the wrist to the middle finger's knuckle"""
    keypoints: Float[np.ndarray, "21 3"] | None = None
    """metres, in the order of `skeleton.HAND_KEYPOINTS`; NaN rows where no measurement supports them"""
    keypoints_2d: Float[np.ndarray, "21 3"] | None = None
    """u, v (colour pixels), score in [0, 1]"""

    def __post_init__(self) -> None:
        assert self.normal.shape == (3,)
        assert self.direction is None or self.direction.shape == (3,)

    @property
    def R_cam_hand(self) -> Float[np.ndarray, "3 3"] | None:
        """Rotation of the hand frame: z out of the palm, x towards the fingers, y = z x x; None without a direction.

        The same for both hands: a right hand's thumb is at -y, a left one's at +y.
        """
        if self.direction is None:
            return None
        across = np.cross(self.normal, self.direction)
        length = np.linalg.norm(across)
        if length < 1e-6:  # the two are parallel
            return None
        y = across / length
        return np.column_stack([np.cross(y, self.normal), y, self.normal])


class Wrist(NamedTuple):
    """Where the look at a hand found its wrist."""

    position: Float[np.ndarray, "3"]
    """metres, colour camera's frame"""
    sigma_m: float
    """as `Person.sigma_m`"""
    confidence: float
    """as `Person.confidence`"""


@dataclass(frozen=True, eq=False)
class Hands(Mapping[str, "Palm | None"]):
    """A person's palms: a mapping from 'left' and 'right'."""

    left: Palm | None = None
    right: Palm | None = None
    why: Mapping[str, str] = field(default_factory=dict)
    """side -> why there is no palm; empty where hands were not looked at"""
    wrists: Mapping[str, Wrist] = field(default_factory=dict)
    """side -> the wrist, of hands that were looked at, also of those without a palm; not part of files"""

    def __getitem__(self, side: str) -> Palm | None:
        if side not in ("left", "right"):
            raise KeyError(side)
        palm: Palm | None = getattr(self, side)
        return palm

    def __iter__(self) -> Iterator[str]:
        return iter(("left", "right"))

    def __len__(self) -> int:
        return 2


@dataclass(frozen=True, eq=False)
class Person:
    """One person in one frame, in the colour camera's frame."""

    keypoints_2d: Keypoints2D
    keypoints: Float[np.ndarray, "18 3"]
    """metres; NaN rows where the method cannot give a joint"""
    confidence: Float[np.ndarray, "18"]
    """probability that the joint is within 10 cm of the truth; 0 where missing"""
    sigma_m: Float[np.ndarray, "18"]
    """one sigma of the position, metres: the ball of this radius holds the truth with 68 %; NaN where missing"""
    source: tuple[str, ...]
    """per joint: observed, inferred or missing"""
    id: int = 0
    """stays with the person through a recording"""
    hands: Mapping[str, Palm | None] = field(default_factory=Hands)
    failed: str | None = None
    """why a detected person has no 3D keypoints at all; None when there are some"""

    def __post_init__(self) -> None:
        assert self.keypoints.shape == (N_JOINTS, 3) and len(self.source) == N_JOINTS

    @classmethod
    def failure(cls, keypoints_2d: Keypoints2D, why: str) -> Person:
        """A person who was detected but could not be lifted."""
        nothing = np.full(N_JOINTS, np.nan)
        return cls(
            keypoints_2d,
            np.full((N_JOINTS, 3), np.nan),
            np.zeros(N_JOINTS),
            nothing,
            (MISSING,) * N_JOINTS,
            failed=why,
        )

    def with_id(self, id: int) -> Person:
        return replace(self, id=id)

    def with_hands(self, hands: Hands) -> Person:
        return replace(self, hands=hands)

    def with_wrists(self, wrists: Mapping[str, Wrist]) -> Person:
        """The same with the wrists ('left', 'right') that are surer than the skeleton's, of those that are observed:
        of a hidden one a look at the hand says nothing new.
        """
        surer = {
            JOINT[f"{side}_wrist"]: wrist
            for side, wrist in wrists.items()
            if wrist.sigma_m < self.sigma_m[JOINT[f"{side}_wrist"]] and self.source[JOINT[f"{side}_wrist"]] == OBSERVED
        }
        if not surer:
            return self
        keypoints, sure, sigma = self.keypoints.copy(), self.confidence.copy(), self.sigma_m.copy()
        for row, wrist in surer.items():
            keypoints[row], sigma[row], sure[row] = wrist.position, wrist.sigma_m, wrist.confidence
        return replace(self, keypoints=keypoints, confidence=sure, sigma_m=sigma)
