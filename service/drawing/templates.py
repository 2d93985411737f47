"""The templates of pages and reports, and how both write numbers and moments."""

from collections.abc import Callable
from datetime import UTC, datetime
from importlib.resources import files
from typing import Any
from urllib.parse import quote
from zoneinfo import ZoneInfo

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

ASSETS = files("service.drawing").joinpath("static")
"""Styles and scripts."""

# How print separates thousands and writes a minus.
_SIGNS = {ord(","): "\N{NARROW NO-BREAK SPACE}", ord("-"): "\N{MINUS SIGN}"}


def figure(value: float | None, digits: int = 2, unit: str = "") -> str:
    """A number with its unit; a dash where there is none."""
    if value is None:
        return "–"
    # Adding zero takes the sign from what rounds to it.
    text = f"{round(value, digits) + 0.0:,.{digits}f}".translate(_SIGNS)
    return f"{text}\N{NO-BREAK SPACE}{unit}" if unit else text


def percent(value: float | None, digits: int = 1) -> str:
    """A share in percent."""
    return figure(None if value is None else value * 100, digits, "%")


def moment(value: datetime | None) -> str | Markup:
    """A moment in UTC; a dash where it is not known, which 1970 stands for."""
    if value is None or value.year <= 1970:
        return "–"
    utc = value.astimezone(UTC)
    return Markup('<time datetime="{}">{}</time>').format(utc.isoformat(), utc.strftime("%Y-%m-%d %H:%M UTC"))


def in_zone(zone: str | None) -> Callable[[datetime], str]:
    """How a moment is told by the clocks of a zone of the tz database; nothing without one."""
    return lambda value: "" if zone is None else f"{value.astimezone(ZoneInfo(zone)):%Y-%m-%d %H:%M %Z}"


def power(watts: float) -> str:
    """A power, in kW where that reads better."""
    return figure(watts / 1e3, 2, "kW") if abs(watts) >= 1000 else figure(watts, 0, "W")


def irradiance(watts_m2: float) -> str:
    """An irradiance, in kW/m² where that reads better."""
    return figure(watts_m2 / 1e3, 2, "kW/m²") if abs(watts_m2) >= 1000 else figure(watts_m2, 0, "W/m²")


def storage(size_bytes: float) -> str:
    """A size on the disk, in the unit that reads best."""
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size_bytes >= size:
            return figure(size_bytes / size, 1, unit)
    return figure(size_bytes, 0, "B")


def in_words(value: Any) -> str:
    """A value as a sentence has it: no braces, no quotes."""
    if isinstance(value, dict):
        return ", ".join(f"{name.replace('_', ' ')} {in_words(inner)}" for name, inner in value.items())
    if isinstance(value, list):
        return ", ".join(in_words(inner) for inner in value)
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def model_in_words(version: str) -> str:
    """A version of the plant's model, ``2:sun_shape+soiling``, as people read it."""
    number, _, effects = version.partition(":")
    told = "no effects" if effects == "none" else ", ".join(effects.replace("_", " ").split("+"))
    return f"version {number}, {told}"


def environment(*packages: str) -> Environment:
    """Templates of these packages, the first one's first, with the filters above."""
    made = Environment(
        loader=ChoiceLoader([PackageLoader(package) for package in packages]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters.update(
        figure=figure,
        percent=percent,
        moment=moment,
        power=power,
        irradiance=irradiance,
        storage=storage,
        in_words=in_words,
        model_in_words=model_in_words,
        path=lambda value: quote(value, ""),
        words=lambda name: name.replace("_", " "),
    )
    return made


TEMPLATES = environment("service.drawing")
"""The template of a study's report."""
