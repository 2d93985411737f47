"""Reference pages that are written from the code: ``python -m docs.generate``.

They are committed, so that links to them work in a clone and the guide is built without the
product. A test compares them with the code.
"""

import dataclasses
import inspect
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
from pydantic_core import PydanticUndefined
from typer.main import get_command

from docs.python_api import python_api_page
from docs.run_notebooks import NAMES, recorded
from heliotwin.cli.main import app as command_line
from model.effects import CATALOGUE
from service.base import settings as settings_module
from service.base.settings import Settings
from service.sources.plant_schema import json_schema
from service.twin.alarms.field_overview import FieldOverviewCache
from service.twin.runtime import Runtime
from service.web.app import create_app
from service.web.auth.security import Role
from service.web.store_metrics import registry

FOLDER = Path(__file__).parent / "reference" / "generated"
Pages = dict[str, Callable[[], str]]
METHODS = ("get", "post", "put", "patch", "delete")


def write_pages(folder: Path) -> None:
    """Write all pages into ``folder``; a page that is unchanged keeps its file."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, page in PAGES.items():
        path, text = folder / f"{name}.md", page()
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _cell(value: object) -> str:
    """Text for a cell of a table."""
    text = " ".join(str(value).split())
    return re.sub(r"([|<>{}*_\[\]$])", r"\\\1", text) or " "


def _code(value: object) -> str:
    """Inline code for a cell of a table."""
    text = " ".join(str(value).split()).replace("|", "\\|")
    return f"`{text}`" if text else " "


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    if not lines:
        return []
    return ["", f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}", *lines, ""]


def _prose(text: str | None) -> str:
    """A docstring or help text as Markdown: inline code stays, other marks are text."""
    parts = re.split(r"(`+[^`]+`+)", inspect.cleandoc(text or ""))
    return "".join(part if part.startswith("`") else _escaped(part) for part in parts)


def _escaped(text: str) -> str:
    """Text without marks of Markdown, but for emphasis."""
    escaped = re.sub(r"([<>{}*_\[\]$])", r"\\\1", text)
    return re.sub(r"\\\*(\w[^*\\]*\w)\\\*", r"*\1*", escaped)


# --- command line


_COMMANDS = """# Command line

