"""ZIP files with headers that lie: each is unpacked or refused, and nothing lies outside."""

import io
import struct
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import IO, Any
from zipfile import ZIP_DEFLATED, ZipFile

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from model.errors import InvalidInputError
from service.base.errors import TooLargeError
from service.sources.files import unpack_archive

MAX_BYTES = 10_000
DIRECTORY, LOCAL, END = b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06"
HUGE = st.sampled_from([0, 1, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1])
HUGER = st.sampled_from([2**32, 2**62, 2**63 - 1, 2**63, 2**64 - 1])


def zip_file() -> bytes:
    """Two files in a folder, one of them compressed."""
    buffer = io.BytesIO()
    with ZipFile(buffer, "w") as file:
        file.writestr("plant/one.json", b"{}" * 50)
        file.writestr("plant/two.json", b"[]" * 500, ZIP_DEFLATED)
    return buffer.getvalue()


def zip64_file(size: int, compressed: int, offset: int, directory: int | None = None) -> bytes:
    """One entry with its numbers in a ZIP64 field, and the directory where ``directory`` says."""
    name, data = b"a/b.json", b"{}"
    large = struct.pack("<HHQQQ", 1, 24, size, compressed, offset)
    local = struct.pack("<4s5H3L2H", LOCAL, 45, 0, 0, 0, 0, 0, 2, 2, len(name), 0) + name + data
    entry = struct.pack(
        "<4s6H3L5H2L",
        DIRECTORY,
        *(45, 45, 0, 0, 0, 0, 0, *[2**32 - 1] * 2, len(name), len(large), 0, 0, 0, 0, 2**32 - 1),
    )
    entry += name + large
    at = len(local) if directory is None else directory
    end64 = struct.pack("<4sQ2H2L4Q", b"PK\x06\x06", 44, 45, 45, 0, 0, 1, 1, len(entry), at)
    locator = struct.pack("<4sLQL", b"PK\x06\x07", 0, len(local) + len(entry), 1)
    end = struct.pack("<4s4H2LH", END, 0, 0, 1, 1, len(entry), 2**32 - 1, 0)
    return local + entry + end64 + locator + end


def unpack(data: bytes, folder: Path, on_disk: bool = False) -> None:
    """Unpack into a folder of ``folder``; what is refused is refused by one of our errors."""
    into = folder / "into"
    into.mkdir()
    file: IO[bytes]
    with tempfile.TemporaryFile() if on_disk else io.BytesIO() as file:
        file.write(data)
        file.seek(0)
        try:
            unpack_archive(file, into, MAX_BYTES)
        finally:
            written = [path for path in folder.rglob("*") if path.is_file()]
            assert all(path.is_relative_to(into) and not path.is_symlink() for path in written)
            assert sum(path.stat().st_size for path in written) <= MAX_BYTES


@pytest.mark.parametrize("on_disk", [False, True])
@pytest.mark.parametrize(
    "numbers",
    [
        (100, 100, 2**63),
        (100, 100, 2**64 - 1),
        (100, 100, 2**62),
        (2**63, 2, 0),
        (100, 2**64 - 1, 0),
        (2, 2, 0, 2**63),
        (2, 2, 0, 2**64 - 1),
        (2, 2, 0, 0),
    ],
)
def test_lying_zip64_headers_are_refused(numbers: Any, on_disk: bool, tmp_path: Path):
    with pytest.raises((InvalidInputError, TooLargeError), match=r"^file: "):
        unpack(zip64_file(*numbers), tmp_path, on_disk)


def test_overlapping_entries_are_refused(tmp_path: Path):
    """Two entries of the directory that lead to the same data."""
    data = bytearray(zip_file())
    second = data.rindex(DIRECTORY)
    data[second + 42 : second + 46] = bytes(4)
    with pytest.raises(InvalidInputError, match="no readable ZIP file"):
        unpack(bytes(data), tmp_path)


@st.composite
def damaged_files(draw: Any) -> bytes:
    """A ZIP file in which some header fields, or some bytes of a record, have other values."""
    if draw(st.booleans()):
        numbers = [draw(HUGE | HUGER) for _ in range(4)]
        data = bytearray(zip64_file(*numbers))
    else:
        data = bytearray(zip_file())
    for _ in range(draw(st.integers(1, 4))):
        record = draw(st.sampled_from([DIRECTORY, LOCAL, END, b"PK\x06\x06", b"PK\x06\x07"]))
        starts = [at for at in range(len(data)) if data.startswith(record, at)]
        if starts:
            at = draw(st.sampled_from(starts)) + draw(st.integers(4, 60))
            value = draw(HUGE.map(lambda number: struct.pack("<L", number)) | st.binary(max_size=4))
            data[at : at + len(value)] = value
    cut = draw(st.integers(0, 40))
    return bytes(data[: len(data) - cut] if draw(st.booleans()) else data)


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(damaged_files(), st.booleans())
def test_damaged_headers_are_unpacked_or_refused(data: bytes, on_disk: bool):
    with tempfile.TemporaryDirectory() as folder, suppress(InvalidInputError, TooLargeError):
        unpack(data, Path(folder), on_disk)
