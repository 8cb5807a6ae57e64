"""How fast network input is simulated, and where the time goes."""

from __future__ import annotations

import cProfile
import pstats
import time
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from understudy.synthetic.samples import Samples

PARTS: Final = MappingProxyType(
    {
        "poses": ("sample_poses",),
        "bodies": ("dress", "pose", "pose_extra"),
        "scene": ("place_cameras", "place_boxes", "_others"),
        "render": ("_splatted", "_boxes_depth", "_occluded"),
        "sensor": ("_measured",),
        "detector": ("detect",),
    }
)
"""Part -> the functions of `understudy.synthetic` that it consists of (none calls another one of them)."""


@dataclass(frozen=True)
class Speed:
    """What a machine manages."""

    per_s: float
    """samples per second of wall time"""
    per_cpu_s: float
    """samples per second of processor time, all threads together; other programs do not change it much"""
    ms: dict[str, float]
    """part -> milliseconds per sample, in all `1000 / per_s`"""

    def table(self) -> str:
        """For reading."""
        head = f"{self.per_s:.0f} samples/s ({self.per_cpu_s:.0f} per second of processor time)"
        lines = [head, *(f"  {name:9} {ms:6.2f} ms" for name, ms in self.ms.items())]
        return "\n".join(lines)


def measure(samples: Samples, size: int = 16, batches: int = 12) -> Speed:
    """Times some batches after one to warm up, then shares the time out among the parts by a profile."""
    samples.batch(0, size)
    start, cpu = time.perf_counter(), time.process_time()
    for k in range(batches):
        samples.batch(k, size)
    per_sample = (time.perf_counter() - start) / (batches * size)
    cpu_per_sample = (time.process_time() - cpu) / (batches * size)
    profile = cProfile.Profile()
    profile.enable()
    for k in range(batches // 2):
        samples.batch(k, size)
    profile.disable()
    spent: dict[str, float] = {}
    for (file, _, name), (_, _, _, cumulative, _) in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        if "synthetic" in file:
            spent[name] = spent.get(name, 0.0) + cumulative
    whole = spent["batch"]
    ms = {part: 1000 * per_sample * sum(spent.get(n, 0.0) for n in names) / whole for part, names in PARTS.items()}
    ms["other"] = 1000 * per_sample - sum(ms.values())
    return Speed(1 / per_sample, 1 / cpu_per_sample, ms)
