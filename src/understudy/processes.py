"""Work that is done in several processes at a time.

The processes are fresh interpreters that run `worker`, not `multiprocessing`'s: those would import the caller's main
module, which then needs a guard against starting everything once more. They get tasks on stdin and answer on stdout,
both pickled. A process stops when its stdin ends, thus also when this process is killed.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread
from typing import IO, Any, Final, TypeVar

from understudy import runtime
from understudy.worker import DONE, TOLD, WARNED

Task = TypeVar("Task")
Answer = TypeVar("Answer")
Tell = Callable[..., object]
"""What work calls to tell how far it is; the arguments travel."""

_PATIENCE_S = 20.0  # for a process to stop by itself
_LIMITS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What numpy's libraries take their number of threads from."""
_ENDED: Final = "ended"  # beside the kinds that `worker` says itself
_Word = tuple["_Process", tuple[str, Any]]  # who says it, of what kind it is, and what


def in_processes(
    tasks: Sequence[Task],
    work: Callable[[Task, Tell], Answer],
    jobs: int,
    *,
    told: Callable[[int, tuple[Any, ...]], object],
    done: Callable[[int, Answer], object],
    died: Callable[[int, str], object],
) -> None:
    """Does all tasks in `jobs` processes, each with a copy of `work` that it keeps, and with its share of the threads.

    Tasks are begun in their order. Called in this thread, with the task's number: told: with what the work tells;
    done: with its answer; died: with the reason, when the process ended in the middle (the others go on). Warnings in
    the processes become warnings here. When this returns or raises, all processes have ended; they are interrupted
    (KeyboardInterrupt) in whatever they do then.
    """
    waiting = deque(range(len(tasks)))
    words: SimpleQueue[_Word] = SimpleQueue()
    processes: list[_Process] = []

    def employ() -> None:
        if waiting:
            processes.append(_Process(work, max(1, runtime.processors() // jobs), words))
            go_on(processes[-1])

    def go_on(process: _Process) -> None:
        if waiting:
            process.give(waiting[0], tasks[waiting.popleft()])
        else:
            process.dismiss()

    try:
        for _ in range(jobs):
            employ()
        left = len(tasks)
        while left:
            process, (kind, content) = words.get()
            number = process.number
            if number is None:  # it has ended, as it was told to
                continue
            if kind == TOLD:
                told(number, content)
            elif kind == WARNED:
                message, category = content
                warnings.warn(message, category, stacklevel=2)
            else:
                left, process.number = left - 1, None
                if kind == DONE:
                    done(number, content)
                    go_on(process)
                else:
                    died(number, process.epitaph())
                    employ()
    finally:
        _end(processes)


class _Process:
    """One process, seen from this one."""

    def __init__(self, work: Callable[..., Any], threads: int, words: SimpleQueue[_Word]):
        """words: where what it says goes (see `worker`), and (_ENDED, None) in the end."""
        self.number: int | None = None
        """of the task that it works on"""
        self._popen = subprocess.Popen(
            [sys.executable, "-P", "-m", "understudy.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=_environment(threads),
        )
        assert self._popen.stdin is not None and self._popen.stdout is not None
        self._to, self._from = self._popen.stdin, self._popen.stdout
        self._say(work)
        self._ear = Thread(target=self._listen, args=(self._from, words), daemon=True)
        self._ear.start()

    def give(self, number: int, task: object) -> None:
        """The next task."""
        self.number = number
        self._say(task)

    def dismiss(self) -> None:
        """Asks it to stop, whatever it does."""
        with suppress(OSError):
            self._to.close()

    def epitaph(self) -> str:
        """Why it has ended without being told to."""
        code = self._popen.wait()
        how = f"exit status {code}"
        if code < 0:
            with suppress(ValueError):
                how = signal.Signals(-code).name + (": out of memory?" if code == -9 else "")
        return f"its process died ({how})"

    def end(self) -> None:
        """Waits until it has stopped; kills it when it takes too long."""
        try:
            self._popen.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            pass
        finally:  # also when interrupted
            self._popen.kill()
            self._popen.wait()
            self._ear.join()
            self._from.close()

    def _say(self, message: object) -> None:
        with suppress(OSError):  # it has died: `_listen` learns of it
            pickle.dump(message, self._to)
            self._to.flush()

    def _listen(self, pipe: IO[bytes], words: SimpleQueue[_Word]) -> None:
        try:
            while True:
                words.put((self, pickle.load(pipe)))
        except (EOFError, OSError, pickle.UnpicklingError):  # also in the middle of a word
            words.put((self, (_ENDED, None)))


def _end(processes: Sequence[_Process]) -> None:
    for process in processes:
        process.dismiss()
    for process in processes:
        process.end()


def _environment(threads: int) -> dict[str, str]:
    """Of a process with so many threads, which finds the modules that this one finds."""
    limits = {name: os.environ.get(name, str(threads)) for name in _LIMITS}
    path = os.pathsep.join(place or os.getcwd() for place in sys.path)
    return {**os.environ, **limits, runtime.THREADS: str(threads), "PYTHONPATH": path}
