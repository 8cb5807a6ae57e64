"""PNG and JPEG files. OpenCV returns half-decoded images without a word, so the files are checked before it sees them.

A damaged PNG is always found (each chunk carries a checksum). A JPEG has no checksums: truncation and a damaged marker
structure are found; a flipped bit inside the compressed data gives a picture with a flaw, which nothing tells from a
picture.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from understudy.errors import FrameError

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # PNG colour type -> channels (3 is a palette, decoded to RGB)
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # markers that start a frame and hold the size
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a length


@dataclass(frozen=True)
class ImageHeader:
    """What a file says about its image."""

    kind: str
    """png or jpeg"""
    width: int
    height: int
    channels: int
    bits: int
    """per channel"""

    def __str__(self) -> str:
        return f"{self.width} x {self.height}, {self.channels} channel(s) of {self.bits} bits"


def read_color(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """An 8-bit colour image, RGB; transparency is ignored. Raises FrameError that names the file."""
    return decode_color(_bytes_of(path), str(path))


def read_depth(path: Path) -> UInt16[np.ndarray, "h w"]:
    """A 16-bit, one-channel image, as stored. Raises FrameError that names the file."""
    where = str(path)
    data = _bytes_of(path)
    header = check_image(data, where)
    if (header.channels, header.bits) != (1, 16):
        raise FrameError(f"{where}: depth must be one channel of 16 bits, this image is {header}")
    return _decode(data, header, where)


def decode_color(data: bytes, where: str) -> UInt8[np.ndarray, "h w 3"]:
    """`read_color` of a file's content; `where` names it in errors."""
    header = check_image(data, where)
    if header.channels < 3 or header.bits > 8:
        raise FrameError(f"{where}: colour must be three channels of 8 bits, this image is {header}")
    return cv2.cvtColor(_decode(data, header, where)[..., :3], cv2.COLOR_BGR2RGB)


def read_size(path: Path) -> tuple[int, int]:
    """(width, height) from the first bytes of a file, without decoding it. Raises FrameError that names the file."""
    header = _header(_bytes_of(path), str(path))
    return header.width, header.height


def check_image(data: bytes, where: str) -> ImageHeader:
    """The header of an image that is there from its first byte to its last. Raises FrameError if it is not."""
    header = _header(data, where)
    if header.kind == "png":
        _check_png(data, where)
    else:
        _check_jpeg(data, where)
    return header


def _bytes_of(path: Path) -> bytes:
    try:
        if path.exists() and not path.is_file():  # reading a pipe would wait for ever
            raise FrameError(f"{path}: not a file")
        return path.read_bytes()
    except FileNotFoundError as e:
        raise FrameError(f"{path}: no such file") from e
    except OSError as e:
        raise FrameError(f"{path}: cannot be read: {e.strerror or e}") from e


def _decode(data: bytes, header: ImageHeader, where: str) -> np.ndarray:
    """As stored (BGR); orientation tags are ignored, since the camera model is that of the stored pixels."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as e:
        raise FrameError(f"{where}: the image cannot be decoded: {e.err}") from e
    if image is None:
        raise FrameError(f"{where}: the image cannot be decoded")
    channels = 1 if image.ndim == 2 else image.shape[2]
    wanted = np.uint16 if header.bits == 16 else np.uint8
    if (
        image.shape[:2] != (header.height, header.width)
        or image.dtype != wanted
        or (channels == 1) != (header.channels == 1)
    ):
        raise FrameError(f"{where}: the image does not decode to what its header says ({header})")
    return image


def _header(data: bytes, where: str) -> ImageHeader:
    if not data:
        raise FrameError(f"{where}: the file is empty")
    if data.startswith(_PNG):
        if len(data) < 33 or data[12:16] != b"IHDR":
            raise FrameError(f"{where}: damaged or truncated PNG (no header)")
        width, height, bits, color_type = struct.unpack(">IIBB", data[16:26])
        if color_type not in _PNG_CHANNELS or not (width and height):
            raise FrameError(f"{where}: damaged PNG (impossible header)")
        return ImageHeader("png", width, height, _PNG_CHANNELS[color_type], bits)
    if data.startswith(b"\xff\xd8"):
        return _jpeg_header(data, where)
    raise FrameError(f"{where}: neither a PNG nor a JPEG image")


def _check_png(data: bytes, where: str) -> None:
    """Every chunk whole and as its checksum says, up to the end chunk."""
    view, position = memoryview(data), len(_PNG)
    while position + 12 <= len(data):
        length, kind = struct.unpack(">I4s", view[position : position + 8])
        end = position + 12 + length
        if end > len(data):
            break
        if zlib.crc32(view[position + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            raise FrameError(f"{where}: damaged PNG (checksum of chunk {kind.decode('latin-1')!r} at byte {position})")
        if kind == b"IEND":
            return
        position = end
    raise FrameError(f"{where}: truncated PNG (no end chunk)")


def _jpeg_header(data: bytes, where: str) -> ImageHeader:
    position = 2
    while position + 10 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
        elif marker in _JPEG_FRAMES:
            bits, height, width, channels = struct.unpack(">BHHB", data[position + 4 : position + 10])
            if not (width and height and channels):
                raise FrameError(f"{where}: damaged JPEG (impossible header)")
            return ImageHeader("jpeg", width, height, channels, bits)
        elif marker in _JPEG_BARE:
            position += 2
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    raise FrameError(f"{where}: damaged or truncated JPEG (no frame header)")


def _check_jpeg(data: bytes, where: str) -> None:
    """The chain of segments leads to the end marker; between scans only what the format allows."""
    position = 2
    while position + 2 <= len(data):
        if data[position] != 0xFF:
            raise FrameError(f"{where}: damaged JPEG (no marker at byte {position})")
        marker = data[position + 1]
        if marker == 0xD9:
            return
        if marker == 0xFF:
            position += 1
        elif marker in _JPEG_BARE:
            position += 2
        elif marker in (0x00, 0xD8):
            raise FrameError(f"{where}: damaged JPEG (marker {marker:#04x} at byte {position})")
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
            if marker == 0xDA:  # compressed data runs to the next marker that is not a stuffed byte or a restart
                position = _end_of_scan(data, position)
    raise FrameError(f"{where}: truncated JPEG (no end marker)")


def _end_of_scan(data: bytes, position: int) -> int:
    while True:
        position = data.find(b"\xff", position)
        if position < 0 or position + 1 >= len(data):
            return len(data)
        if data[position + 1] != 0x00 and data[position + 1] not in _JPEG_BARE:
            return position
        position += 2
