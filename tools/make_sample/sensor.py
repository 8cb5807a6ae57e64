"""A simulated time-of-flight depth camera: exact ray casts with warp, then sensor errors."""

from __future__ import annotations

import numpy as np
import warp as wp
from layout import DEPTH_F, DEPTH_K, DEPTH_MAX, DEPTH_SIZE, DEPTH_UNIT, Array
from numpy.typing import NDArray
from scipy import ndimage


@wp.kernel
def _cast(
    mesh: wp.uint64,
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    dist: wp.array(dtype=wp.float32),
    face: wp.array(dtype=wp.int32),
    normal: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    q = wp.mesh_query_ray(mesh, origin[i], direction[i], 100.0)
    if q.result:
        dist[i] = q.t
        face[i] = q.face
        normal[i] = q.normal
    else:
        dist[i] = -1.0
        face[i] = -1


class Scene:
    """All triangles of one frame, for ray casts in world coordinates."""

    def __init__(self, vertices: Array, faces: NDArray[np.int64]) -> None:
        self._points = wp.array(vertices.astype(np.float32), dtype=wp.vec3)
        self._mesh = wp.Mesh(self._points, wp.array(faces.astype(np.int32).ravel(), dtype=wp.int32))

    def cast(self, origins: Array, directions: Array) -> tuple[Array, NDArray[np.int32], Array]:
        """Distance (in lengths of the direction given), face and normal; -1 where nothing is hit."""
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        n = len(directions)
        o = wp.array(np.broadcast_to(origins, directions.shape).astype(np.float32), dtype=wp.vec3)
        d = wp.array((directions / length).astype(np.float32), dtype=wp.vec3)
        dist, face = wp.zeros(n, dtype=wp.float32), wp.zeros(n, dtype=wp.int32)
        normal = wp.zeros(n, dtype=wp.vec3)
        wp.launch(_cast, dim=n, inputs=[self._mesh.id, o, d, dist, face, normal])
        t = dist.numpy().astype(float)
        return np.where(t > 0, t / length[:, 0], -1.0), face.numpy(), normal.numpy().astype(float)


def pixel_rays(jitter: Array | None = None) -> Array:
    """A ray with z = 1 for every pixel of the depth camera."""
    u, v = np.meshgrid(np.arange(DEPTH_SIZE[0], dtype=float), np.arange(DEPTH_SIZE[1], dtype=float))
    uv = np.stack([u.ravel(), v.ravel()], 1)
    if jitter is not None:
        uv = uv + jitter
    return np.c_[(uv - DEPTH_K[:2, 2]) / DEPTH_F, np.ones(len(uv))]


def depth_image(
    scene: Scene, pose: Array, dark: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.uint16], Array]:
    """The raw 16-bit image and the exact z. `dark` is, per face, how badly it reflects infrared (0..1)."""
    shape = (DEPTH_SIZE[1], DEPTH_SIZE[0])
    exact, _, _ = scene.cast(pose[:3, 3], pixel_rays() @ pose[:3, :3].T)
    # Lateral noise of 1.6 mm: the ray leaves its pixel's centre by about 0.23 pixel at 2.5 m.
    sigma = 0.0016 * DEPTH_F / np.clip(exact, 0.8, 8.0)
    rays = pixel_rays(rng.normal(size=(len(exact), 2)) * sigma[:, None])
    z, face, normal = scene.cast(pose[:3, 3], rays @ pose[:3, :3].T)
    world_dir = rays @ pose[:3, :3].T
    cos = np.abs((normal * world_dir).sum(1)) / np.linalg.norm(world_dir, axis=1)
    angle = np.arccos(np.clip(cos, 0.0, 1.0))
    steep = np.minimum(angle, np.radians(86.0))
    sd = (1.5 - 0.5 * z + 0.3 * z**2 + 0.1 * np.clip(z, 0, None) ** 1.5 * steep**2 / (np.pi / 2 - steep) ** 2) * 1e-3
    hit = (z > 0) & (z < DEPTH_MAX)
    img = np.where(hit, z, 0.0).reshape(shape)
    noise = (rng.normal(size=z.shape) * np.clip(sd, 0.0005, 0.03)).reshape(shape)

    # Flying pixels: within one pixel of a depth edge some readings lie between front and back.
    far = ndimage.maximum_filter(img, 3)
    near = ndimage.minimum_filter(np.where(img > 0, img, 99.0), 3)
    edge = (img > 0) & (far - near > 0.08) & (near < 50)
    draw = rng.random(shape)
    blend = near + (far - near) * rng.random(shape) ** 1.5
    out = np.where(edge & (draw < 0.10), blend, img) + noise
    out[edge & (draw > 0.72)] = 0.0

    # Drop-outs: grazing surfaces, dark hair in patches, single pixels.
    graze = np.clip((np.degrees(angle).reshape(shape) - 79.0) / 9.0, 0.0, 1.0)
    out[rng.random(shape) < graze] = 0.0
    reflect = np.where(face >= 0, dark[np.maximum(face, 0)], 0.0).reshape(shape)
    patch = ndimage.gaussian_filter(rng.normal(size=shape), 1.3)
    patch = 0.5 + 0.5 * np.tanh(1.2 * patch / patch.std())
    out[patch < reflect * (0.55 + 0.45 * (angle.reshape(shape) / (np.pi / 2)))] = 0.0
    out[rng.random(shape) < 0.0008] = 0.0
    out[(img <= 0) | (out > DEPTH_MAX) | (out < 0.3)] = 0.0
    return np.round(out / DEPTH_UNIT).astype(np.uint16), np.where(hit, exact, 0.0).reshape(shape)
