"""The moving part of a recording, without markers: found, tracked, its articulation and its handle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import minimum_filter1d

from understudy.errors import UnderstudyError
from understudy.geometry import inverse, is_rigid, transform_points
from understudy.objects.articulation import FIXED, PRISMATIC, REVOLUTE, Articulation, Handle
from understudy.objects.moving_part.handle import find_handle
from understudy.objects.moving_part.motion import Motion, refine, sharpen, spread_frames, track
from understudy.objects.moving_part.region import Region, grow
from understudy.objects.moving_part.scoring import PartModel, Scorer, motions
from understudy.objects.moving_part.search import (
    HandPath,
    Hypothesis,
    Panel,
    find_panel,
    grasp_frames,
    hand_cost,
    hand_path,
    step_m,
    try_panel,
)
from understudy.objects.moving_part.stack import DepthStack, Frames, Reference, changed, reference
from understudy.trajectories import PoseTrack
from understudy.types import Person

_FAMILY: Final = {"out": 1.0, "level": 1.0, "hinge": 1.0, "flap": 0.7, "lift": 0.7}  # how common they are
_HAND_SPREAD: Final = 0.06  # metres by which the hand may wander on the handle


@dataclass(frozen=True, eq=False)
class HandHint:
    """Where the acting hand was, as the skeleton tells. World frame."""

    times_s: Float[np.ndarray, " t"]
    positions: Float[np.ndarray, "t 3"]
    """mid-palm, metres; NaN where missing; errors of 5 cm are usual, of 12 cm happen"""
    sigma_m: Float[np.ndarray, " t"]
    """one sigma of the position; NaN where missing"""

    def __post_init__(self) -> None:
        t = len(self.times_s)
        if self.positions.shape != (t, 3) or self.sigma_m.shape != (t,):
            raise UnderstudyError(
                f"hand hint: {t} times need positions ({t}, 3) and sigma_m ({t},), "
                f"got {self.positions.shape}, {self.sigma_m.shape}"
            )
        if t < 2 or not (np.diff(self.times_s) > 0).all():
            raise UnderstudyError("hand hint: times_s must be 2 or more and increase")


@dataclass(frozen=True)
class MovingPartConfig:
    """Settings of `find_moving_part`."""

    search_frames: int = 14
    """frames on which hypotheses are tried"""
    tried: int = 6
    """hypotheses that are tracked through the recording"""
    refined: int = 2
    """hypotheses that are refined"""
    points: int = 500
    """of the part, for its final track"""
    least_way_m: float = 0.03
    """of the handle: what moves less did not move"""
    least_moving_s: float = 0.4
    """nothing is opened in less time"""
    least_evidence_m2: float = 0.002
    """area that the motion must explain better than rest does"""


@dataclass(frozen=True, eq=False)
class MovingPart:
    """What moved, and how."""

    track: PoseTrack
    """of the handle's frame, world"""
    articulation: Articulation
    """world; T_rest is the handle's frame at rest"""
    handle: Handle
    q: Float[np.ndarray, " t"]
    """radians or metres; filled in where `track` says not observed"""
    sigma_q: Float[np.ndarray, " t"]
    moving: tuple[int, int]
    """first and last sample of the motion; (0, 0) if nothing moves"""
    part_points: Float[np.ndarray, "n 3"]
    """visible points of the part before the motion, in the handle's frame, metres"""
    quality: dict[str, float] = field(default_factory=dict)
    """agreement (mean over observed frames: 1 = every point is where it should be), evidence_m2, runner_up_m2 (of the
    best hypothesis of another kind of motion), hand_spread_m, handle_seen"""


@dataclass(frozen=True, eq=False)
class _Tracked:
    """A hypothesis after tracking."""

    hypothesis: Hypothesis
    articulation: Articulation
    model: PartModel
    motion: Motion
    evidence_m2: float
    hand_spread_m: float
    merit: float


