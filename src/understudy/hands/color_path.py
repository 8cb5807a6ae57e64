"""Palm normals from the colour image: a palm is looked for at each wrist, then its joints are read in several crops.

The body says where a hand is, how large, and whether it is the left or the right one; the networks, how it is turned.
A flat, dim or half hidden hand shows as crops that disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.special import expit

from understudy.apparent_size import distance_of_size
from understudy.camera import Camera
from understudy.detectors.blazepose_nets import Region
from understudy.hands.nets import (
    HAND_SIZE,
    INDEX,
    MIDDLE,
    PALM_SIZE,
    PALM_WRIST,
    PINKY,
    WRIST,
    HandLandmarks,
    HandNets,
    palm_region,
)
from understudy.skeleton import JOINT
from understudy.types import Person, RegisteredFrame
from understudy.voxels import rotation_to

SIDES: Final = ("left", "right")

_WINDOW = 0.43  # metres: side of the square in which a palm is looked for, of an adult
_BEYOND = 0.06  # metres: from the wrist to its centre
_REACH = 0.11  # metres: farthest that a hand's wrist is from the body's
_LIMBS = {("shoulder", "elbow"): 0.28, ("elbow", "wrist"): 0.25, ("hip", "knee"): 0.40, ("knee", "ankle"): 0.40}
_SCALES = (0.6, 1.15)  # of bodies
_SHORT = 0.3  # a forearm that looks shorter than this share of its length has no direction in the image
_HAND = 0.19  # metres: an adult's hand
_SCORE = 0.2  # least score of a 2D keypoint that is used
_TOGETHER = np.radians(60)  # crops that agree


@dataclass(frozen=True, eq=False)
class ColorPalm:
    """What the colour image says of one palm, in the colour camera's frame."""

    normal: Float[np.ndarray, "3"]
    """unit vector out of the palm"""
    direction: Float[np.ndarray, "3"]
    """unit vector from the wrist to the middle knuckle"""
    spread: float
    """radians: RMS angle of the crops' normals to `normal`; says little where `share` is small"""
    presence: float
    """mean probability that there is a hand"""
    keypoints_2d: Float[np.ndarray, "21 3"]
    """u, v (colour pixels), score; in MediaPipe's order"""
    shape: Float[np.ndarray, "21 3"]
    """metres, camera axes, relative to the wrist"""
    share: float
    """fraction of the crops in which the hand was found and that agree"""
    side_probability: float
    """what the network gives the side (left or right) that the body says; evidence only"""
    pixels: float
    """of an adult's hand at this place"""

    @property
    def quality(self) -> float:
        """About the probability that the normal is within 30 degrees; a logistic fit to rendered hands."""
        size, spread = np.log(self.pixels / 40), np.log(np.degrees(self.spread) / 10 + 0.1)
        word = 2.85 * self.presence + 2.05 * self.share + 3.06 * self.side_probability
        return float(expit(-5.17 + 0.52 * size - 0.28 * spread + word))


@dataclass(frozen=True)
class HandPlace:
    """Where the body says that a hand is."""

    wrist: tuple[float, float]
    """pixels"""
    metre: float
    """pixels a metre at the wrist"""
    scale: float
    """of the body; an adult has 1"""
    window: Region
    """where to look for the palm; the forearm comes from below"""

    @property
    def reach(self) -> float:
        """Farthest that the hand's wrist is from the body's, pixels."""
        return _REACH * self.scale * self.metre


def hand_place(camera: Camera, person: Person, side: str) -> HandPlace | None:
    """The place of a hand; None where the wrist is unknown or outside the image."""
    elbow, wrist = _forearm(camera, person, side)
    scale = body_scale(person)
    uv = camera.project(np.stack([elbow, wrist]))
    if not camera.contains(uv)[1]:
        return None
    metre = camera.fx / float(wrist[2])
    along = wrist - elbow
    center, angle = uv[1], 0.0
    if np.isfinite(uv[0]).all():
        forearm = uv[1] - uv[0]
        if np.linalg.norm(forearm) > _SHORT * np.linalg.norm(along) * metre:
            angle = float(np.arctan2(forearm[0], -forearm[1]))
        center = camera.project(wrist + _BEYOND * scale * along / max(float(np.linalg.norm(along)), 1e-6))
        center = center if np.isfinite(center).all() else uv[1]
    window = Region((float(center[0]), float(center[1])), _WINDOW * scale * metre, angle)
    return HandPlace((float(uv[1, 0]), float(uv[1, 1])), metre, scale, window)


