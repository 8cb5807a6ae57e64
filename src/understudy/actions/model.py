"""The action model: for each segment a mixture over phase, gripper, base and torso, in the frame of the object.

Time-driven mixtures over gripper and base together, in the manipulated object's frame, are the 2018 paper's (section
on action learning). What is ours: tangent spaces at the mean, the opening as the phase of manipulation, mirrors, and
covariances that know how few demonstrations they come from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.actions.alignment import aligned
from understudy.actions.features import BASE, TORSO, YAW, Chart, Mirror, N, floor_frame, sideways_mirror
from understudy.actions.mixture import Mixture, Regression, mixture_of_paths
from understudy.actions.motions import RobotMotion, RobotPose
from understudy.actions.objects import ObjectMotion
from understudy.actions.reproduction import Reproduction, reproduce
from understudy.actions.segments import MANIPULATE, REACH, RELEASE, SEGMENTS, Comparable, SegmentPath, comparable
from understudy.errors import UnderstudyError, one_of
from understudy.geometry import inverse
from understudy.objects.articulation import Articulation, Handle

ALIGNMENTS: Final = ("linear", "dtw")

_FLOOR_M, _FLOOR_RAD, _FLOOR_PHASE = 0.001, np.radians(0.2), 0.002  # no component is narrower
_BASE_FLOOR: Final = 2.5  # the base's floor is so much wider than the gripper's
_PRIOR: Final = {  # gripper m, gripper degrees, base m, base degrees, torso m: spread between demonstrations
    REACH: (0.03, 10.0, 0.10, 10.0, 0.05),
    MANIPULATE: (0.005, 2.0, 0.10, 10.0, 0.05),
    RELEASE: (0.03, 10.0, 0.10, 10.0, 0.05),
}
_PHASES: Final = 1000  # at which paths are compared
_SOFTENED: Final = 1.3  # times wider over the phase: accelerations halve, means move by 1 mm (docs/actions.md)
_PRIOR_DURATION: Final = 0.2  # of the mean


@dataclass(frozen=True, eq=False)
class SegmentModel:
    """One segment."""

    mixture: Mixture
    """over [phase, features] (`features.FEATURES`)"""
    chart: Chart
    duration_s: tuple[float, float]
    """mean and standard deviation"""

    def predict(self, phase: Float[np.ndarray, " t"]) -> Regression:
        """Features at phases in [0, 1]. The covariance is that of one more demonstration."""
        return self.mixture.regress(np.clip(phase, 0, 1))

    def mirrored(self, mirror: Mirror) -> SegmentModel:
        """Left and right swapped: exact, as it is linear in the features."""
        return SegmentModel(self.mixture.mapped(mirror.map), self.chart.mirrored(mirror), self.duration_s)


@dataclass(frozen=True, eq=False)
class ActionModel:
    """How to reach for an object, move it and let go of it, for any pose of the object."""

    segments: dict[str, SegmentModel]
    """of segments.SEGMENTS"""
    progress: Float[np.ndarray, " 33"]
    """share of the opening over the time of the manipulation, evenly spaced"""
    object: ObjectMotion
    """the first demonstration's; in the floor frame of its handle at rest, at its own height"""
    handle: Handle
    planes: str
    """axes of the tool, of 'xyz', to which the gripper's planes of symmetry are normal"""
    demonstrations: int
    """how many it was learnt from"""

    def __post_init__(self) -> None:
        if set(self.segments) != set(SEGMENTS):
            raise UnderstudyError(f"an action model needs the segments {SEGMENTS}, got {tuple(self.segments)}")
        if not (self.planes and set(self.planes) <= set("xyz")):
            raise UnderstudyError(f"planes must be axes of the tool, such as 'yz', got {self.planes!r}")

    def mirror(self, up: Float[np.ndarray, "3"] | None = None) -> Mirror:
        """Swaps left and right. up: the world's z in the handle's frame; None: the demonstrated object's."""
        grasp = self.segments[MANIPULATE].chart.R_mean
        return sideways_mirror(self.object.up if up is None else up, grasp, self.planes)

    def mirrored(self, up: Float[np.ndarray, "3"] | None = None) -> ActionModel:
        """The model for an object with the hinge on the other side. `up` as in `mirror`."""
        mirror = self.mirror(up)
        segments = {name: segment.mirrored(mirror) for name, segment in self.segments.items()}
        flip = np.diag([1.0, -1.0, 1.0, 1.0])  # of the world: the floor frame of the handle is its origin
        old = self.object.articulation
        turn = -1.0 if old.kind == "revolute" else 1.0  # an axis is a pseudovector
        T_start = flip @ self.object.T_start @ np.diag([*mirror.handle, 1.0])
        T_rest = flip @ old.T_rest @ np.diag([*mirror.handle, 1.0])
        direction, point = turn * flip[:3, :3] @ old.direction, flip[:3, :3] @ old.point
        articulation = Articulation(old.kind, T_rest, direction, point, old.range)
        thing = ObjectMotion(articulation, T_start, self.object.q_start, self.object.q_goal)
        return ActionModel(segments, self.progress, thing, self.handle, self.planes, self.demonstrations)

    def reproduce(
        self,
        T_world_object_rest: Float[np.ndarray, "4 4"],
        articulation: Articulation | None = None,
        q_goal: float | None = None,
        rate_hz: float = 50.0,
        start: RobotPose | None = None,
        mirror: bool | None = None,
    ) -> Reproduction:
        """What to do with an object that stands elsewhere, opens to the other side, or is larger.

        T_world_object_rest: the handle before. articulation: in the world; None: the demonstrated one, moved there.
        q_goal: None: as far as was demonstrated, within the articulation's range if that is beyond the start.
        start: where the robot is; None: where the model would start. mirror: None: when the hinge (or the way that a
        door slides) is on the other side than in the demonstrations.
        Raises UnderstudyError for objects of another kind or that open the other way, and for bad numbers.
        """
        if articulation is None:
            articulation = self.object.articulation.moved(T_world_object_rest @ inverse(self.object.T_start))
        here = ObjectMotion.at(articulation, T_world_object_rest, 0.0)
        goal = here.q_start + self.object.travel if q_goal is None else float(q_goal)
        low, high = articulation.range
        if q_goal is None and low <= here.q_start < high and self.object.travel > 0:
            goal = min(goal, high)
        thing = ObjectMotion(articulation, T_world_object_rest, here.q_start, goal)
        thing.require_like(self.object)
        if mirror is None:
            mirror = self.object.side * thing.side < 0
        model = self.mirrored(thing.up) if mirror else self
        return reproduce(model, thing, rate_hz, start)

    def deviations(self, motion: RobotMotion) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """What a demonstration has that the model has not: per segment features minus mean (n, 10), covariance
        (n, 10, 10) of the model.
        """
        cut = comparable(motion, "demonstration")
        if cut.object.side * self.object.side < 0:
            cut = cut.mirrored(self.mirror(cut.object.up))
        out = {}
        for name, segment in self.segments.items():
            path = cut.paths[name]
            expected = segment.predict(path.phase)
            out[name] = (segment.chart.features(path.poses) - expected.mean, expected.covariance)
        return out


