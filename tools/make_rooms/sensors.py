"""Three RGB-D cameras: geometry, and how exact ray casts become raw depth images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import common  # noqa: F401
import numpy as np
from common import Array, Rng
from layout import intrinsics, rodrigues
from numpy.typing import NDArray
from scipy import ndimage
from sensor import Scene


@dataclass(frozen=True)
class Sensor:
    """Intrinsics, mounting and range of one kind of camera."""

    name: str
    color_size: tuple[int, int]
    color_k: Array
    depth_size: tuple[int, int]
    depth_k: Array
    depth_to_color: Array
    near: float
    far: float
    sky: float = 0.0


def _pose(axis: tuple, degrees: float, shift: tuple) -> Array:
    out = np.eye(4)
    out[:3, :3] = rodrigues(np.array(axis, float), np.radians(degrees))
    out[:3, 3] = shift
    return out


SENSORS = {
    "kinect2": Sensor(
        "kinect2",
        (960, 540),
        intrinsics(540.3, 479.5, 269.5),
        (512, 424),
        intrinsics(365.2, 256.8, 208.4),
        _pose((0.2, 1.0, -0.3), 0.35, (0.052, -0.0006, 0.0012)),
        0.5,
        8.0,
    ),
    "azure": Sensor(
        "azure",
        (1280, 720),
        intrinsics(610.4, 637.2, 366.1),
        (640, 576),
        intrinsics(504.2, 321.6, 330.9),
        _pose((-1.0, 0.004, 0.003), 6.0, (-0.032, -0.0021, 0.0040)),  # z of the depth camera points 6 degrees down
        0.3,
        5.6,
    ),
    "realsense": Sensor(
        "realsense",
        (848, 480),
        intrinsics(615.1, 425.7, 238.2),
        (848, 480),
        intrinsics(420.3, 424.1, 240.6),
        _pose((0.5, -1.0, 0.2), 0.4, (0.0148, 0.0002, 0.0003)),
        0.25,
        9.0,
    ),
}


def header(s: Sensor) -> dict[str, Any]:
    """recording.json of a set of single frames."""

    def camera(size: tuple[int, int], k: Array) -> dict[str, Any]:
        return {
            "width": size[0],
            "height": size[1],
            "K": k.tolist(),
            "distortion_model": "none",
            "distortion": [],
        }

    return {
        "format": "rgbd-recording/1",
        "color": camera(s.color_size, s.color_k),
        "depth": {**camera(s.depth_size, s.depth_k), "unit_m": 0.001, "registered": False},
        "T_color_depth": s.depth_to_color.round(9).tolist(),
    }


def pixel_rays(size: tuple[int, int], k: Array, jitter: Array | None = None) -> Array:
    """A ray with z = 1 for every pixel."""
    u, v = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    uv = np.stack([u.ravel(), v.ravel()], 1)
    if jitter is not None:
        uv = uv + jitter
    return np.c_[(uv - k[:2, 2]) / k[[0, 1], [0, 1]], np.ones(len(uv))]


def _view(scene: Scene, pose: Array, s: Sensor, jitter: Array | None) -> tuple[Array, NDArray[np.int32], Array, Array]:
    rays = pixel_rays(s.depth_size, s.depth_k, jitter) @ pose[:3, :3].T
    z, face, normal = scene.cast(pose[:3, 3], rays)
    cos = np.abs((normal * rays).sum(1)) / np.linalg.norm(rays, axis=1)
    return z, face, np.arccos(np.clip(cos, 0.0, 1.0)), rays


def _smooth_noise(rng: Rng, shape: tuple[int, int], sigma: float) -> Array:
    n = ndimage.gaussian_filter(rng.normal(size=shape).astype(np.float32), sigma)
    return n / n.std()


def _time_of_flight(scene: Scene, pose: Array, s: Sensor, dark: Array, rng: Rng, axial: Any, spread: float) -> Array:
    """Two rays within each pixel's footprint: where they disagree the reading mixes both (flying pixels)."""
    shape = (s.depth_size[1], s.depth_size[0])
    n = shape[0] * shape[1]
    z1, face, angle, _ = _view(scene, pose, s, rng.normal(size=(n, 2)) * spread)
    z2, _, _, _ = _view(scene, pose, s, rng.normal(size=(n, 2)) * 1.5 * spread)
    z2 = np.where(z2 > 0, z2, z1)
    steep = np.minimum(angle, np.radians(86.0))
    split = np.abs(z1 - z2) > 0.05 + 0.02 * z1
    share = rng.beta(0.6, 0.6, n)
    mixed = np.where(split, z1 * share + z2 * (1 - share), z1)
    out = mixed + rng.normal(size=n) * axial(np.clip(z1, 0.3, 9.0), steep)
    draw = rng.random(n)
    out[split & (draw < 0.45)] = 0.0  # most of the mixed readings are thrown away by the camera itself
    # The light that comes back falls with distance, slant and darkness.
    reflect = np.where(face >= 0, dark[np.maximum(face, 0)], 0.0)
    strength = np.cos(angle) * (1 - 0.9 * reflect) / np.clip(z1, 0.4, 9.0) ** 2
    floor = 0.10 / (s.far * 0.85) ** 2
    patch = _smooth_noise(rng, shape, 1.2).ravel()
    out[strength * np.exp(0.55 * patch) < floor] = 0.0
    patch = 0.5 + 0.5 * np.tanh(1.2 * _smooth_noise(rng, shape, 1.4).ravel())
    out[patch < reflect * (0.5 + 0.5 * angle / (np.pi / 2)) * np.clip(z1 / 2.5, 0.3, 1.2)] = 0.0
    out[rng.random(n) < 0.001] = 0.0
    out[(z1 <= 0) | (z1 > s.far) | (out < s.near)] = 0.0
    return out.reshape(shape)


