"""What may lie in a folder that a job imports."""

import os
from pathlib import Path

import pytest

from model.errors import InvalidInputError
from service.jobs.kinds.imports import allowed_folder
from service.sources import files
from service.sources.documents import read_json


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path):
    folder = tmp_path / "plant" / "AA39" / "Calibration"
    folder.mkdir(parents=True)
    (folder / "1-raw.png").write_bytes(b"x")
    assert allowed_folder(tmp_path, "plant") == tmp_path / "plant"
    os.mkfifo(folder / "2-calibration-properties.json")
    with pytest.raises(InvalidInputError, match=r"2-calibration-properties\.json: no regular file"):
        allowed_folder(tmp_path, "plant")
    with pytest.raises(InvalidInputError, match="no regular file"):
        read_json(folder / "2-calibration-properties.json")


def test_sizes_are_looked_at_before_anything_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(files, "_MOST_BYTES", 10)
    (tmp_path / "small").write_bytes(b"x" * 10)
    assert allowed_folder(tmp_path, ".") == tmp_path
    (tmp_path / "large").write_bytes(b"x" * 11)
    with pytest.raises(InvalidInputError, match="large: 11 bytes, 10 are the most"):
        allowed_folder(tmp_path, ".")
