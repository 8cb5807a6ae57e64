"""The default detector: BlazePose's networks on every person of the image, steered and checked by depth.

In order: things in the depth -> windows -> candidates -> three looks at each (as seen; with other people hidden; the
same mirrored) -> agreement of the looks and of the depth under them -> people.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from understudy.assets import model_path
from understudy.detectors.blazepose_nets import DETECTOR_SIZE, LANDMARK_SIZE, BlazePoseNets, Landmarks, Region
from understudy.detectors.windows import Scene, Window, tiled, windows
from understudy.skeleton import BONES, FACE, JOINT, N_JOINTS, TORSO, to_coco18
from understudy.types import Keypoints2D, RegisteredDepth

_ON_PERSON, _UNMEASURED, _BEHIND_OTHER, _OFF_PERSON = 1.0, 0.9, 0.35, 0.25
"""What a keypoint's place is worth: on its person, in a depth hole, hidden by something nearer, on the background"""
_LEAST = 0.65
_WITHIN_TORSO = np.random.default_rng(0).dirichlet(np.ones(4), 60)  # weights of its corners: points all over it
_SHOULDERS, _HIPS = TORSO[1:3], TORSO[3:5]
_BODY = np.setdiff1d(np.arange(N_JOINTS), FACE)


@dataclass(frozen=True)
class Candidate:
    """Somebody, before the landmarks."""

    score: float
    region: Region
    hip: Float[np.ndarray, "2"]
    torso: float
    """mid hip to mid shoulder, pixels"""
    group: int
    """index of the thing in the depth image, -1 if none"""
    own_window: bool = False
    """seen in the window around its thing, which shows it better than a tile does"""


@dataclass(frozen=True)
class Sighting:
    """Somebody, with the landmarks."""

    keypoints: Keypoints2D
    torso: float
    """mid hip to mid shoulder, pixels; known also when some of these are outside the image"""
    group: int = -1
    """index of the thing in the depth image, -1 if none"""

    def life_size(self, scene: Scene) -> bool:
        """Whether torso and extent could be a person's, however turned, bent or cut off. True without depth."""
        z = self.keypoints.torso_z
        if z is None or not self.keypoints.found.any():
            return True
        metre = scene.pixels_per_metre(z)
        extent = float(np.ptp(self.keypoints.uv[self.keypoints.found], axis=0).max())
        return 0.08 < self.torso / metre < 1.1 and extent > 0.3 * metre

    def repeats(self, other: Sighting) -> bool:
        """Whether this is the other person once more: the joints of both coincide; or, unless depth tells them apart,
        these joints lie along the other's bones (somebody seen in a leg, or another guess at a strange posture).
        """
        p, q = self.keypoints, other.keypoints
        both = _BODY[p.found[_BODY] & q.found[_BODY]]
        if len(both) >= 3:
            apart = float(np.median(np.linalg.norm(p.uv[both] - q.uv[both], axis=1)))
            if apart < 0.25 * max(self.torso, other.torso):
                return True
        if self.group != other.group and min(self.group, other.group) >= 0:
            return False
        near = (0.3 if self.torso < 0.5 * other.torso else 0.2) * other.torso
        along = _distance_to_bones(p.uv[p.score > 0.2], q) < near
        return len(along) > 0 and float(along.mean()) > 0.7