def _kinect2(scene: Scene, pose: Array, s: Sensor, dark: Array, rng: Rng) -> Array:
    def axial(z: Array, t: Array) -> Array:
        sd = 1.5 - 0.5 * z + 0.3 * z**2 + 0.1 * z**1.5 * t**2 / (np.pi / 2 - t) ** 2
        return np.clip(sd, 0.5, 30.0) * 1e-3

    return _time_of_flight(scene, pose, s, dark, rng, axial, 0.3)


def _azure(scene: Scene, pose: Array, s: Sensor, dark: Array, rng: Rng) -> Array:
    def axial(z: Array, t: Array) -> Array:
        return (0.5 + np.clip(z - 0.5, 0, None)) * 1e-3 * (1 + 0.3 * t**2 / (np.pi / 2 - t) ** 2).clip(1, 6)

    out = _time_of_flight(scene, pose, s, dark, rng, axial, 0.25)
    high = ndimage.maximum_filter(out, 3)
    low = ndimage.minimum_filter(np.where(out > 0, out, 99.0), 3)
    out[(high - low > 0.8) & (low < 50)] = 0.0
    return out


def _realsense(scene: Scene, pose: Array, s: Sensor, dark: Array, rng: Rng) -> Array:
    """Active stereo with a 50 mm base: correlated noise, fat edges, shadows seen by one eye only."""
    shape = (s.depth_size[1], s.depth_size[0])
    base, f = 0.05, float(s.depth_k[0, 0])
    z, face, angle, rays = _view(scene, pose, s, None)
    hit = z > 0
    points = pose[:3, 3] + rays * z[:, None]
    right = pose[:3, 3] + pose[:3, 0] * base
    back = points - right
    t, _, _ = scene.cast(right, back)
    shadow = (hit & (t > 0) & (t < 1.0 - 0.012 / np.clip(z, 0.3, 9) - 0.004)).reshape(shape)
    img = np.where(hit, z, 0.0).reshape(shape)
    # Block matching spreads the front surface over its rim by one to three pixels, raggedly.
    near = ndimage.minimum_filter(np.where(img > 0, img, 99.0), 5)
    near3 = ndimage.minimum_filter(np.where(img > 0, img, 99.0), 3)
    rag = _smooth_noise(rng, shape, 1.5)
    rim = (img > 0) & (img - near > 0.06 * img)
    rim3 = (img > 0) & (img - near3 > 0.06 * img)
    fat = np.where(rim3 & (rag > -0.6), near3, np.where(rim & (rag > 0.7), near, img))
    # Noise of the disparity, alike over a few pixels, and its steps.
    wide = 0.75 * _smooth_noise(rng, shape, 2.2) + 0.55 * _smooth_noise(rng, shape, 1.0)
    wide /= wide.std()
    sd = fat**2 * 0.08 / (f * base) * (1 + 0.35 * np.tan(np.minimum(angle, 1.3)).reshape(shape) ** 2).clip(1, 4)
    disparity = f * base / np.clip(fat + sd * wide, 0.15, 20.0)
    disparity = np.round(disparity * 32) / 32
    out = np.where(fat > 0, f * base / np.clip(disparity, 1e-3, None), 0.0)
    # Holes: the shadow (sometimes filled from in front), the rims, slanted, dark or far patches.
    patch = _smooth_noise(rng, shape, 2.5)
    out[shadow & (patch > -1.3)] = 0.0
    out[rim & (rag < -0.9)] = 0.0
    reflect = np.where(face >= 0, dark[np.maximum(face, 0)], 0.0).reshape(shape)
    graze = np.clip((np.degrees(angle).reshape(shape) - 70.0) / 16.0, 0, 1)
    chance = np.clip(0.3 * reflect + 0.8 * graze + 0.012 * np.clip(img - 3.0, 0, None) ** 2, 0, 0.95)
    rank = 0.5 + 0.5 * np.tanh(0.9 * _smooth_noise(rng, shape, 3.0))
    out[rank < 0.06 + 0.9 * chance - 0.055 * (chance < 0.02)] = 0.0
    wild = _smooth_noise(rng, shape, 1.6) > 3.4  # wrong matches: small blobs far off
    out[wild & (out > 0)] *= rng.uniform(0.6, 1.7)
    out[:, :12] = 0.0  # no partner in the other eye
    out[(out < s.near) | (out > s.far)] = 0.0
    return out.reshape(shape)