def learn(
    motions: Sequence[RobotMotion],
    seed: int = 0,
    alignment: str = "linear",
    components: int | None = None,
    planes: str = "yz",
) -> ActionModel:
    """Learns an action model from one or more demonstrations of the same action on objects of one kind.

    alignment: 'linear': phases of reach and release are shares of their time; 'dtw': demonstrations are warped onto one
    of them. components: per segment; None: by BIC. planes: axes of the tool to which the gripper's planes of symmetry
    are normal. Demonstrations on objects with the hinge on the other side than the first one's are mirrored.
    Raises UnderstudyError that names the demonstration; MissingExtraError without scikit-learn.
    """
    if not motions:
        raise UnderstudyError("an action model needs one demonstration at least")
    if alignment not in ALIGNMENTS:
        raise UnderstudyError(f"alignment {alignment!r} is not {one_of(ALIGNMENTS)}")
    if not (planes and set(planes) <= set("xyz")):
        raise UnderstudyError(f"planes must be axes of the tool, such as 'yz', got {planes!r}")
    cuts = [comparable(motion, f"demonstration {i}") for i, motion in enumerate(motions)]
    cuts = _on_one_side(cuts, planes)
    segments = {}
    for name in SEGMENTS:
        paths = [cut.paths[name] for cut in cuts]
        if alignment == "dtw" and name != MANIPULATE:
            paths = aligned(paths)
        segments[name] = _learn_segment(paths, name, seed, components)
    thing = _at_origin(cuts[0].object, float(np.mean([cut.object.travel for cut in cuts])))
    progress = np.mean([cut.progress for cut in cuts], axis=0)
    return ActionModel(segments, progress, thing, motions[0].handle, planes, len(motions))