class BlazePoseDetector:
    """All people of an image; with depth, also when they overlap."""

    name = "blazepose"

    def __init__(self, min_score: float = 0.5, threads: int = 2):
        """min_score: least probability that a region holds a person. threads: networks that run at a time."""
        self.min_score = min_score
        self._nets = BlazePoseNets(model_path("pose_detection"), model_path("pose_landmark_full"), threads)
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="blazepose")

    def detect(
        self, color: UInt8[np.ndarray, "h w 3"], depth: RegisteredDepth | None = None, index: int = 0
    ) -> list[Keypoints2D]:
        """People in an RGB image (see `Detector.detect`)."""
        height, width = color.shape[:2]
        tiles = tiled(width, height)
        found = [self._pool.submit(self._found_in, tile, color, None) for tile in tiles]
        scene = self._scene(color, depth)  # while the networks look at the tiles
        others = windows(width, height, scene)
        found += [self._pool.submit(self._found_in, window, color, scene) for window in others]
        candidates = distinct(_candidates(scene, tiles + others, [rows.result() for rows in found]))
        looks = self._pool.map(lambda candidate: self._three_looks(color, scene, candidate), candidates)
        people = [
            self._fuse(scene, candidate, [_coco(look, width, height) for look in three])
            for candidate, three in zip(candidates, looks, strict=True)
            if max(look.score for look in three) >= self.min_score
        ]
        return merge_duplicates([p for p in people if scene is None or p.life_size(scene)])

    @staticmethod
    def _scene(color: np.ndarray, depth: RegisteredDepth | None) -> Scene | None:
        if depth is None or not depth.z.any():
            return None
        height, width = color.shape[:2]
        return Scene(depth, depth.camera.resize(width, height))

    def _found_in(self, look: Window, color: np.ndarray, scene: Scene | None) -> Float[np.ndarray, "n 9"]:
        """Rows of everybody whom the detection network sees in one window (see `BlazePoseNets.detect`)."""
        crop = look.region.crop(color, DETECTOR_SIZE)
        if scene is not None and look.group is not None:
            crop = scene.hide(crop, look.region, scene.hidden(look.group))
        return self._nets.detect(crop)

    def _three_looks(
        self, color: np.ndarray, scene: Scene | None, candidate: Candidate
    ) -> tuple[Landmarks, Landmarks, Landmarks]:
        """As seen; again from a better region, with other people hidden where depth tells them apart; and once more
        from a still better region, mirrored.
        """
        region = candidate.region
        hidden = scene.hidden(candidate.group) if scene is not None and candidate.group >= 0 else None

        def masked(region: Region) -> np.ndarray:
            crop = region.crop(color, LANDMARK_SIZE)
            return crop if scene is None or hidden is None else scene.hide(crop, region, hidden)

        plain = self._nets.landmarks(region.crop(color, LANDMARK_SIZE), region)
        # under an overlap the first look may have followed the other person: keep the detector's region there
        if scene is None or hidden is None or not scene.shows(region, hidden):
            region = plain.next_region
        checked = self._nets.landmarks(masked(region), region)
        region = checked.next_region
        return plain, checked, self._nets.landmarks(masked(region), region, mirrored=True)

    @staticmethod
    def _fuse(scene: Scene | None, candidate: Candidate, looks: list[Float[np.ndarray, "18 3"]]) -> Sighting:
        """One person from the three looks. The masked ones place the joints; the plain one can only lower a score."""
        plain, checked, mirrored = looks
        torso = max(_torso_length(checked), 0.5 * candidate.torso, 1.0)
        torso_z, place = None, np.ones((2, len(checked)))
        if scene is not None:
            torso_z = _torso_depth(scene, candidate, checked)
            place = np.stack([_places(scene, candidate.group, torso_z, k[:, :2]) for k in (checked, mirrored)])
        apart = np.linalg.norm(checked[:, :2] - mirrored[:, :2], axis=1) / torso
        weight = place * np.stack([checked[:, 2], mirrored[:, 2]])
        together = (apart < 0.2) & (place[0] == place[1])
        choice = np.where(together, 0.5, weight[1] > weight[0])[:, None]
        rows = (1 - choice) * checked + choice * mirrored
        place = np.where(choice[:, 0] > 0.5, place[1], place[0])
        from_plain = np.linalg.norm(rows[:, :2] - plain[:, :2], axis=1) / torso
        rows[:, 2] *= place * _agreement(apart, 0.2) * _agreement(from_plain, 0.4)
        rows[JOINT["neck"], :2] = rows[_SHOULDERS, :2].mean(0)
        rows[JOINT["neck"], 2] = rows[_SHOULDERS, 2].min()
        return Sighting(Keypoints2D.where(rows[:, :2], rows[:, 2], torso_z), torso, candidate.group)


def _candidates(scene: Scene | None, looks: list[Window], found: list[Float[np.ndarray, "_ 9"]]) -> list[Candidate]:
    """Everybody whom the detection network saw in some window; the same person many times. found: in each."""
    out = []
    for look, rows in zip(looks, found, strict=True):
        A = look.region.to_image(DETECTOR_SIZE)
        for row in rows:
            hip, rim, shoulder, _ = row[1:].reshape(4, 2) @ A[:, :2].T + A[:, 2]
            torso = float(np.linalg.norm(hip - shoulder))
            group = -1 if scene is None else _group_between(scene, hip, shoulder)
            if look.group is not None and group not in (-1, look.group):
                continue  # somebody else, whose own window shows them better
            region, own = Region.from_points(hip, rim), look.group is not None
            out.append(Candidate(float(row[0]), region, hip, torso, group, own))
    return out


def _torso_length(rows: np.ndarray) -> float:
    """Mid shoulders to mid hips, pixels."""
    return float(np.linalg.norm(rows[_SHOULDERS, :2].mean(0) - rows[_HIPS, :2].mean(0)))


