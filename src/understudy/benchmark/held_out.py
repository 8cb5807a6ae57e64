"""Simulated recordings of bodies and scenes that no training, validation or calibration has seen. Needs torch."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

SENSORS: Final = ("kinect2", "azure", "realsense")
BODIES: Final = (("anny", 60), ("capsules", 40))
"""Body sets and how many bodies of each"""
BODY_SEED: Final = 3001
"""of the banks of bodies; training has 1, its validation 1001, calibration 2001"""
SEED: Final = 910_000
"""of the scenes; training counts up from 0, its validation from 1000003"""
FIT_SEED: Final = 970_000
"""of the recordings that the offsets of naive lifting are fitted on"""
FIT_BODIES: Final = (("anny", 320), ("capsules", 160))
FIT_BODY_SEED: Final = 1
"""as training has it"""


def recordings(
    folder: Path, frames: int = 20, fit: bool = False, progress: Callable[[str], object] = lambda text: None
) -> list[Path]:
    """Folders of one recording per sensor and body set, made where they are not there yet.

    frames: of each recording. fit: those that constants are fitted on.
    """
    from understudy.recordings.folder import INFO
    from understudy.synthetic.recording import RecordingConfig, write_synthetic

    made = []
    bodies, body_seed, seed = (FIT_BODIES, FIT_BODY_SEED, FIT_SEED) if fit else (BODIES, BODY_SEED, SEED)
    for i, sensor in enumerate(SENSORS):
        for k, (kind, count) in enumerate(bodies):
            out = folder / f"{'fit' if fit else 'held-out'}-{frames}-{body_seed}" / f"{sensor}-{kind}"
            if not (out / INFO).exists():
                progress(f"simulating {out}")
                config = RecordingConfig(sensor=sensor, bodies=kind, body_count=count, body_seed=body_seed)
                write_synthetic(out, frames, seed + 10 * i + k, config)
            made.append(out)
    return made
