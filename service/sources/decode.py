"""Decoding an uploaded photograph safely: what the bytes claim is checked before any pixel is decoded.

The container is walked first. A file that is no PNG, JPEG, TIFF or BMP, that claims too many pixels, that ends early or
that carries something after its image is refused with one clear line; only then does OpenCV see it.
"""

import struct
import zlib
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError

MAX_PIXELS = 32_000_000

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_NEEDED = {b"IHDR", b"PLTE", b"IDAT", b"IEND"}
# Start-of-frame markers of JPEG: C0 to CF without DHT (C4), JPG (C8) and DAC (CC).
_JPEG_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Markers without a length: TEM and the restarts; SOI and EOI have no business before the scan.
_JPEG_BARE = {0x01, *range(0xD0, 0xD8)}
_JPEG_SCAN = 0xDA
# Sizes [bytes] of TIFF's field types BYTE, SHORT and LONG, the only ones of the fields read here.
_TIFF_TYPES = {1: ("B", 1), 3: ("H", 2), 4: ("I", 4)}
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_SAMPLES, _TIFF_BITS = 256, 257, 277, 258
_TIFF_TILE_WIDTH, _TIFF_TILE_HEIGHT = 322, 323
_TIFF_PLACES = ((273, 279), (324, 325))  # (offsets, byte counts) of strips and of tiles


def decode_image(data: bytes, *, max_pixels: int = MAX_PIXELS) -> Pixels:
    """The pixels of a PNG, JPEG, TIFF or BMP file.

    Parameters
    ----------
    data : bytes
        The whole file, untrusted.
    max_pixels : int
        Largest width x height that is decoded.

    Returns
    -------
    ndarray uint8 or uint16, (rows, columns) for a gray file and (rows, columns, 3) in RGB order for a colour file
        As deep as the file's samples, up to 16 bits; transparency is dropped, and an EXIF orientation is ignored: marks
        and configured corner pixels refer to the sensor.

    Raises
    ------
    InvalidInputError
        If the bytes are not such a file, are cut off, carry something else behind the image, or are too large.
    """
    checked, (width, height) = _container(data)(data)
    if width < 1 or height < 1:
        raise InvalidInputError("image: it claims no pixels; send a photograph")
    if width * height > max_pixels:
        raise InvalidInputError(f"image: {width} x {height} pixels is more than {max_pixels} allowed; scale it down")
    return _pixels(checked, (height, width))


def _container(data: bytes) -> Callable[[bytes], tuple[bytes, tuple[int, int]]]:
    """The reader of the container that the first bytes announce."""
    if data.startswith(_PNG_SIGNATURE):
        return _read_png
    if data.startswith(b"\xff\xd8\xff"):
        return _read_jpeg
    if data.startswith((b"II*\x00", b"MM\x00*")):
        return _read_tiff
    if data.startswith(b"BM"):
        return _read_bmp
    raise InvalidInputError("image: not a PNG, JPEG, TIFF or BMP file; send the camera's photograph in one of them")


def _truncated() -> InvalidInputError:
    return InvalidInputError("image: the file ends early or is damaged; send it again")


def _trailing() -> InvalidInputError:
    return InvalidInputError("image: there is other data behind the image; send the image alone")


def _pixels(data: bytes, shape: tuple[int, int]) -> Pixels:
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != shape:
        raise _truncated()
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)  # type: ignore[return-value]


def _read_png(data: bytes) -> tuple[bytes, tuple[int, int]]:
    """The chunks that make the pixels, with their checksums verified; texts and profiles are left out."""
    kept, position, size = [_PNG_SIGNATURE], len(_PNG_SIGNATURE), None
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 12 + length
        kind, body = data[position + 4 : position + 8], data[position + 8 : end - 4]
        if end > len(data):
            raise _truncated()
        if kind in _PNG_NEEDED:
            if zlib.crc32(kind + body) != struct.unpack_from(">I", data, end - 4)[0]:
                raise _truncated()
            kept.append(data[position:end])
        if kind == b"IHDR" and length == 13:
            size = struct.unpack_from(">II", body)
        position = end
        if kind == b"IEND":
            if position != len(data):
                raise _trailing()
            if size is None:
                raise _truncated()
            return b"".join(kept), size
    raise _truncated()


