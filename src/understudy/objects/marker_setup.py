"""Which marker is on what, and tracks of the things that carry markers.

The file is JSON: {"dictionary": "apriltag_36h11", "markers": [{"id": 3, "size_m": 0.1, "on": "object",
"T_marker_frame": 4x4}, ...]}. `on` is object (its frame is the handle's: articulation.Handle), hand (origin mid-palm, x
to the fingers, z out of the palm) or torso (origin half-way between the middles of shoulders and hips, x the way the
chest faces, z up). T_marker_frame is the pose of that frame in the marker's frame (marker_pose).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from understudy.errors import RecordingError, UnderstudyError, one_of
from understudy.files import read_json
from understudy.geometry import is_rigid
from understudy.objects.markers import DICTIONARIES, MarkerPose, MarkerTracker
from understudy.trajectories import PoseTrack
from understudy.types import RegisteredFrame

CARRIERS: Final = ("object", "hand", "torso")
"""What a marker can be on."""

_AGREE: Final = float(chi2.ppf(0.9999, 6))  # markers on one thing whose poses differ by more are not fused
_ARM_M: Final = 0.1  # at which a turn counts like a shift, where poses are compared
_ORIENTED_RAD: Final = float(np.radians(15))  # largest standard deviation of a rotation that counts as measured


@dataclass(frozen=True, eq=False)
class Marker:
    """One marker."""

    id: int
    size_m: float
    """edge of the black square"""
    on: str
    """one of CARRIERS"""
    T_marker_frame: Float[np.ndarray, "4 4"]
    """pose of the carrier's frame in the marker's"""


@dataclass(frozen=True, eq=False)
class MarkerSetup:
    """All markers of a recording."""

    dictionary: str
    """one of markers.DICTIONARIES"""
    markers: tuple[Marker, ...]

    @classmethod
    def read(cls, path: Path) -> MarkerSetup:
        """From a JSON file. Raises RecordingError that names the file and the field."""
        return cls.from_json(read_json(Path(path)), str(path))

    @classmethod
    def from_json(cls, data: Mapping[str, Any], where: str) -> MarkerSetup:
        """From the file's content. Raises RecordingError that begins with `where`."""
        dictionary = data.get("dictionary")
        if dictionary not in DICTIONARIES:
            raise RecordingError(f"{where}: dictionary {dictionary!r} is not {one_of(DICTIONARIES)}")
        entries = data.get("markers")
        if not isinstance(entries, list) or not entries:
            raise RecordingError(f"{where}: markers must be a list of one marker or more")
        markers = tuple(_marker(entry, f"{where}: markers[{i}]") for i, entry in enumerate(entries))
        seen: set[int] = set()
        for i, marker in enumerate(markers):
            if marker.id in seen:
                raise RecordingError(
                    f"{where}: markers[{i}].id {marker.id} is there twice; each marker needs its own id"
                )
            seen.add(marker.id)
        try:
            MarkerTracker({m.id: m.size_m for m in markers}, dictionary)
        except UnderstudyError as e:
            raise RecordingError(f"{where}: {e}") from e
        return cls(dictionary, markers)

    def to_json(self) -> dict[str, Any]:
        """The inverse of `from_json`."""
        rows = [
            {"id": m.id, "size_m": m.size_m, "on": m.on, "T_marker_frame": m.T_marker_frame.tolist()}
            for m in self.markers
        ]
        return {"dictionary": self.dictionary, "markers": rows}


def _marker(entry: Any, where: str) -> Marker:
    if not isinstance(entry, dict):
        raise RecordingError(f"{where} must be an object with id, size_m, on and T_marker_frame")
    for key in ("id", "size_m", "on", "T_marker_frame"):
        if key not in entry:
            raise RecordingError(f"{where} has no {key!r}")
    id, size_m, on = entry["id"], entry["size_m"], entry["on"]
    if not isinstance(id, int) or isinstance(id, bool) or id < 0:
        raise RecordingError(f"{where}.id must be a whole number, got {id!r}")
    if not isinstance(size_m, int | float) or isinstance(size_m, bool) or not 0 < size_m < 10:
        raise RecordingError(f"{where}.size_m must be metres between 0 and 10, got {size_m!r}")
    if on not in CARRIERS:
        raise RecordingError(f"{where}.on {on!r} is not {one_of(CARRIERS)}")
    try:
        T = np.array(entry["T_marker_frame"], np.float64)
    except (TypeError, ValueError) as e:
        raise RecordingError(f"{where}.T_marker_frame must be 4 rows of 4 numbers") from e
    if T.shape != (4, 4) or not is_rigid(T):
        raise RecordingError(f"{where}.T_marker_frame must be a rigid 4x4 transform")
    return Marker(id, float(size_m), on, T)


