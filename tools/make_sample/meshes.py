"""Triangle mesh helpers and the pieces that a dressed person and a room are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from layout import Array
from numpy.typing import NDArray
from scipy import sparse

Faces = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass
class Piece:
    """A mesh with one material. `weights` skins it; `rest` and `color` are per vertex, `st` per corner."""

    name: str
    vertices: Array
    faces: Faces
    material: str
    color: Array
    weights: Array
    st: Array | None = None


def normals(vertices: Array, faces: Faces) -> Array:
    """Area-weighted vertex normals."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    out = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(out, faces[:, k], n)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)


def adjacency(count: int, faces: Faces) -> sparse.csr_matrix:
    """Row-normalised vertex neighbourhood."""
    e = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    e = np.concatenate([e, e[:, ::-1]])
    m = sparse.csr_matrix((np.ones(len(e)), (e[:, 0], e[:, 1])), shape=(count, count))
    m.data[:] = 1.0
    return sparse.diags(1.0 / np.maximum(np.asarray(m.sum(1)).ravel(), 1.0)) @ m


def border(count: int, faces: Faces) -> Mask:
    """Vertices on an open edge."""
    e = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    u, n = np.unique(e, axis=0, return_counts=True)
    out = np.zeros(count, bool)
    out[u[n == 1].ravel()] = True
    return out


def smooth(values: Array, faces: Faces, times: int, share: float = 0.5, fixed: Mask | None = None) -> Array:
    """Laplacian smoothing of per-vertex values."""
    adj = adjacency(len(values), faces)
    out = values.copy()
    for _ in range(times):
        new = out + share * (adj @ out - out)
        if fixed is not None:
            new[fixed] = out[fixed]
        out = new
    return out


def submesh(faces: Faces, keep: Mask) -> tuple[NDArray[np.int64], Faces]:
    """Vertices used by the kept faces, and these faces renumbered."""
    used, inverse = np.unique(faces[keep], return_inverse=True)
    return used, inverse.reshape(-1, 3).astype(np.int64)


def subdivide(arrays: list[Array], faces: Faces) -> tuple[list[Array], Faces]:
    """Split every triangle in four; per-vertex arrays are averaged on the new vertices."""
    e = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    u, inverse = np.unique(e, axis=0, return_inverse=True)
    n, f = len(arrays[0]), len(faces)
    ab, bc, ca = (n + inverse.ravel()[k * f : (k + 1) * f] for k in range(3))
    a, b, c = faces.T
    new = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return [np.concatenate([x, 0.5 * (x[u[:, 0]] + x[u[:, 1]])]) for x in arrays], new.astype(np.int64)


def wave_noise(points: Array, scale: float, seed: int, waves: int = 12) -> Array:
    """Smooth noise of about unit variance: a sum of sines of random direction near one wavelength."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(waves, 3))
    direction *= (
        (2 * np.pi / scale) * rng.uniform(0.6, 1.6, (waves, 1)) / np.linalg.norm(direction, axis=1, keepdims=True)
    )
    return np.sin(points @ direction.T + rng.uniform(0, 2 * np.pi, waves)).sum(1) * np.sqrt(2.0 / waves)


def grid_faces(rows: int, cols: int) -> Faces:
    """Triangles of a rows x cols vertex grid."""
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(cols - 1), indexing="ij")
    a = (r * cols + c).ravel()
    return np.concatenate([np.stack([a, a + 1, a + cols], 1), np.stack([a + 1, a + cols + 1, a + cols], 1)]).astype(
        np.int64
    )


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> tuple[Array, Faces]:
    """An axis-aligned box with outward faces."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    v = np.array([[x, y, z] for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return v, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int64)
