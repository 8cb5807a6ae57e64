"""The paper's method as a `Lifter`: root, grid, network, assembly. torch is imported when a `PaperLifter` is made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float, Float32

from understudy.camera import Camera
from understudy.errors import MissingExtraError
from understudy.lifting import SEEN_SCORE
from understudy.skeleton import N_JOINTS
from understudy.types import INFERRED, OBSERVED, Keypoints2D, Person, RegisteredFrame
from understudy.voxelposenet.paper_grid import (
    PaperGrid,
    assemble_paper,
    depth_points,
    network_input,
    paper_root,
    pixel_rays,
    volume_peaks,
)

NO_ROOT: Final = "no root: neither the neck nor a hip has a 2D score above 0.5 and depth under it"

_TARGET_VARIANCE = 3.0**2 / 2  # cells^2 along each axis, of the Gaussians exp(-d^2 / 3^2) of training
_LARGEST_SIGMA = 0.5  # metres


class PaperLifter:
    """The paper's lifting, with the weights of a file of `save_paper_weights` (variant `paper` or `paper-fast`).

    Who has no root (see `paper_grid.paper_root`) is a `Person.failure`, as in the paper; everybody else gets all 18
    joints. `confidence` is the 3D score, the peak of the joint's volume clipped to [0, 1]: as the paper has it, not
    calibrated to a probability. `sigma_m` comes from the same number, see `sigma_of_score`. `source` is observed where
    the 2D score is above 0.5, else inferred.
    """

    def __init__(self, weights: Path, assembly: bool = True):
        """assembly: the paper's last step, `assemble_paper`. Without it all joints are the network's."""
        try:
            from understudy.voxelposenet.paper_net import load_paper_net, score_volume
        except ImportError as e:
            raise MissingExtraError("the paper's network", "train") from e
        self.assembly = assembly
        self._net = load_paper_net(weights)
        self._score_volume = score_volume
        self._rays: tuple[Camera, Float32[np.ndarray, "h w 2"]] | None = None

    @property
    def variant(self) -> str:
        return self._net.variant

    def lift(self, frame: RegisteredFrame, people: Sequence[Keypoints2D]) -> list[Person]:
        roots = [paper_root(seen, frame.depth, frame.camera) for seen in people]
        points = self._points(frame) if any(roots) else np.zeros((0, 3), np.float32)
        out = []
        for seen, root in zip(people, roots, strict=True):
            if root is None:
                out.append(Person.failure(seen, NO_ROOT))
                continue
            volumes = self._score_volume(self._net, network_input(points, seen, frame.camera, root))
            out.append(self._person(frame.camera, seen, PaperGrid.around(root), volumes))
        return out

    def _points(self, frame: RegisteredFrame) -> Float32[np.ndarray, "n 3"]:
        camera = frame.depth.camera
        if self._rays is None or self._rays[0] is not camera:
            self._rays = camera, pixel_rays(camera)
        return depth_points(frame.depth, self._rays[1])

    def _person(
        self, camera: Camera, seen: Keypoints2D, grid: PaperGrid, volumes: Float32[np.ndarray, "18 64 64 64"]
    ) -> Person:
        xyz, score3d = volume_peaks(volumes, grid)
        return Person(
            keypoints_2d=seen,
            keypoints=assemble_paper(seen, camera, xyz, score3d) if self.assembly else xyz,
            confidence=np.clip(score3d, 0.0, 1.0),
            sigma_m=sigma_of_score(score3d, grid.cell),
            source=tuple(OBSERVED if seen.score[j] > SEEN_SCORE else INFERRED for j in range(N_JOINTS)),
        )


def sigma_of_score(score3d: Float[np.ndarray, "18"], cell: float) -> Float[np.ndarray, "18"]:
    """Standard deviation (metres) of a joint from the peak of its volume.

    The volume that is best in squared L2 is the mean of the target Gaussians (variance t per axis, height 1) over where
    the joint may be. If that is Gaussian with variance s, the peak is (t / (t + s))^(3/2), so s = t (peak^(-2/3) - 1).
    A cell's width adds 1/12 cell^2; at most 0.5 m. True of a network that has learned its loss with our target's width;
    not calibrated on data.

    cell: metres.
    """
    peak = np.clip(score3d, 1e-3, 1.0)
    variance = _TARGET_VARIANCE * (peak ** (-2 / 3) - 1) + 1 / 12
    return np.minimum(cell * np.sqrt(variance), _LARGEST_SIGMA)
