"""Runs neural networks on the CPU. The one place that knows OpenVINO.

Always in float32: left alone, OpenVINO computes in bfloat16 where the processor can, and joints end up elsewhere.

OpenVINO's Python package reports every import of itself to Google Analytics and puts an id into the user's home, both
through `openvino_telemetry`. That module is barred first; OpenVINO then takes a stub of its own, which does nothing.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any, Final

import numpy as np

from understudy.errors import ModelFileError, UnderstudyError, one_of

_ONE_THREAD = Lock()
"""Held while in OpenVINO's Python layer: two threads that use a part of it for the first time can block each other for
good (2026.4: one holds the interpreter's lock and waits for the other to set up a static table, which needs that lock).
Not held while a network computes."""

KINDS: Final = (".tflite", ".onnx", ".xml")
"""File name endings: TensorFlow Lite, ONNX, OpenVINO IR (its weights beside it, in .bin)."""

THREADS: Final = "UNDERSTUDY_THREADS"
"""Environment variable: the most threads that each network of this process may use."""


class Network:
    """A network, ready to run.

    It may be called from several threads at once: each call has buffers of its own. The same inputs give the same
    numbers, bit for bit, in every call.
    """

    def __init__(self, compiled: Any, outputs: Sequence[str] = ()):
        self._compiled = compiled
        self._idle: list[Any] = []  # requests that nobody uses
        self.inputs: Final[tuple[str, ...]] = _names(compiled.inputs)
        self.shapes: Final = {name: _shape(port) for name, port in zip(self.inputs, compiled.inputs, strict=True)}
        """of the inputs; -1 where a length is open"""
        self.outputs: Final[tuple[str, ...]] = tuple(outputs) or _names(compiled.outputs)

    @property
    def threads(self) -> int:
        """How many threads it computes with, in all."""
        return int(self._compiled.get_property("INFERENCE_NUM_THREADS"))

    def __call__(self, *inputs: np.ndarray, **named: np.ndarray) -> tuple[np.ndarray, ...]:
        """The outputs, in the order of `self.outputs`; they are the caller's to keep.

        Inputs come in the order of `self.inputs`, or by these names.
        """
        given = {**dict(zip(self.inputs, inputs, strict=False)), **named}
        if set(given) != set(self.inputs) or len(inputs) + len(named) != len(self.inputs):
            raise TypeError(f"the network takes each of {self.inputs} once, not {len(inputs)} arrays and {list(named)}")
        return self._finish(self._start(given))

    def _start(self, given: Mapping[str, np.ndarray]) -> Any:
        with _ONE_THREAD:
            request = self._idle.pop() if self._idle else self._compiled.create_infer_request()
            request.start_async([given[name] for name in self.inputs])
        return request

    def _finish(self, request: Any) -> tuple[np.ndarray, ...]:
        request.wait()
        with _ONE_THREAD:
            results = tuple(request.get_output_tensor(i).data.copy() for i in range(len(self.outputs)))
            self._idle.append(request)  # unless it failed
        return results


class RowNetwork:
    """A network for people or hands that have nothing to do with each other, one a row: it computes each row on its
    own, several at a time. Made for one row, a network takes a fifth less time than made for any number, and a row's
    numbers cannot depend on its company.

    It may be called from several threads at once.
    """

    def __init__(self, network: Network, at_a_time: int, alone: Network | None = None):
        """network: takes one row; at_a_time: so many calls of it compute at once. alone: what computes a row that would
        be the only one at its time; default: `network`.
        """
        self._network, self._at_a_time, self._alone = network, at_a_time, alone
        self.inputs: Final = network.inputs
        self.shapes: Final = network.shapes
        self.outputs: Final = network.outputs

    def __call__(self, **named: np.ndarray) -> tuple[np.ndarray, ...]:
        """The outputs, in the order of `self.outputs`; they are the caller's to keep.

        named: each of the inputs, with as many rows as the others, at least one.
        """
        counts = {len(array) for array in named.values()}
        if set(named) != set(self.inputs) or len(counts) != 1 or 0 in counts:
            shapes = {name: array.shape for name, array in named.items()}
            raise TypeError(f"the network takes {self.inputs}, each with as many rows, at least one, not {shapes}")
        rows = [{name: array[i : i + 1] for name, array in named.items()} for i in range(counts.pop())]
        last = rows.pop() if self._alone is not None and len(rows) % self._at_a_time == 1 else None
        computing: deque[Any] = deque()
        results = []
        for row in rows:
            if len(computing) > self._at_a_time:  # one more, so that none of them waits for us
                results.append(self._network._finish(computing.popleft()))
            computing.append(self._network._start(row))
        results += [self._network._finish(request) for request in computing]
        if self._alone is not None and last is not None:
            results.append(self._alone._finish(self._alone._start(last)))
        return tuple(np.concatenate(parts) for parts in zip(*results, strict=True))


def load(
    path: Path, *, threads: int | None = None, streams: int = 1, outputs: Sequence[str] = (), one_row: bool = False
) -> Network:
    """Reads a network from a file of one of the `KINDS` and compiles it for this CPU. Writes no files.

    threads: in all; default: OpenVINO's choice, one a physical core. streams: how many calls run at a time, each on
    its share of the threads; further calls wait. The environment variable `THREADS` limits both. outputs: names of
    those that are wanted, in this order (what only the others need is not computed); default: all. one_row: where the
    length of the inputs' first axis is open, it is one.
    Raises ModelFileError when the file is absent, damaged or not such a network.
    """
    if path.suffix not in KINDS:
        raise ModelFileError(f"{path}: a network's file name must end in {one_of(KINDS)}")
    if not path.is_file():
        raise ModelFileError(f"{path}: there is no such file")
    if (most := _most_threads()) is not None:
        threads, streams = min(threads or most, most), min(streams, most)
    config: dict[str, object] = {
        "INFERENCE_PRECISION_HINT": "f32",
        "PERFORMANCE_HINT": "LATENCY",
        "NUM_STREAMS": streams,
        "ENABLE_CPU_PINNING": False,  # other programs use these cores, too
    }
    if threads is not None:
        config["INFERENCE_NUM_THREADS"] = threads
    try:
        with _ONE_THREAD:
            return Network(_compiled(path, outputs, config, one_row), outputs)
    except RuntimeError as e:
        lines = [line for line in str(e).splitlines() if line and not line.startswith(("Exception from", "Check"))]
        raise ModelFileError(f"{path}: damaged, or not a network that OpenVINO can read: {' '.join(lines)}") from e


def load_rows(
    path: Path, *, threads: int | None = None, outputs: Sequence[str] = (), same_bits: bool = False
) -> RowNetwork:
    """Reads a network of rows, of which two at a time share the threads and one alone has them all.

    threads, outputs: as `load` has them. same_bits: every row has a single thread, because with more the last bits of
    this network's numbers depend on how many there are.
    Raises ModelFileError as `load` does.
    """
    if same_bits:
        return RowNetwork(load(path, threads=min(2, processors()), streams=2, outputs=outputs, one_row=True), 2)
    alone = load(path, threads=threads, outputs=outputs, one_row=True)
    if alone.threads == 1:
        return RowNetwork(alone, 1)
    return RowNetwork(load(path, threads=alone.threads, streams=2, outputs=outputs, one_row=True), 2, alone)


def processors() -> int:
    """How many processors this process may use: those that it is bound to, no more than `THREADS` says."""
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(bound, _most_threads() or bound)


def _most_threads() -> int | None:
    word = os.environ.get(THREADS)
    if not word:
        return None
    if not word.isdecimal() or int(word) < 1:
        raise UnderstudyError(f"environment variable {THREADS}: must be a whole number above 0, got {word!r}")
    return int(word)


def _compiled(path: Path, outputs: Sequence[str], config: dict[str, object], one_row: bool) -> Any:
    openvino, core = _openvino()
    model = core.read_model(path)
    if one_row:
        shapes = {port: port.partial_shape for port in model.inputs}
        model.reshape({port: [1, *list(shape)[1:]] for port, shape in shapes.items() if shape[0].is_dynamic})
    if outputs:
        results = {name: result for result in model.get_results() for name in result.output(0).names}
        if absent := [name for name in outputs if name not in results]:
            raise ModelFileError(f"{path}: the network has no output {absent[0]!r}; it has {one_of(results)}")
        model = openvino.Model([results[name] for name in outputs], model.get_parameters())
    return core.compile_model(model, "CPU", config)


@cache
def _openvino() -> tuple[Any, Any]:
    """The module, silenced, and its `Core`."""
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]  # None: importing it fails
    import openvino

    return openvino, openvino.Core()


def _names(ports: Sequence[Any]) -> tuple[str, ...]:
    """One name of each; its number where it has none."""
    return tuple(min(port.names, default=str(i)) for i, port in enumerate(ports))


def _shape(port: Any) -> tuple[int, ...]:
    return tuple(-1 if length.is_dynamic else length.get_length() for length in port.partial_shape)
