"""The moving part of a recording, without markers: found, tracked, its articulation and its handle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import minimum_filter1d

from understudy.errors import UnderstudyError
from understudy.geometry import inverse, is_rigid, transform_points
from understudy.objects.articulation import REVOLUTE, Articulation
from understudy.objects.moving_part.grip import Part, handle_near, handle_of
from understudy.objects.moving_part.hinge import fit_hinge
from understudy.objects.moving_part.motion import Motion, refine, sharpen, spread_frames, track
from understudy.objects.moving_part.outcome import at_handle, at_rest, pose_track, reversed_
from understudy.objects.moving_part.part import HandHint, MovingPart, MovingPartConfig
from understudy.objects.moving_part.region import Region, grow, telling
from understudy.objects.moving_part.scoring import PartModel, Scorer, in_part
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
from understudy.types import Person

_FAMILY: Final = {"out": 1.0, "level": 1.0, "hinge": 1.0, "flap": 0.7, "lift": 0.7}  # how common they are
_TRUST_LATER, _TRUST_LAST = (
    0.3,
    0.1,
)  # in the hand, the better part and articulation are known: hidden hands are far off
_WIDEST: Final = 1.3  # metres: radius of a hinge; no door leaf is wider
_POLISHED: Final = 2  # times that a hinge is fitted to the last track
_AGREES: Final = 0.2  # of a frame that may tell where a hinge is
_SURE: Final = 0.1  # metres: sigma of a hand that may tell where on the part it is
_WORSE: Final = 0.95  # of the best merit: what a refinement may lose
_HAND_SPREAD: Final = 0.1  # metres by which the hand may wander on the handle


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
        worth = [t for t in refined if t.merit >= self.config.least_evidence_m2]
        last = (self._polished(self._refined(t, (0.008,))) for t in worth)
        best = next((t for t in last if t.articulation.radius_m < _WIDEST), None)
        if best is None:
            return self._still()
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

    def _follow(
        self, model: PartModel, articulation: Articulation, points: int, sigma_m: float, trust: float = 1.0
    ) -> Motion:
        thin = model.thinned(points, self.rng)
        return track(self.scorer, thin, articulation, self.hand, self.times_s, int(self.grasps[0]), sigma_m, trust)

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
            held = self._held(articulation, motion.q, moving)
            spread = float(np.sqrt(np.median(((held - np.median(held, axis=0)) ** 2).sum(1))))
        way = float(np.ptp(motion.q)) * step_m(articulation)
        possible = articulation.radius_m < _WIDEST  # beyond, it is a drawer that is not quite straight
        trust = 1 / (1 + (spread / _HAND_SPREAD) ** 2) * _FAMILY[h.family] * (way > self.config.least_way_m) * possible
        merit = region.evidence_m2 * float(trust)
        return _Tracked(h, articulation, region.model, motion, region.evidence_m2, spread, merit)

    def _refined(self, t: _Tracked, sigmas_m: tuple[float, ...] = (0.015, 0.008)) -> _Tracked:
        best = t
        for sigma_m in sigmas_m:
            articulation, thickness = self._fit(t, sigma_m)
            model = replace(t.model, thickness_m=thickness)
            motion = self._follow(model, articulation, 160, 1.2 * sigma_m, 1.0 if sigma_m > 0.01 else _TRUST_LATER)
            region = self._grow(model, articulation, motion)
            if region is None:
                break
            t = self._judged(t.hypothesis, articulation, region, motion)
            best = t if t.merit > _WORSE * best.merit else best
        return best

    def _polished(self, t: _Tracked) -> _Tracked:
        """With a last track that hardly cares about the hand; a hinge is fitted to it again."""
        t = replace(t, motion=self._last(t))
        for _ in range(_POLISHED if t.articulation.kind == REVOLUTE else 0):
            t = replace(t, articulation=self._fit(t, 0.008)[0])
            t = replace(t, motion=self._last(t))
        return t

    def _last(self, t: _Tracked) -> Motion:
        return self._follow(telling(t.model, t.articulation), t.articulation, 200, 0.01, _TRUST_LAST)

    def _held(self, articulation: Articulation, q: np.ndarray, moving: np.ndarray) -> Float[np.ndarray, "n 3"]:
        """Where the hand is on the part while it moves (world, at rest)."""
        index = np.flatnonzero(moving)
        sure = index[self.hand.sigma_m[index] < _SURE]
        index = sure if len(sure) >= 3 else index
        return in_part(articulation, q[index], self.hand.positions[index])

    def _fit(self, t: _Tracked, sigma_m: float) -> tuple[Articulation, float]:
        """Articulation, and thickness of the front, from some frames."""
        trusted = self._trusted(t.articulation, t.motion)
        thin = t.model.thinned(220, self.rng)
        if t.articulation.kind == REVOLUTE and t.model.flat.sum() > 40:
            good = trusted & (t.motion.agreement > _AGREES)
            picked = spread_frames(t.motion.q, good if good.sum() > 5 else trusted, 24)
            return fit_hinge(self.scorer, thin, t.articulation, t.motion.q[picked], picked, sigma_m)
        picked = spread_frames(t.motion.q, trusted, 12)
        return refine(self.scorer, thin, t.articulation, t.motion.q, picked, sigma_m)

    # --- result ---

    def _result(self, t: _Tracked, runner_up: float) -> MovingPart:
        sharp = telling(t.model, t.articulation).thinned(self.config.points, self.rng)
        motion = sharpen(self.scorer, sharp, t.articulation, t.motion)
        q = motion.q
        assert motion.curvature is not None
        way = np.abs(q) * step_m(t.articulation)
        observed = self.stack.usable & (motion.agreement > 0.1) & (motion.curvature > 0)
        moving = np.abs(np.gradient(t.motion.q)) * step_m(t.articulation) > 0.003
        first, last = (int(i) for i in np.flatnonzero(moving)[[0, -1]]) if moving.any() else (0, 0)
        if way.max() < self.config.least_way_m:
            return self._still()
        grip = np.median(self._held(t.articulation, q, moving), axis=0)
        part = Part(t.articulation, t.model, q, observed, last)
        T_rest, handle, seen = handle_of(part, self.stack, self.ref, self.T_world_cam, grip)
        articulation = at_handle(t.articulation, T_rest, q)
        if np.median(q[last:]) < 0:
            articulation, q = reversed_(articulation), -q
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
        track = pose_track(articulation, q, sigma_m / reach, observed, handle_sigma_m=0.01 if seen else 0.04)
        points = transform_points(inverse(T_rest), t.model.points)
        return MovingPart(track, articulation, handle, q, sigma_m / reach, (first, last), points, quality)

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
        camera, at = self.stack.camera, panel.T_world_panel[:3, 3]
        T_rest, handle, seen = handle_near(self.ref, camera, self.T_world_cam, normal, front, at, self.ref.z > 0)
        points = transform_points(inverse(T_rest), panel.model.points)
        return at_rest(T_rest, handle, seen, points, self.stack.usable)
