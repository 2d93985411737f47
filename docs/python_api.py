"""The page of the Python API, from signatures and docstrings."""

import ast
import inspect
import pydoc
import re
import textwrap
from collections.abc import Callable, Iterator
from typing import Any

_HEAD = """# Python API

`import heliotwin` is the library for researchers: open a plant, predict a surface, forecast flux,
run a study. Three notebooks show it: [surfaces from photographs](surfaces_from_photographs.md),
[a forecast anywhere](forecast_anywhere.md) and [a hidden effect](hidden_effect.md).

Below it, `model` has pure functions over frozen dataclasses, with shapes and units in their
docstrings.
"""

ALL = "*"
CONTENT: dict[str, dict[str, str]] = {
    "The library": {
        "heliotwin.open_plant": "",
        "heliotwin.make_demo": "",
        "heliotwin.plane": "",
        "heliotwin.to_frame": "",
        "heliotwin.PlantFolder": ALL,
        "heliotwin.Surface": ALL,
        "heliotwin.Flux": ALL,
        "heliotwin.Comparison": ALL,
        "heliotwin.StudyResult": ALL,
        "heliotwin.Photograph": ALL,
    },
    "Plant and surfaces": {
        "model.plant.Heliostat": "juelich",
        "model.plant.TargetPlane": ALL,
        "model.surface.control_points": "",
        "model.surface.split_canting": "",
        "model.surface.greville": "",
    },
    "Trace flux": {
        "model.tracing.trace": "",
        "model.tracing.montecarlo.trace_montecarlo": "",
        "model.tracing.TracedFlux": "normalized",
        "model.tracing.Window": "",
        "model.metrics.flux_accuracy": "",
    },
    "Measure photographs": {"model.imaging.measure.measure": ""},
    "Predict surfaces": {
        "model.network.predictor.default_predictor": "",
        "model.network.predictor.SurfacePredictor": "predict",
        "model.refinement.estimator.refine": "",
        "model.observation.Observation": "",
        "model.metrics.surface_error": "",
    },
    "Forecast a field": {"model.fleet.aligned_field": "", "model.fleet.superpose": ""},
    "Calibrate mounts": {"model.pointing.calibration.calibrate": ""},
    "Find effects": {
        "model.study.loop.study": "",
        "model.effects.base.Effect": "on_sun on_mount on_scene on_optics on_image",
        "model.effects.base.Parameter": "",
    },
    "The sun": {
        "model.ephemeris.sun_positions": "",
        "model.ephemeris.sun_angles_at": "",
        "model.frames.sun_direction": "",
        "model.frames.sun_angles": "",
    },
}
"""Objects by heading, each with its members that are listed: names, or all that are public."""


def python_api_page(prose: Callable[[str], str]) -> str:
    """Every object of `CONTENT`; ``prose`` makes Markdown of a docstring's text."""
    lines = [_HEAD]
    for heading, objects in CONTENT.items():
        lines += [f"## {heading}", ""]
        for name, members in objects.items():
            found: Any = pydoc.locate(name)
            lines += _described(f"### {name}", name, found, prose)
            for member in _members(found, members):
                title = f"{name.rpartition('.')[2]}.{member}"
                value = inspect.getattr_static(found, member)
                lines += _described(f"#### {title}", title, value, prose)
    return "\n".join(lines)


def _members(kind: Any, members: str) -> Iterator[str]:
    if members != ALL:
        yield from members.split()
        return
    for name, value in vars(kind).items():
        if not name.startswith("_") and inspect.getdoc(_function(value)) and _is_member(value):
            yield name


def _is_member(value: Any) -> bool:
    return inspect.isfunction(_function(value)) or isinstance(value, property)


def _function(value: Any) -> Any:
    """The function of a method, a class method or a cached property."""
    return getattr(value, "__func__", getattr(value, "func", value))


def _described(heading: str, name: str, value: Any, prose: Callable[[str], str]) -> Iterator[str]:
    yield heading
    yield ""
    function = _function(value)
    if callable(function):
        yield from ("```python", _signature(name, function), "```", "")
    yield from _markdown(inspect.getdoc(function) or "", prose)


def _signature(name: str, value: Any) -> str:
    """A call with its parameters as the source has them; one a line if they do not fit."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(value))).body
    if isinstance(node, ast.ClassDef):
        words, end = _class_parameters(node), ""
    else:
        assert isinstance(node, ast.FunctionDef)
        words = _parameters(node.args)
        end = "" if node.returns is None else f" -> {ast.unparse(node.returns)}"
    line = f"{name.rpartition('.')[2]}({', '.join(words)}){end}"
    wrapped = "".join(f"    {word},\n" for word in words)
    return line if len(line) <= 100 else f"{line.partition('(')[0]}(\n{wrapped}){end}"


def _class_parameters(node: ast.ClassDef) -> list[str]:
    """Parameters of a class: of its ``__init__``, else the fields of a dataclass."""
    for part in node.body:
        if isinstance(part, ast.FunctionDef) and part.name == "__init__":
            return _parameters(part.args)
    fields = [ast.unparse(part) for part in node.body if isinstance(part, ast.AnnAssign)]
    return [field for field in fields if not field.startswith("_") and "ClassVar" not in field]


def _parameters(given: ast.arguments) -> list[str]:
    """Parameters without ``self``, each with its type and its default."""
    first = [*given.posonlyargs, *given.args]
    missing: list[ast.expr | None] = [None] * (len(first) - len(given.defaults))
    words = [_parameter(*one) for one in zip(first, [*missing, *given.defaults], strict=True)]
    words = [word for word in words if word not in ("self", "cls")]
    if given.vararg is not None:
        words.append(f"*{_parameter(given.vararg)}")
    elif given.kwonlyargs:
        words.append("*")
    named = zip(given.kwonlyargs, given.kw_defaults, strict=True)
    return [*words, *(_parameter(*one) for one in named)]


def _parameter(argument: ast.arg, default: ast.expr | None = None) -> str:
    text = ast.unparse(argument)
    return text if default is None else f"{text} = {ast.unparse(default)}"


def _markdown(docstring: str, prose: Callable[[str], str]) -> Iterator[str]:
    """A docstring in numpydoc's form as Markdown: entries of its sections become a list."""
    first, *sections = re.split(r"^(\w[\w ]*)\n-{3,}\n", docstring, flags=re.MULTILINE)
    yield from (prose(first.strip()), "")
    for title, body in zip(sections[::2], sections[1::2], strict=True):
        yield from (f"**{title}**", "")
        if title == "Examples":
            yield from ("```python", body.strip(), "```", "")
            continue
        entries, _, remark = body.strip().partition("\n\n")
        for entry in re.split(r"\n(?=\S)", entries):
            head, _, text = entry.partition("\n")
            about = prose(inspect.cleandoc(text)).replace("\n", "\n  ")
            yield f"- `{head}`" + (f": {about}" if about else "")
        yield from ("", *([prose(remark), ""] if remark else ()))
