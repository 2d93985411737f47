"""Program of a decoder process: reads image files, returns pixels or a refusal.

`service.sources.decode` starts it. The process imports little, so that it starts fast. The kernel
enforces its limits of CPU time and memory. The claims of a file are checked before its pixels are
decoded, so that most bad files get a clear error. Pillow reads the headers of PNG, JPEG and BMP. It
does not read TIFF headers, because it would read all values of all tags.
"""

import io
import os
import re
import resource
import struct
import sys
import zlib
from collections.abc import Callable
from io import FileIO
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from model.errors import InvalidInputError
from service.sources.decode import (
    ANSWER,
    CPU_S,
    DECODED,
    LARGER,
    REFUSED,
    REQUEST,
    TooManyPixelsError,
)

# Most memory [bytes] for one file: a fixed part, and for each pixel twice four samples of 16 bits.
_MEMORY_BYTES = 256 * 2**20
_MEMORY_PER_PIXEL = 16

# Most pixels of all scans of a JPEG together: about 2 s. Progressive files have ten scans.
_MAX_SCANNED = 1_000_000_000

# Rows that are converted from BGR to RGB at a time.
_STRIP = 64

# A marker that ends a scan; 0xFF00 is a byte of it, and 0xFFD0 to 0xFFD7 restart it.
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
# Fill bytes, and markers without a length.
_BARE_MARKERS = {0xFF, 0x01, *range(0xD0, 0xD8)}

_STATM = Path("/proc/self/statm")

_FORMATS = ("PNG", "JPEG", "BMP")

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_NEEDED = {b"IHDR", b"PLTE", b"eXIf", b"IDAT", b"IEND"}

# Sizes [bytes] of TIFF's field types, BYTE to DOUBLE (TIFF 6.0, section 2); 0 is no type.
_TIFF_SIZES = np.array([0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8])
_TIFF_NUMBERS = {3: "u2", 4: "u4"}  # SHORT and LONG
_TIFF_MOST_TAGS = 512
_TIFF_SUBFILE = 254  # kind of a page
_TIFF_MOST_PREVIEWS = 16  # a picture has one for each halving of its size
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_SAMPLES = 256, 257, 258, 277
_TIFF_PHOTOMETRIC, _TIFF_FORMAT, _WHITE_IS_ZERO, _UNSIGNED = 262, 339, 0, {1, 4}
_TIFF_TILE_WIDTH, _TIFF_TILE_HEIGHT = 322, 323
_TIFF_PLACES = ((273, 279), (324, 325))  # (offsets, byte counts) of strips and of tiles


class CheckedFile(NamedTuple):
    """The bytes to decode, and the columns and rows that their header claims."""

    data: bytes
    width: int
    height: int
    is_inverted: bool = False  # as OpenCV decodes it


def decode(data: bytes, max_pixels: int) -> NDArray[Any]:
    """Decode a file to gray or BGR pixels of 8 or 16 bits.

    Raises
    ------
    InvalidInputError
        If the file cannot be decoded; the message gives the reason.
    """
    checked = _container(data)(data)
    _, width, height, is_inverted = checked
    if width < 1 or height < 1:
        raise InvalidInputError("image: it claims no pixels; send a photograph")
    if width * height > max_pixels:
        raise TooManyPixelsError(
            f"image: {width} x {height} pixels is more than {max_pixels} allowed; scale it down"
        )
    limit_memory(_MEMORY_BYTES + _MEMORY_PER_PIXEL * width * height)
    pixels = _pixels(checked.data, (height, width))
    return ~pixels if is_inverted else pixels


def _container(data: bytes) -> Callable[[bytes], CheckedFile]:
    """The check function for the file format of the first bytes."""
    if data.startswith(_PNG_SIGNATURE):
        return _check_png
    if data.startswith(b"\xff\xd8\xff"):
        return _check_jpeg
    if data.startswith((b"II*\x00", b"MM\x00*")):
        return _check_tiff
    if data.startswith(b"BM"):
        return _check_bmp
    raise InvalidInputError(
        "image: not a PNG, JPEG, TIFF or BMP file; send the camera's photograph in one of them"
    )


