"""Recordings -> a folder of demonstrations. Resumes where it stopped; one recording that fails does not stop the rest.

OUT/NAME/demonstration.json, .npz   what `storage` reads
OUT/NAME/demonstration.png          trajectories over the image, from above, and over time (with matplotlib)
OUT/NAME/people/                    the estimation of its frames (`pipeline`)
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from understudy import methods, runtime
from understudy.demonstration import storage
from understudy.demonstration.build import DemonstrationConfig
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.making import ESTIMATION, PICTURE, Estimation, Maker, Order, Result, picture
from understudy.demonstration.progress import Progress
from understudy.errors import RecordingError, UnderstudyError
from understudy.processes import in_processes

__all__ = ["ESTIMATION", "MOST_JOBS", "PICTURE", "Result", "demonstrate", "load_all", "picture"]

MOST_JOBS: Final = 8
"""processes that are started without being asked for; each takes 0.8 GB of memory"""


def demonstrate(
    paths: Sequence[str | Path],
    out: Path,
    config: DemonstrationConfig | Sequence[DemonstrationConfig] | None = None,
    *,
    method: str = methods.DEFAULT,
    detector: str = "blazepose",
    hands: str = "full",
    weights: Path | None = None,
    overlays: bool = False,
    restart: bool = False,
    progress: bool = False,
    report: Callable[[Result], object] = lambda result: None,
    jobs: int | None = None,
) -> list[Result]:
    """Makes a demonstration of each recording, under `out`. Results come in the order of the recordings.

    config: of all recordings, or one for each. method, detector, hands, weights, overlays, restart: as in
    `pipeline.estimate_recording`. What was finished with the same settings is not made again. progress: a bar on
    stderr. report: called with each result as it comes.

    jobs: recordings that are worked on at a time, each in a process of its own with its share of the processors; 1: in
    this process. Default: as many as there are processors, at most `MOST_JOBS`. The results are the same, bit for bit.
    When a process dies, its recording has failed, and the others go on; when this one is interrupted, all stop, and the
    same call goes on where they were.
    """
    out = Path(out)
    configs = _each(config or DemonstrationConfig(), len(paths))
    folders = _folders(paths, out)
    orders = _orders(paths, folders, configs)
    maker = Maker(Estimation(method, detector, hands, weights, overlays), restart)
    jobs = min(_jobs(jobs), len(orders))
    results: dict[Path, Result] = {}
    with Progress([order.folder.name for order in orders], progress) as shown:

        def done(number: int, result: Result) -> None:
            results[orders[number].folder] = result
            shown.finished(number)
            report(result)

        def died(number: int, why: str) -> None:
            done(number, Result(orders[number].recording, orders[number].folder, None, f"{why}; what it had is kept"))

        if jobs > 1:
            in_processes(orders, maker.make, jobs, told=lambda n, words: shown.step(n, *words), done=done, died=died)
        else:
            for number, order in enumerate(orders):
                done(number, maker.make(order, partial(shown.step, number)))
    return [results[folder] for folder in folders]


def _orders(
    paths: Sequence[str | Path], folders: Sequence[Path], configs: Sequence[DemonstrationConfig]
) -> list[Order]:
    """One for each folder: a recording that is named twice is made once."""
    orders: dict[Path, Order] = {}
    for path, folder, config in zip(paths, folders, configs, strict=True):
        if orders.setdefault(folder, Order(str(path), folder, config)).config != config:
            raise UnderstudyError(f"{path}: is named twice, with different configs")
    return list(orders.values())


def _each(config: DemonstrationConfig | Sequence[DemonstrationConfig], recordings: int) -> list[DemonstrationConfig]:
    several = [config] * recordings if isinstance(config, DemonstrationConfig) else list(config)
    if len(several) != recordings:
        raise UnderstudyError(f"demonstrate: {len(several)} configs for {recordings} recordings; give one, or as many")
    return several


def _jobs(asked: int | None) -> int:
    if asked is None:
        return min(runtime.processors(), MOST_JOBS)
    if asked < 1:
        raise UnderstudyError(f"jobs {asked}: must be 1 or more")
    return asked


def load_all(paths: Sequence[str | Path]) -> list[Demonstration]:
    """The demonstrations in folders: each is one itself, or holds some. Raises RecordingError if there is none."""
    found: list[Demonstration] = []
    for path in map(Path, paths):
        inner = sorted(p.parent for p in path.glob(f"*/{storage.INFO}"))
        folders = [path] if (path / storage.INFO).exists() else inner
        if not folders:
            raise RecordingError(
                f"{path}: holds no demonstration ({storage.INFO}); `understudy demonstrate` makes them"
            )
        found += [storage.load(folder) for folder in folders]
    return found


def _folders(paths: Sequence[str | Path], out: Path) -> list[Path]:
    """A folder for each recording, by its name; recordings of the same name are told apart by where they lie."""
    places = [Path(path).resolve() for path in paths]
    names = {place: place.stem if place.is_file() else place.name for place in places}
    times = Counter(names.values())
    folders = []
    for place in places:
        name = names[place]
        if times[name] > 1:
            name = f"{name}_{hashlib.sha256(str(place).encode()).hexdigest()[:6]}"
        folders.append(out / name)
    return folders
