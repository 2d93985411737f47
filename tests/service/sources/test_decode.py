import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest

from model.errors import InvalidInputError
from service.sources.decode import decode_image


@pytest.fixture(scope="module")
def picture():
    ramp = np.linspace(0, 255, 60, dtype=np.uint8)
    return np.stack([np.tile(ramp, (40, 1)), np.full((40, 60), 90, np.uint8), np.tile(ramp[::-1], (40, 1))], axis=-1)


def encoded(picture, suffix):
    return cv2.imencode(suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()


def chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_claiming(width, height):
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 99)) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff"])
def test_lossless_files_come_back_in_rgb(picture, suffix):
    assert np.array_equal(decode_image(encoded(picture, suffix)), picture)


def test_jpeg_comes_back_nearly(picture):
    assert np.abs(decode_image(encoded(picture, ".jpg")).astype(int) - picture).mean() < 6


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_gray_stays_gray_and_deep_samples_stay_deep(suffix):
    deep = np.arange(0, 40 * 60 * 20, 20, dtype=np.uint16).reshape(40, 60)
    decoded = decode_image(cv2.imencode(suffix, deep)[1].tobytes())
    assert decoded.dtype == np.uint16
    np.testing.assert_array_equal(decoded, deep)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".jpg"])
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.95])
def test_a_truncated_file_is_refused(picture, suffix, kept):
    data = encoded(picture, suffix)
    with pytest.raises(InvalidInputError):
        decode_image(data[: int(kept * len(data))])


def test_a_bomb_is_refused_before_its_pixels_are_decoded():
    with pytest.raises(InvalidInputError, match="60000 x 60000 pixels"):
        decode_image(png_claiming(60000, 60000))


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".jpg"])
def test_every_format_obeys_the_pixel_limit(picture, suffix):
    with pytest.raises(InvalidInputError, match="more than 2399 allowed"):
        decode_image(encoded(picture, suffix), max_pixels=2399)


def test_a_png_whose_data_do_not_fill_it_is_refused():
    with pytest.raises(InvalidInputError, match="damaged"):
        decode_image(png_claiming(500, 500))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x89PNG",
        b"a text file, and not a short one\n" * 9,
        b"<svg xmlns='x'/>",
        b"GIF89a" + b"\0" * 99,
        b"%PDF-1.7",
        b"\x89PNG\r\n\x1a\n",
        b"\xff\xd8\xff\xd9",
        b"BM",
        b"II*\0",
        b"II*\0\xff\xff\xff\xff",
        b"MM\0*\0\0\0\x08\xff\xff" + b"\xff" * 40,
    ],
)
def test_what_is_no_image_is_refused_in_one_line(data):
    with pytest.raises(InvalidInputError) as caught:
        decode_image(data)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp"])
def test_a_polyglot_is_refused(picture, suffix):
    with pytest.raises(InvalidInputError, match="other data behind the image"):
        decode_image(encoded(picture, suffix) + b"PK\x03\x04<script>alert(1)</script>")


def test_texts_in_a_png_do_not_reach_the_decoder(picture):
    data = encoded(picture, ".png")
    bomb = chunk(b"zTXt", b"k\0\0" + zlib.compress(b"\0" * 3_000_000))
    assert np.array_equal(decode_image(data[:33] + bomb + data[33:]), picture)


def test_damage_is_noticed_anywhere(picture):
    data = bytearray(encoded(picture, ".png"))
    data[len(data) // 2] ^= 0xFF
    with pytest.raises(InvalidInputError, match="damaged"):
        decode_image(bytes(data))


def test_random_bytes_behind_a_signature_never_crash():
    rng = np.random.default_rng(0)
    for start in (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"BM"):
        for _ in range(40):
            with pytest.raises(InvalidInputError):
                decode_image(start + rng.bytes(int(rng.integers(0, 300))))


def jpeg_with_a_trap(picture, marker):
    """A bare marker before an APP1 that holds a small frame header just where that marker's "length" would lead.

    The real frame, which the decoder meets, is huge.
    """
    data = encoded(picture, ".jpg")
    frame = next(i for i in range(len(data)) if data[i : i + 2] == b"\xff\xc0")
    huge = data[:frame] + data[frame : frame + 5] + struct.pack(">HH", 32000, 32000) + data[frame + 9 :]
    hidden = bytearray(b"\xff\xe1" + struct.pack(">H", 65533) + bytes(65531))
    landing = 0xFFE1  # read from the APP1's own marker, counted from there
    hidden[landing : landing + 19] = data[frame : frame + 19]
    return huge[:2] + bytes((0xFF, marker)) + bytes(hidden) + huge[2:]


@pytest.mark.parametrize("marker", [0x01, 0xD0, 0xD7])
def test_a_bare_marker_does_not_hide_the_real_size(picture, marker):
    with pytest.raises(InvalidInputError, match="32000 x 32000 pixels"):
        decode_image(jpeg_with_a_trap(picture, marker))


def test_a_second_frame_is_refused(picture):
    data = encoded(picture, ".jpg")
    frame = next(i for i in range(len(data)) if data[i : i + 2] == b"\xff\xc0")
    length = struct.unpack_from(">H", data, frame + 2)[0]
    with pytest.raises(InvalidInputError, match="more than one frame"):
        decode_image(data[:frame] + data[frame : frame + 2 + length] + data[frame:])


def test_bare_markers_do_no_harm(picture):
    data = encoded(picture, ".jpg")
    np.testing.assert_array_equal(decode_image(data[:2] + b"\xff\x01" + data[2:]), decode_image(data))


def test_the_decoder_has_a_limit_of_its_own():
    """Behind the checks: OpenCV itself refuses, whoever calls it in a process of the service."""
    code = (
        "import service, cv2, numpy as np, sys\n"
        "data = sys.stdin.buffer.read()\n"
        "try:\n    cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)\n"
        "except cv2.error as error:\n    print('refused' if 'pixels' in str(error).lower() else error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], input=png_claiming(20000, 20000), capture_output=True, check=True
    )
    assert done.stdout.strip() == b"refused"
