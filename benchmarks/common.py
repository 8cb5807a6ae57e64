"""Timing and reporting shared by the benchmark scripts. Ratios within one run are what counts: machines are noisy."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np

import understudy

RESULTS = Path(__file__).parent / "results"


def milliseconds(work: Callable[[], object], repeat: int = 30) -> float:
    """Median wall time of one call, after one call to warm up."""
    work()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1000 * float(np.median(times))


def report(name: str, heads: list[str], rows: list[list[str]], notes: str = "") -> None:
    """Prints a table, and keeps it in results/NAME.md with the command, versions and hardware."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    text = "\n".join(
        [
            f"# {name}",
            "",
            *lines,
            "",
            *([notes, ""] if notes else []),
            machine(),
            "",
        ]
    )
    print(text)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.md").write_text(text)


def machine() -> str:
    """Lines on what a result depends on: command, versions, hardware."""
    packages = ", ".join(f"{p} {version(p)}" for p in ("numpy", "scipy", "opencv-python-headless", "openvino"))
    return "\n".join(
        [
            f"- command: `python {' '.join([str(Path(sys.argv[0])), *sys.argv[1:]])}`",
            f"- {time.strftime('%Y-%m-%d')}, understudy {understudy.__version__}, Python {platform.python_version()}, "
            f"{packages}",
            f"- {_cpu()}",
        ]
    )


def _cpu() -> str:
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores"
