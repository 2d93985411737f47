import io
import os
import signal
import struct
import subprocess
import sys
import time
import zlib
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from model.errors import InvalidInputError
from service.base.errors import BusyError
from service.sources import decode
from service.sources.decode import decode_image
from tests.service.sources.pictures import PIXELS, gray_tiff, jpeg_of_scans, tiff


@pytest.fixture(scope="module")
def picture():
    ramp = np.linspace(0, 255, 60, dtype=np.uint8)
    return np.stack(
        [np.tile(ramp, (40, 1)), np.full((40, 60), 90, np.uint8), np.tile(ramp[::-1], (40, 1))],
        axis=-1,
    )


def encoded(picture, suffix):
    return cv2.imencode(suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()


def chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_claiming(width, height):
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * 99))
        + chunk(b"IEND", b"")
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
    """A bare marker before an APP1 that holds a small frame header just where that marker's
    "length" would lead.

    The real frame, which the decoder meets, is huge.
    """
    data = encoded(picture, ".jpg")
    frame = next(i for i in range(len(data)) if data[i : i + 2] == b"\xff\xc0")
    huge = (
        data[:frame]
        + data[frame : frame + 5]
        + struct.pack(">HH", 32000, 32000)
        + data[frame + 9 :]
    )
    hidden = bytearray(b"\xff\xe1" + struct.pack(">H", 65533) + bytes(65531))
    landing = 0xFFE1  # read from the APP1's own marker, counted from there
    hidden[landing : landing + 19] = data[frame : frame + 19]
    return huge[:2] + bytes((0xFF, marker)) + bytes(hidden) + huge[2:]


@pytest.mark.parametrize(
    ("marker", "refusal"), [(0x01, "damaged"), (0xD0, "32000 x 32000"), (0xD7, "32000 x 32000")]
)
def test_a_bare_marker_does_not_hide_the_real_size(picture, marker, refusal):
    with pytest.raises(InvalidInputError, match=refusal):
        decode_image(jpeg_with_a_trap(picture, marker))


def test_a_second_frame_is_refused(picture):
    data = encoded(picture, ".jpg")
    frame = next(i for i in range(len(data)) if data[i : i + 2] == b"\xff\xc0")
    length = struct.unpack_from(">H", data, frame + 2)[0]
    with pytest.raises(InvalidInputError, match="damaged"):
        decode_image(data[:frame] + data[frame : frame + 2 + length] + data[frame:])


def test_a_progressive_jpeg_is_decoded_and_one_of_endless_scans_is_not():
    assert decode_image(jpeg_of_scans(20)).shape == (500, 800)
    with pytest.raises(InvalidInputError, match="2501 scans over 800 x 500 pixels takes too long"):
        decode_image(jpeg_of_scans(2501))


def test_a_plain_tiff_is_decoded():
    assert decode_image(gray_tiff()).tobytes() == PIXELS


@pytest.mark.parametrize(
    ("data", "refusal"),
    [
        (gray_tiff((256, 3, 1, 30000)), "not each there once and in order"),
        (gray_tiff((256, 3, 1, 8)), "not each there once and in order"),
        (gray_tiff(_277=(8, 1, 4)), "tag 277 has 1 values of type 8"),
        (gray_tiff(_258=(8, 1, 64)), "tag 258 has 1 values of type 8"),
        (gray_tiff(_277=(3, 0, 0)), "tag 277 has 0 values"),
        (gray_tiff(_257=(3, 0, 0)), "tag 257 has 0 values"),
        (gray_tiff(_258=(3, 1, 32)), "more than 4 samples or 16 bits"),
        (gray_tiff(_277=(3, 1, 60000)), "more than 4 samples or 16 bits"),
        (gray_tiff((60000, 99, 1, 0)), "unknown type"),
        (gray_tiff(_279=(4, 1, 65000)), "ends early"),
        (gray_tiff((339, 3, 1, 2)), "of signed samples is not supported"),
        (gray_tiff((339, 3, 1, 3)), "of floating-point or complex samples"),
        (gray_tiff(_258=(3, 1, 12)), "of 9 to 15 bits"),
        (gray_tiff(_258=(3, 1, 16), _262=(3, 1, 5)), "neither gray nor RGB"),
    ],
)
def test_a_tiff_that_readers_read_differently_is_refused(data, refusal):
    with pytest.raises(InvalidInputError, match=refusal):
        decode_image(data)