def _distance_to_bones(uv: Float[np.ndarray, "n 2"], person: Keypoints2D) -> np.ndarray:
    """Distance (pixels) of each point to the nearest bone of a person, shape (n,); infinite if there are no bones."""
    ends = np.array(BONES)
    ends = ends[person.found[ends].all(1)]
    if not len(ends):
        return np.full(len(uv), np.inf)
    a, ab = person.uv[ends[:, 0]], person.uv[ends[:, 1]] - person.uv[ends[:, 0]]
    t = ((uv[:, None] - a) * ab).sum(-1) / np.maximum((ab * ab).sum(-1), 1e-9)
    return np.linalg.norm(uv[:, None] - a - t.clip(0, 1)[..., None] * ab, axis=-1).min(1)


def _agreement(apart: np.ndarray, least: float) -> np.ndarray:
    """1 for looks within 8 % of a torso length of each other, falling to `least` when they are far apart."""
    return least + (1 - least) * np.exp(-((np.maximum(apart - 0.08, 0) / 0.25) ** 2))


def _coco(landmarks: Landmarks, width: int, height: int) -> Float[np.ndarray, "18 3"]:
    """COCO-18 rows (u, v, score); score 0 outside the image."""
    score = landmarks.visibility * landmarks.presence
    rows = to_coco18(np.column_stack([landmarks.uv, score]), "blazepose")
    inside = (rows[:, :2] >= -0.5) & (rows[:, :2] < (width - 0.5, height - 0.5))
    rows[~inside.all(1), 2] = 0
    return rows


def _group_between(scene: Scene, hip: np.ndarray, shoulder: np.ndarray) -> int:
    """The group under most of the line from hip to shoulder, -1 if there is none."""
    t = np.linspace(0.1, 0.9, 9)[:, None]
    groups = scene.groups_at(hip + t * (shoulder - hip))
    names, counts = np.unique(groups[groups >= 0], return_counts=True)
    return int(names[np.argmax(counts)]) if len(names) else -1


def _torso_depth(scene: Scene, candidate: Candidate, rows: np.ndarray) -> float | None:
    """Median depth (metres) of the person's own cells between shoulders and hips; None where nothing was measured."""
    corners = rows[TORSO[1:], :2]
    row, col, inside = scene.grid.cells_of(_WITHIN_TORSO @ corners)
    z = scene.grid.z[row, col]
    good = inside & (z > 0)
    own = good & (scene.group_of_cell[row, col] == candidate.group)
    chosen = own if own.sum() >= 3 and candidate.group >= 0 else good
    return float(np.median(z[chosen])) if chosen.any() else None


def _places(scene: Scene, group: int, torso_z: float | None, uv: Float[np.ndarray, "18 2"]) -> Float[np.ndarray, "18"]:
    """What the place of each keypoint is worth (the constants at the head of this file)."""
    if torso_z is None:
        return np.full(len(uv), _UNMEASURED)
    grid = scene.grid
    row, col, _ = grid.cells_of(uv)
    offsets = np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)])
    rows = (row[:, None] + offsets[:, 0]).clip(0, grid.z.shape[0] - 1)
    cols = (col[:, None] + offsets[:, 1]).clip(0, grid.z.shape[1] - 1)
    z, groups = grid.z[rows, cols], scene.group_of_cell[rows, cols]
    near = (z > 0) & (np.abs(z - torso_z) < 0.9)
    on = (near & (groups == group) if group >= 0 else near).any(1)
    on |= near.any(1) & ~(groups >= 0).any(1)  # small parts cut off, and feet that merge with the floor
    unmeasured = (z == 0).all(1)
    nearer = ((z > 0) & (z < torso_z - 0.25)).any(1)
    return np.select([on, unmeasured, nearer], [_ON_PERSON, _UNMEASURED, _BEHIND_OTHER], _OFF_PERSON)


def distinct(candidates: list[Candidate]) -> list[Candidate]:
    """The best candidate of each person: best first, others dropped whose hips are close for their size."""
    out: list[Candidate] = []
    for c in sorted(candidates, key=lambda c: (c.own_window, c.score), reverse=True):
        if not any(_same(c, kept) for kept in out):
            out.append(c)
    return out


def _same(a: Candidate, b: Candidate) -> bool:
    distance = float(np.linalg.norm(a.hip - b.hip) / max(a.torso, b.torso, 1.0))
    if a.group != b.group and a.group >= 0 and b.group >= 0:
        return distance < 0.1
    return distance < 0.5


def merge_duplicates(people: list[Sighting]) -> list[Keypoints2D]:
    """Drops who repeats a stronger one, and whose six best joints have a mean score under `_LEAST`."""
    out: list[Sighting] = []
    for p in sorted(people, key=lambda p: -p.keypoints.score.sum()):
        best = np.sort(p.keypoints.score)[-6:]
        if best.mean() >= _LEAST and not any(p.repeats(q) for q in out):
            out.append(p)
    return [p.keypoints for p in out]
