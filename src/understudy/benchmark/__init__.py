"""Methods x recordings with truth -> tables, numbers and plots: `benchmark(recordings, methods, out, estimate)`."""

from understudy.benchmark.run import ALL, PLOTS, TABLES, BenchmarkResult, Estimate, Timed, benchmark, precomputed
from understudy.benchmark.tables import Row

__all__ = ["ALL", "PLOTS", "TABLES", "BenchmarkResult", "Estimate", "Row", "Timed", "benchmark", "precomputed"]
