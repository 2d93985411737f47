"""Run the notebooks of ``docs/notebooks``: ``python -m docs.run_notebooks`` records their outputs.

A notebook is a script in Jupytext's percent format. What its cells print goes to ``NAME.json``
beside it, and their pictures to ``docs/images/notebooks``. From these `docs.generate` writes the
pages, and the build of the guide the ``.ipynb`` files, which need neither Jupyter nor the product.
"""

import ast
import base64
import contextlib
import hashlib
import io
import json
import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SOURCES = Path(__file__).with_name("notebooks")
PICTURES = Path(__file__).with_name("images") / "notebooks"
NAMES = ("surfaces_from_photographs", "forecast_anywhere", "hidden_effect")


@dataclass(frozen=True)
class Cell:
    """A cell of a notebook: prose or code, the text that it printed, and names of its pictures."""

    is_code: bool
    source: str
    text: str = ""
    pictures: tuple[str, ...] = ()


def read_source(name: str) -> list[Cell]:
    """The cells of a script, without outputs."""
    _, *parts = (SOURCES / f"{name}.py").read_text(encoding="utf-8").split("# %%")
    cells = []
    for part in parts:
        head, _, body = part.partition("\n")
        is_code = "[markdown]" not in head
        prose = re.sub(r"^# ?", "", body.strip(), flags=re.MULTILINE)
        cells.append(Cell(is_code, body.strip() if is_code else prose))
    return cells


def digest(name: str) -> str:
    """Digest of a script, by which a test finds outputs that are out of date."""
    return hashlib.sha256((SOURCES / f"{name}.py").read_bytes()).hexdigest()[:16]


def recorded(name: str) -> list[Cell]:
    """The cells of a notebook with their outputs."""
    outputs = json.loads((SOURCES / f"{name}.json").read_text(encoding="utf-8"))["outputs"]
    return [
        Cell(cell.is_code, cell.source, output["text"], tuple(output["pictures"]))
        for cell, output in zip(read_source(name), outputs, strict=True)
    ]


def run(name: str) -> float:
    """Run a notebook here, record its outputs, and return its processor time [s]."""
    import matplotlib as mpl

    mpl.use("Agg")
    variables: dict[str, Any] = {"__name__": "__main__"}
    begun_s, outputs = time.process_time(), list[dict[str, Any]]()
    for number, cell in enumerate(read_source(name)):
        said, pictures = io.StringIO(), list[str]()
        if cell.is_code:
            with contextlib.redirect_stdout(said):
                exec(compile(ast.parse(cell.source), f"{name}[{number}]", "exec"), variables)
            pictures = _save_figures(f"{name}-{number}")
        outputs.append({"text": said.getvalue().strip(), "pictures": pictures})
    took_s = round(time.process_time() - begun_s, 1)
    document = {"digest": digest(name), "outputs": outputs}
    (SOURCES / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return took_s


def _save_figures(name: str) -> list[str]:
    from matplotlib import pyplot

    PICTURES.mkdir(parents=True, exist_ok=True)
    names = []
    for number in pyplot.get_fignums():
        names.append(f"{name}-{number}.png")
        pyplot.figure(number).savefig(PICTURES / names[-1], dpi=72)
    pyplot.close("all")
    return names


def notebook(name: str) -> str:
    """The notebook as the text of an ``.ipynb`` file, with its outputs."""
    cells = [_cell(number, cell) for number, cell in enumerate(recorded(name))]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    document = {"cells": cells, "metadata": {"kernelspec": kernel}}
    return json.dumps(document | {"nbformat": 4, "nbformat_minor": 5}, indent=1)


def _cell(number: int, cell: Cell) -> dict[str, Any]:
    made = {"id": f"cell-{number}", "metadata": {}, "source": cell.source.splitlines(keepends=True)}
    if not cell.is_code:
        return made | {"cell_type": "markdown"}
    outputs: list[dict[str, Any]] = []
    if cell.text:
        lines = cell.text.splitlines(keepends=True)
        outputs.append({"output_type": "stream", "name": "stdout", "text": lines})
    for picture in cell.pictures:
        data = {"image/png": base64.b64encode((PICTURES / picture).read_bytes()).decode()}
        outputs.append({"output_type": "display_data", "data": data, "metadata": {}})
    return made | {"cell_type": "code", "execution_count": None, "outputs": outputs}


def write_notebooks(folder: Path) -> None:
    """Write all notebooks as ``.ipynb`` into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        (folder / f"{name}.ipynb").write_text(notebook(name), encoding="utf-8")


if __name__ == "__main__":
    for chosen in sys.argv[1:] or NAMES:
        sys.stdout.write(f"{chosen}: {run(chosen):.1f} s\n")