def track_markers(
    frames: Iterable[RegisteredFrame], setup: MarkerSetup, T_world_cam: Float[np.ndarray, "4 4"]
) -> dict[str, PoseTrack]:
    """Tracks of everything in the setup that carries a marker, a sample per frame.

    Where no marker of a thing is seen its pose is NaN and its covariance infinite; nothing is filled in. Several
    markers on one thing are fused; those that contradict what most of them say are left out.
    """
    carriers = [on for on in CARRIERS if any(m.on == on for m in setup.markers)]
    groups = [[m.id for m in setup.markers if m.on == on] for on in carriers]
    tracker = MarkerTracker({m.id: m.size_m for m in setup.markers}, setup.dictionary, groups=groups)
    rows: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {on: [] for on in carriers}
    unknown = (np.full((4, 4), np.nan), np.diag(np.full(6, np.inf)))
    for frame in frames:
        seen = tracker.detect(frame)
        for on in carriers:
            poses = [_carried(seen[m.id], m, T_world_cam) for m in setup.markers if m.on == on and m.id in seen]
            rows[on].append(_fused(poses) if poses else unknown)
    tracks = {}
    for on, samples in rows.items():
        T = np.array([T for T, _ in samples]).reshape(-1, 4, 4)
        covariance = np.array([C for _, C in samples]).reshape(-1, 6, 6)
        observed = np.isfinite(T).all(axis=(1, 2))
        oriented = observed.copy()
        turns = np.linalg.eigvalsh(covariance[observed, 3:, 3:])[:, -1]
        oriented[observed] = np.sqrt(np.maximum(turns, 0.0)) < _ORIENTED_RAD
        tracks[on] = PoseTrack(T, covariance, observed, oriented)
    return tracks


def _carried(pose: MarkerPose, marker: Marker, T_world_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the carrier's frame in the world, and its covariance along the world's axes."""
    T_cam_frame = pose.T_cam_marker @ marker.T_marker_frame
    x, y, z = T_cam_frame[:3, 3] - pose.T_cam_marker[:3, 3]
    A = np.eye(6)
    A[:3, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0.0]])  # turns of the marker move what is away from it
    A = np.kron(np.eye(2), T_world_cam[:3, :3]) @ A
    return T_world_cam @ T_cam_frame, A @ pose.covariance @ A.T


def _fused(poses: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Mean of poses, weighted by their information, in the tangent space of one of them.

    That one is the pose that most others agree with, of several such ones the surest; those that contradict it are
    left out.
    """
    doubt = [float(np.trace(C[:3, :3]) + _ARM_M**2 * np.trace(C[3:, 3:])) for _, C in poses]
    apart = np.array([[_apart(a, b) for b in poses] for a in poses]).reshape(len(poses), len(poses), 6)
    agree = np.array(
        [[_distance(apart[i, j], a[1] + b[1]) < _AGREE for j, b in enumerate(poses)] for i, a in enumerate(poses)]
    )
    middle = min(range(len(poses)), key=lambda i: (-agree[i].sum(), doubt[i]))
    information, pull = np.zeros((6, 6)), np.zeros(6)
    for j in np.flatnonzero(agree[middle]):
        W = np.linalg.inv(poses[j][1])
        information += W
        pull += W @ apart[middle, j]
    covariance = np.linalg.inv(information)
    step = covariance @ pull
    fused = poses[middle][0].copy()
    fused[:3, 3] += step[:3]
    fused[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ fused[:3, :3]
    return fused, covariance


def _apart(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> Float[np.ndarray, "6"]:
    """(dp, dr) from the first pose to the second."""
    turn = Rotation.from_matrix(b[0][:3, :3] @ a[0][:3, :3].T).as_rotvec()
    return np.concatenate([b[0][:3, 3] - a[0][:3, 3], turn])


def _distance(e: Float[np.ndarray, "6"], covariance: Float[np.ndarray, "6 6"]) -> float:
    """Squared, in standard deviations."""
    return float(e @ np.linalg.solve(covariance, e))
