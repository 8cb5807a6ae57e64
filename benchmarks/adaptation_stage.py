"""Adaptation of demonstrations that were made from recordings of the stage, against the 2018 paper's table.

    understudy stage record --task all --demos 5 --out RECORDINGS
    python benchmarks/demonstrations.py RECORDINGS/* --work WORK
    python benchmarks/adaptation_stage.py --rgbd WORK [--markers WORK_MARKERS] --out docs/adaptation

Input kinds: all demonstrations of a task together, estimated from RGB-D; the same with markers on the teacher; each
RGB-D demonstration alone; RGB-D demonstrations with corrupted hands and torsos. What was measured is kept (--cache),
under what it depends on: demonstrations, code, robot. A second run measures only what has changed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from common import machine

import understudy
from understudy.adaptation.errors import InfeasibleError
from understudy.adaptation.metrics import MORE, PAPER, PAPER_BEFORE, ROWS, as_numbers, evaluate
from understudy.adaptation.most import adapt_most
from understudy.adaptation.platform import Platform
from understudy.demonstration import storage
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.tasks import TASKS
from understudy.errors import UnderstudyError
from understudy.files import write_atomically

MISSING, OUTLIERS, OUTLIER_M, TORSO_GAP_S = 0.3, 0.05, 0.5, 2.0
KINDS = {
    "rgbd": "Estimated from RGB-D, all of a task together",
    "markers": "With markers on the teacher, all of a task together",
    "single": "One demonstration alone (RGB-D)",
    "corrupted": "Corrupted (RGB-D), all of a task together",
}
ABOUT = {
    "rgbd": "",
    "markers": "The paper's values are those with markers, as far as they are known here.",
    "single": "Each demonstration is adapted for itself; medians over those that are feasible.",
    "corrupted": f"Of the hands {100 * MISSING:.0f} % are missing, {100 * OUTLIERS:.0f} % are off by "
    f"{100 * OUTLIER_M:.0f} cm in any direction, the torso is missing for {TORSO_GAP_S:.0f} s (seeded). "
    "'Gripper-hand' is the distance to what was observed, outliers and all; 'to the uncorrupted hand' the distance to "
    "what was there before.",
}
UNCORRUPTED = "to the uncorrupted hand, cm"
WORDS = {**ROWS, **MORE, "uncorrupted_cm": f"gripper-hand {UNCORRUPTED}"}


@dataclass
class Measured:
    """One table's part: of one task, or of one demonstration."""

    kept: list[str]
    before: dict[str, float | None] = field(default_factory=dict)
    after: dict[str, float | None] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    samples: int = 0
    seconds: float = 0.0
    """processor time of `adapt_most`"""


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = parse(arguments)
    platform, robot_key = robot_platform(chosen.robot)
    sources = {"rgbd": chosen.rgbd, "markers": chosen.markers, "single": chosen.rgbd, "corrupted": chosen.rgbd}
    sections, begin = [], time.perf_counter()
    for kind in (k for k in KINDS if k in chosen.only and sources[k] is not None):
        tasks: dict[str, list[Measured]] = {}
        for task, folders in by_task(sources[kind], chosen.task).items():
            groups = [[f] for f in folders] if kind == "single" else [folders]
            for group in groups:
                work = kept_in(chosen.cache, [kind, robot_key, *map(content, group)], group, kind, platform)
                tasks.setdefault(task, []).append(work)
                tell(kind, task, work)
        sections.append(section(kind, tasks))
    text = document(sections, platform.name, time.perf_counter() - begin)
    print(text)
    if chosen.out is not None:
        write_atomically(chosen.out / "README.md", text)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rgbd", type=Path, metavar="DIR", help="folder of demonstrations, estimated from RGB-D")
    parser.add_argument("--markers", type=Path, metavar="DIR", help="the same recordings, with markers on the teacher")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for README.md")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS), help="input kinds (default: all)")
    parser.add_argument("--task", nargs="+", choices=TASKS, default=list(TASKS), help="tasks (default: all)")
    parser.add_argument("--robot", default="pr2")
    parser.add_argument("--cache", type=Path, metavar="DIR", help="what was measured before, to go on from")
    chosen = parser.parse_args(arguments)
    if chosen.rgbd is None and chosen.markers is None:
        parser.error("give --rgbd or --markers")
    return chosen


