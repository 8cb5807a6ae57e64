"""The processes of a training run, and how they are asked to stop (torch)."""

from __future__ import annotations

import os
import signal
import threading
from dataclasses import dataclass
from types import FrameType
from typing import Any

import torch

from understudy.errors import UnderstudyError


@dataclass(frozen=True)
class World:
    """The processes that train together (torchrun); one when started without it."""

    device: torch.device
    rank: int = 0
    size: int = 1

    @classmethod
    def join(cls, device: str) -> World:
        here = torch.device(device)
        if here.type == "cuda" and not torch.cuda.is_available():
            raise UnderstudyError(f"device {device!r}: this machine, or this build of torch, has no CUDA device")
        if int(os.environ.get("WORLD_SIZE", "1")) < 2:
            return cls(here)
        if here.type == "cuda":
            here = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
            torch.cuda.set_device(here)
        if not torch.distributed.is_initialized():
            torch.distributed.init_process_group("nccl" if here.type == "cuda" else "gloo")
        return cls(here, torch.distributed.get_rank(), torch.distributed.get_world_size())

    def any(self, here: bool) -> bool:
        """Whether it is so in any of the processes; all must ask."""
        if self.size == 1:
            return here
        flag = torch.tensor(int(here), device=self.device)
        torch.distributed.all_reduce(flag, torch.distributed.ReduceOp.MAX)
        return bool(flag)


class Stop:
    """Ctrl-C and SIGTERM wait until a step is done; a second one does not."""

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Stop:
        if threading.current_thread() is threading.main_thread():
            self._before = {s: signal.signal(s, self._ask) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