def _truncated() -> InvalidInputError:
    return InvalidInputError("image: the file ends early or is damaged; send it again")


def _trailing() -> InvalidInputError:
    return InvalidInputError("image: there is other data behind the image; send the image alone")


def _with_header(data: bytes) -> CheckedFile:
    """The file with its size; Pillow reads the header without decoding pixels."""
    try:
        with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
            return CheckedFile(data, *image.size)
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, struct.error) as error:
        raise _truncated() from error


def _pixels(data: bytes, shape: tuple[int, int]) -> NDArray[Any]:
    # EXIF orientation is applied, as viewers and browsers do.
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as error:
        if error.code == cv2.Error.STS_NO_MEM:
            raise MemoryError from error
        image = None
    turned = None if image is None else image.shape[:2] in (shape, shape[::-1])
    if image is None or not turned or image.dtype not in (np.uint8, np.uint16):
        raise _truncated()
    return image


def _check_png(data: bytes) -> CheckedFile:
    """The chunks that the pixels need, with verified checksums; texts and profiles are left out."""
    chunks, position = [_PNG_SIGNATURE], len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 12 + length
        kind, body = data[position + 4 : position + 8], memoryview(data)[position + 4 : end - 4]
        if end > len(data):
            raise _truncated()
        if kind in _PNG_NEEDED:
            if zlib.crc32(body) != struct.unpack_from(">I", data, end - 4)[0]:
                raise _truncated()
            chunks.append(data[position:end])
        position = end
        if kind == b"IEND":
            if position != len(data):
                raise _trailing()
            return _with_header(b"".join(chunks))
    raise _truncated()


def _end_of_jpeg(data: bytes) -> int:
    """Where the image ends that a JPEG begins with: behind its marker EOI (ITU-T T.81, B.1).

    A second image behind it, such as those of cameras with several lenses, is other data.
    """
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker in _BARE_MARKERS:
            position += 1 if marker == 0xFF else 2
            continue
        position += 2 + int.from_bytes(data[position + 2 : position + 4])
        if marker == 0xDA:
            found = _MARKER.search(data, position)
            position = len(data) if found is None else found.start()
        if data[position : position + 2] == b"\xff\xd9":
            return position + 2
    raise _truncated()


def _check_jpeg(data: bytes) -> CheckedFile:
    if data[_end_of_jpeg(data) :].strip(b"\x00"):
        raise _trailing()
    checked = _with_header(data)
    width, height = checked.width, checked.height
    # This is an upper bound: each scan begins with these bytes. Scan data never contain them, but
    # an embedded preview may.
    scans = data.count(b"\xff\xda")
    if scans * width * height > _MAX_SCANNED:
        raise InvalidInputError(
            f"image: a JPEG of {scans} scans over {width} x {height} pixels takes too long to"
            " decode; save it again, as a baseline JPEG or PNG"
        )
    return checked


def _check_bmp(data: bytes) -> CheckedFile:
    checked = _with_header(data)
    (claimed,) = struct.unpack_from("<I", data, 2)
    if claimed > len(data):
        raise _truncated()
    if claimed and claimed < len(data):
        raise _trailing()
    return checked


def _unlike_a_tiff(why: str) -> InvalidInputError:
    return InvalidInputError(f"image: a TIFF {why}; save it again, as PNG or JPEG")


def _next_directory(data: bytes, order: str, start: int) -> int:
    """Where the directory behind that at ``start`` begins; 0 behind the last."""
    (count,) = struct.unpack_from(order + "H", data, start)
    return int(struct.unpack_from(order + "I", data, start + 2 + 12 * count)[0])