def robot_platform(name: str) -> tuple[Platform, str]:
    """The robot, warmed up (compiled, meshes read), and what tells it from others."""
    from understudy.adaptation.robots import platform_of
    from understudy.robot.model import load_robot

    robot = load_robot(name)
    platform = platform_of(robot)
    q, torso = robot.sample(2)
    platform.achievable(robot.forward(q, torso), torso)
    return platform, robot.checksum


def by_task(folder: Path, tasks: Sequence[str]) -> dict[str, list[Path]]:
    """Folders of demonstrations below a folder, per task in the paper's order. Raises UnderstudyError if empty."""
    found = sorted(p.parent for p in folder.glob(f"*/{storage.INFO}"))
    if not found:
        raise UnderstudyError(f"{folder}: holds no demonstration ({storage.INFO}); `understudy demonstrate` makes them")
    of_task = {f: json.loads((f / storage.INFO).read_text())["task"] for f in found}
    groups = {task: [f for f in found if of_task[f] == task] for task in tasks}
    return {task: group for task, group in groups.items() if group}


# measuring


def kept_in(folder: Path | None, key: list[str], group: list[Path], kind: str, platform: Platform) -> Measured:
    """From the cache, or measured now and kept."""
    name = hashlib.sha256("\n".join([source_code(), *key, *(f.name for f in group)]).encode()).hexdigest()[:24]
    path = None if folder is None else folder / f"{name}.json"
    if path is not None and path.exists():
        return Measured(**json.loads(path.read_text()))
    measured = measure(group, kind, platform)
    if path is not None:
        write_atomically(path, json.dumps(vars(measured)))
    return measured


@cache
def source_code() -> str:
    """Of what adaptation is computed with: this file, adaptation, robots, Lie groups, articulations."""
    root = Path(understudy.__file__).parent
    files = [
        Path(__file__),
        root / "lie.py",
        *(p for d in ("adaptation", "robot", "objects") for p in (root / d).rglob("*.py")),
    ]
    return hashlib.sha256(b"".join(p.read_bytes() for p in sorted(files))).hexdigest()


def content(folder: Path) -> str:
    """Of a demonstration's files."""
    return hashlib.sha256(b"".join((folder / n).read_bytes() for n in (storage.INFO, storage.ARRAYS))).hexdigest()


def measure(group: list[Path], kind: str, platform: Platform) -> Measured:
    """Adapts the demonstrations of a task and scores the result; kept is empty where none is feasible."""
    shown = [storage.load(f) for f in group]
    given = [corrupted(d, i) for i, d in enumerate(shown)] if kind == "corrupted" else shown
    begin = time.process_time()
    try:
        result, refused = adapt_most(given, platform)
    except InfeasibleError as e:
        return Measured([], left_out={f.name: str(e) for f in group}, seconds=time.process_time() - begin)
    seconds = time.process_time() - begin
    chosen = [i for i in range(len(group)) if i not in refused]
    numbers = evaluate([given[i] for i in chosen], result, platform)
    before, after = (as_numbers(numbers[when]) for when in ("before", "after"))
    if kind == "corrupted":
        clean = evaluate([shown[i] for i in chosen], result, platform)
        before["uncorrupted_cm"], after["uncorrupted_cm"] = None, clean["after"].hand_cm
    return Measured(
        [group[i].name for i in chosen],
        before,
        after,
        {group[i].name: why for i, why in refused.items()},
        list(result.report.notes),
        sum(len(shown[i]) for i in chosen),
        seconds,
    )


def corrupted(d: Demonstration, seed: int) -> Demonstration:
    """With hands missing and off, and without the torso for a while; covariances and everything else as they were."""
    rng, t = np.random.default_rng([seed, TASKS.index(d.task)]), len(d)
    hand, torso = d.hand, d.torso
    T = hand.T_world_x.copy()
    wild = np.flatnonzero(hand.known & (rng.random(t) < OUTLIERS))
    away = rng.normal(size=(len(wild), 3))
    T[wild, :3, 3] += OUTLIER_M * away / np.linalg.norm(away, axis=1, keepdims=True)
    missing = rng.random(t) < MISSING
    T[missing] = np.nan
    hand = replace(hand, T_world_x=T, observed=hand.observed & ~missing, oriented=hand.oriented & ~missing)
    gap = min(t, round(TORSO_GAP_S / float(np.median(np.diff(d.times_s)))))
    start = int(rng.integers(0, t - gap + 1))
    unseen = (np.arange(t) >= start) & (np.arange(t) < start + gap)
    xy_yaw = np.where(unseen[:, None], np.nan, torso.xy_yaw)
    return replace(d, hand=hand, torso=replace(torso, xy_yaw=xy_yaw, observed=torso.observed & ~unseen))


