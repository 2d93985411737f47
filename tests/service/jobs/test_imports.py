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
    with pytest.raises(InvalidInputError, match="no regular file"):
        read_json(folder / "2-calibration-properties.json")


def test_sizes_are_looked_at_before_anything_is_read(tmp_path: Path):
    (tmp_path / "large").write_bytes(b"x" * 11)
    with pytest.raises(InvalidInputError, match="large: 11 bytes, 10 are the most"):
        files.read_file(tmp_path / "large", 10)


def test_a_file_outside_is_not_looked_at(tmp_path: Path):
    """Whether it exists makes no difference to the answer; folders that are links lead outside,
    too.
    """
    root, outside = tmp_path / "root", tmp_path / "outside"
    root.mkdir()
    outside.mkdir()
    (outside / "there").write_text("{}")
    (root / "link").symlink_to(outside)
    with files.confined_to(root):
        for name in ("there", "nowhere"):
            with pytest.raises(InvalidInputError, match="leads outside of the folder"):
                read_json(root / "link" / name)
    assert read_json(root / "link" / "there") == {}
