"""Files of pictures, byte by byte."""

import struct

import cv2
import numpy as np


def jpeg_of_scans(count):
    """A small file of 500 x 800 pixels with so many scans, the last of which refine nothing."""
    data = cv2.imencode(
        ".jpg", np.full((500, 800), 90, np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    )[1].tobytes()
    last = data.rindex(b"\xff\xda")
    return data[:last] + data[last:-2] * (count - data.count(b"\xff\xda") + 1) + data[-2:]


def tiff(*entries, data=b""):
    """A little-endian TIFF of entries (tag, type, count, value), with ``data`` behind its
    directory.
    """
    directory = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + directory + bytes(4) + data


SHORT, LONG = 3, 4


GRAY = {
    256: (SHORT, 1, 8),
    257: (SHORT, 1, 8),
    258: (SHORT, 1, 8),
    259: (SHORT, 1, 1),
    262: (SHORT, 1, 1),
}
"""An image of 8 x 8 pixels."""


BEHIND = {273: (LONG, 1, 122), 277: (SHORT, 1, 1), 278: (SHORT, 1, 8), 279: (LONG, 1, 64)}
"""Its pixels lie behind nine entries."""


PIXELS = bytes(range(64))


def gray_tiff(*more, **changed):
    """With ``more`` entries behind; ``changed`` are entries by ``_TAG``."""
    changes = {int(name[1:]): entry for name, entry in changed.items()}
    fields = GRAY | BEHIND | changes
    return tiff(*[(tag, *fields[tag]) for tag in sorted(fields)], *more, data=PIXELS)
