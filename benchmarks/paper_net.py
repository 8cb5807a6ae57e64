"""The paper's network on a CPU: milliseconds per person, torch eager and OpenVINO, float32; the default one beside it.

    python benchmarks/paper_net.py

Also how far OpenVINO's volumes are from torch's, and what making the input takes. The weights are the initial ones:
time does not depend on them.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from importlib.metadata import version

import numpy as np
import torch
from common import milliseconds, report

from understudy import runtime
from understudy.camera import Camera
from understudy.skeleton import JOINT
from understudy.types import Keypoints2D
from understudy.voxelposenet.checkpoint import load_net
from understudy.voxelposenet.paper_grid import PaperGrid, PaperRoot, network_input, occupancy, volume_peaks
from understudy.voxelposenet.paper_net import PaperNet
from understudy.voxelposenet.predictor import weights_path
from understudy.voxelposenet.tensorflow_weights import VARIANTS

THREADS = 2
ROUNDS = 5
HINTS = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": THREADS, "PERFORMANCE_HINT": "LATENCY"}


def main() -> None:
    before = os.getloadavg()
    torch.set_num_threads(THREADS)
    torch.manual_seed(0)
    points, keypoints, camera, root = scene()
    x = np.ascontiguousarray(network_input(points, keypoints, camera, root).transpose(3, 0, 1, 2)[None])
    runs: dict[tuple[str, str], Callable[[], object]] = {}
    differences = {}
    for variant in VARIANTS:
        net = PaperNet(variant).eval()
        last = PaperNet(variant).eval().to(memory_format=torch.channels_last_3d)
        runs[variant, "eager"] = torch_run(net, torch.from_numpy(x))
        runs[variant, "last"] = torch_run(last, torch.from_numpy(x).to(memory_format=torch.channels_last_3d))
        runs[variant, "openvino"], differences[variant] = openvino_run(net, x)
    runs["default", "openvino"] = default_run()
    times = in_turn(runs)
    fast = float(np.median(times["paper-fast", "openvino"]))
    rows = []
    for variant in VARIANTS:
        columns = [f"{np.median(t):.0f} ({min(t):.0f})" for (v, _), t in times.items() if v == variant]
        count = sum(p.numel() for p in PaperNet(variant).parameters())
        ratio = fast / float(np.median(times[variant, "openvino"]))
        rows.append([variant, str(count), *columns, f"{differences[variant]:.0e}", f"{ratio:.1f}"])
    own = times["default", "openvino"]
    count = sum(p.numel() for p in load_net(weights_path().with_suffix(".safetensors")).parameters())
    least_and_median = f"{np.median(own):.1f} ({min(own):.1f})"
    rows.append(["default", str(count), "", "", least_and_median, "", f"{fast / float(np.median(own)):.1f}"])
    grid = PaperGrid.around(root)
    volumes = np.random.default_rng(0).random((18, 64, 64, 64), np.float32)
    parts = {
        f"occupancy of {len(points)} points": lambda: occupancy(points, grid),
        "whole input": lambda: network_input(points, keypoints, camera, root),
        "peaks of the volumes": lambda: volume_peaks(volumes, grid),
    }
    around = "; ".join(f"{name} {milliseconds(work):.2f} ms" for name, work in parts.items())
    report(
        "paper_net",
        [
            "variant",
            "parameters",
            "torch eager ms",
            "the same, channels last",
            "OpenVINO f32 ms",
            "difference",
            "times as fast as paper-fast",
        ],
        rows,
        f"One person (batch 1), 64^3 cells, {THREADS} threads: median (least) of {ROUNDS} rounds in each of which "
        f"everything runs once; torch {torch.__version__}, OpenVINO {version('openvino')}. Difference: OpenVINO's "
        "largest to torch's over all three volumes, in standard deviations of the volume. Other jobs may have shared "
        f"the cores: load average {before[0]:.1f} before, {os.getloadavg()[0]:.1f} after (idle machine: 0, about "
        f"{THREADS}).\n\nAround the network: {around}.",
    )


def torch_run(net: PaperNet, x: torch.Tensor) -> Callable[[], object]:
    def run() -> object:
        with torch.inference_mode():
            return net(x)

    return run


def openvino_run(net: PaperNet, x: np.ndarray) -> tuple[Callable[[], object], float]:
    """A run, and how far its volumes are from torch's."""
    sys.modules["openvino_telemetry"] = None  # type: ignore[assignment]  # else convert_model sends usage data
    import openvino

    with torch.no_grad():
        expected = [v.numpy() for v in net(torch.from_numpy(x))]
        model = openvino.convert_model(net, example_input=torch.from_numpy(x), input=list(x.shape))
    request = openvino.Core().compile_model(model, "CPU", HINTS).create_infer_request()
    got = request.infer([x])
    difference = max(float(np.abs(got[i] - v).max() / v.std()) for i, v in enumerate(expected))
    return lambda: request.infer([x]), difference


def default_run() -> Callable[[], object]:
    """The shipped network on one person, through the runtime that users have."""
    network = runtime.load_rows(weights_path(), threads=THREADS, outputs=("joints", "spread", "head"))
    rng = np.random.default_rng(0)
    depth = rng.uniform(-1.2, 1.2, (1, 2, 64, 64)).astype(np.float32)
    keypoints = rng.uniform(-0.8, 0.8, (1, 18, 3)).astype(np.float32)
    distance = np.full((1, 1), 2.5, np.float32)
    floor = np.array([[0.0, -1.0, 0.0, 1.4]], np.float32)
    return lambda: network(depth=depth, keypoints=keypoints, root_z=distance, floor=floor)


def in_turn(runs: dict[tuple[str, str], Callable[[], object]]) -> dict[tuple[str, str], list[float]]:
    """Milliseconds of every run, ROUNDS times. In turn: what else the machine does meets all of them alike."""
    times: dict[tuple[str, str], list[float]] = {name: [] for name in runs}
    for i in range(ROUNDS + 1):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            if i:  # the first round warms up
                times[name].append(1000 * (time.perf_counter() - start))
    return times


def scene() -> tuple[np.ndarray, Keypoints2D, Camera, PaperRoot]:
    """100 000 points and 18 keypoints about a neck 2.5 m away. The volume need not be a person's."""
    rng = np.random.default_rng(0)
    camera = Camera(960, 540, np.array([[540.7, 0, 479.5], [0, 540.7, 269.5], [0, 0, 1.0]]))
    neck = np.array([0.1, -0.3, 2.5])
    surface = neck + rng.normal(0, (0.4, 0.5, 0.15), (100_000, 3)) + (0, 0.5, 0)
    joints = neck + rng.uniform((-0.5, -0.2, -0.1), (0.5, 1.2, 0.1), (18, 3))
    joints[JOINT["neck"]] = neck
    keypoints = Keypoints2D(camera.project(joints), np.full(18, 0.9))
    return surface.astype(np.float32), keypoints, camera, PaperRoot(JOINT["neck"], neck)


if __name__ == "__main__":
    main()
