"""Adaptation of the tests' synthetic demonstrations, whose truth is exact: every metric, per input kind and task.

    python benchmarks/adaptation_synthetic.py [--robot pr2 tiago_pro pr2:left] --out docs/adaptation/synthetic.md

Nobody was watched here: hands and torsos are formulas with correlated noise (tests/adaptation_scenes.py). What the
stage's recordings give is measured by `adaptation_stage.py`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from common import machine

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import adaptation_scenes as scenes

from understudy.adaptation.adapt import adapt
from understudy.adaptation.metrics import MORE, PAPER, ROWS, Metrics, evaluate
from understudy.adaptation.platform import Platform
from understudy.adaptation.robots import platform_of
from understudy.files import write_atomically
from understudy.robot.model import load_robot

KINDS = {"markers": scenes.MARKERS, "RGB-D": scenes.Noise(), "corrupted": scenes.CORRUPTED}
ABOUT = (
    "5 demonstrations per task, 11 s at 10 Hz. Markers: hand 3 mm, 1 deg; RGB-D: hand 1.5 cm, 6 deg (per axis), torso "
    "3 cm, 5 deg; corrupted: RGB-D with 30 % of the hands missing, 5 % off by 50 cm, the torso missing for 2 s. "
    "'Gripper-hand' of corrupted input is the distance to what was observed, outliers and all. Values are after "
    "adaptation, room door / swivel door / drawer / sliding door; one value: all four are that."
)
Scores = dict[str, list[dict[str, Metrics]]]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", nargs="+", default=["pr2"], help="the first one in full, the others in short")
    parser.add_argument("--out", type=Path, metavar="FILE")
    chosen = parser.parse_args(arguments)
    parts = ["# Adaptation of synthetic demonstrations", ""]
    parts += ["Written by `benchmarks/adaptation_synthetic.py`; made anew, not edited.", "", ABOUT, ""]
    for number, name in enumerate(chosen.robot):
        platform = platform_of(load_robot(name))
        begin = time.process_time()
        scores = measured(platform)
        seconds = time.process_time() - begin
        parts += [f"## {platform.name}", ""] + (in_short(scores) if number else in_full(scores))
        parts += ["", f"{seconds:.0f} s of processor time, with what is loaded and compiled first.", ""]
    text = "\n".join([*parts, machine(), ""])
    print(text)
    if chosen.out is not None:
        write_atomically(chosen.out, text)


def measured(platform: Platform) -> Scores:
    """Per input kind, metrics of each task."""
    scores: Scores = {}
    for kind, noise in KINDS.items():
        for task in scenes.TASKS:
            shown = scenes.demonstrations(task, 5, noise)
            scores.setdefault(kind, []).append(evaluate(shown, adapt(shown, platform), platform))
            print(platform.name, kind, task, file=sys.stderr)
    return scores


def in_full(scores: Scores) -> list[str]:
    """All rows."""
    heads = ["after adaptation", *scores, "paper, RGB-D"]
    rows = []
    for name, words in {**ROWS, **MORE}.items():
        values = [together([getattr(pair["after"], name) for pair in pairs]) for pairs in scores.values()]
        paper = PAPER["RGB-D"].get(name)
        rows.append([words, *values, "" if paper is None else " / ".join("-" if v != v else f"{v:g}" for v in paper)])
    before = [together([pair["before"].achievable_percent for pair in pairs]) for pairs in scores.values()]
    rows.append(["kinematically achievable before, %", *before, ""])
    return ["| " + " | ".join(row) + " |" for row in (heads, ["---"] * len(heads), *rows)]


def in_short(scores: Scores) -> list[str]:
    """The worst of what must hold."""
    after = [pair["after"] for pairs in scores.values() for pair in pairs]
    worst = {
        name: (min if name.endswith("percent") else max)(getattr(m, name) for m in after)
        for name in ("grasp_cm", "grasp_deg", "gripper_object_cm", "gripper_object_deg", "map_free_percent")
        + ("achievable_percent", "within_limits_percent", "joints_within_percent")
    }
    words = {**ROWS, **MORE}
    return ["The worst of all tasks and input kinds:", ""] + [f"- {words[n]}: {digits(v)}" for n, v in worst.items()]


def together(values: Sequence[float]) -> str:
    """All four, or the one that all are."""
    words = [digits(v) for v in values]
    return words[0] if len(set(words)) == 1 else " / ".join(words)


def digits(value: float) -> str:
    """As many as a reader needs."""
    if value != value:
        return "-"
    return "< 0.001" if 0 < value < 0.001 else f"{value:.3f}" if value < 0.1 else f"{value:.2f}".removesuffix(".00")


if __name__ == "__main__":
    main()