def find_moving_part(
    frames: Frames,
    people: Sequence[Sequence[Person]],
    T_world_cam: Float[np.ndarray, "4 4"],
    hand: HandHint,
    *,
    config: MovingPartConfig | None = None,
) -> MovingPart:
    """Finds the rigid part that a person moves in a recording by a camera that stands still.

    frames: the recording; indexed once each, in order (they may be decoded lazily; those that raise FrameError are left
    out). people: everybody in each frame, to be masked. T_world_cam: of the colour camera, world z up. hand: one row
    per frame. If nothing moves, the articulation is `fixed` and the handle is where the hand was.

    Raises UnderstudyError for inputs that do not fit together, no readable frame, or a hand that is never near a
    surface.
    """
    config = config or MovingPartConfig()
    if not len(frames) == len(people) == len(hand.times_s):
        raise UnderstudyError(
            f"moving part: needs people and a hand for each of {len(frames)} frames, "
            f"got {len(people)} and {len(hand.times_s)}"
        )
    if T_world_cam.shape != (4, 4) or not is_rigid(T_world_cam):
        raise UnderstudyError("moving part: T_world_cam must be a rigid 4x4 transform")
    if np.isfinite(hand.positions).all(1).sum() < 3:
        raise UnderstudyError("moving part: the hand's position is known in fewer than 3 frames")
    return _Finder(DepthStack.read(frames, people), T_world_cam, hand, config).find()


