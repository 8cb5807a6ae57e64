"""Trials: a skill, run in many layouts that it has not seen, in physics.

Of a trial's seed follow the furniture (kind of handle, dimensions, side of the hinge, friction, springs), the robot's
start, and all noise. Demonstrations are made on furniture of seeds below `FIRST_SEED`; trials use seeds from there on.
The furniture stands at the world's origin; what is random is where the robot starts from, as seen from it, and by how
much the robot is wrong about where it stands.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from understudy.actions import ActionModel, Skill
from understudy.adaptation.platform import Platform
from understudy.demonstration.tasks import TASKS
from understudy.errors import UnderstudyError, one_of
from understudy.execution.config import Config
from understudy.execution.execution import Execution, Planner
from understudy.execution.outcome import Outcome
from understudy.execution.planning import make_plan
from understudy.execution.surroundings import observe
from understudy.files import read_json, write_atomically
from understudy.robot.description import load_description
from understudy.robot.model import Robot
from understudy.robot.simulator import Simulator
from understudy.robot.simulator_video import write_video
from understudy.stage.furniture import Furniture, sample_furniture

FORMAT: Final = "trial/1"
FIRST_SEED: Final = 100_000
"""Furniture of smaller seeds is for demonstrations and training."""
PER_SEED: Final = 1_000
"""Trials of one seed of the command; more are refused."""

START_X, START_Y, START_YAW = (-1.9, -1.3), (-0.4, 0.5), np.radians(25)
"""Of the base, seen from the closed handle: metres before the front, metres to its left, radians to either side."""

# The free arm is folded before the chest (Willow Garage's tuck), so that the robot fits through doors
_TUCKED: Final = {
    "l_shoulder_pan_joint": 0.06,
    "l_shoulder_lift_joint": 1.2485,
    "l_upper_arm_roll_joint": 1.789,
    "l_elbow_flex_joint": -1.683,
    "l_forearm_roll_joint": -1.734,
    "l_wrist_flex_joint": -0.096,
    "l_wrist_roll_joint": -0.086,
}


def trial_robot(name: str) -> Robot:
    """A robot by name or description, the PR2 with its free arm folded."""
    description = load_description(name)
    if description.name == "pr2_right":
        description = replace(description, others=_TUCKED)
    return Robot(description)


@dataclass(frozen=True)
class TrialSetup:
    """One layout."""

    task: str
    seed: int
    """of furniture, start and noise"""

    @property
    def furniture(self) -> Furniture:
        """The same for the same seed."""
        return sample_furniture(self.task, self.seed)

    @property
    def base_start(self) -> Float[np.ndarray, "3"]:
        """x, y (metres), yaw (radians), world."""
        rng = np.random.default_rng([self.seed, 41, TASKS.index(self.task)])
        low, high = (START_X[0], START_Y[0], -START_YAW), (START_X[1], START_Y[1], START_YAW)
        return rng.uniform(low, high)


def setups(task: str, n: int, seed: int) -> list[TrialSetup]:
    """n layouts of a task. Raises UnderstudyError for numbers out of range."""
    if task not in TASKS:
        raise UnderstudyError(f"task {task!r}: must be {one_of((*TASKS, 'all'))}")
    if not 1 <= n <= PER_SEED or seed < 0:
        raise UnderstudyError(f"trials: n must be in 1 ... {PER_SEED} and seed at least 0, got n {n}, seed {seed}")
    return [TrialSetup(task, FIRST_SEED + PER_SEED * seed + i) for i in range(n)]


def goal(model: ActionModel, furniture: Furniture) -> float:
    """How far a trial is to open the part: as far as was demonstrated, or as it opens."""
    return min(model.object.travel, furniture.articulation.range[1])


def run_trial(
    model: ActionModel,
    robot: Robot,
    platform: Platform,
    setup: TrialSetup,
    *,
    video: Path | None = None,
    config: Config | None = None,
    planner: Planner = make_plan,
) -> Outcome:
    """One trial; the same for the same arguments. video: where to write one (needs OpenGL, takes much longer)."""
    furniture = setup.furniture
    with Simulator(
        robot, furniture, seed=setup.seed, base_start=setup.base_start, render=video is not None
    ) as simulator:
        perception = partial(observe, furniture)
        q_goal = goal(model, furniture)
        execution = Execution(model, robot, platform, perception, q_goal=q_goal, config=config, planner=planner)
        outcome = execution.run(simulator)
        if video is not None and simulator.video is not None:
            write_video(video, simulator.video.frames)
    return outcome


def run_trials(
    skill: Skill,
    robot: Robot,
    platform: Platform,
    layouts: Sequence[TrialSetup],
    out: Path,
    *,
    videos: str = "none",
    done: Callable[[TrialSetup, dict[str, Any]], None] | None = None,
    planner: Planner = make_plan,
) -> list[dict[str, Any]]:
    """Runs what has not been run yet; one file per trial in `out`, written whole or not at all.

    videos: none, failures or all. planner: see `Execution`. Results of another skill in the same folder are refused
    (UnderstudyError).
    """
    if videos not in ("none", "failures", "all"):
        raise UnderstudyError(f"videos {videos!r}: must be {one_of(('none', 'failures', 'all'))}")
    name = skill_name(skill)
    rows = []
    for setup in layouts:
        file = Path(out) / f"{setup.task}-{setup.seed}.json"
        row = _kept(file, name)
        if row is None:
            row = _run(skill.model, robot, platform, setup, name, planner)
            write_atomically(file, json.dumps(row, indent=2) + "\n")
        film = file.with_suffix(".mp4")
        if (videos == "all" or (videos == "failures" and not row["success"])) and not film.exists():
            run_trial(skill.model, robot, platform, setup, video=film, planner=planner)  # again: it is the same trial
        rows.append(row)
        if done is not None:
            done(setup, row)
    return rows


def skill_name(skill: Skill) -> str:
    """By which results are told apart: what the skill does, not where it is kept."""
    digest = hashlib.sha256(f"{skill.task} {skill.robot}".encode())
    for segment in skill.model.segments.values():
        for array in (segment.mixture.weights, segment.mixture.means, segment.mixture.covariances):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def _kept(file: Path, skill: str) -> dict[str, Any] | None:
    if not file.exists():
        return None
    row = read_json(file)
    if row.get("format") != FORMAT or row.get("skill") != skill:
        raise UnderstudyError(f"{file}: is of another skill (or version): give another folder, or remove it")
    return row


def _run(
    model: ActionModel, robot: Robot, platform: Platform, setup: TrialSetup, skill: str, planner: Planner
) -> dict[str, Any]:
    wall, process = time.perf_counter(), time.process_time()
    outcome = run_trial(model, robot, platform, setup, planner=planner)
    return {
        "format": FORMAT,
        "skill": skill,
        "task": setup.task,
        "seed": setup.seed,
        **outcome.to_json(),
        "wall_s": round(time.perf_counter() - wall, 2),
        "processor_s": round(time.process_time() - process, 2),
    }


def wilson_interval(successes: int, n: int, z: float = 1.959963984540054) -> tuple[float, float]:
    """Confidence interval of a share (95 % by default). Wilson 1927."""
    if n < 1 or not 0 <= successes <= n:
        raise UnderstudyError(f"a share needs 0 <= successes <= n and n >= 1, got {successes} of {n}")
    p = successes / n
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low = 0.0 if successes == 0 else float(middle - half)
    return low, 1.0 if successes == n else float(middle + half)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line per task: successes with their interval, how far, how hard, how long, and why not."""
    head = (
        f"{'task':14} {'success':>9} {'95 % interval':>15} {'opened':>7} {'retried':>7} {'force N':>8} {'s/trial':>8}"
    )
    head += "  failures"
    lines = [head]
    for task in dict.fromkeys(row["task"] for row in rows):
        part = [row for row in rows if row["task"] == task]
        good, n = sum(row["success"] for row in part), len(part)
        low, high = wilson_interval(good, n)
        reasons = Counter(row["reason"] for row in part if not row["success"])
        why = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common()) or "-"
        median = {
            key: float(np.median([row[key] for row in part])) for key in ("opened_share", "max_force_n", "wall_s")
        }
        retried = sum(row["retries"] > 0 for row in part)
        interval = f"{100 * low:.0f} ... {100 * high:.0f} %"
        lines.append(
            f"{task:14} {f'{good}/{n}':>9} {interval:>15} {100 * median['opened_share']:6.0f}% {retried:7d} "
            f"{median['max_force_n']:8.0f} {median['wall_s']:8.1f}  {why}"
        )
    return "\n".join(lines)