Every verb has `--help`. Exit code 0 is done, 1 failed, 2 bad input with one line that names it, and
130 is an interruption by Ctrl-C. Verbs that look at a store (`export`, `check`, `backup`, `times`,
`models adopt`) make none.
"""


def command_page() -> str:
    """Every verb of ``heliotwin`` with its arguments and options."""
    lines = [_COMMANDS]
    root = get_command(command_line)
    for words, command in _verbs(root, ["heliotwin"]):
        lines += [f"## {' '.join(words[1:])}", "", _prose(command.help), "", "```text"]
        context = click.Context(command, info_name=" ".join(words))
        usage = command.collect_usage_pieces(context)
        lines += [f"{' '.join(words)} {' '.join(usage)}", "```", ""]
        lines += _table(
            ["parameter", "default", "meaning"], [_parameter(p) for p in command.params]
        )
    return "\n".join(lines) + "\n"


def _verbs(command: Any, words: list[str]) -> Iterator[tuple[list[str], Any]]:
    if not hasattr(command, "commands"):
        yield words, command
        return
    for name in sorted(command.commands):
        yield from _verbs(command.commands[name], [*words, name])


def _parameter(parameter: Any) -> tuple[str, str, str]:
    is_argument = parameter.param_type_name == "argument"
    names = [parameter.human_readable_name] if is_argument else parameter.opts
    choices = getattr(parameter.type, "choices", ())
    about = getattr(parameter, "help", None) or ""
    if choices:
        about += f" One of {', '.join(str(getattr(c, 'value', c)) for c in choices)}."
    default = parameter.default
    is_shown = default is not None and default is not False and "Sentinel" not in repr(default)
    shown = getattr(default, "value", default) if is_shown and not callable(default) else ""
    return ", ".join(_code(n) for n in names), _code(shown), _cell(about)


# --- REST


def rest_page() -> str:
    """Every operation of the REST interface."""
    with tempfile.TemporaryDirectory() as folder:
        document = create_app(Settings(data_dir=Path(folder))).openapi()
    schemas = document["components"]["schemas"]
    lines = ["# REST interface", "", "The running service has the same at `/docs`, with forms to"]
    lines += ["try it, and as OpenAPI at `/openapi.json`.", ""]
    by_tag: dict[str, list[tuple[str, str, dict[str, Any]]]] = {}
    for path, operations in document["paths"].items():
        for method in METHODS:
            if method in operations:
                operation = operations[method]
                by_tag.setdefault(operation.get("tags", ["service"])[0], []).append(
                    (method.upper(), path, operation)
                )
    for tag, operations in by_tag.items():
        lines += [f"## {_cell(tag).capitalize()}", ""]
        for method, path, operation in operations:
            lines += _operation(method, path, operation, schemas)
    return "\n".join(lines) + "\n"


def _operation(
    method: str, path: str, operation: dict[str, Any], schemas: dict[str, Any]
) -> list[str]:
    about = operation.get("description") or operation.get("summary", "")
    lines = [f"### `{method} {path}`", "", _prose(about), ""]
    lines += _table(
        ["parameter", "in", "type", "meaning"],
        [
            (
                _code(p["name"]),
                p["in"],
                _cell(_type(p["schema"])),
                _cell(p.get("description") or p["schema"].get("description", "")),
            )
            for p in operation.get("parameters", [])
        ],
    )
    for media, content in operation.get("requestBody", {}).get("content", {}).items():
        schema = _resolved(content.get("schema", {}), schemas)
        required = schema.get("required", ())
        rows = [
            (
                _code(name) + (" (required)" if name in required else ""),
                _cell(_type(field)),
                _cell(field.get("description", "")),
            )
            for name, field in schema.get("properties", {}).items()
        ]
        if rows:
            lines += [f"Body, `{media}`:", *_table(["field", "type", "meaning"], rows)]
    return lines


def _resolved(schema: dict[str, Any], schemas: dict[str, Any]) -> dict[str, Any]:
    inner = schema.get("oneOf") or schema.get("anyOf") or [schema]
    reference = inner[0].get("$ref", "").rpartition("/")[2]
    return schemas[reference] if reference else inner[0]


def _type(schema: dict[str, Any]) -> str:
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    if "const" in schema:
        return str(schema["const"])
    if "enum" in schema:
        return ", ".join(map(str, schema["enum"]))
    for key in ("anyOf", "oneOf", "allOf"):
        if key in schema:
            return " or ".join(dict.fromkeys(_type(inner) for inner in schema[key]))
    if schema.get("type") == "array" and "items" in schema:
        return f"list of {_type(schema['items'])}"
    if patterns := schema.get("patternProperties"):
        return f"by name: {' or '.join(map(_type, patterns.values()))}"
    return str(schema.get("format") or schema.get("type", "any"))


# --- settings, metrics, effects, roles


def settings_page() -> str:
    """Every setting with its default and meaning, by group."""
    lines = ["# Settings", "", "Settings come from the environment, or from a file `.env` in the"]
    lines += ["working folder. Service and workers need the same ones.", ""]
    for group in settings_module._SettingsGroup.__subclasses__():
        if group is Settings:
            continue
        lines += [f"## {_cell((group.__doc__ or '').rstrip('.'))}", ""]
        rows = []
        for name, field in group.model_fields.items():
            value = field.get_default(call_default_factory=True)
            shown = "" if value is None or value is PydanticUndefined else _default(value)
            rows.append(
                (_code(f"HELIOTWIN_{name.upper()}"), _code(shown), _cell(field.description or ""))
            )
        lines += _table(["setting", "default", "meaning"], rows)
    return "\n".join(lines) + "\n"


def _default(value: object) -> str:
    if isinstance(value, dict):
        return "see the meaning"
    return f"{value:g}" if isinstance(value, float) else str(value)


def metrics_page() -> str:
    """Every metric of the service, with its labels."""
    with tempfile.TemporaryDirectory() as folder:
        runtime = Runtime.from_settings(
            Settings(data_dir=Path(folder)),
            SimpleNamespace(),  # type: ignore[arg-type]
        )
        runtime.database.upgrade()
        try:
            families = sorted(
                registry(runtime, FieldOverviewCache(runtime)).collect(), key=lambda f: f.name
            )
        finally:
            runtime.close()
    lines = ["# Metrics", "", "`GET /metrics` and the port `HELIOTWIN_METRICS_PORT` report these."]
    own = [f for f in families if f.name.startswith("heliotwin")]
    lines += _table(
        ["metric", "type", "meaning"],
        [
            (
                _code(f"{f.name}_total" if f.type == "counter" else f.name),
                f.type,
                _cell(f.documentation),
            )
            for f in own
        ],
    )
    lines += [
        "The metrics `process_*` and `python_*` of Prometheus's client are there as well.",
        "",
    ]
    return "\n".join(lines) + "\n"


def effects_page() -> str:
    """Every effect of the catalogue: parameters, physics, and what it is confused with."""
    lines = [
        "# Effects",
        "",
        "The catalogue in the order of the light's path. Names and parameters",
    ]
    lines += ["are those of `twin.json`, of reports and of REST.", ""]
    for name, effect in CATALOGUE.items():
        module = inspect.getmodule(effect)
        lines += [f"## {name}", "", _prose(effect.about), ""]
        lines += _table(
            ["parameter", "neutral", "from", "to", "unit", "has one value for"],
            [
                (
                    _code(f.name),
                    *(f"{f.metadata[key]:g}" for key in ("neutral", "low", "high")),
                    f.metadata["unit"],
                    {"set": "all measurements"}.get(
                        f.metadata["owner"], f"each {f.metadata['owner']}"
                    ),
                )
                for f in dataclasses.fields(effect)
                if "owner" in f.metadata
            ],
        )
        lines += [*_sections(inspect.getdoc(module) or ""), ""]
    return "\n".join(lines) + "\n"


def _sections(docstring: str) -> Iterator[str]:
    """The sections of an effect's docstring: a title, then indented text."""
    for title, body in re.findall(r"^(\S.*)\n((?:(?: {4}.*)?\n?)+)", docstring, re.MULTILINE):
        text = inspect.cleandoc(body)
        if not text:
            continue
        yield f"**{title.strip()}.**"
        yield ""
        for index, part in enumerate(re.split(r"::\n", text)):
            if index == 0:
                yield _prose(part) + (":" if "::\n" in text else "")
            else:
                code = re.match(r"(?:\n|    .*\n?)+", part)
                block = code.group(0) if code else ""
                yield from ("", "```text", inspect.cleandoc(block), "```", "")
                yield _prose(part[len(block) :])
        yield ""


