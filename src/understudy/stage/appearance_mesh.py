"""Triangle meshes: neighbourhoods, smoothing, subdivision, parts. Vertices (v, 3) metres, faces (f, 3) outward."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from understudy.stage.kinematics import unit


def edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """The three edges of every face."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Unit normals, weighted by area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    n = len(faces)
    spread = sparse.csr_matrix((np.ones(3 * n), (faces.T.ravel(), np.tile(np.arange(n), 3))), shape=(len(vertices), n))
    return unit(np.asarray(spread @ np.cross(b - a, c - a)))


def border(count: int, faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " v"]:
    """Vertices on an open edge."""
    ends = rim(faces)
    out = np.zeros(count, bool)
    out[ends.ravel()] = True
    return out


def rim(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """Open edges: those of one face only."""
    unique, count = np.unique(np.sort(edges(faces), axis=1), axis=0, return_counts=True)
    return np.asarray(unique[count == 1])


def averaging(count: int, pairs: Int[np.ndarray, "e 2"]) -> sparse.csr_matrix:
    """(v, v): the mean of a vertex's neighbours; a vertex without any keeps its value."""
    both = np.concatenate([pairs, pairs[:, ::-1]])
    A = sparse.csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    A.data[:] = 1.0
    degree = np.asarray(A.sum(1)).ravel()
    A = A + sparse.diags((degree == 0).astype(float))
    return (sparse.diags(1 / np.maximum(degree, 1)) @ A).tocsr()


def smooth(
    values: Float[np.ndarray, "v k"],
    mean: sparse.csr_matrix,
    times: int,
    share: float = 0.5,
    fixed: Bool[np.ndarray, " v"] | None = None,
) -> Float[np.ndarray, "v k"]:
    """Laplacian smoothing with `averaging`'s matrix; `fixed` vertices keep their values."""
    free = np.ones(len(values)) if fixed is None else np.where(fixed, 0.0, 1.0)
    for _ in range(times):
        values = values + (share * free)[:, None] * (mean @ values - values)
    return values


def part(
    faces: Int[np.ndarray, "f 3"], keep: Bool[np.ndarray, " f"]
) -> tuple[Int[np.ndarray, " u"], Int[np.ndarray, "g 3"]]:
    """The vertices that the kept faces use, and these faces with new indices."""
    used, inverse = np.unique(faces[keep], return_inverse=True)
    return used, inverse.reshape(-1, 3).astype(np.int64)


def subdivision(count: int, faces: Int[np.ndarray, "f 3"]) -> tuple[sparse.csr_matrix, Int[np.ndarray, "g 3"]]:
    """Every face in four: a matrix that takes values at old vertices to new ones (old ones first), and the faces."""
    unique, inverse = np.unique(np.sort(edges(faces), axis=1), axis=0, return_inverse=True)
    f, e = len(faces), len(unique)
    ab, bc, ca = (count + inverse.ravel()[k * f : (k + 1) * f] for k in range(3))
    a, b, c = faces.T
    new = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    halves = sparse.csr_matrix((np.full(2 * e, 0.5), (np.repeat(np.arange(e), 2), unique.ravel())), shape=(e, count))
    return sparse.csr_matrix(sparse.vstack([sparse.identity(count), halves])), new.astype(np.int64)


def grid(rows: int, columns: int) -> Int[np.ndarray, "f 3"]:
    """Faces of a grid of vertices, row by row."""
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (r * columns + c).ravel()
    down, right = a + columns, a + 1
    return np.concatenate([np.stack([a, right, down], 1), np.stack([right, down + 1, down], 1)]).astype(np.int64)


def waves(points: Float[np.ndarray, "v 3"], length_m: float, rng: np.random.Generator) -> Float[np.ndarray, " v"]:
    """Smooth noise of about unit variance: sines in random directions with about this wavelength."""
    direction = unit(rng.normal(size=(12, 3))) * (2 * np.pi / length_m) * rng.uniform(0.6, 1.6, (12, 1))
    return np.asarray(np.sin(points @ direction.T + rng.uniform(0, 2 * np.pi, 12)).sum(1) / np.sqrt(6))
