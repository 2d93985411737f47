"""Configuration of the guide: `docs.backend` builds it."""

import sys
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from docs import figures, run_notebooks  # noqa: E402  # they need the path above

project = "heliotwin"
html_show_copyright = False
html_title = "heliotwin"
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["guide.css"]
html_show_sphinx = False
html_copy_source = False
html_last_updated_fmt = None

extensions = ["myst_parser"]
myst_enable_extensions = ["attrs_block", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_static"]
default_role = "literal"
nitpicky = False
html_math_renderer = "mathml"


def _mathml(source: str, as_block: bool) -> str:
    return str(tex2mathml(source, as_block=as_block))


def _inline_math(translator: nodes.NodeVisitor, node: nodes.math) -> None:
    translator.body.append(_mathml(node.astext(), as_block=False))  # type: ignore[attr-defined]
    raise nodes.SkipNode


def _display_math(translator: nodes.NodeVisitor, node: nodes.math_block) -> None:
    translator.body.append(  # type: ignore[attr-defined]
        f'<div class="math">{_mathml(node.astext(), as_block=True)}</div>'
    )
    raise nodes.SkipNode


def _insert_figures(_: Sphinx, __: str, source: list[str]) -> None:
    source[0] = figures.fill(source[0])


def _write_notebooks(app: Sphinx, error: Exception | None) -> None:
    if error is None:
        run_notebooks.write_notebooks(Path(app.outdir) / "notebooks")


def setup(app: Sphinx) -> None:
    """Insert measured figures, draw equations as MathML, which needs no script, and write
    notebooks.
    """
    app.connect("build-finished", _write_notebooks)
    app.connect("source-read", _insert_figures)
    app.add_html_math_renderer("mathml", (_inline_math, None), (_display_math, None))