def _read_jpeg(data: bytes) -> tuple[bytes, tuple[int, int]]:
    if not data.rstrip(b"\x00").endswith(b"\xff\xd9"):
        raise _trailing() if b"\xff\xd9" in data[-(1 << 16) :] else _truncated()
    position, size = 2, None
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # a fill byte
            position += 1
            continue
        if marker in _JPEG_BARE:
            position += 2
            continue
        if marker in _JPEG_FRAMES:
            # Two sizes, of which the decoder takes the one that was not looked at, are a trap.
            if size is not None:
                raise InvalidInputError("image: a JPEG of more than one frame is not supported; send a photograph")
            height, width = struct.unpack_from(">HH", data, position + 5)
            size = (width, height)
        if marker in (0xD8, 0xD9):
            raise _truncated()
        if marker == _JPEG_SCAN:
            if size is None:
                raise _truncated()
            return data, size
        position += 2 + max(2, struct.unpack_from(">H", data, position + 2)[0])
    raise _truncated()


def _read_bmp(data: bytes) -> tuple[bytes, tuple[int, int]]:
    if len(data) < 54:
        raise _truncated()
    claimed, offset, header = struct.unpack_from("<I4xII", data, 2)
    if header < 40:
        raise InvalidInputError("image: an OS/2 bitmap is not supported; send PNG or JPEG")
    width, height, bits, compression = struct.unpack_from("<ii2xHI", data, 18)
    if compression in (0, 3):
        row = (width * bits + 31) // 32 * 4
        if width > 0 and len(data) < offset + row * abs(height):
            raise _truncated()
    if claimed > len(data):
        raise _truncated()
    if claimed and claimed < len(data):
        raise _trailing()
    return data, (width, abs(height))


def _tiff_fields(data: bytes, order: str) -> dict[int, tuple[int, ...]]:
    """The integer fields of the first directory, by tag."""
    (start,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, start)
    fields: dict[int, tuple[int, ...]] = {}
    for entry in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind, number = struct.unpack_from(order + "HHI", data, entry)
        code, width = _TIFF_TYPES.get(kind, ("", 0))
        if not code or number * width > len(data):
            continue
        place = entry + 8 if number * width <= 4 else struct.unpack_from(order + "I", data, entry + 8)[0]
        fields[tag] = struct.unpack_from(f"{order}{number}{code}", data, place)
    return fields


def _read_tiff(data: bytes) -> tuple[bytes, tuple[int, int]]:
    try:
        fields = _tiff_fields(data, "<" if data.startswith(b"II") else ">")
        size = fields[_TIFF_WIDTH][0], fields[_TIFF_HEIGHT][0]
    except (struct.error, KeyError, IndexError) as error:
        raise _truncated() from error
    # Samples and bits multiply the memory that the decoder takes for each pixel.
    if fields.get(_TIFF_SAMPLES, (1,))[0] > 4 or max(fields.get(_TIFF_BITS, (1,)), default=1) > 16:
        raise InvalidInputError("image: a TIFF of more than 4 samples or 16 bits is not supported; send PNG or JPEG")
    if fields.get(_TIFF_TILE_WIDTH, (0,))[0] > 4096 or fields.get(_TIFF_TILE_HEIGHT, (0,))[0] > 4096:
        raise InvalidInputError("image: a TIFF with tiles above 4096 pixels is not supported; send PNG or JPEG")
    for offsets, counts in _TIFF_PLACES:
        for offset, count in zip(fields.get(offsets, ()), fields.get(counts, ()), strict=False):
            if offset + count > len(data):
                raise _truncated()
    return data, size