def _forearm(camera: Camera, person: Person, side: str) -> Float[np.ndarray, "2 3"]:
    """Elbow and wrist, metres; of a joint without a 3D position, the 2D one at the wrist's or the body's distance."""
    rows = [JOINT[f"{side}_elbow"], JOINT[f"{side}_wrist"]]
    points = person.keypoints[rows].copy()
    missing = np.isnan(points).any(1)
    if missing.any():
        keypoints = person.keypoints_2d
        usable = keypoints.score > _SCORE
        rays = np.where(usable[:, None], camera.normalized(keypoints.uv), np.nan)
        z = float(points[1, 2])
        if np.isnan(z):
            found = distance_of_size(rays)
            z = found[0] if found else np.nan
        at = np.column_stack([rays[rows] * z, np.full(2, z)])
        points = np.where(missing[:, None], at, points)
    return points


def body_scale(person: Person) -> float:
    """Size of the body's limbs relative to an adult's; 1 where nothing is known."""
    ratios = []
    for (a, b), length in _LIMBS.items():
        ends = [[JOINT[f"{side}_{a}"], JOINT[f"{side}_{b}"]] for side in SIDES]
        ratios += (np.linalg.norm(np.diff(person.keypoints[ends], axis=1)[:, 0], axis=1) / length).tolist()
    known = [r for r in ratios if np.isfinite(r)]
    return float(np.clip(np.median(known), *_SCALES)) if known else 1.0


def jittered(region: Region, n: int) -> list[Region]:
    """n regions around one, always the same: shifted (4 % of the side), scaled (12 %), turned (15 degrees).

    The first is the region itself.
    """
    steps = (np.arange(n)[:, None] * (0.8567, 0.7339, 0.6287, 0.5386) + 0.5) % 1 * 2 - 1  # an even cover of the cube
    c, s = np.cos(region.angle), np.sin(region.angle)
    shifts = 0.04 * region.size * steps[:, :2] @ np.array([[c, s], [-s, c]])
    sizes, turns = region.size * np.exp(0.12 * steps[:, 2]), 0.26 * steps[:, 3]
    return [
        Region((region.center[0] + float(dx), region.center[1] + float(dy)), float(size), region.angle + float(turn))
        for (dx, dy), size, turn in zip(shifts, sizes, turns, strict=True)
    ]


