"""What every 2D detector is."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from understudy.types import Keypoints2D, RegisteredDepth


@runtime_checkable
class Detector(Protocol):
    """Finds every person in a colour image. `tests/test_detectors.py` holds all back-ends to this contract."""

    name: str

    def detect(
        self, color: UInt8[np.ndarray, "h w 3"], depth: RegisteredDepth | None = None, index: int = 0
    ) -> list[Keypoints2D]:
        """People in an RGB image.

        color: RGB.
        depth: registered depth of the same moment; a back-end may use it, and must work without it.
        index: number of the frame in its recording, for back-ends that look results up.
        Returns one `Keypoints2D` per person (colour pixels), nobody twice; an empty list if there is nobody.
        """
        ...
