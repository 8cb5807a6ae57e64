"""A comparison as pages: README.md with tables and definitions, its plots as PNG, and trainings.md."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from understudy import plots
from understudy.benchmark.comparison import DEGRADED, RUN, UPPER_BOUND, Group, Key
from understudy.benchmark.environment import environment
from understudy.benchmark.methods import NO_ASSEMBLY, OURS, PAPER_ASSEMBLY
from understudy.benchmark.scores import DISTANCES_M, Score, evaluate_lifted, pck_over_distance, scores
from understudy.benchmark.subjects import COVERED_JOINTS, DETECTIONS, QUALITIES
from understudy.benchmark.tables import environment_lines, markdown_lines, number
from understudy.files import write_atomically
from understudy.metrics import Evaluation, JointMetrics
from understudy.skeleton import JOINTS

UPPER: Final = f"{OURS} on "
"""begins the names of the rows that got the true 2D"""
PLOTS: Final = ("pck", "distance", "joints", "quality", "calibration")
"""Plots of each group: GROUP-NAME.png"""

_DEFINITIONS = f"""\
- People: true people with a joint in the image whom the 2D detector found. Detections are matched to them in 2D,
  before any method runs (least median distance of the keypoints, at most 0.3 of the person's size in the image);
  **all methods get the same detections**. Undetected people and detections of nobody are counted above the tables,
  and are nobody's fault here.
- Held-out simulation: people 1.5 to 5 m from the camera; neither training nor validation nor calibration has these
  bodies (`benchmark.held_out`).
- Joints: those inside the image, visible or occluded. EPE: mean Euclidean error, cm, of the joints that a method
  gave. PCK@10: share within 10 cm. AUC: area under the PCK curve from 0 to 20 cm, over its width (0 to 1).
- **A joint that a method does not give counts as missed in PCK and AUC, and is left out of the EPE.** `common EPE` is
  over the joints that all methods of the table give, so that it compares like with like. `given`: share of joints
  that a method gives.
- hard: people who are not frontal (chest more than 45 degrees from the way to the camera, from the true shoulders and
  hips) or have something in front of them: {COVERED_JOINTS} or more joints in view that the truth calls occluded,
  where the measured surface before the joint is more than 25 cm from all of the person's own bones.
- swaps: share of left-right pairs whose joints are both nearer to the other side's truth than to their own.
- failed: people for whom a method gives no joint at all.
- ECE: mean over 10 bins of the confidence, weighted by joints, of |confidence - share within 10 cm|. Within sigma:
  share of errors of at most `sigma_m`, which claims 68 %. `paper*` has neither; its score volume's peak stands in for
  confidence.
- naive: 2D keypoint at the median of the 3 nearest depths. naive-offset: that, moved along the ray by a constant per
  kind of joint, fitted on the simulator. mlp: residual MLP on all 2D keypoints and the depths under them, trained on
  people of the same simulator (`python -m understudy.voxelposenet.mlp`). paper-fast, paper: the paper's networks, with
  its root, grid and assembly (`understudy train --preset paper`). `{NO_ASSEMBLY}`: the network's joints.
  `{PAPER_ASSEMBLY}`: where the 2D score exceeds the confidence, the 2D keypoint at the network's depth. `{UPPER}...`:
  the network given the projected true joints (score 1) in place of detections: the upper bound.
- Degraded 2D: "errors x 2" doubles each detected keypoint's distance from the true one; "20 % dropped" loses each
  found keypoint with a probability of 20 %."""


@dataclass(frozen=True)
class Trainings:
    """Other trainings of the network that were run, by what is special about them."""

    bodies: tuple[str, ...] = ()
    """body sets that have been trained on, `RUN + name` in the groups"""
    without: tuple[str, ...] = ()
    """sensors that were held out"""
    notes: tuple[str, ...] = field(default=())
    seen: Mapping[str, int] = field(default_factory=dict)
    """body set or sensor -> how many simulated people that run was shown"""


def held_out_name(sensor: str) -> str:
    """Method of the network that was trained without a sensor."""
    return f"{RUN}without {sensor}"


def write_report(
    out: Path,
    groups: Sequence[Group],
    trainings: Trainings,
    notes: Sequence[str],
    trained: Mapping[str, str] | None = None,
) -> None:
    """README.md, the plots of every group, and trainings.md if other trainings were run.

    notes: what was left out. trained: of methods, on what and how long.
    Otherwise a page on trainings that is there stays: it says itself when and with what it was made.
    """
    parts = ["# Comparison of methods", _INTRODUCTION]
    for group in groups:
        for name, png in draw(group).items():
            write_atomically(out / name, png)
        parts += list(_group(group))
    ran = ["## Where it ran", environment_lines(environment())]
    left_out = list(notes)
    if trainings.bodies or trainings.without or not (out / TRAININGS).exists():
        left_out += trainings.notes
    if trainings.bodies or trainings.without:
        page = ["# What the network was trained on", _TRAININGS, *_trainings(groups, trainings), *ran]
        write_atomically(out / TRAININGS, "\n\n".join(page) + "\n")
    if (out / TRAININGS).exists():
        parts.append(f"Other body sets in training, and a sensor kept out of it: [{TRAININGS}]({TRAININGS}).")
    if trained:
        parts += ["## How long others were trained", "\n".join(f"- {name}: {how}" for name, how in trained.items())]
    if left_out:
        parts += ["## Left out", "\n".join(f"- {n}" for n in left_out)]
    parts += ["## What the numbers mean", _DEFINITIONS, *ran]
    write_atomically(out / "README.md", "\n\n".join(parts) + "\n")


TRAININGS: Final = "trainings.md"
ALL: Final = "both"
"""the training with both body sets, and with all sensors"""
_TRAININGS = (
    "Written by `benchmarks/paper_tables.py` when it is given such runs; the test recordings and definitions are those "
    "of [README.md](README.md)."
)

_INTRODUCTION = (
    "Written by `benchmarks/paper_tables.py` (the command is at the end); made anew, not edited. The tables and "
    "figures have the shape of those of the paper (Zimmermann et al., ICRA 2018). Errors in cm; definitions are at the "
    "end."
)


def main_keys(group: Group) -> dict[str, Key]:
    """Rows of the main table: methods on the detections, the network on true 2D; last, what `few` leaves out."""
    variants = (NO_ASSEMBLY, PAPER_ASSEMBLY)
    keys: dict[str, Key] = {m: (DETECTIONS, m) for m in group.methods if m not in variants}
    upper: dict[str, Key] = {f"{UPPER}{q}": (q, OURS) for q in UPPER_BOUND if (q, OURS) in group.lifted}
    return keys | upper | {m: (DETECTIONS, m) for m in variants if m in group.methods}


def few(group: Group) -> dict[str, Key]:
    """The methods of crowded plots: of the network's variants only ours (the first rows, so colours stay)."""
    left_out = (NO_ASSEMBLY, PAPER_ASSEMBLY, f"{UPPER}{UPPER_BOUND[1]}")
    return {n: k for n, k in main_keys(group).items() if n not in left_out}


def _evaluations(group: Group, keys: Mapping[str, Key]) -> dict[str, Evaluation]:
    return {name: evaluate_lifted(group.subjects, group.lifted[key]) for name, key in keys.items()}


def draw(group: Group) -> dict[str, bytes]:
    """File name -> PNG."""
    keys, some, title = main_keys(group), few(group), f"{group.title}, joints in view"
    lifted = {name: group.lifted[key] for name, key in keys.items()}
    shares = {name: pck_over_distance(group.subjects, one)[0] for name, one in lifted.items()}
    counts = pck_over_distance(group.subjects, next(iter(lifted.values())))[1]
    qualities = [q for q in QUALITIES if any(q == k[0] for k in group.lifted)]
    auc = {
        m: [_joints(group, (q, m)).auc if (q, m) in group.lifted else np.nan for q in qualities]
        for m in DEGRADED
        if m in group.methods
    }
    drawn = {
        "pck": plots.pck_curves(_evaluations(group, keys), title),
        "distance": plots.pck_over_distance(shares, counts, DISTANCES_M, title),
        "joints": plots.joint_bars(_evaluations(group, some), title),
        "quality": plots.grouped_bars(
            auc, qualities, "AUC (0-20 cm), joints in view", f"Quality of the 2D keypoints: {group.title}", digits=2
        ),
        "calibration": plots.calibration(_evaluations(group, some), title),
    }
    return {f"{group.slug}-{name}.png": png for name, png in drawn.items()}


def _joints(group: Group, key: Key) -> JointMetrics:
    return evaluate_lifted(group.subjects, group.lifted[key]).joints["in_view"]


# --- tables ---


def _cm(metres: float) -> str:
    return number(100 * metres, 1)


def _percent(share: float) -> str:
    return number(100 * share, 1)


def main_table(rows: Mapping[str, Score]) -> str:
    """Table (a)."""
    heads = [
        "method", "EPE cm", "hard cm", "visible cm", "occluded cm", "common EPE cm", "given %", "PCK@10 %", "AUC",
        "AUC hard", "AUC occluded", "swaps %", "failed",
    ]  # fmt: skip
    cells = []
    for name, s in rows.items():
        cm = [s.epe_m, s.hard_m, s.visible_m, s.occluded_m, s.common_m]
        auc = [s.auc, s.auc_hard, s.auc_occluded]
        numbers = [*map(_cm, cm), _percent(s.given), _percent(s.pck), *(number(a, 3) for a in auc), _percent(s.swapped)]
        cells.append([name, *numbers, str(s.failed)])
    return markdown_lines(heads, cells)


def _group(group: Group) -> Iterator[str]:
    s = group.subjects
    frames = len({*zip(s.recording.tolist(), s.frame.tolist(), strict=True)})
    occluded = int((s.counted & s.occluded).sum())
    yield f"## {group.title}"
    yield (
        f"{len(s.frame)} people in {frames} frames of {', '.join(group.names)}: {int(s.counted.sum())} joints, "
        f"{occluded} of them occluded; {int(s.hard.sum())} people are hard. Not detected: {int(s.undetected.sum())} "
        f"people; detections of nobody: {int(s.unmatched.sum())}."
    )
    yield main_table(scores(group, main_keys(group)))
    yield _image(group, "pck", "PCK curves")
    yield _image(group, "distance", "PCK over distance")
    yield "### Quality of the 2D keypoints"
    yield "EPE cm / AUC, by what the methods are given:"
    yield quality_table(group)
    yield _image(group, "quality", "quality of the 2D keypoints")
    yield "### Error per joint"
    yield joint_table(group)
    yield _image(group, "joints", "error per joint")
    yield "### Calibration"
    yield calibration_table(group)
    yield _image(group, "calibration", "calibration")


def _image(group: Group, name: str, text: str) -> str:
    return f"![{group.title}: {text}]({group.slug}-{name}.png)"


def quality_table(group: Group) -> str:
    """Ablation: rows qualities, columns methods."""
    methods = [m for m in DEGRADED if m in group.methods]

    def cell(key: Key) -> str:
        if key not in group.lifted:
            return "-"
        joints = _joints(group, key)
        return f"{_cm(joints.epe_m)} / {number(joints.auc, 3)}"

    return markdown_lines(["2D keypoints", *methods], [[q, *(cell((q, m)) for m in methods)] for q in QUALITIES])


def joint_table(group: Group) -> str:
    """EPE per joint, both sides together, with the share that was given."""
    evaluations = _evaluations(group, few(group))
    kinds = dict.fromkeys(name.rpartition("_")[2] for name in JOINTS)
    cells = []
    for kind in kinds:
        row = [kind]
        for evaluation in evaluations.values():
            of = [m for name, m in evaluation.per_joint.items() if name.rpartition("_")[2] == kind]
            given = sum(m.n_given for m in of)
            epe = sum(m.epe_m * m.n_given for m in of if m.n_given) / given if given else float("nan")
            truth = sum(m.n_truth for m in of)
            row.append(f"{_cm(epe)} ({number(100 * given / truth if truth else float('nan'), 0)})")
        cells.append(row)
    return markdown_lines(["joint", *(f"{m}, EPE cm (given %)" for m in evaluations)], cells)


def calibration_table(group: Group) -> str:
    """ECE and coverage of sigma."""
    cells = []
    for name, evaluation in _evaluations(group, main_keys(group)).items():
        c = evaluation.calibration
        cells.append([name, _percent(c.ece), _percent(c.within_1_sigma), _percent(c.within_2_sigma)])
    return markdown_lines(["method", "ECE %", "within sigma %, right: 68", "within 2 sigma %"], cells)


def test_sets(groups: Sequence[Group]) -> dict[str, tuple[Group, np.ndarray]]:
    """Title -> group and its subjects: each group by the body set in its recordings' names, or whole."""
    out: dict[str, tuple[Group, np.ndarray]] = {}
    for group in groups:
        parts = [b for b in ("anny", "capsules") if group.rows(b).any()]
        for part in parts:
            out[f"{group.title}: {part}"] = group, group.rows(part)
        if len(parts) != 1:
            out[group.title] = group, np.ones(len(group.subjects.frame), bool)
    return out


def _trainings(groups: Sequence[Group], trainings: Trainings) -> Iterator[str]:
    """Tables (b)."""
    sets = test_sets(groups)

    def cell(group: Group, people: np.ndarray, method: str) -> str:
        if (DETECTIONS, method) not in group.lifted or not people.any():
            return "-"
        e = evaluate_lifted(group.subjects, group.lifted[DETECTIONS, method], people).joints["in_view"]
        return f"{number(e.auc, 3)} ({_cm(e.epe_m)})"

    def shown(run: str) -> str:
        return f"{trainings.seen[run]:,}" if run in trainings.seen else "-"

    if trainings.seen:
        yield (
            "These runs are shorter than the one whose weights are shipped (its model card says how long that was): "
            "compare their rows with each other."
        )
    if trainings.bodies:
        yield "AUC (EPE cm) of the network by the body set that it was trained on, on each set of test recordings:"
        rows = [[b, shown(b), *(cell(g, people, RUN + b) for g, people in sets.values())] for b in trainings.bodies]
        yield markdown_lines(["trained on", "people shown", *sets], rows)
    if trainings.without:
        yield "AUC (EPE cm) on recordings of a sensor that was kept out of training:"
        columns = {"trained without it": held_out_name, f"{OURS} (shipped; trained with it)": lambda sensor: OURS}
        if ALL in trainings.bodies:
            columns[f"as long, trained with it ({shown(ALL)} people)"] = lambda sensor: RUN + ALL
        rows = [
            [
                f"{sensor}, {g.title}",
                shown(sensor),
                *(cell(g, g.rows(sensor), method(sensor)) for method in columns.values()),
            ]
            for sensor in trainings.without
            for g in groups
        ]
        heads = ["sensor", "people shown", *columns]
        yield markdown_lines(heads, rows)
