"""The image files: whole, once, checked when read."""

import hashlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.base.errors import StoreDamagedError, UnsupportedImageError
from service.store.image_files import ImageStore, media_type
from tests.service.conftest import png


def test_image_lies_under_its_digest(tmp_path: Path):
    images = ImageStore(tmp_path / "images")
    sha256 = images.put(b"abc")
    assert sha256 == hashlib.sha256(b"abc").hexdigest()
    assert images.path(sha256) == tmp_path / "images" / sha256[:2] / sha256[2:]
    assert images.read(sha256) == b"abc"


def test_same_bytes_are_one_file_whoever_writes(tmp_path: Path):
    images = ImageStore(tmp_path)
    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(images.put, [b"x" * 10_000] * 32))) == 1
    assert sum(path.is_file() for path in tmp_path.rglob("*")) == 1


def test_cut_off_file_is_mended(tmp_path: Path):
    images = ImageStore(tmp_path)
    sha256 = images.put(b"abcdef")
    images.path(sha256).write_bytes(b"abc")
    with pytest.raises(StoreDamagedError, match="damaged"):
        images.read(sha256)
    with pytest.raises(StoreDamagedError, match="damaged"):
        images.checked(sha256)
    images.put(b"abcdef")
    assert images.read(sha256) == b"abcdef"
    assert images.checked(sha256).read_bytes() == b"abcdef"


def test_missing_file_is_said(tmp_path: Path):
    with pytest.raises(StoreDamagedError, match="missing"):
        ImageStore(tmp_path).read("0" * 64)
    with pytest.raises(StoreDamagedError, match="missing"):
        ImageStore(tmp_path).checked("0" * 64)


def test_failed_write_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        ImageStore(tmp_path).put(b"abc")
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


@pytest.mark.parametrize(
    ("start", "expected"),
    [
        (b"\x89PNG\r\n\x1a\n", "image/png"),
        (b"\xff\xd8\xff\xe0", "image/jpeg"),
        (b"II*\x00", "image/tiff"),
    ],
)
def test_format_is_told_by_the_first_bytes(start: bytes, expected: str):
    assert media_type(start + b"rest") == expected
    assert media_type(png()) == "image/png"


@pytest.mark.parametrize("data", [b"", b"<svg/>", b"GIF89a", b"%PDF-1.7", b"\x89PN"])
def test_other_formats_are_refused(data: bytes):
    with pytest.raises(UnsupportedImageError):
        media_type(data)
