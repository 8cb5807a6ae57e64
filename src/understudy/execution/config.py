"""Settings of an execution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

TICK_S: Final = 0.02
"""Between commands."""


@dataclass(frozen=True)
class Config:
    """Thresholds. Metres of the handle's way, newtons, seconds."""

    enough: float = 0.8
    """share of the goal that counts as opened"""
    measure_s: float = 0.06
    """between measurements of the handle"""
    settle_s: float = 0.6
    """before the handle, to measure it; and after the fingers closed"""
    slow_m: float = 0.012
    """of lag behind the plan: the plan is run slower ..."""
    stop_m: float = 0.03
    """... and stands still"""
    sticking_m: float = 0.07
    """the same once the part has moved: dry friction then holds it for a while, until the arm has pulled enough"""
    moved_m: float = 0.01
    """way after which a part has moved"""
    patience_s: float = 1.0
    """that it stands still until the part counts as blocked"""
    at_end: float = 0.9
    """share of the way after which a part that stands still has come to its end"""
    slipped_m: float = 0.04
    """between where the handle is in the hand and where it was when the fingers had closed"""
    held_share: float = 0.4
    """of the handle's thickness: fingers that are closer together hold nothing"""
    missed_m: float = 0.05
    """by which the arm may miss a tool pose"""
    force_n: float = 180.0
    came_back: float = 0.03
    """share of the goal by which a part must have closed again for its touch to count as its own doing"""
    closing_s: float = 1.2
    clearance_m: float = 0.045
    """by which the fingers are opened wider than the handle: more would meet what is beside it"""
    give_way_s: float = 0.6
    """time constant with which the set point gives way to forces across the handle's way"""
    given_m: float = 0.03
    given_rad: float = 0.35
    retries: int = 1
    back_m: float = 0.7
    """that the base goes back before another attempt"""
    back_speed: float = 0.25
    longest_s: float = 120.0