class ColorPath:
    """Palm normals of a person from the colour image."""

    def __init__(self, nets: HandNets, crops: int = 2, min_presence: float = 0.5):
        """crops: of each hand, half of them mirrored. min_presence: least probability that a crop holds a hand."""
        self.crops, self.min_presence, self._nets = crops, min_presence, nets

    def estimate(
        self, frame: RegisteredFrame, person: Person, sides: Sequence[str] = SIDES
    ) -> dict[str, ColorPalm | None]:
        """'left', 'right' -> palm; None where no hand was found at the wrist, or none was looked for (`sides`)."""
        places = {side: hand_place(frame.camera, person, side) for side in SIDES}
        regions = self._regions(frame, {side: place for side, place in places.items() if place is not None}, sides)
        jitter = {side: jittered(region, self.crops) for side, region in regions.items()}
        looks = self._looks(frame, [region for side in jitter for region in jitter[side]])
        out: dict[str, ColorPalm | None] = dict.fromkeys(SIDES)
        for i, side in enumerate(jitter):
            place = places[side]
            assert place is not None
            out[side] = self._combine(frame.camera, place, side, looks[i * self.crops : (i + 1) * self.crops])
        return out

    def _regions(self, frame: RegisteredFrame, places: dict[str, HandPlace], sides: Sequence[str]) -> dict[str, Region]:
        """The region of each hand of `sides` for which a palm was found: the best palm that is nearer to its wrist than
        to the other, and near enough.
        """
        sought = {side: place for side, place in places.items() if side in sides}
        windows = [place.window for place in sought.values()]
        found = self._nets.palms([window.crop(frame.color, PALM_SIZE) for window in windows])
        wrists = {side: np.array(place.wrist) for side, place in places.items()}
        out = {}
        for (side, place), palms in zip(sought.items(), found, strict=True):
            A = place.window.to_image(PALM_SIZE)
            for palm in palms:
                wrist = A[:, :2] @ palm[PALM_WRIST] + A[:, 2]
                apart = {s: float(np.linalg.norm(wrist - at)) for s, at in wrists.items()}
                if apart[side] < place.reach and apart[side] == min(apart.values()):
                    out[side] = palm_region(palm, A)
                    break
        return out

    def _looks(self, frame: RegisteredFrame, regions: list[Region]) -> list[HandLandmarks]:
        crops = [region.crop(frame.color, HAND_SIZE) for region in regions]
        return self._nets.landmarks(crops, regions, [i % self.crops % 2 == 1 for i in range(len(regions))])

    def _combine(self, camera: Camera, place: HandPlace, side: str, looks: list[HandLandmarks]) -> ColorPalm | None:
        """The palm that most looks agree on."""
        kept = [
            look
            for look in looks
            if look.presence > self.min_presence and np.linalg.norm(look.uv[WRIST] - place.wrist) < place.reach
        ]
        if not kept:
            return None
        shapes = np.stack([hand_shape(camera, look, 1 / place.metre) for look in kept])
        if not np.isfinite(shapes).all():  # where the lens model has no rays
            return None
        normals = palm_normal(shapes, side)
        apart = _angles(normals, normals)
        agree = apart[np.argmin(apart.mean(1))] < _TOGETHER
        normal, shape = _unit(normals[agree].mean(0)), shapes[agree].mean(0)
        presence, share = float(np.mean([look.presence for look in kept])), float(agree.sum()) / len(looks)
        uv = np.median([look.uv for look, good in zip(kept, agree, strict=True) if good], axis=0)
        right = float(np.mean([look.right for look in kept]))
        return ColorPalm(
            normal=normal,
            direction=_unit(shape[MIDDLE]),
            spread=float(np.sqrt((_angles(normals, normal[None]) ** 2).mean())),
            presence=presence,
            keypoints_2d=np.column_stack([uv, np.full(len(uv), presence * share)]),
            shape=shape,
            share=share,
            side_probability=right if side == "right" else 1 - right,
            pixels=_HAND * place.metre,
        )


def hand_shape(camera: Camera, look: HandLandmarks, metres_per_pixel: float) -> Float[np.ndarray, "21 3"]:
    """Joints relative to the wrist, metres, camera axes: across the view from the image positions, along it from the
    network's shape, which is fitted to them in size.
    """
    uv, world = look.uv - look.uv.mean(0), look.world[:, :2] - look.world[:, :2].mean(0)
    pixels_per_unit = np.sqrt((uv**2).sum() / max((world**2).sum(), 1e-12))
    points = np.column_stack([look.uv, look.world[:, 2] * pixels_per_unit]) * metres_per_pixel
    ray = camera.unproject(look.uv[[WRIST, INDEX, PINKY]].mean(0), 1.0)
    return (points - points[WRIST]) @ rotation_to(_unit(ray))


def palm_normal(shape: Float[np.ndarray, "*n 21 3"], side: str) -> Float[np.ndarray, "*n 3"]:
    """Unit normal out of the palm of a hand's joints."""
    across = np.cross(shape[..., INDEX, :] - shape[..., WRIST, :], shape[..., PINKY, :] - shape[..., WRIST, :])
    return _unit(across if side == "right" else -across)


def _angles(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "n m"]:
    """Radians between all unit vectors of two sets."""
    return np.arccos(np.clip(a @ b.T, -1, 1))


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