def _require_one_picture(data: bytes, order: str) -> None:
    """Refuse further pages; previews, of reduced resolution, are none."""
    (page,) = struct.unpack_from(order + "I", data, 4)
    for _ in range(_TIFF_MOST_PREVIEWS + 1):
        page = _next_directory(data, order, page)
        if not page:
            return
        kind = _tiff_tags(data, order, page).get(_TIFF_SUBFILE)
        if kind is None or not struct.unpack_from(order + "I", data, int(kind["place"]))[0] & 1:
            break
    raise _unlike_a_tiff("of several pages is not supported; send one picture")


def _tiff_tags(data: bytes, order: str, start: int) -> dict[int, NDArray[Any]]:
    """The entries of a directory by tag: ``kind``, ``count``, and ``place`` of their values.

    Tags must be unique and in ascending order, as TIFF 6.0 says. Otherwise libtiff could use
    another entry than the one that was checked.
    """
    (count,) = struct.unpack_from(order + "H", data, start)
    if count > _TIFF_MOST_TAGS:
        raise _unlike_a_tiff(f"of {count} tags, {_TIFF_MOST_TAGS} are the most, is not supported")
    fields = [
        ("tag", order + "u2"),
        ("kind", order + "u2"),
        ("count", order + "u4"),
        ("place", order + "u4"),
    ]
    entries = np.frombuffer(data, np.dtype(fields), count, start + 2).astype(
        [(name, np.int64) for name, _ in fields]
    )
    if (np.diff(entries["tag"]) <= 0).any():
        raise _unlike_a_tiff("whose tags are not each there once and in order is damaged")
    sizes = _TIFF_SIZES[np.where(entries["kind"] < len(_TIFF_SIZES), entries["kind"], 0)]
    if (sizes == 0).any():
        raise _unlike_a_tiff("with a tag of an unknown type is not supported")
    sizes = sizes * entries["count"]
    is_inline = sizes <= 4
    entries["place"][is_inline] = start + 2 + 12 * np.flatnonzero(is_inline) + 8
    if (entries["place"] + sizes > len(data)).any():
        raise _truncated()
    if sizes.sum() > len(data):
        raise _unlike_a_tiff("whose tags share their values is not supported")
    return {int(entry["tag"]): entry for entry in entries}


def _check_tiff(data: bytes) -> CheckedFile:
    order = "<" if data.startswith(b"II") else ">"
    try:
        tags = _tiff_tags(data, order, *struct.unpack_from(order + "I", data, 4))
        _require_one_picture(data, order)
    except InvalidInputError:
        raise
    except (struct.error, ValueError) as error:  # the directory lies beyond the end
        raise _truncated() from error

    def numbers(tag: int, counts: tuple[int, ...] | None = None) -> NDArray[Any]:
        """The values of a tag; empty if it is missing.

        ``counts`` are the allowed numbers of values; None allows any.
        """
        if tag not in tags:
            return np.empty(0, np.int64)
        kind, count, place = (int(tags[tag][name]) for name in ("kind", "count", "place"))
        if kind not in _TIFF_NUMBERS or (counts is not None and count not in counts):
            raise _unlike_a_tiff(
                f"whose tag {tag} has {count} values of type {kind} is not supported"
            )
        return np.frombuffer(data, order + _TIFF_NUMBERS[kind], count, place).astype(np.int64)

    width, height, samples, tile_width, tile_height = (
        int(numbers(tag, (1,)).sum())  # one value or none
        for tag in (_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_SAMPLES, _TIFF_TILE_WIDTH, _TIFF_TILE_HEIGHT)
    )
    # Samples and bits multiply the memory that the decoder needs for each pixel.
    bits = numbers(_TIFF_BITS, (1, max(samples, 1)))
    kinds = {*numbers(_TIFF_FORMAT, (1, max(samples, 1))).tolist()}
    if not kinds <= _UNSIGNED:
        named = "signed" if 2 in kinds else "floating-point or complex"
        raise _unlike_a_tiff(f"of {named} samples is not supported; write unsigned integers")
    photometric = numbers(_TIFF_PHOTOMETRIC, (1,)).tolist()
    is_deep = bool((bits > 8).any())
    if is_deep and not {*photometric} <= {_WHITE_IS_ZERO, 1, 2}:
        raise _unlike_a_tiff("of more than 8 bits that is neither gray nor RGB is not supported")
    if is_deep and (bits < 16).any():
        raise _unlike_a_tiff("of 9 to 15 bits is not supported; write 16")
    if samples > 4 or (bits > 16).any():
        raise _unlike_a_tiff("of more than 4 samples or 16 bits is not supported")
    if tile_width > 4096 or tile_height > 4096:
        raise _unlike_a_tiff("with tiles above 4096 pixels is not supported")
    for offsets, counts in (
        (numbers(offsets), numbers(counts)) for offsets, counts in _TIFF_PLACES
    ):
        if len(offsets) != len(counts) or (offsets + counts > len(data)).any():
            raise _truncated()
    return CheckedFile(data, width, height, is_deep and photometric == [_WHITE_IS_ZERO])


