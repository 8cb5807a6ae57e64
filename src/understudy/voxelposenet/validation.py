"""Errors and calibration of a network on simulated people (torch)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch

from understudy.skeleton import FLIP, JOINTS
from understudy.synthetic.samples import Batch
from understudy.voxelposenet.loss import WITHIN, metric_error
from understudy.voxelposenet.net import VoxelPoseNet


@dataclass(frozen=True)
class Results:
    """One row per person, one column per joint."""

    error: np.ndarray
    """metres"""
    mirrored: np.ndarray
    """metres: distance to the other side's joint"""
    sigma: np.ndarray
    confidence: np.ndarray
    in_view: np.ndarray
    occluded: np.ndarray
    hard: np.ndarray
    root_z: np.ndarray
    tag: np.ndarray


@torch.inference_mode()
def collect(net: VoxelPoseNet, batches: Iterable[Batch]) -> Results:
    """Runs the network over batches."""
    net.eval()
    device = next(net.parameters()).device
    rows: list[tuple[np.ndarray, ...]] = []
    for i in range(len(batches)) if hasattr(batches, "__len__") else range(0):
        batch = Batch(*(t.to(device) for t in batches[i]))  # type: ignore[index]
        out = net(batch.depth, batch.keypoints, batch.root_z)
        tensors = (
            metric_error(out.joints, batch.joints, batch.root_z),
            metric_error(out.joints, batch.joints[:, torch.as_tensor(FLIP)], batch.root_z),
            out.head[..., 0].exp(),
            out.head[..., 1].sigmoid(),
            batch.in_view, batch.occluded, batch.hard, batch.root_z, batch.tag,
        )  # fmt: skip
        rows.append(tuple(t.cpu().numpy() for t in tensors))
    return Results(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def summary(r: Results) -> dict[str, float]:
    """The numbers of a validation, errors in cm, over joints that are in view."""
    view, hidden = r.in_view, r.in_view & r.occluded
    visible = view & ~hidden

    def cm(mask: np.ndarray) -> float:
        return round(100 * float(r.error[mask].mean()), 3) if mask.any() else float("nan")

    kinds = np.array([n.split("_")[-1] for n in JOINTS])
    row = {"all": cm(view), "visible": cm(visible), "occluded": cm(hidden), "hard": cm(view & r.hard[:, None])}
    row |= {k: cm(view & (kinds == k)) for k in ("wrist", "ankle", "elbow", "knee", "hip", "shoulder", "nose")}
    row["auc20"] = round(float(np.clip(1 - r.error[view] / 0.2, 0, None).mean()), 4)
    row["pck10"] = round(float((r.error[view] < WITHIN).mean()), 4)
    row["swapped"] = round(swaps(r), 4)
    row["inside_sigma"] = round(float((r.error[view] < r.sigma[view]).mean()), 4)
    row["calibration"] = round(calibration_error(r.confidence[view], r.error[view] < WITHIN), 4)
    return row


def swaps(r: Results) -> float:
    """Share of limb joints in view that lie nearer to the other side's joint, by more than 10 cm."""
    sided = np.array([n.endswith(("elbow", "wrist", "knee", "ankle", "hip", "shoulder")) for n in JOINTS])
    use = r.in_view & sided
    return float(((r.error > r.mirrored + 0.1) & use).sum() / max(1, use.sum()))


def calibration_error(confidence: np.ndarray, right: np.ndarray, bins: int = 10) -> float:
    """Expected calibration error with equally wide bins."""
    which = np.minimum((confidence * bins).astype(int), bins - 1)
    total = np.bincount(which, minlength=bins)
    gap = np.abs(np.bincount(which, confidence, bins) - np.bincount(which, right, bins))
    return float(gap.sum() / max(1, total.sum()))


def validate(net: VoxelPoseNet, batches: Iterable[Batch]) -> dict[str, float]:
    """`summary` of `collect`."""
    return summary(collect(net, batches))
