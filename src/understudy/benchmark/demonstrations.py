"""How near a demonstration is to what really happened: errors of hand, torso, object and segments.

Everything is compared in the colour camera's frame (headings: on the demonstration's own floor), sample by sample on
the demonstration's clock, so that the choice of the world's frame is no error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from understudy.demonstration.clock import resample_poses
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.segments import MOVING
from understudy.errors import UnderstudyError
from understudy.geometry import angle_between, inverse
from understudy.lie import wrapped
from understudy.objects.articulation import PRISMATIC, REVOLUTE, Articulation
from understudy.skeleton import JOINT
from understudy.trajectories import PoseTrack

BOUNDARY_S: Final = 0.3
"""A segment's boundary is found when it is so near."""


@dataclass(frozen=True, eq=False)
class TrueDemonstration:
    """What happened in a recording, colour camera's frame."""

    task: str
    times_s: Float[np.ndarray, " t"]
    acting: str
    T_cam_hand: Float[np.ndarray, "t 4 4"]
    """of the acting hand"""
    hand_visible: Bool[np.ndarray, " t"]
    T_cam_torso: Float[np.ndarray, "t 4 4"]
    """on the floor: x the way that the chest faces, z up"""
    T_cam_object: Float[np.ndarray, "t 4 4"]
    """of the handle"""
    articulation: Articulation
    q: Float[np.ndarray, " t"]

    @property
    def boundaries_s(self) -> tuple[float, float]:
        """Seconds at which the handle begins to move faster than MOVING, and at which it no longer does."""
        way = self.q * (self.articulation.radius_m if self.articulation.kind == REVOLUTE else 1.0)
        fine = np.linspace(self.times_s[0], self.times_s[-1], 50 * len(self.times_s))
        path = np.interp(fine, self.times_s, way)
        moving = np.flatnonzero(np.abs(np.gradient(path, fine)) > MOVING)
        if not len(moving):
            raise UnderstudyError("the truth's object does not move")
        return float(fine[moving[0]]), float(fine[moving[-1]])


@dataclass(frozen=True, eq=False)
class DemonstrationErrors:
    """Errors of one demonstration. Arrays hold one number for each sample that counts."""

    task: str
    hand_m: Float[np.ndarray, " _"]
    """where the hand is visible and a position is given"""
    hand_given: float
    """share of the samples with a visible hand that have a position"""
    hand_turn_rad: Float[np.ndarray, " _"]
    torso_m: Float[np.ndarray, " _"]
    """on the floor"""
    heading_rad: Float[np.ndarray, " _"]
    object_m: Float[np.ndarray, " _"]
    """of the handle's frame"""
    object_rad: Float[np.ndarray, " _"]
    motion_m: Float[np.ndarray, " _"]
    """of the true handle, were it moved from its true rest as the estimated object moved from its own"""
    boundaries_s: tuple[float, float]
    """estimated minus true: start and end of the manipulation"""
    acting_right: bool
    kind_right: bool
    axis_rad: float
    radius_m: float
    """error of the hinge's radius; NaN without one"""
    range_share: float
    """error of the range, as a share of the true one"""
    nees: float
    """mean squared error of the hand's position in units of its variance: 3 when the covariances are right"""


def from_stage(folder: str | Path) -> TrueDemonstration:
    """The truth of a recording from the stage. Raises RecordingError when it has none."""
    from understudy import recordings
    from understudy.stage.truth import read_stage_truth

    stage = read_stage_truth(folder)
    with recordings.open(folder) as recording:
        people = recording.truth
        row = JOINT[f"{stage.acting}_wrist"]
        shown = people.frames if people is not None else {}
        visible = [any(p.in_view[row] and not p.occluded[row] for p in shown.get(i, ())) for i in recording.indices]
    T_cam_world = inverse(stage.T_world_cam)
    T_world_torso = np.tile(np.eye(4), (len(stage.times_s), 1, 1))
    T_world_torso[:, :3, :3] = Rotation.from_rotvec(stage.torso_xy_yaw[:, 2:] * [0, 0, 1]).as_matrix()
    T_world_torso[:, :2, 3] = stage.torso_xy_yaw[:, :2]
    return TrueDemonstration(
        stage.task,
        stage.times_s,
        stage.acting,
        T_cam_world @ stage.T_world_hand[stage.acting],
        np.array(visible),
        T_cam_world @ T_world_torso,
        T_cam_world @ stage.T_world_object,
        stage.furniture.articulation.moved(T_cam_world),
        stage.q,
    )


