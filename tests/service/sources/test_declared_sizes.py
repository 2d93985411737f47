"""Arrays of other people's files: what they declare is compared with what may be, before anything
of them is read.
"""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from model.errors import InvalidInputError
from model.plant import Heliostat
from service.base.arrays import pack, unpack_untrusted
from service.sources.folder import read_surface
from service.sources.hdf5 import read_deflectometry

HELIOSTAT = Heliostat.juelich("AA39", [0.0, 60.0, 0.0], 60.0)


def header(shape: str, kind: str = "<f8") -> bytes:
    """The beginning of an npy file; its data are missing."""
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def npz(content: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("control_points.npy", content)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "refusal"),
    [
        (
            npz(header("(4, 1000, 500, 3)") + bytes(48_000_000)),
            "bytes of arrays; at most 4194304 are read",
        ),
        (
            npz(header("(4, 100000000, 100, 3)")),
            r"declares the shape \(4, 100000000, 100, 3\), but has",
        ),
        (
            npz(header("(4, 8, 8, 3)", "|O") + bytes(99)),
            "must hold real numbers, got the type object",
        ),
        (
            npz(header("(1, 1, 1, 1)", "<U9") + bytes(99)),
            "must hold real numbers, got the type <U9",
        ),
        (npz(b"nothing"), "not an npz file of numbers"),
        (b"PK\x05\x06", "not an npz file of numbers"),
    ],
    ids=["bomb", "shape", "objects", "text", "no array", "no archive"],
)
def test_an_npz_is_not_unpacked_beyond_its_bound(tmp_path: Path, data: bytes, refusal: str):
    file = tmp_path / "AA39" / "Deflectometry" / "AA39-nurbs-surface.npz"
    file.parent.mkdir(parents=True)
    file.write_bytes(data)
    with pytest.raises(InvalidInputError, match=refusal) as caught:
        read_surface(tmp_path, HELIOSTAT)
    assert str(file) in str(caught.value)


def test_arrays_within_the_bound_are_read():
    assert unpack_untrusted(pack({"a": np.arange(3.0)}), 1000, "x")["a"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("degree", [0, 8, 10**9, np.nan])
def test_a_degree_without_end_is_refused(tmp_path: Path, degree: float):
    file = tmp_path / "AA39" / "Deflectometry" / "AA39-nurbs-surface.npz"
    file.parent.mkdir(parents=True)
    file.write_bytes(
        pack({"control_points": np.zeros((4, 9, 9, 3)), "degrees": np.array([degree])})
    )
    with pytest.raises(InvalidInputError, match="'degrees' must be 1 to 7"):
        read_surface(tmp_path, HELIOSTAT)


def huge(group: h5py.Group) -> None:
    group.create_dataset("surface_points", (10**8, 3), "f8", chunks=(1000, 3), compression="gzip")


def large_chunks(group: h5py.Group) -> None:
    group.create_dataset(
        "surface_points", (0, 3), "f8", chunks=(10**7, 3), maxshape=(None, 3), compression="gzip"
    )


def elsewhere(group: h5py.Group) -> None:
    group["surface_points"] = h5py.ExternalLink("other.h5", "/x")


def outside(group: h5py.Group) -> None:
    group.create_dataset("surface_points", (8, 3), "f8", external=[("/etc/hostname", 0, 192)])


def soft(group: h5py.Group) -> None:
    group["surface_points"] = h5py.SoftLink("/nowhere")


def missing(group: h5py.Group) -> None:
    group["surface_normals"] = np.zeros((3, 3))


def text(group: h5py.Group) -> None:
    group["surface_points"] = "points"


@pytest.mark.parametrize(
    ("make", "refusal"),
    [
        (huge, "at most 500000 points are read"),
        (large_chunks, "at most 500000 points are read"),
        (elsewhere, "'surface_points' is a link; copy"),
        (soft, "'surface_points' is a link; copy"),
        (missing, "'surface_points' is missing"),
        (outside, "the numbers of 'surface_points' are in another file"),
        (text, "must be numbers"),
    ],
)
def test_deflectometry_is_not_read_beyond_its_bound(
    tmp_path: Path, make: Callable[[h5py.Group], None], refusal: str
):
    file = tmp_path / "AA39-deflectometry.h5"
    with h5py.File(file, "w") as data:
        make(data.create_group("facet1"))
    with pytest.raises(InvalidInputError, match=refusal):
        read_deflectometry(file, HELIOSTAT)


def test_a_file_that_is_no_hdf5_is_named(tmp_path: Path):
    file = tmp_path / "AA39-deflectometry.h5"
    file.write_bytes(b"nothing")
    with pytest.raises(InvalidInputError, match=r"deflectometry\.h5: no readable HDF5 file"):
        read_deflectometry(file, HELIOSTAT)
