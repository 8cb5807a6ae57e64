"""The program of the processes of `processes`: does tasks until stdin ends."""

from __future__ import annotations

import _thread
import os
import pickle
import signal
import sys
import warnings
from queue import SimpleQueue
from threading import Lock, Thread
from typing import IO, Any, Final

TOLD: Final = "told"
"""by the work, before its answer"""
WARNED: Final = "warned"
"""message and category"""
DONE: Final = "done"
"""the answer"""


def main() -> None:
    """Reads the work and then its tasks; writes pairs of TOLD, WARNED or DONE and what comes with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the first one says what is to be done
    signal.signal(signal.SIGTERM, _stop)
    words = _taken(sys.stdout)
    import cv2  # only now: Ctrl-C may come while such things are imported

    from understudy import runtime

    cv2.setNumThreads(runtime.processors())
    tasks: SimpleQueue[Any] = SimpleQueue()
    one_speaks = Lock()

    def say(kind: str, content: object) -> None:
        with one_speaks:
            pickle.dump((kind, content), words)
            words.flush()

    warnings.showwarning = lambda message, category, *where, **more: say(WARNED, (str(message), category))
    try:
        work = pickle.load(sys.stdin.buffer)
        Thread(target=_read, args=(sys.stdin.buffer, tasks), daemon=True).start()
        while (task := tasks.get()) is not None:
            say(DONE, work(task, lambda *content: say(TOLD, content)))
    except (KeyboardInterrupt, BrokenPipeError):
        return  # what is finished is on disk


def _read(pipe: IO[bytes], tasks: SimpleQueue[Any]) -> None:
    """The end of stdin ends the work at once, whatever is being done."""
    try:
        while True:
            tasks.put(pickle.load(pipe))
    except (EOFError, OSError, pickle.UnpicklingError):
        _thread.interrupt_main(signal.SIGTERM)
        tasks.put(None)  # wakes an idle main thread


def _stop(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def _taken(stream: Any) -> IO[bytes]:
    """The file behind a stream, for words alone; what else is written to the stream goes to stderr."""
    own = os.fdopen(os.dup(stream.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), stream.fileno())
    return own


if __name__ == "__main__":
    main()
