"""Square fiducial markers (AprilTag, ArUco): found by OpenCV, their poses refined with depth."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from understudy.errors import UnderstudyError, one_of
from understudy.objects.marker_corners import fit_corners
from understudy.objects.marker_pose import Solution, depth_plane, solve_square
from understudy.types import RegisteredFrame

DICTIONARIES: Final = {
    name.removeprefix("DICT_").lower(): int(getattr(cv2.aruco, name))
    for name in dir(cv2.aruco)
    if name.startswith("DICT_") and name.isupper()
}
"""Names of families of markers, such as 'apriltag_36h11' and '4x4_50', and OpenCV's numbers for them."""

_ENLARGED: Final = 2.0  # images in which a thing's markers are missing are looked at again, so much larger ...
_ENLARGED_EVERY: Final = 5  # ... one frame in so many: it takes five times as long as the rest together
_NEAR: Final = 2.5  # of a tag's size: where it is looked for first, around where it was
_NEAR_ENLARGED: Final = 3.0  # at most
_NEAR_PX: Final = 60  # size of a tag in the image of its surroundings, that small ones are enlarged to
_LEAST_NEAR_PX: Final = 40
_REMEMBERED: Final = 10  # frames
_TURN: Final = 0.35  # radians: between frames, a turn of this size costs as much as one standard deviation
_SAME_RAD: Final = 0.01
_LARGEST_DOUBT: Final = 9.0  # that continuity can cast on a pose, squared standard deviations

Region = tuple[int, int, int, int]
"""Of an image: its left, top, right and bottom, pixels; those two not in it."""


@dataclass(frozen=True, eq=False)
class MarkerPose:
    """A marker in one frame."""

    T_cam_marker: Float[np.ndarray, "4 4"]
    """marker frame: origin at its middle, x to its right, y up, z out of it"""
    covariance: Float[np.ndarray, "6 6"]
    """of (dp, dr), metres and radians, along the camera's axes; with the other pose's share where it is ambiguous"""
    corners_2d: Float[np.ndarray, "4 2"]
    """colour pixels: left above, right above, right below, left below"""
    ambiguity: float
    """probability that the mirrored pose (the square's other solution) is the right one, 0 to 0.5"""
    used_depth: bool


