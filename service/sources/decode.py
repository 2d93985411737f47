"""Decode untrusted photographs in separate processes with limits of time and memory.

If a file breaks a decoder or keeps it busy, only that process is lost. Processes start when they
are needed, stay for the next photograph, and end with the service.
`service.sources.decoder_process` is their program.
"""

import atexit
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from service.base.errors import BusyError

MAX_PIXELS = 32_000_000

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

REQUEST = struct.Struct("<QQ")
"""A request: size [bytes] of the file in the shared memory, and the most pixels to decode."""

REFUSED, DECODED, LARGER = 0, 1, 2

ANSWER = struct.Struct("<BQQQQ")
"""An answer, whose content is in the shared memory.

- `REFUSED`, or `LARGER` if the image has too many pixels: size [bytes] of the reason (UTF-8), then
  zeros.
- `DECODED`: rows, columns, channels (1 or 3) and bytes per sample (1 or 2) of the pixels.
"""

CPU_S = 10
"""Most CPU time [s] for one file; the slowest of 50 million pixels take 2 to 3 s."""

# Most wall time [s] for one file, on a busy machine.
_WALL_S = 60.0

# Idle processes that stay, each with about 60 MB.
_MAX_IDLE = 2

# Memory [bytes] that an idle process keeps for the next photograph, both in its heap and in the
# shared memory. The thresholds of glibc's heap cannot be larger.
_MAX_KEPT = 32 * 2**20

# Signals that end a process if a file breaks the decoder.
_FAULTS = {signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGILL, signal.SIGFPE}

_PROGRAM = ("-m", "service.sources.decoder_process")

# OpenCV logs nothing, and the heap keeps its memory.
_ENVIRONMENT = {
    "OPENCV_LOG_LEVEL": "SILENT",
    "MALLOC_MMAP_THRESHOLD_": str(_MAX_KEPT),
    "MALLOC_TRIM_THRESHOLD_": str(_MAX_KEPT),
}

_REMEDY = "save it again, as a plain PNG or JPEG, and send that"


class TooManyPixelsError(InvalidInputError):
    """An image has too many pixels, according to its header; nothing else was read."""


def decode_image(data: bytes, *, max_pixels: int = MAX_PIXELS) -> Pixels:
    """Decode the pixels of a PNG, JPEG, TIFF or BMP file.

    Parameters
    ----------
    data : bytes
        The whole file, untrusted.
    max_pixels : int
        Largest width x height that is decoded.

    Returns
    -------
    ndarray uint8 or uint16
        (rows, columns) for a gray file and (rows, columns, 3) in RGB order for a colour file.
        The depth is that of the file's samples, up to 16 bits. Transparency is dropped. EXIF
        orientation is applied: marks and corner pixels refer to the picture as viewers show it.

    Raises
    ------
    TooManyPixelsError
        If it has more pixels than ``max_pixels``.
    InvalidInputError
        If the bytes are no such file, are incomplete, have other data behind the image, or take too
        much time or memory to decode.
    BusyError
        If something else ended the process, such as the system when memory is short.
    """
    return _DECODERS.decode(data, max_pixels)


def _shared_memory() -> FileIO:
    """A file without a name; in memory, if the system has such files."""
    if hasattr(os, "memfd_create"):
        return FileIO(os.memfd_create("decoder", 0), "r+")
    return tempfile.TemporaryFile(buffering=0)


class DecoderEndedError(Exception):
    """A decoder process ended before it answered; ``returncode`` as in `subprocess.Popen`."""

    def __init__(self, returncode: int) -> None:
        super().__init__(f"a decoder ended by {returncode}")
        self.returncode = returncode


class DecoderProcess:
    """A process that decodes one file after the other."""

    def __init__(self) -> None:
        paths = (str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH"))
        self.is_late = False
        self._memory = _shared_memory()
        self._process = subprocess.Popen(
            [sys.executable, "-P", *_PROGRAM, str(self._memory.fileno())],
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=[self._memory.fileno()],
            env=os.environ | _ENVIRONMENT | {"PYTHONPATH": os.pathsep.join(filter(None, paths))},
            process_group=0,  # Ctrl-C goes to the service only
        )

    def decode(self, data: bytes, max_pixels: int) -> Pixels:
        """Decode as `decode_image` does.

        Raises DecoderEndedError if the process ends; then it can only be closed.
        """
        timer = threading.Timer(_WALL_S, self._end_late)
        timer.daemon = True
        timer.start()
        try:
            return self._exchange(data, max_pixels)
        except (BrokenPipeError, EOFError):
            raise DecoderEndedError(self._process.wait()) from None
        finally:
            timer.cancel()

    def _exchange(self, data: bytes, max_pixels: int) -> Pixels:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._memory.seek(0)
        self._memory.write(data)
        self._process.stdin.write(REQUEST.pack(len(data), max_pixels))
        answer = self._process.stdout.read(ANSWER.size)
        if len(answer) < ANSWER.size:
            raise EOFError
        kind, rows, columns, channels, width = ANSWER.unpack(answer)
        if kind in (REFUSED, LARGER):
            refusal = TooManyPixelsError if kind == LARGER else InvalidInputError
            raise refusal(self._read(np.empty(rows, np.uint8)).tobytes().decode())
        shape = (rows, columns) if channels == 1 else (rows, columns, channels)
        pixels: Pixels = self._read(np.empty(shape, {1: np.uint8, 2: np.uint16}[width]))
        if pixels.nbytes > _MAX_KEPT:
            self._memory.truncate(0)
        return pixels

    def _read(self, array: Any) -> Any:
        """Fill an array from the shared memory."""
        self._memory.seek(0)
        if self._memory.readinto(memoryview(array).cast("B")) < array.nbytes:
            raise EOFError
        return array

    def _end_late(self) -> None:
        self.is_late = True
        self._process.kill()

    def close(self) -> None:
        """End the process immediately."""
        self._process.kill()
        with self._process, self._memory:  # closes the pipes and waits
            pass


class DecoderPool:
    """Decoder processes, one for each concurrent call."""

    def __init__(self) -> None:
        self._idle: list[DecoderProcess] = []
        self._lock = threading.Lock()

    def decode(self, data: bytes, max_pixels: int) -> Pixels:
        """Decode as `decode_image` does."""
        for _ in range(2):  # an idle process may have ended in the meantime
            decoder = self._take()
            try:
                pixels = decoder.decode(data, max_pixels)
            except DecoderEndedError as error:
                decoder.close()
                if error.returncode == -signal.SIGXCPU or decoder.is_late:
                    raise InvalidInputError(
                        f"image: it takes more than {CPU_S} s to decode; {_REMEDY}"
                    ) from None
                if -error.returncode in _FAULTS:
                    raise InvalidInputError(f"image: it breaks the decoder; {_REMEDY}") from None
            except InvalidInputError:
                self._put_back(decoder)
                raise
            except BaseException:
                decoder.close()
                raise
            else:
                self._put_back(decoder)
                return pixels
        raise BusyError("image: the machine ended its decoding; send it again")

    def _take(self) -> DecoderProcess:
        with self._lock:
            if self._idle:
                return self._idle.pop()
        return DecoderProcess()

    def _put_back(self, decoder: DecoderProcess) -> None:
        with self._lock:
            if len(self._idle) < _MAX_IDLE:
                self._idle.append(decoder)
                return
        decoder.close()

    def close(self) -> None:
        """End the idle processes; the next photograph starts one again."""
        with self._lock:
            idle, self._idle = self._idle, []
        for decoder in idle:
            decoder.close()


_DECODERS = DecoderPool()
atexit.register(_DECODERS.close)