def score(demo: Demonstration, truth: TrueDemonstration) -> DemonstrationErrors:
    """Compares a demonstration with the truth. Raises UnderstudyError when the two do not overlap in time."""
    even = demo.times_s
    if even[0] > truth.times_s[-1] or even[-1] < truth.times_s[0]:
        raise UnderstudyError("demonstration and truth do not overlap in time")
    T_cam_world = inverse(demo.T_world_cam)
    hand, torso, object = (
        _at(T, truth.times_s, even) for T in (truth.T_cam_hand, truth.T_cam_torso, truth.T_cam_object)
    )
    visible = np.interp(even, truth.times_s, truth.hand_visible.astype(float)) > 0.75
    own_hand = T_cam_world @ demo.hand.T_world_x
    shift = own_hand[:, :3, 3] - hand[:, :3, 3]
    counts = visible & demo.hand.observed & np.isfinite(shift).all(axis=1)
    planar = _planar(demo.T_world_cam @ torso)
    apart = demo.torso.xy_yaw - planar
    heading = np.abs(wrapped(apart[:, 2]))
    there = np.isfinite(apart).all(axis=1)
    own_object = T_cam_world @ demo.object.T_world_x
    known = demo.object.known
    moved = T_cam_world @ demo.object.T_world_x @ inverse(demo.articulation.T_rest) @ demo.T_world_cam @ object[0]
    begin, end = truth.boundaries_s
    variance = demo.hand.covariance[counts][:, :3, :3]
    world_shift = shift[counts] @ demo.T_world_cam[:3, :3].T
    nees = np.einsum("ni,nij,nj->n", world_shift, np.linalg.inv(variance), world_shift) if counts.any() else np.zeros(1)
    found, real = demo.articulation.moved(T_cam_world), truth.articulation
    last = min(demo.segments.release, len(even) - 1)
    turn = angle_between(found.direction, real.direction) if found.kind == real.kind else float("nan")
    return DemonstrationErrors(
        demo.task,
        np.linalg.norm(shift[counts], axis=1),
        float(counts.sum() / max(1, visible.sum())),
        _turn(own_hand[counts & demo.hand.oriented], hand[counts & demo.hand.oriented]),
        np.linalg.norm(apart[there, :2], axis=1),
        heading[there],
        np.linalg.norm(own_object[known, :3, 3] - object[known, :3, 3], axis=1),
        _turn(own_object[known], object[known]),
        np.linalg.norm(moved[known, :3, 3] - object[known, :3, 3], axis=1),
        (float(even[demo.segments.grasp] - begin), float(even[last] - end)),
        demo.acting == truth.acting,
        found.kind == real.kind,
        float(turn),
        abs(found.radius_m - real.radius_m) if real.kind == REVOLUTE == found.kind else float("nan"),
        abs(np.ptp(found.range) - np.ptp(truth.q)) / max(float(np.ptp(truth.q)), 1e-9)
        if found.kind == real.kind and real.kind in (PRISMATIC, REVOLUTE)
        else float("nan"),
        float(np.mean(nees)),
    )


def table(errors: Sequence[DemonstrationErrors]) -> tuple[list[str], list[list[str]]]:
    """Heads and rows, a row for each task and one for all."""
    tasks = list(dict.fromkeys(e.task for e in errors))
    groups = [(task, [e for e in errors if e.task == task]) for task in tasks]
    if len(tasks) > 1:
        groups.append(("all", list(errors)))
    return HEADS, [[name, str(len(group)), *_numbers(group)] for name, group in groups]


HEADS: Final = [
    "task", "demos", "hand cm", "hand 90 %", "hand deg", "torso cm", "heading deg", "object cm", "object 95 %",
    "object deg", "motion cm", "kind right", "axis deg", "radius cm", "range %", "within 0.3 s", "acting right",
]  # fmt: skip

DEFINITIONS: Final = (
    "Medians over samples, unless a head says otherwise. hand: distance between estimated and true middle of the "
    "acting palm, where it is visible (its wrist inside the image and not occluded); hand deg: angle between the "
    "hand's frames where a palm was given; torso, heading: on the floor; object: of the handle's frame, over all "
    "samples; motion: how far the true handle would be off if it moved as the estimate says; kind right, acting right: "
    "of demonstrations; axis: angle between directions; range: error of how far it was opened; within 0.3 s: of the "
    "two boundaries of the manipulation (true: where the handle is faster than 2 cm/s)."
)


def _numbers(group: Sequence[DemonstrationErrors]) -> list[str]:
    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(e, name) for e in group])

    def median(values: np.ndarray, scale: float, digits: int = 1, share: float = 50) -> str:
        values = values[np.isfinite(values)]
        return f"{scale * np.percentile(values, share):.{digits}f}" if len(values) else "-"

    boundaries = np.abs([b for e in group for b in e.boundaries_s])
    right = [sum(getattr(e, name) for e in group) for name in ("kind_right", "acting_right")]
    return [
        median(joined("hand_m"), 100),
        median(joined("hand_m"), 100, share=90),
        median(joined("hand_turn_rad"), 180 / np.pi, 0),
        median(joined("torso_m"), 100),
        median(joined("heading_rad"), 180 / np.pi, 0),
        median(joined("object_m"), 100),
        median(joined("object_m"), 100, share=95),
        median(joined("object_rad"), 180 / np.pi),
        median(joined("motion_m"), 100),
        f"{right[0]}/{len(group)}",
        median(np.array([e.axis_rad for e in group]), 180 / np.pi),
        median(np.array([e.radius_m for e in group]), 100),
        median(np.array([e.range_share for e in group]), 100),
        f"{100 * float((boundaries <= BOUNDARY_S).mean()):.0f} %",
        f"{right[1]}/{len(group)}",
    ]


def _at(T: Float[np.ndarray, "t 4 4"], times: np.ndarray, at: np.ndarray) -> Float[np.ndarray, "n 4 4"]:
    t = len(T)
    yes = np.ones(t, bool)
    return resample_poses(PoseTrack(T, np.zeros((t, 6, 6)), yes, yes), times, at).T_world_x


def _planar(T: Float[np.ndarray, "t 4 4"]) -> Float[np.ndarray, "t 3"]:
    return np.column_stack([T[:, 0, 3], T[:, 1, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0])])


def _turn(a: Float[np.ndarray, "n 4 4"], b: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " n"]:
    """Angles between rotations, radians."""
    both = np.isfinite(a).all(axis=(1, 2)) & np.isfinite(b).all(axis=(1, 2))
    if not both.any():
        return np.zeros(0)
    A, B = Rotation.from_matrix(a[both, :3, :3]), Rotation.from_matrix(b[both, :3, :3])
    return np.asarray((A.inv() * B).magnitude())
