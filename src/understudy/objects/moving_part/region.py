"""Which points of the reference belong to the part: those that are found where it went, and not where they were."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Int

from understudy.geometry import transform_points
from understudy.objects.articulation import PRISMATIC, Articulation
from understudy.objects.moving_part.scoring import PartModel, Scorer, motions, point_scores
from understudy.objects.moving_part.search import fit_plane, step_m
from understudy.objects.moving_part.stack import Reference, left

_REACH: Final = (1.25, 2.2)  # metres from the grasp: level, upright
_HEIGHT: Final = (-0.02, 0.13)  # metres above the front's plane
_ON_PLANE: Final = 0.012
_OUT: Final = 0.015
_POINTS: Final = 5000
_INFORMATIVE: Final = 0.03  # metres that a point must have gone for a frame to say anything about it
_SIGMA: Final = 0.01
_CONTRADICTED: Final = -0.35  # evidence below which a point stays where it is, even if edges are uncertain
_IN_PLANE: Final = 0.3  # of the direction along the normal
_FIT_FROM: Final = 60  # flat points
_STRICT: Final = 0.006
_END, _STRIP = 0.06, 0.03  # metres along and across the way that a front slides


@dataclass(frozen=True, eq=False)
class Region:
    model: PartModel
    evidence_m2: float
    """area of the reference that the motion explains and rest does not, less what it contradicts"""
    pixels: Int[np.ndarray, "n 2"]
    """row and column of each point of the model"""


def grow(
    scorer: Scorer,
    ref: Reference,
    model: PartModel,
    articulation: Articulation,
    q: Float[np.ndarray, " k"],
    frames: Int[np.ndarray, " k"],
) -> Region | None:
    """The part's points from the reference, judged by k frames with known q; None if next to nothing moves so."""
    at = articulation.T_rest[:3, 3]
    way = np.abs(q) * step_m(articulation)
    plane = float(model.points[model.flat].mean(0) @ model.normal)
    offset = ref.points - at
    height = ref.points @ model.normal - plane
    near = (ref.z > 0) & (height > _HEIGHT[0]) & (height < _HEIGHT[1])
    near &= (np.hypot(offset[..., 0], offset[..., 1]) < _REACH[0]) & (np.abs(offset[..., 2]) < _REACH[1])
    near &= (np.abs(height) < _ON_PLANE) | (height > _OUT)
    if not _in_plane(articulation, model.normal):
        near &= left(scorer.stack, ref, frames[way > 0.5 * way.max()]) if way.max() > _INFORMATIVE else True
    step = max(1, int(np.ceil(np.sqrt(near.sum() / _POINTS))))
    rows, columns = np.nonzero(near[::step, ::step])
    rows, columns = rows * step, columns * step
    if len(rows) < 30:
        return None
    everything = PartModel(
        ref.points[rows, columns], np.abs(height[rows, columns]) < _ON_PLANE, model.normal, model.thickness_m
    )
    gone, fit, news = _judge(scorer, everything, articulation, q, frames)
    belongs = (fit > 0.25) & (gone > -0.1)
    if _in_plane(articulation, model.normal):
        # A front that slides covers its own place, and nothing says which points near its leading edge have moved: it
        # reaches to where its plane ends, or to what clearly stays.
        belongs |= everything.flat & (gone > _CONTRADICTED)
    chosen = _connected(belongs, gone, rows // step, columns // step, np.linalg.norm(everything.points - at, axis=1))
    if chosen.sum() < 30:
        return None
    z = ref.z[rows, columns]
    area = (z * step / scorer.stack.camera.fx) ** 2
    return Region(
        _fitted(everything.part(chosen)), float((news * area)[chosen].sum()), np.column_stack([rows, columns])[chosen]
    )


def telling(model: PartModel, articulation: Articulation) -> PartModel:
    """The points that say where the part is.

    Of a front that slides in its own plane these are the ones at its ends, and what stands out: wherever it goes, the
    others find themselves on it.
    """
    if not _in_plane(articulation, model.normal) or model.flat.sum() < _FIT_FROM:
        return model
    along = model.points @ articulation.direction
    strip = np.rint(model.points @ np.cross(articulation.direction, model.normal) / _STRIP).astype(int)
    strip -= strip.min()
    least, most = np.full(strip.max() + 1, np.inf), np.full(strip.max() + 1, -np.inf)
    np.minimum.at(least, strip[model.flat], along[model.flat])
    np.maximum.at(most, strip[model.flat], along[model.flat])
    ends = ~model.flat | (along < least[strip] + _END) | (along > most[strip] - _END)
    return model.part(ends) if (ends & model.flat).sum() >= _FIT_FROM else model


def _in_plane(articulation: Articulation, normal: Float[np.ndarray, "3"]) -> bool:
    return articulation.kind == PRISMATIC and abs(float(articulation.direction @ normal)) < _IN_PLANE


def _fitted(model: PartModel) -> PartModel:
    """With the normal that its flat points show."""
    flat = model.points[model.flat]
    if len(flat) < _FIT_FROM:
        return model
    normal = fit_plane(flat)[0]
    return replace(model, normal=normal * np.sign(normal @ model.normal))


def _judge(
    scorer: Scorer, model: PartModel, articulation: Articulation, q: np.ndarray, frames: np.ndarray
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Per point: how much better moving explains it than resting, and how well moving does; means over frames."""
    T = motions(articulation, q)
    there = scorer.compare(model, T, frames)
    here = scorer.compare(model, np.tile(np.eye(4), (len(q), 1, 1)), frames)
    moving, resting = point_scores(there, _SIGMA), point_scores(here, _SIGMA, unexplained=0.0)
    way = np.stack([np.linalg.norm(transform_points(A, model.points) - model.points, axis=1) for A in T])
    telling = way > _INFORMATIVE
    n = np.maximum(telling.sum(0), 1)
    gone = ((moving - resting) * telling).sum(0) / n
    seen = np.maximum((telling & (moving != 0)).sum(0), 1)
    fit = np.where(telling.any(0), (moving * telling).sum(0) / seen, moving.mean(0))
    news = (point_scores(there, _STRICT) - point_scores(here, _STRICT, 0.0)).mean(0)

    return gone, fit, news


def _connected(
    belongs: np.ndarray, gone: np.ndarray, rows: np.ndarray, columns: np.ndarray, distance: np.ndarray
) -> np.ndarray:
    """Of the points that belong, the connected piece with the most evidence near the grasp."""
    image = np.zeros((rows.max() + 3, columns.max() + 3), np.uint8)
    image[rows[belongs], columns[belongs]] = 1
    image = cv2.dilate(image, np.ones((3, 3), np.uint8))
    labels = cv2.connectedComponents(image)[1][rows, columns]
    weight = np.where(belongs, (gone.clip(0) + 0.05) * (distance < 0.4), 0.0)
    total = np.bincount(labels, weight)
    total[0] = 0
    return np.asarray(belongs & (labels == int(total.argmax())))