def raw_depth(scene: Scene, color_pose: Array, s: Sensor, dark: Array, rng: Rng) -> NDArray[np.uint16]:
    """The raw 16-bit image in millimetres."""
    pose = color_pose @ s.depth_to_color
    make = {"kinect2": _kinect2, "azure": _azure, "realsense": _realsense}[s.name]
    return np.round(make(scene, pose, s, dark, rng) * 1000.0).clip(0, 65535).astype(np.uint16)


def shaded_color(scene: Scene, pose: Array, s: Sensor, colors: Array, rng: Rng) -> NDArray[np.uint8]:
    """A plain picture (RGB): colours by surface, one light from above and one from the camera."""
    rays = pixel_rays(s.color_size, s.color_k) @ pose[:3, :3].T
    _, face, normal = scene.cast(pose[:3, 3], rays)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    normal = normal * -np.sign((normal * unit).sum(1, keepdims=True))
    light = 0.30 + 0.35 * np.clip(-(normal * unit).sum(1), 0, 1)
    light += 0.35 * np.clip(normal @ (np.array([0.3, -0.35, 0.89])), 0, 1)
    image = np.where(face[:, None] >= 0, colors[np.maximum(face, 0)] * light[:, None], 0.8)
    image = np.clip(1.15 * image, 0, 1) ** (1 / 2.2) * 255
    image = image.reshape(s.color_size[1], s.color_size[0], 3)
    image = ndimage.gaussian_filter(image.astype(np.float32), (0.5, 0.5, 0))
    image += rng.normal(size=image.shape).astype(np.float32) * 2.0
    return np.clip(np.round(image), 0, 255).astype(np.uint8)