class _Finder:
    def __init__(self, stack: DepthStack, T_world_cam: np.ndarray, hand: HandHint, config: MovingPartConfig):
        self.stack, self.T_world_cam, self.config = stack, T_world_cam, config
        self.times_s = hand.times_s
        self.hand: HandPath = hand_path(hand.times_s, hand.positions, hand.sigma_m)
        self.rng = np.random.default_rng(0)
        self.grasps, self.ref = self._grasps()
        self.scorer = Scorer(stack, self.ref, T_world_cam)

    def find(self) -> MovingPart:
        tracked = sorted((t for t in map(self._tracked, self._hypotheses()) if t), key=lambda t: -t.merit)
        refined = sorted(map(self._refined, tracked[: self.config.refined]), key=lambda t: -t.merit)
        if not refined or refined[0].merit < self.config.least_evidence_m2:
            return self._still()
        best = self._refined(refined[0], (0.008,))
        others = [t.merit for t in (*refined, *tracked) if t.hypothesis.family != best.hypothesis.family]
        return self._result(best, max(others, default=0.0))

    # --- search ---

    def _grasps(self) -> tuple[np.ndarray, Reference]:
        """Frames at which the hand may have taken hold, and the scene before the first of them."""
        t = len(self.stack)
        ref = reference(self.stack, np.arange(max(t // 8, min(t, 5))), self.T_world_cam)
        grasps = grasp_frames(self.hand, ref)
        if len(grasps):
            ref = reference(self.stack, np.arange(max(int(grasps[0]), min(t, 5))), self.T_world_cam)
            grasps = grasp_frames(self.hand, ref)
        if not len(grasps):
            raise UnderstudyError("moving part: the hand is never near a surface that was there before")
        return grasps, ref

    def _hypotheses(self) -> list[Hypothesis]:
        """The most promising ones, two of a family at most."""
        t = len(self.stack)
        moved = changed(self.stack, self.ref, np.arange(2 * t // 3, t))
        frames = np.flatnonzero(self.stack.usable & (np.arange(t) > self.grasps[0]))
        if not len(frames):
            return []
        frames = frames[np.unique(np.linspace(0, len(frames) - 1, self.config.search_frames).astype(int))]
        found: list[Hypothesis] = []
        for i in self.grasps:
            panel = find_panel(self.ref, moved, self.hand.positions[i], int(i), self.T_world_cam[:3, 3])
            if panel is not None:
                found += try_panel(panel, self.scorer, self.hand, frames)
        found.sort(key=lambda h: -h.gain)
        out: list[Hypothesis] = []
        for h in found:
            if sum(o.family == h.family for o in out) < 2 and len(out) < self.config.tried:
                out.append(h)
        return out

    # --- one hypothesis ---

    def _follow(self, model: PartModel, articulation: Articulation, points: int, sigma_m: float) -> Motion:
        thin = model.thinned(points, self.rng)
        return track(self.scorer, thin, articulation, self.hand, self.times_s, int(self.grasps[0]), sigma_m)

    def _grow(self, model: PartModel, articulation: Articulation, motion: Motion) -> Region | None:
        picked = spread_frames(motion.q, self._trusted(articulation, motion), 14)
        return grow(self.scorer, self.ref, model, articulation, motion.q[picked], picked)

    def _trusted(self, articulation: Articulation, motion: Motion) -> Bool[np.ndarray, " t"]:
        """Usable frames in which the hand is where the handle should be, and those in which nobody holds it."""
        cost = hand_cost(articulation, motion.q[:, None], self.hand.positions, self.hand.sigma_m)[:, 0]
        near = minimum_filter1d(cost, 3, mode="nearest") < 0.5
        return self.stack.usable & (near | ~motion.held)

    def _tracked(self, h: Hypothesis) -> _Tracked | None:
        motion = self._follow(h.panel.model, h.articulation, 80, 0.025)
        region = self._grow(h.panel.model, h.articulation, motion)
        return None if region is None else self._judged(h, h.articulation, region, motion)

    def _judged(self, h: Hypothesis, articulation: Articulation, region: Region, motion: Motion) -> _Tracked:
        """With its merit: the evidence, less where the hand wanders on the part or hardly any time is spent moving."""
        moving = np.abs(np.gradient(motion.q)) * step_m(articulation) > 0.003
        lasts = float(moving.sum() * np.median(np.diff(self.times_s)))
        spread = 1.0
        if lasts >= self.config.least_moving_s and moving.sum() >= 3:
            held = _in_part(articulation, motion.q[moving], self.hand.positions[moving])
            spread = float(np.sqrt(np.median(((held - np.median(held, axis=0)) ** 2).sum(1))))
        way = float(np.ptp(motion.q)) * step_m(articulation)
        trust = np.exp(-0.5 * (spread / _HAND_SPREAD) ** 2) * _FAMILY[h.family] * (way > self.config.least_way_m)
        merit = region.evidence_m2 * float(trust)
        return _Tracked(h, articulation, region.model, motion, region.evidence_m2, spread, merit)

    def _refined(self, t: _Tracked, sigmas_m: tuple[float, ...] = (0.015, 0.008)) -> _Tracked:
        for sigma_m in sigmas_m:
            picked = spread_frames(t.motion.q, self._trusted(t.articulation, t.motion), 12)
            thin = t.model.thinned(220, self.rng)
            articulation, thickness = refine(self.scorer, thin, t.articulation, t.motion.q, picked, sigma_m)
            model = replace(t.model, thickness_m=thickness)
            motion = self._follow(model, articulation, 160, 1.2 * sigma_m)
            region = self._grow(model, articulation, motion)
            if region is None:
                return t
            t = self._judged(t.hypothesis, articulation, region, motion)
        return t

    # --- result ---

    def _result(self, t: _Tracked, runner_up: float) -> MovingPart:
        motion = sharpen(self.scorer, t.model.thinned(self.config.points, self.rng), t.articulation, t.motion)
        q = motion.q
        assert motion.curvature is not None
        way = np.abs(q) * step_m(t.articulation)
        observed = self.stack.usable & (motion.agreement > 0.1) & (motion.curvature > 0)
        moving = np.flatnonzero(np.abs(np.gradient(t.motion.q)) * step_m(t.articulation) > 0.003)
        first, last = (int(moving[0]), int(moving[-1])) if len(moving) else (0, 0)
        if way.max() < self.config.least_way_m:
            return self._still()
        grip = np.median(_in_part(t.articulation, q[moving], self.hand.positions[moving]), axis=0)
        front = float(t.model.points[t.model.flat].mean(0) @ t.model.normal)
        T_rest, handle, seen = self._handle(self.ref, np.eye(4), t.model.normal, front, grip)
        if not seen and last < len(q) - 3:  # somebody stood before it: look again where it came to rest
            after = reference(self.stack, np.arange(last + 1, len(q)), self.T_world_cam)
            moved = motions(t.articulation, q[-1:])[0]
            again = self._handle(after, moved, t.model.normal, front, grip)
            T_rest, handle, seen = again if again[2] else (T_rest, handle, seen)
        articulation = _at_handle(t.articulation, T_rest, q)
        if np.median(q[last:]) < 0:
            articulation, q = _reversed(articulation), -q
        articulation = replace(articulation, range=(float(q.min()), float(q.max())))
        reach = step_m(articulation)
        sigma_m = np.where(observed, 0.003 + 0.05 / np.sqrt(np.maximum(motion.curvature, 25.0)), 0.05)
        quality = {
            "agreement": float(motion.agreement[observed].mean()) if observed.any() else 0.0,
            "evidence_m2": t.evidence_m2,
            "runner_up_m2": runner_up,
            "hand_spread_m": t.hand_spread_m,
            "handle_seen": float(seen),
        }
        track = _pose_track(articulation, q, sigma_m / reach, observed, handle_sigma_m=0.01 if seen else 0.04)
        points = transform_points(inverse(T_rest), t.model.points)
        return MovingPart(track, articulation, handle, q, sigma_m / reach, (first, last), points, quality)

    def _handle(
        self, ref: Reference, moved: np.ndarray, normal: np.ndarray, front: float, hand: np.ndarray
    ) -> tuple[np.ndarray, Handle, bool]:
        """T_world_handle at rest, looked for where `moved` takes the part: normal, front and hand are those at rest."""
        at = transform_points(moved, hand)
        n = moved[:3, :3] @ normal
        ray = at - self.T_world_cam[:3, 3]
        pixel_m = float(ray @ self.T_world_cam[:3, 2]) / self.stack.camera.fx
        offset = float(n @ transform_points(moved, normal * front))
        T, handle, seen = find_handle(ref, n, offset, at, ray / np.linalg.norm(ray), pixel_m)
        return inverse(moved) @ T, handle, seen

    def _still(self) -> MovingPart:
        """Nothing moves: the handle where the hand was nearest to a front."""
        panels: list[Panel] = []
        for i in self.grasps:
            p = find_panel(
                self.ref, np.zeros(self.ref.z.shape, bool), self.hand.positions[i], int(i), self.T_world_cam[:3, 3]
            )
            if p is not None:
                panels.append(p)
        if not panels:
            raise UnderstudyError("moving part: nothing moves, and there is no upright front near the hand")
        panel = panels[len(panels) // 2]
        normal = panel.model.normal
        front = float(panel.model.points[panel.model.flat].mean(0) @ normal)
        T_rest, handle, seen = self._handle(self.ref, np.eye(4), normal, front, panel.T_world_panel[:3, 3])
        t = len(self.stack)
        articulation = Articulation(FIXED, T_rest, normal, T_rest[:3, 3], (0.0, 0.0))
        track = _pose_track(
            articulation, np.zeros(t), np.zeros(t), self.stack.usable.copy(), handle_sigma_m=0.01 if seen else 0.05
        )
        points = transform_points(inverse(T_rest), panel.model.points)
        quality = {"agreement": 0.0, "evidence_m2": 0.0, "runner_up_m2": 0.0, "hand_spread_m": 0.0}
        return MovingPart(
            track,
            articulation,
            handle,
            np.zeros(t),
            np.zeros(t),
            (0, 0),
            points,
            quality | {"handle_seen": float(seen)},
        )


def _in_part(articulation: Articulation, q: np.ndarray, positions: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Points that are on the part at q, brought back to where they are at rest (world)."""
    T = np.linalg.inv(motions(articulation, q))
    return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], positions) + T[:, :3, 3])


def _at_handle(a: Articulation, T_rest: np.ndarray, q: np.ndarray) -> Articulation:
    """The same motion of the handle's frame."""
    origin = T_rest[:3, 3]
    point = origin if a.kind == PRISMATIC else a.point + a.direction * ((origin - a.point) @ a.direction)
    return Articulation(a.kind, T_rest, a.direction, point, (float(q.min()), float(q.max())))


def _reversed(a: Articulation) -> Articulation:
    return replace(a, direction=-a.direction, range=(-a.range[1], -a.range[0]))


def _pose_track(
    a: Articulation, q: np.ndarray, sigma_q: np.ndarray, observed: np.ndarray, handle_sigma_m: float
) -> PoseTrack:
    """Poses on the articulation; covariance from q along the motion, and of where the handle is on the part."""
    t = len(q)
    covariance = np.zeros((t, 6, 6))
    covariance[:, :3, :3] = np.eye(3) * (handle_sigma_m**2 + 0.003**2)
    covariance[:, 3:, 3:] = np.eye(3) * np.radians(1.0) ** 2
    T = a.pose(q)
    tangent = np.zeros((t, 6))
    if a.kind == PRISMATIC:
        tangent[:, :3] = a.direction
    elif a.kind == REVOLUTE:
        tangent[:, :3] = np.cross(a.direction, T[:, :3, 3] - a.point)
        tangent[:, 3:] = a.direction
    covariance += sigma_q[:, None, None] ** 2 * tangent[:, :, None] * tangent[:, None, :]
    return PoseTrack(T, covariance, observed, observed.copy())
