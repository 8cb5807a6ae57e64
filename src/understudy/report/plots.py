"""The plot of a trial: how far the object was open, and the force on its handle."""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from understudy.plots import require_matplotlib


def trial_curves(curves: Mapping[str, Float[np.ndarray, " t"]], revolute: bool) -> bytes:
    """A PNG. curves: `teaching_trials.CURVES`. Raises MissingExtraError without matplotlib."""
    require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 6.4), layout="constrained")
    opened, force = figure.subplots(2, 1, sharex=True)
    time = curves["times_s"] - curves["times_s"][0]
    scale, unit = (np.degrees(1.0), "degrees") if revolute else (100.0, "cm")
    opened.plot(time, scale * curves["opened"], color="#D55E00", linewidth=2)
    opened.set(title=f"opened, {unit}")
    fingers = opened.twinx()
    fingers.plot(time, 100 * np.maximum(curves["opening_m"], 0), color="#0072B2", linewidth=1, linestyle="--")
    fingers.set_ylabel("fingers commanded apart, cm (dashed)", color="#0072B2", fontsize=8)
    force.plot(time, curves["force"], color="#009E73", linewidth=1)
    force.set(title="force between gripper and part, N", xlabel="s")
    for axes in (opened, force):
        axes.grid(alpha=0.3)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=80)
    return buffer.getvalue()
