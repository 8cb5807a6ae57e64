"""Skinning weights of bodies made of lofts."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from understudy.synthetic.capsule_loft import Part
from understudy.synthetic.segments import SEGMENT, SEGMENTS
from understudy.synthetic.surface import SIDES


def _smooth(t: Tensor) -> Tensor:
    """0 below 0, 1 above 1, smooth between."""
    t = t.clamp(0, 1)
    return t * t * (3 - 2 * t)


_NEIGHBOURS = {
    # part: (segment before, half width of the blend, segment after, half width of the blend), in shares of the length
    "upper_arm": ("clavicle", 0.22, "forearm", 0.14),
    "forearm": ("upper_arm", 0.16, "hand", 0.12),
    "hand": ("forearm", 0.25, "fingers", 0.15),
    "fingers": ("hand", 0.15, None, 0.1),
    "thigh": ("pelvis", 0.18, "shin", 0.11),
    "shin": ("thigh", 0.11, "foot", 0.07),
}


def skinning_weights(part: Part, vertices: Float[Tensor, "v 3"], origins: Float[Tensor, "s 3"]) -> Float[Tensor, "v s"]:
    """Skinning weights of a part's vertices, from the mean body; at a joint both segments have one half."""
    out = torch.zeros(len(vertices), len(SEGMENTS))
    x, z = vertices[:, 0], vertices[:, 2]

    def place(name: str) -> Tensor:
        return origins[SEGMENT[name]]

    if part.segment == "chest":
        to_abdomen = _smooth((z - place("abdomen")[2]) / 0.14 + 0.5)
        to_chest = _smooth((z - place("chest")[2]) / 0.14 + 0.5)
        to_neck = 0.5 * _smooth((z - place("neck")[2] + 0.03) / 0.05)
        shoulder = place("left_upper_arm")
        girdle = _smooth((x.abs() - 0.04) / (shoulder[0] - 0.05)) * _smooth((z - shoulder[2]) / 0.10 + 0.9)
        hip = place("left_thigh")
        leg = 0.5 * _smooth((x.abs() - 0.02) / (hip[0] - 0.02)) * _smooth(0.6 - z / 0.12)
        out[:, SEGMENT["pelvis"]] = (1 - to_abdomen) * (1 - leg)
        out[:, SEGMENT["abdomen"]] = to_abdomen * (1 - to_chest)
        out[:, SEGMENT["chest"]] = to_chest * (1 - girdle) * (1 - to_neck)
        out[:, SEGMENT["neck"]] = to_chest * (1 - girdle) * to_neck
        for side, sign in SIDES:
            own = x * sign > 0
            out[own, SEGMENT[f"{side}_clavicle"]] = (to_chest * girdle)[own]
            out[own, SEGMENT[f"{side}_thigh"]] = ((1 - to_abdomen) * leg)[own]
    elif part.segment == "neck":
        to_neck = _smooth((z - place("neck")[2]) / 0.06 + 0.5)
        to_head = _smooth((z - place("head")[2]) / 0.07 + 0.8)
        out[:, SEGMENT["chest"]] = 1 - to_neck
        out[:, SEGMENT["neck"]] = to_neck * (1 - to_head)
        out[:, SEGMENT["head"]] = to_neck * to_head
    elif part.segment == "head" or part.segment.endswith("_foot"):
        out[:, SEGMENT[part.segment]] = 1.0
    else:
        side, _, kind = part.segment.partition("_")
        before, h0, after, h1 = _NEIGHBOURS[kind]
        start, axis = place(part.segment), part.frame[0, :, 2]
        if kind == "hand":  # palm and thumb: along the palm
            axis = torch.nn.functional.normalize(place(f"{side}_fingers") - start, dim=0)
        length = (place(f"{side}_{after}") - start).norm() if after else part.length.mean()
        t = (vertices - start) @ axis / length
        from_before = _smooth((t + h0) / (2 * h0))
        to_after = _smooth((t - 1 + h1) / (2 * h1)) if after else torch.zeros_like(t)
        thumb = kind == "hand" and (part.frame[0, :, 2] - axis).norm() > 0.1
        if thumb:
            from_before, to_after = torch.ones_like(t), torch.zeros_like(t)
        out[:, SEGMENT[before if before == "pelvis" else f"{side}_{before}"]] = 1 - from_before
        out[:, SEGMENT[part.segment]] = from_before * (1 - to_after)
        if after:
            out[:, SEGMENT[f"{side}_{after}"]] = from_before * to_after
    return out