# writing


def tell(kind: str, task: str, m: Measured) -> None:
    what = f"{m.seconds:.1f} s of processor time" if m.kept else next(iter(m.left_out.values()), "").splitlines()[0]
    print(f"{kind}, {task}: {', '.join(m.kept) or 'none'}: {what}", file=sys.stderr)


def section(kind: str, tasks: dict[str, list[Measured]]) -> str:
    """One input kind's table, and what is to be said about it."""
    heads = [
        "",
        *(f"{task.replace('_', ' ')} ({count(parts)})" for task, parts in tasks.items()),
        "paper",
    ]
    rows = []
    for name, words in WORDS.items():
        if name == "uncorrupted_cm" and kind != "corrupted":
            continue
        cells = [f"{middle(p, 'before', name)} / {middle(p, 'after', name)}" for p in tasks.values()]
        rows.append([words, *cells, paper(kind, name, tasks)])
    seconds = [f"{sum(m.seconds for m in p):.1f}" for p in tasks.values()]
    rows.append(["processor time of the adaptation, s", *seconds, ""])
    lines = [f"## {KINDS[kind]}", *([ABOUT[kind]] if ABOUT[kind] else []), ""]
    lines += ["| " + " | ".join(row) + " |" for row in (heads, ["---"] * len(heads), *rows)]
    return "\n".join([*lines, *remarks(tasks), ""])


def count(parts: list[Measured]) -> str:
    """So many of so many demonstrations."""
    kept = sum(len(p.kept) for p in parts)
    return f"{kept} of {kept + sum(len(p.left_out) for p in parts)}"


def middle(parts: list[Measured], when: str, name: str) -> str:
    """The median over the parts that were feasible."""
    values = [getattr(p, when).get(name) for p in parts if p.kept]
    known = [v for v in values if v is not None]
    return digits(float(np.median(known))) if known else "-"


def paper(kind: str, name: str, tasks: Iterable[str]) -> str:
    """The paper's values for those tasks, as far as they are known."""
    column = [TASKS.index(task) for task in tasks]
    source = "markers" if kind == "markers" else "RGB-D"
    after, before = PAPER[source].get(name), PAPER_BEFORE[source].get(name)
    words = {
        when: " / ".join("-" if np.isnan(v[i]) else f"{v[i]:g}" for i in column)
        for when, v in (("before", before), ("after", after))
        if v is not None
    }
    return "; ".join(f"{when} {w}" for when, w in words.items())


def digits(value: float) -> str:
    """As many as a reader needs."""
    if value == 0 or value >= 99.995:
        return f"{value:.0f}"
    return "< 0.001" if value < 0.001 else f"{value:.3f}" if value < 0.1 else f"{value:.2f}"


def remarks(tasks: dict[str, list[Measured]]) -> list[str]:
    """Who was left out and why; notes of the adaptation."""
    lines = []
    for task, parts in tasks.items():
        for p in parts:
            lines += [f"- {name} left out: {short(why)}" for name, why in p.left_out.items()]
            who = p.kept[0] if len(parts) > 1 and p.kept else task
            lines += [f"- {who}: {note}" for note in p.notes]
    return ["", *lines] if lines else []


def short(why: str) -> str:
    """An error's first line, and of the places that it names the first."""
    return " ".join(line.strip() for line in why.splitlines()[:2])


def document(sections: list[str], robot: str, seconds: float) -> str:
    parts = [
        "# Adaptation of demonstrations from the stage",
        "",
        "Written by `benchmarks/adaptation_stage.py`; made anew, not edited. "
        f"Robot: {robot}. Values are before / after adaptation; in brackets, how many demonstrations were kept. "
        "Definitions: ../adaptation.md.",
        "",
        *sections,
        f"Made in {seconds:.0f} s (less where earlier measurements were taken over).",
        "",
        machine(),
        "",
    ]
    return "\n".join(parts)


if __name__ == "__main__":
    try:
        main()
    except (UnderstudyError, ImportError) as e:
        sys.exit(f"adaptation_stage.py: {e}")
