"""Work for the processes of test_processes.py; they import this, so it is light."""

from __future__ import annotations

import os
import signal
import time
import warnings
from pathlib import Path

from understudy.processes import Tell


def act(folder: Path, tell: Tell) -> str:
    """Does what the folder's name says."""
    what = folder.name.partition("_")[0]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pid").write_text(str(os.getpid()))
    if what == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "exits":
        os._exit(3)
    print("what a library writes to stdout")  # must not disturb the answers
    for i in range(2):
        tell(i + 1, 2)
    if what == "warns":
        warnings.warn("palms are hard", UserWarning, stacklevel=1)
    if what == "waits":
        try:
            (folder / "begun").touch()
            for _ in range(6000):
                time.sleep(0.01)
        finally:
            (folder / "kept").touch()
    return f"{folder.name}: {os.environ['UNDERSTUDY_THREADS']} {os.environ['OMP_NUM_THREADS']}"