def limit_memory(more: int) -> None:
    """Let the process map this many more bytes; no effect if there is no ``/proc``."""
    if _STATM.exists():
        mapped = int(_STATM.read_text().split()[0]) * resource.getpagesize()
        _set_limit(resource.RLIMIT_AS, mapped + more)


def limit_computation() -> None:
    """Let the kernel end the process after `CPU_S` more seconds of CPU time."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    _set_limit(resource.RLIMIT_CPU, int(used.ru_utime + used.ru_stime) + CPU_S + 1)


def _set_limit(kind: int, limit: int) -> None:
    """Set a limit that can be raised again, up to the operator's hard limit."""
    _, most = resource.getrlimit(kind)
    resource.setrlimit(kind, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))


def answer(size: int, max_pixels: int, memory: FileIO) -> bytes:
    """Decode the file in the shared memory under the limits; return the answer's header.

    The content of the answer is written to the shared memory.
    """
    limit_computation()
    kind = REFUSED
    try:
        limit_memory(_MEMORY_BYTES)
        memory.seek(0)
        pixels = decode(memory.read(size), max_pixels)
    except TooManyPixelsError as error:
        kind, reason = LARGER, str(error)
    except InvalidInputError as error:
        reason = str(error)
    except MemoryError:
        reason = (
            "image: it takes more memory to decode than its pixels need; save it again, as PNG or"
            " JPEG"
        )
    else:
        memory.seek(0)
        for first in range(0, len(pixels), _STRIP):  # a strip fits into the processor's cache
            strip = pixels[first : first + _STRIP]
            rgb = strip if strip.ndim == 2 else cv2.cvtColor(strip, cv2.COLOR_BGR2RGB)
            memory.write(np.ascontiguousarray(rgb).data.cast("B"))
        return ANSWER.pack(
            DECODED, *pixels.shape[:2], pixels.shape[2] if pixels.ndim == 3 else 1, pixels.itemsize
        )
    memory.seek(0)
    return ANSWER.pack(kind, memory.write(reason.encode()), 0, 0, 0)


def main() -> None:
    """Answer one file after the other until the service closes the pipe or ends."""
    Image.MAX_IMAGE_PIXELS = None  # `decode` checks the size, with a clearer message
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    incoming, outgoing = sys.stdin.buffer, sys.stdout.buffer
    with Path(os.devnull).open("wb") as nothing:
        os.dup2(nothing.fileno(), 2)  # the libraries' messages on broken files are dropped
    with FileIO(int(sys.argv[-1]), "r+") as memory:
        while request := incoming.read(REQUEST.size):
            size, max_pixels = REQUEST.unpack(request)
            outgoing.write(answer(size, max_pixels, memory))
            outgoing.flush()


if __name__ == "__main__":
    main()