@pytest.mark.parametrize(
    ("kinds", "is_read"),
    [([0], False), ([2], False), ([1], True), ([1, 1], True), ([1, 0], False), ([1] * 17, False)],
)
def test_only_previews_may_follow_the_picture_of_a_tiff(kinds, is_read):
    buffer, others = io.BytesIO(), []
    for kind in kinds:
        others.append(Image.new("L", (10, 8), 200))
        others[-1].encoderinfo = {"tiffinfo": {254: kind}}
    Image.new("L", (60, 40), 50).save(buffer, "TIFF", save_all=True, append_images=others)
    if is_read:
        assert decode_image(buffer.getvalue()).shape == (40, 60)
    else:
        with pytest.raises(InvalidInputError, match="of several pages"):
            decode_image(buffer.getvalue())


@pytest.mark.parametrize("count", [500, 1000])
def test_a_tiff_whose_tags_share_a_million_bytes_is_refused_without_reading_them(count):
    entries = [(60000 + tag, 1, 1_000_000, 8) for tag in range(count)]
    with pytest.raises(InvalidInputError, match="TIFF"):
        decode_image(tiff(*entries, data=bytes(1_000_000)))


# --- the decoder's process
# --------------------------------------------------------------------------------------------


def spoiled(monkeypatch, statement):
    """Decoders whose program does something else than to decode."""
    program = (
        "from service.sources import decoder_process as d\ndef decode(*_):\n   "
        f" {statement}\nd.decode = decode\n"
    )
    monkeypatch.setattr(decode, "_PROGRAM", ("-c", f"{program}d.CPU_S = 0\nd.main()"))
    return decode.DecoderPool()


@pytest.mark.parametrize(
    ("statement", "refusal"),
    [
        pytest.param(
            "while True: pass",
            "takes more than 10 s to decode; save it again",
            marks=pytest.mark.full,
        ),
        ("bytearray(2**40)", "more memory to decode than its pixels need; save it again"),
        ("__import__('os').abort()", "breaks the decoder; save it again"),
    ],
)
def test_a_file_that_breaks_the_decoder_is_refused_and_the_next_one_decoded(
    monkeypatch, statement, refusal
):
    with closing(spoiled(monkeypatch, statement)) as pool:
        with pytest.raises(InvalidInputError, match=refusal):
            pool.decode(b"", 1)
        with pytest.raises(InvalidInputError, match=refusal):
            pool.decode(b"", 1)


def test_a_decoder_that_hangs_is_ended(monkeypatch):
    monkeypatch.setattr(decode, "_WALL_S", 0.1)
    pool = spoiled(monkeypatch, "__import__('time').sleep(300)")
    with closing(pool), pytest.raises(InvalidInputError, match="takes more than"):
        pool.decode(b"", 1)


def test_a_decoder_that_was_ended_meanwhile_is_replaced(picture):
    with closing(decode.DecoderPool()) as pool:
        pool.decode(encoded(picture, ".png"), 10_000)
        (idle,) = pool._idle
        os.kill(idle._process.pid, signal.SIGKILL)
        assert np.array_equal(pool.decode(encoded(picture, ".png"), 10_000), picture)


def test_a_machine_that_ends_every_decoder_is_not_the_photographs_fault(monkeypatch):
    pool = spoiled(monkeypatch, "__import__('os').kill(__import__('os').getpid(), 9)")
    with closing(pool), pytest.raises(BusyError, match="send it again"):
        pool.decode(b"", 1)