def _on_one_side(cuts: list[Comparable], planes: str) -> list[Comparable]:
    """All demonstrations as if their objects had the hinge on the first one's side."""
    first = cuts[0]
    grasp = first.paths[MANIPULATE].poses.T_carrier_tool[0, :3, :3]
    out = []
    for i, cut in enumerate(cuts):
        try:
            cut.object.require_like(first.object)
        except UnderstudyError as e:
            raise UnderstudyError(f"demonstration {i} does not go with demonstration 0: {e}") from e
        other_side = cut.object.side * first.object.side < 0
        out.append(cut.mirrored(sideways_mirror(cut.object.up, grasp, planes)) if other_side else cut)
    return out


def _at_origin(thing: ObjectMotion, travel: float) -> ObjectMotion:
    """The object, moved over the floor so that the floor frame of its handle is the world's origin."""
    T = inverse(lie.se2_to_se3(floor_frame(thing.T_start[None]))[0])
    return ObjectMotion(thing.articulation.moved(T), T @ thing.T_start, thing.q_start, thing.q_start + travel)


def _learn_segment(paths: list[SegmentPath], name: str, seed: int, components: int | None) -> SegmentModel:
    chart = Chart.at_mean([path.poses for path in paths])
    curves = np.array([_at_phases(path, chart) for path in paths])
    floor = np.array([_FLOOR_PHASE, *np.maximum(_floor(), 2 * _noise(paths, chart) / np.sqrt(len(paths)))])
    mixture = mixture_of_paths(curves, floor, seed=seed, components=components)
    durations = np.array([path.duration_s for path in paths])
    n, mean = len(paths), float(durations.mean())
    spread = np.sqrt((durations.var() * (n + 1) + (_PRIOR_DURATION * mean) ** 2) / n)
    mixture = _predictive(mixture, n, _prior(name)).softened(_SOFTENED)
    return SegmentModel(mixture, chart, (mean, float(spread)))


def _at_phases(path: SegmentPath, chart: Chart) -> Float[np.ndarray, "1000 11"]:
    """Phase and features at even phases, so that a demonstration counts by what it shows, not by its length.

    Many: a path at 10 Hz is continuous. With its few samples BIC would take a curve for a line and scatter.
    """
    phase, which, count = np.unique(path.phase, return_inverse=True, return_counts=True)
    grid = np.linspace(0, 1, _PHASES)
    columns = [np.bincount(which, column) / count for column in chart.features(path.poses).T]  # while it stands: means
    return np.column_stack([grid, *(np.interp(grid, phase, column) for column in columns)])


def _noise(paths: list[SegmentPath], chart: Chart) -> Float[np.ndarray, "10"]:
    """Standard deviation from sample to sample of what is no motion: by third differences, whose variance is 20-fold.

    Components narrower than twice the noise of the mean path would follow it.
    """
    rough = [np.diff(chart.features(path.poses), 3, axis=0).std(axis=0) / np.sqrt(20) for path in paths]
    return np.asarray(np.median(rough, axis=0))


def _predictive(mixture: Mixture, n: int, prior: Float[np.ndarray, "10 10"]) -> Mixture:
    """Covariances of a mixture from n demonstrations, made those of one more demonstration.

    EM's covariance S (divided by n) underrates: unbiased it is n / (n - 1) S, and the mean is uncertain by 1 / n, which
    makes (n + 1) / (n - 1) S. The mean of n - 1 such and one prior (inverse Wishart with one sample's weight) is
    ((n + 1) S + prior) / n: the prior alone and S where there is one demonstration, S where there are many.
    """
    return mixture.with_residuals(((n + 1) * mixture.residuals + prior) / n)


def _floor() -> Float[np.ndarray, "10"]:
    floor = np.repeat([_FLOOR_M, _FLOOR_RAD, _FLOOR_M, _FLOOR_M], (3, 3, 3, 1))
    floor[BASE] *= _BASE_FLOOR
    floor[YAW] = _FLOOR_RAD * _BASE_FLOOR
    floor[TORSO] = _FLOOR_M * _BASE_FLOOR
    return floor


def _prior(name: str) -> Float[np.ndarray, "10 10"]:
    """Covariance between demonstrations that is assumed before there is any."""
    gripper, turn, base, yaw, torso = _PRIOR[name]
    sigma = [*[gripper] * 3, *[np.radians(turn)] * 3, base, base, np.radians(yaw), torso]
    assert len(sigma) == N
    return np.diag(np.square(sigma))
