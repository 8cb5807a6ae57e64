"""`understudy trials`: a robot uses its skills in simulated rooms that it has not seen."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from understudy.cli.common import command, needs_extra
from understudy.errors import UnderstudyError


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands,
        "trials",
        "run skills in physics, in layouts that they have not seen",
        "  understudy trials --skill skills --task all --n 20 --seed 0 --out trials\n"
        "  understudy trials --skill skills/drawer --n 5 --out trials --videos failures\n"
        "\nSuccess: opened to 80 % of what was demonstrated, let go, and touched nothing else. Run it again to go on.",
    )
    parser.add_argument(
        "--skill", type=Path, required=True, metavar="DIR", help="a skill, or a folder with one skill per task in it"
    )
    parser.add_argument("--task", default="all", metavar="TASK", help="a task, or 'all' that there are skills for")
    parser.add_argument("--n", type=int, default=20, metavar="N", help="layouts per task (default 20)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="which layouts (default 0)")
    parser.add_argument("--robot", default="pr2", metavar="NAME", help="a robot's name (default pr2)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for results, one file per trial")
    parser.add_argument(
        "--videos", default="none", choices=("none", "failures", "all"), help="which trials to film (default none)"
    )
    parser.set_defaults(run=_trials, after_interrupt=": run the same command again to go on")


def _trials(arguments: argparse.Namespace) -> int:
    from understudy.actions import load_skill

    with needs_extra("robots and simulation", "robot"):
        from understudy.adaptation.robots import platform_of
        from understudy.execution import trials

    skills = [load_skill(folder) for folder in _folders(arguments.skill)]
    skills = [skill for skill in skills if arguments.task in ("all", skill.task)]
    if not skills:
        raise UnderstudyError(f"{arguments.skill}: no skill for the task {arguments.task!r}")
    layouts = [trials.setups(skill.task, arguments.n, arguments.seed) for skill in skills]
    robot = trials.trial_robot(arguments.robot)
    platform = platform_of(robot)
    rows: list[dict[str, Any]] = []
    for skill, part in zip(skills, layouts, strict=True):
        rows += trials.run_trials(
            skill, robot, platform, part, arguments.out, videos=arguments.videos, done=_said(len(part))
        )
    print(trials.table(rows))
    print(f"  {arguments.out}")
    return 0


def _said(n: int) -> Any:
    count = iter(range(1, n + 1))

    def say(setup: Any, row: dict[str, Any]) -> None:
        print(
            f"  {setup.task} {next(count)}/{n}: {row['reason'].lower().replace('_', ' ')}: {row['detail']}", flush=True
        )

    return say


def _folders(path: Path) -> list[Path]:
    """The skill itself, or all skills in the folder."""
    if (path / "skill.json").is_file():
        return [path]
    found = sorted(p.parent for p in path.glob("*/skill.json"))
    if not found:
        raise UnderstudyError(f"{path}: no skill there, nor in its folders (skill.json)")
    return found
