"""How long adaptation takes: 10 demonstrations x 150 steps, 100 to 20 000 steps, and gtsam on the same graph.

    python benchmarks/adaptation.py [--robot pr2] [--gtsam-demonstrations 2] [--longest 20000]

gtsam gets its own factors (C++) for all edges between poses, and Python callbacks for map and reachability, which it
has no factors for. Both solve the same least-squares problem, from the same start, to the same tolerance.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import RESULTS, report

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import adaptation_scenes as scenes

from understudy.adaptation import edges, prepare
from understudy.adaptation.adapt import adapt
from understudy.adaptation.calibration import DEFAULT_HAND_TOOL, Calibration
from understudy.adaptation.graph import Graph, State
from understudy.adaptation.platform import Platform
from understudy.adaptation.solver import Chain, Linear, Stop, minimise
from understudy.adaptation.weights import SCHEDULE, Margins, Weights

FULL = replace(SCHEDULE[-1], kernel="none")
TOLERANCE = 1e-5
KINDS = ("hand", "torso", "torso lift", "rigid", "gripper speed", "base speed", "torso speed", "reach", "map")


def timed(work: Callable[[], object]) -> tuple[object, float, float]:
    """Result, wall seconds, processor seconds."""
    wall, process = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - process


def whole(platform: Platform) -> list[list[str]]:
    """`adapt` with everything: grasp, calibration, base search, graph, exact checks."""
    rows = []
    for task in scenes.TASKS:
        shown = scenes.demonstrations(task, 10, samples=150)
        result, wall, process = timed(lambda shown=shown: adapt(shown, platform))
        course = result.report.convergence
        count = str(len(course.iterations))
        rows.append([f"adapt, {task}, 10 x 150", f"{wall:.2f}", f"{process:.2f}", count, ""])
        rows.append(["- of which the graph", f"{course.seconds:.2f}", f"{course.process_seconds:.2f}", count, ""])
    return rows


def lengthened(n: int) -> tuple[Graph, State]:
    """One long demonstration of n steps."""
    shown = [scenes.demonstration("room_door", samples=n)]
    return prepared(shown, scenes.platform())


def prepared(shown: list, platform: Platform, weights: Weights | None = None) -> tuple[Graph, State]:
    """Graph and first guess with the default calibration."""
    g = scenes.GraspFamily(0.0, 0.7, 0.05).members(np.array([0.2]), np.zeros(1))[0]
    calibration = Calibration(DEFAULT_HAND_TOOL, np.array([-0.15, 0.0, 0.0]))
    problem = prepare.stacked(shown, calibration, g, prepare.Obstacles(shown))
    base = np.concatenate([prepare.first_base(d, calibration.torso_base) for d in shown])
    state = State(prepare.first_gripper(problem, g), base, np.full(len(base), platform.torso_rest), g)
    return Graph(problem, platform, weights, Margins()), state


def scaling(longest: int) -> tuple[list[list[str]], list[tuple[int, float]]]:
    """Seconds per iteration of the whole graph over the number of steps."""
    rows, points = [], []
    for n in [k for k in (100, 200, 500, 1000, 2000, 5000, 10_000, 20_000) if k <= longest]:
        graph, state = lengthened(n)
        chain = Chain(n, lambda s, graph=graph: graph.linearise(s, SCHEDULE[1]), lambda s, d, g: s.retract(d, g))
        (_, course, _), wall, process = timed(lambda c=chain, s=state: minimise(c, s, Stop(0.0, 10)))
        each = process / len(course)
        points.append((n, each))
        rows.append([f"graph, {n} steps", f"{wall:.2f}", f"{process:.2f}", str(len(course)), f"{1e6 * each / n:.1f}"])
    return rows, points


def against_gtsam(platform: Platform, count: int) -> list[list[str]]:
    """The same edges, the same start."""
    import gtsam

    shown = scenes.demonstrations("room_door", count, samples=150)
    weights = replace(Weights(), gripper_acceleration=None, base_acceleration=None, obstacle=0.02, reach=0.02)
    graph, state = prepared(shown, platform, weights)

    def chosen(s: State) -> list[Linear]:
        return [e for e in graph.linearise(s, FULL) if e.kind in KINDS]

    n = len(state.torso)
    chain = Chain(n, chosen, lambda s, d, g: s.retract(d, g), free_border=False)
    (_, course, _), wall, process = timed(lambda: minimise(chain, state, Stop(TOLERANCE, 100)))
    ours = min(i.cost for i in course)
    factors, values = _gtsam_graph(gtsam, graph, state)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(TOLERANCE)
    optimiser = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters)
    _, theirs_wall, theirs_process = timed(optimiser.optimize)
    name = f"room_door, {count} x 150, poses + map + reach"
    iterations = str(optimiser.iterations())
    return [
        [f"understudy: {name}", f"{wall:.2f}", f"{process:.2f}", str(len(course)), f"cost {ours:.1f}"],
        [
            f"gtsam {gtsam.__version__ if hasattr(gtsam, '__version__') else '4.3'}: {name}",
            f"{theirs_wall:.1f}",
            f"{theirs_process:.1f}",
            iterations,
            f"cost {2 * optimiser.error():.1f}; {theirs_process / process:.0f} times as long",
        ],
    ]


def _gtsam_graph(gtsam, graph: Graph, start: State):
    """All edges of KINDS. The grasp is fixed for both."""
    p, w, platform = graph.problem, graph.weights, graph.platform
    swap = np.r_[3:6, 0:3]
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def key(name: str, i: int) -> int:
        return gtsam.symbol(name, int(i))

    def sigmas(s):
        return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(s, float))

    def covariance(c, pair, planar=False):
        spread = np.array([pair[0]] * 2 + [pair[1]]) if planar else np.repeat(pair, 3)
        total = c + np.diag(spread**2)
        return gtsam.noiseModel.Gaussian.Covariance(total if planar else total[np.ix_(swap, swap)])

    def reach(this, v, H):
        g, b, h = list(this.keys())
        q = v.atPose2(b)
        base = np.array([[q.x(), q.y(), q.theta()]])
        T = v.atPose3(g).matrix()[None]
        e, J, Jb, Jh = edges.reach(platform.reachability, T, base, np.array([v.atDouble(h)]), graph.margins.reach)
        if H is not None:
            H[0], H[1], H[2] = (np.asfortranarray(x) for x in (J[0][:, swap], Jb[0], Jh[0]))
        return e[0]

    def clearance(around):
        def error(this, v, H):
            q = v.atPose2(next(iter(this.keys())))
            base = np.array([[q.x(), q.y(), q.theta()]])
            margin = graph.margins.obstacle
            e, J = edges.map_clearance(around.map, around.obstacles, platform.footprint, base, margin)
            if H is not None:
                H[0] = np.asfortranarray(J[0])
            return e[0]

        return error

    around = {i: s for s in p.surroundings for i in range(s.steps.start, s.steps.stop)}
    near = sigmas(np.full(len(platform.footprint), w.obstacle))
    grasp = sigmas(np.repeat(w.grasp, 3)[swap])
    for i in range(len(start.torso)):
        G, B, Z = key("g", i), key("b", i), key("h", i)
        values.insert(G, gtsam.Pose3(start.gripper[i]))
        values.insert(B, gtsam.Pose2(*start.base[i]))
        values.insert(Z, float(start.torso[i]))
        pair = w.hand_holding if p.holding[i] else w.hand
        factors.add(gtsam.PriorFactorPose3(G, gtsam.Pose3(p.hand[i]), covariance(p.hand_covariance[i], pair)))
        noise = covariance(p.torso_covariance[i], w.torso, planar=True)
        factors.add(gtsam.PriorFactorPose2(B, gtsam.Pose2(*p.torso[i]), noise))
        factors.add(gtsam.PriorFactorDouble(Z, platform.torso_rest, sigmas([w.torso_rest])))
        if p.holding[i]:
            factors.add(gtsam.PriorFactorPose3(G, gtsam.Pose3(p.object[i] @ p.grasp), grasp))
        if np.isfinite(p.dt[i]):
            dt = p.dt[i]
            smooth = sigmas(dt * np.repeat(w.gripper_speed, 3)[swap])
            factors.add(gtsam.BetweenFactorPose3(G, key("g", i + 1), gtsam.Pose3(), smooth))
            smooth = sigmas(dt * np.array([w.base_speed[0]] * 2 + [w.base_speed[1]]))
            factors.add(gtsam.BetweenFactorPose2(B, key("b", i + 1), gtsam.Pose2(), smooth))
            factors.add(gtsam.BetweenFactorDouble(Z, key("h", i + 1), 0.0, sigmas([dt * w.torso_speed])))
        factors.add(gtsam.CustomFactor(sigmas([w.reach]), [G, B, Z], reach))
        factors.add(gtsam.CustomFactor(near, [B], clearance(around[i])))
    return factors, values


def plot(points: list[tuple[int, float]]) -> None:
    """Seconds per iteration over steps."""
    from matplotlib.figure import Figure

    n, seconds = np.array(points).T
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    axes.loglog(n, seconds, "o-", label="measured")
    axes.loglog(n, seconds[-1] * n / n[-1], ":", color="0.4", label="linear in steps")
    axes.set(xlabel="steps", ylabel="processor seconds per iteration", title="Adaptation: time is linear in steps")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(RESULTS / "adaptation.png", dpi=80)


def main() -> None:
    """Measures and writes results/adaptation.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", help="a robot of understudy.robot; default: the tests' formula")
    parser.add_argument("--gtsam-demonstrations", type=int, default=2)
    parser.add_argument("--longest", type=int, default=20_000)
    arguments = parser.parse_args()
    platform = scenes.platform()
    if arguments.robot:
        from understudy.adaptation.robots import platform_of
        from understudy.robot import load_robot

        platform = platform_of(load_robot(arguments.robot))
    rows = whole(platform)
    more, points = scaling(arguments.longest)
    rows += more + against_gtsam(platform, arguments.gtsam_demonstrations)
    heads = ["what", "wall s", "processor s", "iterations", "us per step and iteration; or"]
    notes = f"Robot: {platform.name}. gtsam: C++ factors between poses, Python callbacks for map and reachability."
    report("adaptation", heads, rows, notes)
    plot(points)


if __name__ == "__main__":
    main()