def roles_page() -> str:
    """What each role of a key may do."""
    source = inspect.getsource(Role)
    found = re.findall(r'= "(\w+)"\n    """((?:.|\n)*?)"""', source)
    lines = ["# Roles", "", "Each role includes the roles before it."]
    lines += _table(["role", "may"], [(_code(name), _cell(about)) for name, about in found])
    return "\n".join(lines) + "\n"


def plant_schema_page() -> str:
    """Every key of ``plant.yaml``, by part."""
    schema: Any = json_schema()
    parts = schema.pop("$defs")
    lines = ["# Keys of plant.yaml", "", _prose(schema["description"]), ""]
    lines += ["`heliotwin plant schema` prints the same as a JSON schema.", ""]
    for name, part in {"plant.yaml": schema, **parts}.items():
        lines += [f"## {name}", ""] + ([] if part is schema else [_prose(part["description"]), ""])
        required = part.get("required", ())
        lines += _table(
            ["key", "type", "default", "meaning"],
            [
                (
                    _code(key),
                    _cell(_type(field)),
                    "required" if key in required else _code(_plain_default(field)),
                    _cell(field.get("description", "")),
                )
                for key, field in part["properties"].items()
            ],
        )
    return "\n".join(lines) + "\n"


def _plain_default(field: dict[str, Any]) -> str:
    value = field.get("default", {})
    return "" if value == {} or isinstance(value, dict) else _default(value)


def notebook_page(name: str) -> str:
    """A notebook with its recorded outputs as a page; `docs.run_notebooks` records them."""
    parts = []
    for cell in recorded(name):
        parts.append(f"```python\n{cell.source}\n```" if cell.is_code else cell.source)
        parts += [f"```text\n{cell.text}\n```"] if cell.text else []
        parts += [f"![Picture of this cell](../../images/notebooks/{one})" for one in cell.pictures]
    ipynb = f'<a href="../../notebooks/{name}.ipynb" download>{name}.ipynb</a>'
    parts.append(
        f"The guide has this page as a notebook: {ipynb}. Its source is `docs/notebooks/{name}.py`."
    )
    return "\n\n".join(parts) + "\n"


PAGES: Pages = {
    "cli": command_page,
    "rest": rest_page,
    "settings": settings_page,
    "metrics": metrics_page,
    "effects": effects_page,
    "roles": roles_page,
    "plant-schema": plant_schema_page,
    "python-api": partial(python_api_page, _prose),
    **{name: partial(notebook_page, name) for name in NAMES},
}
"""Name of each page, and the function that writes it."""


if __name__ == "__main__":
    write_pages(FOLDER)
