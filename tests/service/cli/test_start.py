"""The command starts without the libraries that only some verbs need, and take seconds to load."""

import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = {"torch", "h5py", "matplotlib", "cv2", "onnxruntime", "fastapi", "scipy", "pvlib", "pandas"}

LOADED = """
import sys
from service.cli.main import main
sys.argv = ["heliotwin", *sys.argv[1:]]
try:
    main()
except SystemExit as ended:
    assert not ended.code, ended.code
print("loaded:", *{name.partition(".")[0] for name in sys.modules}, file=sys.stderr)
"""


@pytest.mark.parametrize(
    "arguments",
    [("--help",), ("predict", "--help"), ("models", "--help"), ("keys", "list"), ("migrate",)],
)
def test_start_loads_no_library_that_the_verb_does_not_need(
    arguments: tuple[str, ...], tmp_path: Path
):
    environment = {"HELIOTWIN_DATA_DIR": str(tmp_path / "data"), "PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", LOADED, *arguments],
        capture_output=True,
        text=True,
        env=environment,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    loaded = set(done.stderr.strip().splitlines()[-1].removeprefix("loaded:").split())
    assert "service" in loaded
    assert not loaded & HEAVY
