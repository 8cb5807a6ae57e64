"""How much a skill in the simulator bears: trials with more noise than usual, and without the closed loop.

    python benchmarks/trials.py SKILLS --task drawer --n 10

SKILLS is a folder of skills, as for `understudy trials`. Prints one row per variant: successes and Wilson intervals.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

from understudy.actions import load_skill
from understudy.adaptation.robots import platform_of
from understudy.execution import trials
from understudy.execution.config import Config
from understudy.execution.execution import Execution
from understudy.execution.surroundings import observe
from understudy.robot.simulator import Noise, Simulator

USUAL = Noise()
VARIANTS = {
    "no noise": (Noise((0, 0), (0, 0), (0, 0)), Config()),
    "as in trials": (USUAL, Config()),
    "localisation 4 cm, 4 degrees": (replace(USUAL, localisation=(0.04, 4.0)), Config()),
    "handle 1 cm, 2 degrees": (replace(USUAL, near=(0.01, 2.0)), Config()),
    "not measured near the handle": (USUAL, Config(measure_s=1e6)),
    "does not give way": (USUAL, Config(give_way_s=1e6)),
}


def main() -> None:
    """Runs the variants."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("skills", type=Path)
    parser.add_argument("--task", default="drawer")
    parser.add_argument("--n", type=int, default=10)
    arguments = parser.parse_args()
    model = load_skill(arguments.skills / arguments.task).model
    robot = trials.trial_robot("pr2")
    platform = platform_of(robot)
    print(f"{arguments.task}, {arguments.n} layouts")
    for name, (noise, config) in VARIANTS.items():
        good, force = 0, 0.0
        for setup in trials.setups(arguments.task, arguments.n, 0):
            furniture = setup.furniture
            simulator = Simulator(robot, furniture, seed=setup.seed, base_start=setup.base_start, noise=noise)
            goal = trials.goal(model, furniture)
            perception = partial(observe, furniture)
            outcome = Execution(model, robot, platform, perception, q_goal=goal, config=config).run(simulator)
            good, force = good + outcome.success, max(force, outcome.max_force)
        low, high = trials.wilson_interval(good, arguments.n)
        print(
            f"{name:30} {good:3d}/{arguments.n}  {100 * low:3.0f} ... {100 * high:3.0f} %  largest force {force:4.0f} N"
        )


if __name__ == "__main__":
    main()
