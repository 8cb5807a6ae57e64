"""Errors and calibration of a network on simulated people (torch)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import torch
from torch import nn

from understudy.errors import UnderstudyError
from understudy.skeleton import FLIP, JOINTS
from understudy.synthetic.samples import Batch
from understudy.synthetic.sensors import SENSORS
from understudy.voxelposenet.kinds import Estimate, read_default
from understudy.voxelposenet.loss import WITHIN, metric_error


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
def collect(
    net: nn.Module, batches: Iterable[Batch], estimate: Callable[[nn.Module, Batch], Estimate] = read_default
) -> Results:
    """Runs a network over batches. estimate: what it says of one of them; default: `VoxelPoseNet`'s."""
    net.eval()
    device = next(net.parameters()).device
    rows: list[tuple[np.ndarray, ...]] = []
    for given in batches:
        batch = Batch(*(t.to(device) for t in given))
        out = estimate(net, batch)
        tensors = (
            metric_error(out.joints, batch.joints, batch.root_z),
            metric_error(out.joints, batch.joints[:, torch.as_tensor(FLIP)], batch.root_z),
            out.sigma, out.confidence,
            batch.in_view, batch.occluded, batch.hard, batch.root_z, batch.tag,
        )  # fmt: skip
        rows.append(tuple(t.cpu().numpy() for t in tensors))
    if not rows:
        raise UnderstudyError("validation needs at least one batch")
    return Results(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def summary(r: Results) -> dict[str, float]:
    """The numbers of a validation, errors in cm, over joints that are in view."""
    view = r.in_view
    kinds = np.array([n.split("_")[-1] for n in JOINTS])
    row = {**errors_cm(r, view), "hard": _cm(r, view & r.hard[:, None])}
    row |= {k: _cm(r, view & (kinds == k)) for k in ("wrist", "ankle", "elbow", "knee", "hip", "shoulder", "nose")}
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


def validate(net: nn.Module, batches: Iterable[Batch]) -> dict[str, float]:
    """`summary` of `collect`."""
    return summary(collect(net, batches))


# --- tables ---


def errors_cm(r: Results, which: np.ndarray) -> dict[str, float]:
    """Mean errors of joints: all, those that the camera sees, those that it does not. which: (n, 18)."""
    masks = {"all": which, "visible": which & ~r.occluded, "occluded": which & r.occluded}
    return {name: _cm(r, mask) for name, mask in masks.items()}


def joint_table(r: Results, sensors: Sequence[str] = ()) -> list[dict[str, Any]]:
    """A row per joint."""
    return [{"joint": name, **_row(r, np.arange(len(JOINTS)) == j)} for j, name in enumerate(JOINTS)]


def distance_table(r: Results, sensors: Sequence[str] = ()) -> list[dict[str, Any]]:
    """A row per metre between camera and person."""
    rows = [{"from_m": m, "to_m": m + 1, **_row(r, (r.root_z >= m) & (r.root_z < m + 1))} for m in range(8)]
    return [row for row in rows if row["n"]]


def sensor_table(r: Results, sensors: Sequence[str] = ()) -> list[dict[str, Any]]:
    """A row per sensor. sensors: those that training has seen."""
    rows = []
    for i, name in enumerate(SENSORS):
        seen = "yes" if name in sensors else "no"
        rows.append({"sensor": name, "in_training": seen, **_row(r, r.tag[:, :1] == i)})
    return [row for row in rows if row["n"]]


TABLES: Final[Mapping[str, Callable[[Results, Sequence[str]], list[dict[str, Any]]]]] = MappingProxyType(
    {"joints": joint_table, "distance": distance_table, "sensor": sensor_table}
)
"""Name of a breakdown -> its rows, from results with every sensor of `SENSORS`"""


def _row(r: Results, which: np.ndarray) -> dict[str, float]:
    """Numbers of joints in view among `which` (broadcast to (n, 18))."""
    mask = r.in_view & which
    share = round(float((r.error[mask] < WITHIN).mean()), 4) if mask.any() else float("nan")
    return {"n": int(mask.sum()), "n_occluded": int((mask & r.occluded).sum()), **errors_cm(r, mask), "pck10": share}


def _cm(r: Results, mask: np.ndarray) -> float:
    return round(100 * float(r.error[mask].mean()), 3) if mask.any() else float("nan")
