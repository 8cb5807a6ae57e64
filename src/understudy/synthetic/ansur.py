"""Body dimensions of adults: ANSUR II (4082 men, 1986 women), and random people with these dimensions."""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

STATURE: Final = ((1.756, 0.069), (1.629, 0.064))
"""Mean and standard deviation of men and of women, metres."""

LENGTHS: Final = MappingProxyType(
    {
        # name: men's mean, sd, women's mean, sd (metres), correlation with stature
        "acromial_height": (1.441, 0.063, 1.335, 0.058, 0.96),
        "acromion_radiale": (0.335, 0.018, 0.311, 0.017, 0.80),
        "radiale_stylion": (0.268, 0.015, 0.241, 0.015, 0.75),
        "hand": (0.193, 0.010, 0.181, 0.010, 0.68),
        "biacromial": (0.416, 0.019, 0.365, 0.018, 0.50),
        "trochanter_height": (0.901, 0.049, 0.845, 0.045, 0.88),
        "knee_height": (0.492, 0.027, 0.466, 0.027, 0.87),
        "ankle_height": (0.073, 0.006, 0.063, 0.005, 0.45),
    }
)
"""Lengths along the body; means and deviations are ANSUR II's, the correlations are rounded."""

SHOULDER_IN: Final = 0.0375
"""metres from the acromion, a point on the skin, inward to the shoulder's centre (rounded)"""

UPPER_ARM, FOREARM, PALM = 0.865, 1.01, 0.52
"""Between joint centres, as shares of acromion-radiale, radiale-stylion and hand length (rounded)."""


def draw_sex(n: int, generator: torch.Generator) -> Bool[Tensor, " n"]:
    """True for women: half of the people, to one person, in random order."""
    return (torch.arange(n) % 2 == 1)[torch.randperm(n, generator=generator)]


def draw_stature(female: Bool[Tensor, " n"], generator: torch.Generator) -> Float[Tensor, " n"]:
    """Statures in metres, normal within 2.8 standard deviations."""
    z = torch.randn(len(female), generator=generator).clamp(-2.8, 2.8)
    (man, man_sd), (woman, woman_sd) = STATURE
    return torch.where(female, woman + woman_sd * z, man + man_sd * z)


def draw_lengths(
    female: Bool[Tensor, " n"], stature: Float[Tensor, " n"], generator: torch.Generator
) -> dict[str, Float[Tensor, " n"]]:
    """Lengths of LENGTHS for people of given statures, metres."""
    (man, man_sd), (woman, woman_sd) = STATURE
    z = torch.where(female, (stature - woman) / woman_sd, (stature - man) / man_sd)
    out = {}
    for name, (mean_m, sd_m, mean_f, sd_f, r) in LENGTHS.items():
        own = torch.randn(len(z), generator=generator).clamp(-2.5, 2.5)
        own = r * z + (1 - r * r) ** 0.5 * own
        out[name] = torch.where(female, mean_f + sd_f * own, mean_m + sd_m * own)
    return out


def bones(long: dict[str, Float[Tensor, " n"]]) -> dict[str, Float[Tensor, " n"]]:
    """Distances between joint centres, metres, from lengths of LENGTHS."""
    return {
        "shoulders": long["biacromial"] - 2 * SHOULDER_IN,
        "upper_arm": UPPER_ARM * long["acromion_radiale"],
        "forearm": FOREARM * long["radiale_stylion"],
        "palm": PALM * long["hand"],
        "thigh": (long["trochanter_height"] - long["knee_height"]).clamp_min(0.3),
        "shin": long["knee_height"] - long["ankle_height"],
    }
