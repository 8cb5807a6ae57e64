"""Simulated network input: samples per second on one core and where the time goes, against two other ways.

The alternatives, in the same run: the same samples with rays cast at all boxes at once (the first version of
`render.cast`), and a full-resolution Kinect v2 frame (depth and colour) of which an input could be cut out.
"""

from __future__ import annotations

from multiprocessing import get_context

import numpy as np
import torch
from common import milliseconds, report

from understudy.synthetic import render
from understudy.synthetic.bodies import load_bank
from understudy.synthetic.draw import Draw
from understudy.synthetic.furniture import place_boxes
from understudy.synthetic.recording import RecordingConfig, Studio
from understudy.synthetic.samples import SampleConfig, Samples
from understudy.synthetic.scene import Boxes, SceneConfig, place_cameras
from understudy.synthetic.timing import measure

BATCH = 16


def main() -> None:
    torch.set_num_threads(1)
    bank = load_bank("capsules", 40, 1001)
    samples = Samples(bank, SampleConfig(), 0)
    speed = measure(samples, BATCH, batches=10)
    rows = [["samples/s", f"{speed.per_s:.0f}", ""]]
    rows += [["samples per second of processor time", f"{speed.per_cpu_s:.0f}", ""]]
    with get_context("spawn").Pool(2) as two:
        for kind in ("capsules", "anny"):
            both = sum(two.map(alone, [kind] * 2, chunksize=1))
            rows.append([f"samples/s of two processes, {kind}", f"{both:.0f}", ""])
    rows += [[f"  {part}, ms a sample", f"{ms:.2f}", f"{ms * speed.per_s / 10:.0f} %"] for part, ms in speed.ms.items()]

    boxes, origin, rays = scene()
    assert torch.equal(render.cast(boxes, origin, rays), cast_at_once(boxes, origin, rays))
    ours = milliseconds(lambda: render.cast(boxes, origin, rays), 10) / BATCH
    at_once = milliseconds(lambda: cast_at_once(boxes, origin, rays), 10) / BATCH
    rows.append(["casting rays at boxes, ms a sample", f"{ours:.2f}", ""])
    rows.append(["  all boxes at once (same numbers)", f"{at_once:.2f}", f"{at_once / ours:.1f} x"])

    studio = Studio(4, 0, RecordingConfig(people=1, bodies="capsules", body_count=40), bank)
    frames = iter(range(1000))
    full = milliseconds(lambda: studio.frame(next(frames)), 5)
    ratio = full * speed.per_s / 1000
    rows.append(["full-resolution frame, ms", f"{full:.0f}", f"{ratio:.0f} x a sample"])
    report(
        "synth",
        ["what", "value", "share or ratio"],
        rows,
        "One core where nothing else is said, `capsules` bodies, batches of 16. Target: 150 samples/s on two cores.",
    )


def alone(kind: str) -> float:
    """Samples per second of this process, with one thread."""
    torch.set_num_threads(1)
    return measure(Samples(load_bank(kind, 40, 1001), SampleConfig(), 0), BATCH, batches=10).per_s


def scene() -> tuple[Boxes, torch.Tensor, torch.Tensor]:
    """Furniture, camera places and rays as in `Samples`."""
    draw = Draw(0)
    joints = torch.from_numpy(np.random.default_rng(0).uniform(-0.4, 0.4, (BATCH, 18, 3))).float()
    joints[..., 2] += 1
    cameras = place_cameras(draw, SceneConfig(), joints)
    boxes = place_boxes(draw, SceneConfig(), cameras, joints, torch.ones(BATCH, dtype=torch.bool))
    rays = render.pixel_rays(torch.full((BATCH,), 70.0), 72).reshape(BATCH, -1, 3) @ cameras.R_cam_world
    return boxes, cameras.center, rays


def cast_at_once(boxes: Boxes, origin: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
    """As `render.cast`, for all boxes at a time."""
    start, direction = boxes.local(origin[:, None]), boxes.local(rays, vectors=True)
    inverse = 1 / torch.where(direction.abs() < 1e-6, 1e-6, direction)
    a, b = (-boxes.half[:, :, None] - start) * inverse, (boxes.half[:, :, None] - start) * inverse
    enter, leave = torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)
    return torch.where((enter < leave) & (enter > 0.05), enter, render.FAR).amin(1)


if __name__ == "__main__":
    main()