def test_decoders_end_with_their_service(picture):
    """Also where it is killed: nobody is left to end them."""
    code = (
        "import sys\nfrom service.sources import decode\n"
        "decode.decode_image(sys.stdin.buffer.read())\n"
        "print(decode._DECODERS._idle[0]._process.pid, flush=True)\n"
        "import os, signal; os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], input=encoded(picture, ".png"), capture_output=True
    )
    assert done.returncode == -signal.SIGKILL
    assert not done.stderr
    pid = int(done.stdout)
    while (
        Path(f"/proc/{pid}").exists()
        and "Z" not in Path(f"/proc/{pid}/stat").read_text().split()[2]
    ):
        time.sleep(0.05)


def test_what_libraries_say_of_a_broken_file_reaches_no_log(picture):
    code = (
        "import sys\nfrom service.sources.decode import"
        " decode_image\ndecode_image(sys.stdin.buffer.read())"
    )
    data = encoded(picture, ".jpg")
    done = subprocess.run(
        [sys.executable, "-c", code], input=data[:700] + data[800:], capture_output=True
    )
    assert b"Corrupt" not in done.stderr
    assert done.stderr.count(b"\n") < 40  # of the traceback at the most


def test_the_decoder_has_a_limit_of_its_own():
    """In addition to the checks, OpenCV itself refuses in every process of the service."""
    code = (
        "import service, cv2, numpy as np, sys\ndata = sys.stdin.buffer.read()\ntry:\n   "
        " cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)\nexcept cv2.error as"
        " error:\n    print('refused' if 'pixels' in str(error).lower() else error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=png_claiming(20000, 20000),
        capture_output=True,
        check=True,
    )
    assert done.stdout.strip() == b"refused"


@pytest.mark.parametrize("bits", [8, 16])
def test_white_is_zero_at_every_depth(bits):
    stored = np.frombuffer(PIXELS, f"<u{bits // 8}")
    rows = len(stored) // 8
    sizes = {"_257": (3, 1, rows), "_258": (3, 1, bits), "_278": (3, 1, rows)}
    black_is_zero, white_is_zero = (
        decode_image(gray_tiff(_262=(3, 1, kind), **sizes)) for kind in (1, 0)
    )
    assert np.array_equal(black_is_zero.ravel(), stored)
    assert np.array_equal(white_is_zero, ~black_is_zero)


TURNS = {
    1: lambda seen: seen,
    2: np.fliplr,
    3: lambda seen: np.rot90(seen, 2),
    4: np.flipud,
    5: lambda seen: seen.T,
    6: lambda seen: np.rot90(seen, 1),
    7: lambda seen: np.rot90(seen, 2).T,
    8: lambda seen: np.rot90(seen, -1),
}
"""What a camera stores of a picture, by the orientation that it writes."""


@pytest.mark.parametrize("orientation", TURNS)
@pytest.mark.parametrize("suffix", ["JPEG", "PNG", "TIFF"])
def test_orientation_is_applied_in_every_format(suffix, orientation):
    seen = np.kron(np.arange(12, dtype=np.uint8).reshape(3, 4) * 20, np.ones((16, 16), np.uint8))
    exif = Image.Exif()
    exif[274] = orientation
    more = {"tiffinfo": {274: orientation}} if suffix == "TIFF" else {"exif": exif}
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(TURNS[orientation](seen))).save(buffer, suffix, **more)
    found = decode_image(buffer.getvalue())
    assert found.shape == seen.shape
    assert np.abs(found.astype(int) - seen).mean() < 2


@pytest.mark.parametrize("behind", [b"x", b"x" * 100_000, b"x\xff\xd9", "itself"])
def test_data_behind_a_jpeg_is_refused_by_one_rule(picture, behind):
    data = encoded(picture, ".jpg")
    with pytest.raises(InvalidInputError, match="other data behind the image"):
        decode_image(data + (data if behind == "itself" else behind))
    assert np.array_equal(decode_image(data + bytes(100)), decode_image(data))
