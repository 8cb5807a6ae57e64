"""Robot kinematics: forward (ours against a Pinocchio loop), exact IK, reachability map and field.

    python benchmarks/robot.py [ROBOT ...] [--build]      default: pr2 tiago_pro

--build also trains the field and builds the map anew (minutes of processor time, not kept). Rates are per second of
processor time, so that other work on the machine matters less.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
from common import report

from understudy.robot.field import load_field, train_field, typical_poses, uniform_poses
from understudy.robot.ik import solve_ik
from understudy.robot.ik_follow import follow_ik_path
from understudy.robot.ik_path import solve_ik_path
from understudy.robot.model import Robot, load_robot
from understudy.robot.reachability import build_map, load_map

HEADS = ["robot", "what", "measured", "against"]


def main() -> None:
    names = [name for name in sys.argv[1:] if not name.startswith("--")] or ["pr2", "tiago_pro"]
    rows = []
    for name in names:
        robot = load_robot(name)
        warm_up(robot)
        for part in (kinematics, inverse, reachability):
            rows += [[name, *row] for row in part(robot)]
        if "--build" in sys.argv:
            rows += [[name, *row] for row in builds(robot)]
    report("robot", HEADS, rows, "P: precision, R: recall of 'reachable' against exact IK with self-collision.")


def seconds(work: Callable[[], Any]) -> tuple[float, Any]:
    """Processor time of one call, and what it returns."""
    start = time.process_time()
    out = work()
    return time.process_time() - start, out


def warm_up(robot: Robot) -> None:
    """Compiles, reads meshes, makes the seed table, fills the caches."""
    q, torso = robot.sample(2)
    solve_ik(robot, robot.forward(q, torso), torso)
    follow_ik_path(robot, robot.forward(q, torso), torso, np.arange(2.0))
    load_field(robot).distance(robot.forward(q, torso), torso)
    load_map(robot)


def kinematics(robot: Robot) -> list[list[str]]:
    q, torso = robot.sample(200_000)
    ours, _ = seconds(lambda: robot.forward(q, torso))
    model, few = robot.model, 20_000
    data, full = model.createData(), pin.randomConfiguration(model)
    tool = model.getBodyId(robot.description.tool_link)

    def loop() -> None:
        for _ in range(few):
            pin.forwardKinematics(model, data, full)
            pin.updateFramePlacement(model, data, tool).homogeneous  # noqa: B018

    theirs, _ = seconds(loop)
    collision, hit = seconds(lambda: robot.collides(q[:3000], torso[:3000]))
    ratio = (theirs / few) / (ours / len(q))
    return [
        ["forward kinematics", f"{len(q) / ours / 1e6:.2f} M/s", f"Pinocchio loop, same run: x {ratio:.1f}"],
        ["self-collision", f"{3000 / collision:.0f} /s", f"{hit.mean():.1%} of random configurations collide"],
    ]


def inverse(robot: Robot) -> list[list[str]]:
    q, torso = robot.sample(3000, seed=7)
    T = robot.forward(q, torso)
    free = ~robot.collides(q, torso)
    bare, a = seconds(lambda: solve_ik(robot, T, torso, check_collisions=False))
    checked, b = seconds(lambda: solve_ik(robot, T[free], torso[free]))
    lifted, c = seconds(lambda: solve_ik(robot, T, None, check_collisions=False))
    box = uniform_poses(robot, np.random.default_rng(0), 1000, 0.0)
    mixed, d = seconds(lambda: solve_ik(robot, box, torso[:1000]))
    path = np.tile(np.eye(4), (150, 1, 1))
    path[:, :3, 3] = np.column_stack([np.full(150, 0.65), np.linspace(-0.6, -0.2, 150), np.full(150, 0.9)])
    along, e = seconds(lambda: solve_ik_path(robot, path, np.full(150, 0.1)))
    quick, f = seconds(lambda: follow_ik_path(robot, path, np.full(150, 0.1), 0.1 * np.arange(150)))
    return [
        ["IK, limits only", f"{len(T) / bare:.0f} poses/s", f"{a.success.mean():.2%} solved"],
        ["IK, free of self-collision", f"{free.sum() / checked:.0f} poses/s", f"{b.success.mean():.2%} solved"],
        ["IK, free torso", f"{len(T) / lifted:.0f} poses/s", f"{c.success.mean():.2%} solved"],
        ["IK, box around the robot", f"{1000 / mixed:.0f} poses/s", f"{d.success.mean():.1%} reachable"],
        ["IK path, 150 steps", f"{1000 * along:.0f} ms", f"{e.success.mean():.1%} solved, {len(e.jumps)} jumps"],
        ["the same, followed", f"{1000 * quick:.0f} ms", f"{f.success.mean():.1%} solved, {len(f.jumps)} jumps"],
    ]


def reachability(robot: Robot) -> list[list[str]]:
    rng, n = np.random.default_rng(99), 2000
    q, torso = robot.sample(n, seed=55)
    near = robot.forward(q, torso)
    near[:, :3, 3] += rng.normal(0, 0.08, (n, 3))
    level = typical_poses(rng, n)
    rows = []
    field, chart = load_field(robot), load_map(robot)
    sets = {"box": uniform_poses(robot, rng, n, 0.0), "boundary": near, "typical": level}
    for name, T in sets.items():
        exact = solve_ik(robot, T, torso).success
        value = field.distance(T, torso)[0]
        plain, safe = score(value - field.margin <= 0, exact), score(value <= 0, exact)
        rows.append([f"field, {name}", f"{safe} with margin", f"{plain} without; {exact.mean():.0%} reachable"])
        rows.append([f"map, {name}", score(chart.reachable(T, torso) > 0.1, exact), "score above 0.1"])
    many, heights = np.tile(level, (15, 1, 1)), np.tile(torso, 15)
    spent = min(seconds(lambda: field.distance(many, heights))[0] for _ in range(5))
    load, _ = seconds(lambda: load_field(robot))
    load_chart, _ = seconds(lambda: load_map(robot))
    place, _ = seconds(lambda: chart.base_placements(level[:1] + 0.0, 0.1))
    rows.append(["field, 30 000 poses with gradients", f"{1000 * spent:.0f} ms", "target 60 ms"])
    rows.append(["load the field; the map", f"{1000 * load:.0f}; {1000 * load_chart:.0f} ms", "target 500 ms"])
    rows.append(["base placements of one pose", f"{1000 * place:.0f} ms", "all x, y, 48 headings"])
    return rows


def score(says: np.ndarray, exact: np.ndarray) -> str:
    """Precision and recall."""
    both = (says & exact).sum()
    return f"P {both / max(says.sum(), 1):.3f} R {both / max(exact.sum(), 1):.3f}"


def builds(robot: Robot) -> list[list[str]]:
    field, _ = seconds(lambda: train_field(robot))
    chart, _ = seconds(lambda: build_map(robot))
    return [
        ["train the field", f"{field:.0f} s of processor time", "two threads for the labels"],
        ["build the map", f"{chart:.0f} s of processor time", "two threads"],
    ]


if __name__ == "__main__":
    main()
