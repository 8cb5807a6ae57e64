"""Skills from demonstrations, and what baselines reach, in the same trials: the table of docs/execution/README.md.

    understudy demonstrate RECORDINGS... --out DEMOS            # and with --teacher markers --object markers: MARKED
    python benchmarks/skills.py DEMOS --markers MARKED --work WORK --out docs/execution --n 20 --seed 3

For each task, in trials of the same layouts: the skill from all demonstrations; from one (the first that is feasible
alone); from all, with the teacher's markers followed instead of hands and torso in RGB-D; and imitation: hand and torso
followed as they were seen (`execution.imitation`). Runs again where it stopped; --only runs some rows.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import machine

from understudy.actions import Skill, learn, load_skill, save_skill
from understudy.adaptation.errors import InfeasibleError
from understudy.adaptation.most import adapt_most
from understudy.adaptation.platform import Platform
from understudy.adaptation.robots import platform_of
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.run import load_all
from understudy.demonstration.tasks import TASKS
from understudy.execution import trials
from understudy.execution.imitation import imitation_plan, unadapted
from understudy.execution.planning import make_plan
from understudy.files import write_atomically
from understudy.robot import load_robot
from understudy.teaching_motions import robot_motions, too_short

ROWS = {
    "all": "all demonstrations",
    "one": "one demonstration",
    "markers": "teacher and object followed by markers",
    "imitation": "imitation, without adaptation",
}


def learnt(task: str, row: str, shown: list[Demonstration], platform: Platform, folder: Path) -> Skill:
    """The skill of one row, made once."""
    if (folder / "skill.json").exists():
        return load_skill(folder)
    short = [why for d in shown if (why := too_short(d))]
    usable = [d for d in shown if not too_short(d)]  # as `understudy teach` does
    if row == "one":
        usable = first_feasible(usable, platform)
    result, left_out = adapt_most(usable, platform)
    kept = [d for i, d in enumerate(usable) if i not in left_out]
    if row == "imitation":
        result = unadapted(kept, result, platform)
    of = 1 if row == "one" else len(shown)
    used = {"demonstrations": len(kept), "of": of, "left out": [*short, *left_out.values()]}
    skill = Skill(learn(robot_motions(kept, result)), task, "pr2", used)
    save_skill(folder, skill)
    return skill


def first_feasible(shown: list[Demonstration], platform: Platform) -> list[Demonstration]:
    """The first demonstration that the robot can do."""
    for d in shown:
        try:
            adapt_most([d], platform)
        except InfeasibleError:
            continue
        return [d]
    raise SystemExit("no demonstration is feasible alone")


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs what has not been run yet; writes the table of all that has."""
    chosen = parse(arguments)
    shows = platform_of(load_robot("pr2"))  # as `understudy teach` adapts to it
    robot = trials.trial_robot("pr2")
    platform = platform_of(robot)
    shown = {"rgbd": load_all([chosen.demonstrations])}
    if chosen.markers:
        shown["markers"] = load_all([chosen.markers])
    for task in chosen.task:
        for row in chosen.only:
            source = [d for d in shown.get("markers" if row == "markers" else "rgbd", []) if d.task == task]
            if not source:
                print(f"{task}, {row}: no demonstrations")
                continue
            folder = chosen.work / row / task
            skill = learnt(task, row, source, shows, folder)
            results = trials.run_trials(
                skill, robot, platform, trials.setups(task, chosen.n, chosen.seed),
                chosen.work / row / f"trials-{chosen.seed}",
                planner=imitation_plan if row == "imitation" else make_plan,
                done=lambda setup, r, row=row: print(row, setup.task, setup.seed, r["reason"], r["detail"], flush=True),
            )  # fmt: skip
            print(trials.table(results), flush=True)
    if chosen.out:
        write_atomically(chosen.out / "README.md", page(chosen.work, chosen.seed))


def page(work: Path, seed: int) -> str:
    """The table of all results that there are."""
    heads = ["task", "learnt from", "of", "success", "95 % interval", "opened", "retried", "N", "wall s", "failures"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for task in TASKS:
        for row, words in ROWS.items():
            files = sorted((work / row / f"trials-{seed}").glob(f"{task}-*.json"))
            if files:
                lines.append(
                    line(task, words, load_skill(work / row / task), [json.loads(f.read_text()) for f in files])
                )
    text = [
        "# Skills in trials that no demonstration shows",
        "",
        "Written by `benchmarks/skills.py`; made anew, not edited.",
        "",
        *lines,
        "",
        f"Layouts of seed {seed} (`understudy trials --seed {seed}`): the same for all rows of a task. Of: "
        "demonstrations that it was learnt from, and that there were. Opened, N (greatest force on the part), "
        "wall s (planning and simulation): medians; in brackets the share of trials within 10 s. Interval: Wilson.",
        "",
        machine(),
    ]  # fmt: skip
    return "\n".join(text)


def line(task: str, words: str, skill: Skill, rows: list[dict[str, Any]]) -> str:
    """One line of the table."""
    good, n = sum(r["success"] for r in rows), len(rows)
    low, high = trials.wilson_interval(good, n)
    why: dict[str, int] = {}
    for r in rows:
        if not r["success"]:
            word = r["reason"].lower().replace("_", " ")
            why[word] = why.get(word, 0) + 1
    seconds = np.array([r["wall_s"] for r in rows])
    cells = [
        task,
        words,
        f"{skill.provenance.get('demonstrations')} of {skill.provenance.get('of')}",
        f"{good}/{n}",
        f"{100 * low:.0f} ... {100 * high:.0f} %",
        f"{100 * np.median([r['opened_share'] for r in rows]):.0f} %",
        str(sum(r["retries"] > 0 for r in rows)),
        f"{np.median([r['max_force_n'] for r in rows]):.0f}",
        f"{np.median(seconds):.1f} ({100 * np.mean(seconds <= 10):.0f} %)",
        ", ".join(f"{count} {word}" for word, count in sorted(why.items(), key=lambda p: -p[1])),
    ]
    return "| " + " | ".join(cells) + " |"


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demonstrations", type=Path, help="folder of demonstrations, from RGB-D")
    parser.add_argument("--markers", type=Path, help="folder of demonstrations, with the teacher's markers")
    parser.add_argument("--task", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--only", nargs="+", default=list(ROWS), choices=list(ROWS), help="rows of the table")
    parser.add_argument("--n", type=int, default=20, help="layouts per task")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--work", type=Path, required=True, help="skills and trials; goes on where it stopped")
    parser.add_argument("--out", type=Path, help="folder for README.md")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
