"""Azure Kinect recordings (.mkv), without the Kinect's SDK. Needs the extra 'kinect' (PyAV).

Opening reads the file once from end to end, to learn the times of all images, and decodes none. A frame is then found
by seeking; frames that are asked for in order are read on without seeking.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from understudy.errors import FrameError, MissingExtraError, RecordingError
from understudy.recordings.base import Recording
from understudy.recordings.folder import check_size
from understudy.recordings.images import decode_color
from understudy.recordings.k4a_calibration import camera_from_calibration
from understudy.recordings.pairing import pair_nearest

UNIT_M = np.float32(0.001)
"""metres per depth value"""

RATES_HZ = (5.0, 15.0, 30.0)
"""what the camera can be set to"""

_CODECS = {"COLOR": ("mjpeg", "rawvideo"), "DEPTH": ("rawvideo",)}


class KinectRecording(Recording):
    """An Azure Kinect recording. Colour and depth images are paired by their times (within half a frame).

    A frame's time is its colour image's. Images without a partner are left out and counted in `unmatched_color` and
    `unmatched_depth`; a Kinect drops some now and then, above all the first ones.
    """

    format_name = "Azure Kinect recording"
    looks_for = "a file named *.mkv"

    def __init__(self, path: str | Path):
        """Raises MissingExtraError without PyAV; RecordingError if the file is broken as a whole."""
        path = Path(path)
        self._file = _KinectFile(path)
        try:
            camera = camera_from_calibration(
                self._file.calibration(), self._file.size("COLOR"), self._file.size("DEPTH"), str(path)
            )
            color_pts, depth_pts = self._file.index()
            color_s, depth_s = self._file.seconds("COLOR", color_pts), self._file.seconds("DEPTH", depth_pts)
            fps = _fps(color_s) or _fps(depth_s)
            pairs = pair_nearest(color_s, depth_s - self._file.depth_delay_s(), 0.5 / (fps or 30.0))
            if not pairs:
                raise RecordingError(
                    f"{path}: no frames: {len(color_s)} colour and {len(depth_s)} depth images, none of the same time"
                )
        except BaseException:
            self._file.close()
            raise
        self.unmatched_color, self.unmatched_depth = len(color_s) - len(pairs), len(depth_s) - len(pairs)
        self._pts = [(color_pts[i], depth_pts[j]) for i, j in pairs]
        super().__init__(path, camera, range(len(pairs)), [float(color_s[i]) for i, _ in pairs], fps)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return path.suffix.lower() == ".mkv" and path.is_file()

    def _read(self, position: int) -> tuple[UInt8[np.ndarray, "h w 3"], Float32[np.ndarray, "hd wd"]]:
        where = f"{self.path}: frame {self.indices[position]}"
        color_packet, depth_packet = self._file.packets(*self._pts[position], where)
        color = self._file.decode_color(color_packet, f"{where}: colour")
        check_size(color, self.camera.color, self.path, "the track")
        camera, data = self.camera.depth, bytes(depth_packet)
        if len(data) != 2 * camera.width * camera.height:
            raise FrameError(f"{where}: depth: damaged or truncated ({len(data)} bytes)")
        raw = np.frombuffer(data, dtype=">u2").reshape(camera.height, camera.width)  # 'b16g' is big-endian
        return color, raw.astype(np.float32) * UNIT_M

    def close(self) -> None:
        self._file.close()


class _KinectFile:
    """The container: its two tracks, their packets by time stamp (`pts`), and no error of PyAV's let through."""

    def __init__(self, path: Path):
        try:
            import av
        except ImportError as e:
            raise MissingExtraError("Azure Kinect .mkv files", "kinect") from e
        self._av, self._path = av, path
        with self._errors(RecordingError, str(path)):
            self._container = av.open(str(path), mode="r")
        try:
            self._streams = {name: self._find(name) for name in _CODECS}
        except BaseException:
            self._container.close()
            raise
        self._second = round(1 / float(self._streams["COLOR"].time_base))  # in the units of pts
        self._demuxed: Iterator[Any] = iter(())
        self._position: int | None = None  # pts up to which packets are read; None: seek first
        self._early: dict[tuple[int, int], Any] = {}  # packets of later frames that came before their partners

    @contextmanager
    def _errors(self, kind: type[RecordingError], where: str) -> Iterator[None]:
        try:
            yield
        except (self._av.FFmpegError, OSError) as e:
            raise kind(f"{where}: damaged, truncated or not a Matroska file ({e})") from e

    def _find(self, name: str) -> Any:
        for stream in self._container.streams.video:
            if stream.metadata.get("title") == name or f"K4A_{name}_TRACK" in stream.metadata:
                codec = stream.codec_context.name
                if codec not in _CODECS[name]:
                    raise RecordingError(f"{self._path}: track {name} is coded as {codec}: must be {_CODECS[name]}")
                return stream
        raise RecordingError(f"{self._path}: has no track {name}; an Azure Kinect recording has COLOR and DEPTH")

    def size(self, name: str) -> tuple[int, int]:
        """(width, height) of a track's images."""
        codec = self._streams[name].codec_context
        return codec.width, codec.height

    def calibration(self) -> bytes:
        """The content of the attached calibration."""
        for stream in self._container.streams.attachments:
            if stream.metadata.get("filename") == "calibration.json" or "K4A_CALIBRATION_FILE" in stream.metadata:
                return bytes(stream.data or b"")
        raise RecordingError(f"{self._path}: no calibration.json is attached")

    def depth_delay_s(self) -> float:
        """How much later (seconds) than colour the camera was set to take depth images."""
        try:
            return int(self._container.metadata.get("K4A_DEPTH_DELAY_NS", 0)) * 1e-9
        except ValueError:
            return 0.0

    def index(self) -> tuple[list[int], list[int]]:
        """The pts of all colour and of all depth images, ascending. Reads the whole file."""
        found: dict[int, set[int]] = {stream.index: set() for stream in self._streams.values()}
        with self._errors(RecordingError, str(self._path)):
            try:
                for packet in self._container.demux(*self._streams.values()):
                    if packet.pts is not None and packet.size:
                        found[packet.stream.index].add(packet.pts)
            except self._av.FFmpegError:  # a file cut short: what came before counts
                if not all(found.values()):
                    raise
        color, depth = (sorted(found[self._streams[name].index]) for name in ("COLOR", "DEPTH"))
        return color, depth

    def seconds(self, name: str, pts: list[int]) -> np.ndarray:
        """Time stamps -> seconds, shape (n,)."""
        return np.array(pts, dtype=np.float64) * float(self._streams[name].time_base)

    def packets(self, color_pts: int, depth_pts: int, where: str) -> tuple[Any, Any]:
        """The packets of a colour and a depth image. Raises FrameError."""
        wanted = [(self._streams["COLOR"].index, color_pts), (self._streams["DEPTH"].index, depth_pts)]
        first, last = min(color_pts, depth_pts), max(color_pts, depth_pts)
        reads_on = self._position is not None and self._position < first <= self._position + self._second
        self._position = None  # until this frame is found
        with self._errors(FrameError, where):
            # Seeking in one track may land behind the other's packet; seeking in the other then lands before both.
            for track in ([None] if reads_on else []) + ["COLOR", "DEPTH"]:
                if track is not None:
                    self._early.clear()
                    self._container.seek(first, stream=self._streams[track], backward=True)
                    self._demuxed = self._container.demux(*self._streams.values())
                if self._read_until(wanted, first, last + self._second):
                    self._position = first
                    return self._early[wanted[0]], self._early[wanted[1]]
        raise FrameError(f"{where}: its images are not where they were when the file was opened")

    def _read_until(self, wanted: list[tuple[int, int]], first: int, limit: int) -> bool:
        """Reads packets into `_early`, those before `first` left out, until all the wanted ones are there."""
        self._early = {key: packet for key, packet in self._early.items() if key[1] >= first}
        while not all(key in self._early for key in wanted):
            packet = next(self._demuxed, None)
            if packet is None or packet.pts is None or packet.pts > limit:
                return False
            if packet.pts >= first:
                self._early[packet.stream.index, packet.pts] = packet
        return True

    def decode_color(self, packet: Any, where: str) -> UInt8[np.ndarray, "h w 3"]:
        """The packet's image, RGB. Raises FrameError."""
        stream = packet.stream
        if stream.codec_context.name == "mjpeg":
            return decode_color(bytes(packet), where)
        with self._errors(FrameError, where):
            for frame in packet.decode():
                return np.ascontiguousarray(frame.to_ndarray(format="rgb24"))
        raise FrameError(f"{where}: the image cannot be decoded")

    def close(self) -> None:
        self._early.clear()
        self._demuxed = iter(())
        self._position = None
        self._container.close()


def _fps(times_s: np.ndarray) -> float | None:
    """Frames per second from ascending times: the camera's setting where it is near one; None for a single image."""
    if len(times_s) < 2:
        return None
    measured = 1 / float(np.median(np.diff(times_s)))
    nearest = min(RATES_HZ, key=lambda rate: abs(rate - measured))
    return nearest if abs(nearest - measured) < 0.1 * nearest else measured