class MarkerTracker:
    """Finds markers in frames, one after the other.

    size_m: edge of the black square, of all markers or by id; with a mapping, other ids are left alone.
    dictionary: one of DICTIONARIES. depth: whether poses use it. groups: ids that are on the same thing: while one of
    them is followed, the others are looked for around it only. Without groups each marker is a thing of its own.
    """

    def __init__(
        self,
        size_m: Mapping[int, float] | float,
        dictionary: str = "apriltag_36h11",
        *,
        depth: bool = True,
        groups: Collection[Collection[int]] | None = None,
    ) -> None:
        if dictionary not in DICTIONARIES:
            raise UnderstudyError(f"markers: dictionary {dictionary!r} is not {one_of(DICTIONARIES)}")
        sizes = size_m.values() if isinstance(size_m, Mapping) else [size_m]
        if not all(0 < size < 10 for size in sizes):
            raise UnderstudyError(f"markers: sizes must be positive metres, got {size_m}")
        self._dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary])
        count = len(self._dictionary.bytesList)
        outside = [i for i in size_m if not 0 <= i < count] if isinstance(size_m, Mapping) else []
        if outside:
            raise UnderstudyError(f"markers: dictionary {dictionary!r} has ids 0 to {count - 1}, not {outside}")
        self._size, self._depth = size_m, depth
        ids = list(size_m) if isinstance(size_m, Mapping) else []
        self._groups = [frozenset(group) for group in groups] if groups is not None else [frozenset([i]) for i in ids]
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(self._dictionary, parameters)
        self._last: dict[int, tuple[MarkerPose, int]] = {}
        self._frame = 0
        self._patterns: dict[int, np.ndarray] = {}

    def detect(self, frame: RegisteredFrame) -> dict[int, MarkerPose]:
        """Markers by id. One that is seen twice in a frame is left out: nobody knows which is meant.

        With a mapping of sizes, markers that are all found around where they were are not looked for elsewhere.
        """
        self._frame += 1
        gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
        found = self._found(gray)
        poses = {}
        for id, corners in found.items():
            pose = self._pose(frame, gray, id, corners)
            if pose is not None:
                poses[id] = pose
                self._last[id] = (pose, self._frame)
        return poses

    def _wanted(self, id: int) -> bool:
        return not isinstance(self._size, Mapping) or id in self._size

    def _found(self, gray: UInt8[np.ndarray, "h w"]) -> dict[int, np.ndarray]:
        """Corners (pixels) by id: first around where they were, then in the whole image, then by looking closer."""
        recent = {id: pose for id, (pose, when) in self._last.items() if self._frame - when <= _REMEMBERED}
        seen: dict[int, list[np.ndarray]] = {}
        for region in _joined([_around(pose.corners_2d, gray.shape) for pose in recent.values()]):
            seen |= self._near(gray, region, [p for p in recent.values() if _holds(region, p.corners_2d.mean(0))])
        if not self._complete(seen) or self._frame % _ENLARGED_EVERY == 0:
            seen = self._search(gray, (0, 0), 1.0) | seen
        if not self._complete(seen) and self._frame % _ENLARGED_EVERY == 1:
            seen = self._search(gray, (0, 0), _ENLARGED) | seen
        return {id: corners[0] for id, corners in seen.items() if len(corners) == 1}

    def _complete(self, seen: Collection[int]) -> bool:
        """Whether of every thing a marker is seen; never, where nobody said what there is."""
        return bool(self._groups) and all(not group.isdisjoint(seen) for group in self._groups)

    def _near(self, gray: UInt8[np.ndarray, "h w"], region: Region, poses: list[MarkerPose]) -> dict[int, list]:
        """What is in a part of the image, which is enlarged for the smallest marker that was there."""
        u, v, right, low = region
        if right - u <= 8 or low - v <= 8:
            return {}
        smallest = min(float(np.ptp(pose.corners_2d, axis=0).max()) for pose in poses)
        scale = float(np.clip(_NEAR_PX / max(smallest, 1.0), 1.0, _NEAR_ENLARGED))
        return self._search(gray[v:low, u:right], (u, v), scale)

    def _search(
        self, gray: UInt8[np.ndarray, "h w"], origin: tuple[int, int], scale: float
    ) -> dict[int, list[np.ndarray]]:
        image = gray
        if scale != 1:
            size = [round(scale * length) for length in gray.shape[::-1]]
            image = cv2.resize(gray, size, interpolation=cv2.INTER_CUBIC)
        shrink = np.array(gray.shape[::-1]) / image.shape[::-1]  # 1 / scale, but for whole pixels
        corners, ids, _ = self._detector.detectMarkers(image)
        seen: dict[int, list[np.ndarray]] = {}
        for id, quad in zip([] if ids is None else [int(i) for i in ids.ravel()], corners, strict=True):
            if self._wanted(id):
                pixels = (quad.reshape(4, 2).astype(np.float64) + 0.5) * shrink - 0.5 + origin
                seen.setdefault(id, []).append(pixels)
        return seen

    def _pattern(self, id: int) -> UInt8[np.ndarray, "c c"]:
        """The marker with its black border, a pixel per cell."""
        if id not in self._patterns:
            cells = self._dictionary.markerSize + 2
            self._patterns[id] = cv2.aruco.generateImageMarker(self._dictionary, id, cells, borderBits=1)
        return self._patterns[id]

    def _pose(self, frame: RegisteredFrame, gray: np.ndarray, id: int, corners: np.ndarray) -> MarkerPose | None:
        fitted = fit_corners(gray, corners, self._pattern(id))
        corners = fitted.uv
        plane = depth_plane(frame.depth, corners, frame.depth.scale_to(frame.camera)) if self._depth else None
        size = self._size[id] if isinstance(self._size, Mapping) else self._size
        solutions = solve_square(frame.camera, corners, fitted.covariance, size, plane)
        if not solutions:
            return None
        costs = np.array([s.cost + self._doubt(id, s) for s in solutions])
        order = np.argsort(costs, kind="stable")
        best, other = solutions[order[0]], solutions[order[-1]]
        ambiguity = 0.0
        if not _same(best, other):
            ambiguity = float(1 / (1 + np.exp(min(costs[order[-1]] - costs[order[0]], 700.0))))
        return MarkerPose(best.T_cam_marker, _mixed(best, other, ambiguity), corners, ambiguity, plane is not None)

    def _doubt(self, id: int, solution: Solution) -> float:
        """Half a squared residual: how far a pose has turned since the marker was seen last."""
        last = self._last.get(id)
        if last is None or self._frame - last[1] > _REMEMBERED or last[0].ambiguity > 0.2:
            return 0.0
        turn = solution.T_cam_marker[:3, :3] @ last[0].T_cam_marker[:3, :3].T
        angle = float(Rotation.from_matrix(turn).magnitude())
        return min(angle**2 / (_TURN**2 * (self._frame - last[1])), _LARGEST_DOUBT) / 2


def _around(corners: Float[np.ndarray, "4 2"], shape: tuple[int, ...]) -> Region:
    """Where a marker is looked for that was there."""
    reach = max(_NEAR * float(np.ptp(corners, axis=0).max()), _LEAST_NEAR_PX)
    low = np.clip((corners.mean(axis=0) - reach).astype(int), 0, shape[1::-1])
    high = np.clip((corners.mean(axis=0) + reach).astype(int), 0, shape[1::-1])
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _joined(regions: list[Region]) -> list[Region]:
    """The regions, those that overlap made into one."""
    joined: list[Region] = []
    for region in regions:
        apart = []
        for other in joined:
            if region[0] < other[2] and other[0] < region[2] and region[1] < other[3] and other[1] < region[3]:
                low, high = np.minimum(region, other)[:2], np.maximum(region, other)[2:]
                region = int(low[0]), int(low[1]), int(high[0]), int(high[1])
            else:
                apart.append(other)
        joined = [*apart, region]
    return joined


def _holds(region: Region, point: Float[np.ndarray, "2"]) -> bool:
    return bool(region[0] <= point[0] <= region[2] and region[1] <= point[1] <= region[3])


def _same(a: Solution, b: Solution) -> bool:
    """Whether two solutions are one minimum."""
    turn = Rotation.from_matrix(a.T_cam_marker[:3, :3] @ b.T_cam_marker[:3, :3].T)
    return a is b or float(turn.magnitude()) < _SAME_RAD


def _mixed(best: Solution, other: Solution, share: float) -> Float[np.ndarray, "6 6"]:
    """Second moment, around the best, of a mixture of two solutions."""
    turn = Rotation.from_matrix(other.T_cam_marker[:3, :3] @ best.T_cam_marker[:3, :3].T).as_rotvec()
    d = np.concatenate([other.T_cam_marker[:3, 3] - best.T_cam_marker[:3, 3], turn])
    return (1 - share) * best.covariance + share * (other.covariance + np.outer(d, d))
