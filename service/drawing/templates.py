"""Templates of pages and reports, with their formats of numbers and times."""

import re
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from importlib.resources import files
from typing import Any, Self
from urllib.parse import quote
from zoneinfo import ZoneInfo

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from model.times import format_time

ASSETS = files("service.drawing").joinpath("static")
"""Styles and scripts."""

# Typographic thousands separator and minus sign.
_SIGNS = {ord(","): "\N{NARROW NO-BREAK SPACE}", ord("-"): "\N{MINUS SIGN}"}


class Quantity(str):
    """A formatted number, with its ``value`` (None if unknown) and ``unit`` for tables as CSV."""

    value: float | None
    unit: str

    def __new__(cls, text: str, value: float | None, unit: str) -> Self:
        """Combine them."""
        made = super().__new__(cls, text)
        made.value, made.unit = value, unit
        return made


def figure(value: float | None, digits: int = 2, unit: str = "") -> Quantity:
    """A number with its unit; a dash for None."""
    if value is None:
        return Quantity("–", None, unit)
    # Adding zero turns -0 into 0.
    text = f"{round(value, digits) + 0.0:,.{digits}f}".translate(_SIGNS)
    space = "\N{NO-BREAK SPACE}" * (unit not in ("", "°"))
    return Quantity(f"{text}{space}{unit}", float(value), unit)


def percent(value: float | None, digits: int = 1) -> Quantity:
    """A share in percent."""
    return figure(None if value is None else value * 100, digits, "%")


def moment(value: datetime | None, zone: str = "UTC") -> str | Markup:
    """A time in a ``zone``; a dash if it is unknown, which includes 1970 and before."""
    if value is None or value.year <= 1970:
        return "–"
    return Markup('<time datetime="{}">{}</time>').format(
        format_time(value.astimezone(UTC)), in_zone(zone)(value)
    )


def form_time(value: datetime | None, zone: str = "UTC") -> str:
    """A time in a ``zone`` for a form's field, to the second if it has seconds.

    The second of two equal times, when clocks are set back, has its offset.
    """
    if value is None:
        return ""
    local = value.astimezone(ZoneInfo(zone))
    seconds = f":{local:%S}" if local.second else ""
    return f"{local:%Y-%m-%d %H:%M}{seconds}{f'{local:%z}' if local.fold else ''}"


def in_zone(zone: str | None) -> Callable[[datetime], str]:
    """A function that formats a time in a zone of the tz database.

    Without a zone, it returns an empty text.
    """
    return lambda value: (
        "" if zone is None else f"{value.astimezone(ZoneInfo(zone)):%Y-%m-%d %H:%M %Z}"
    )


_UTC_TIME = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d(:\d\d)?( UTC|Z)")


def times_in_zone(text: str, zone: str = "UTC") -> str:
    """A text whose times in UTC, such as ``2026-06-21 11:00 UTC``, are in a ``zone`` instead."""
    in_text = in_zone(zone)
    return _UTC_TIME.sub(
        lambda found: in_text(datetime.fromisoformat(found[0].replace(" UTC", "Z"))), text
    )


_PREFIXES = (("T", 1e12), ("G", 1e9), ("M", 1e6), ("k", 1e3))


def prefixed(value: float | None, unit: str) -> Quantity:
    """A number in three figures with a prefix of its unit, such as 355 MW; whole below 1000."""
    if value is None:
        return figure(None, unit=unit)
    rounded = float(f"{value:.3g}")
    prefix, size = next((one for one in _PREFIXES if abs(rounded) >= one[1]), ("", 0.0))
    text = _three_figures(rounded / size, prefix + unit) if size else figure(value, 0, unit)
    return Quantity(text, float(value), unit)


def _three_figures(value: float, unit: str) -> Quantity:
    """With three decimals at most, and all digits from 1000 on."""
    ends = enumerate((100.0, 10.0, 1.0))
    rounded = abs(float(f"{value:.3g}"))
    digits = next((n for n, least in ends if rounded >= least), 3) if value else 0
    return figure(value, digits, unit)


def irradiance(watts_m2: float | None) -> Quantity:
    """A flux in kW/m²; its ``value`` for tables as CSV is in W/m²."""
    if watts_m2 is None:
        return figure(None, unit="W/m²")
    return Quantity(_three_figures(watts_m2 / 1e3, "kW/m²"), float(watts_m2), "W/m²")


def quantity(name: str, value: float) -> Quantity:
    """A number in the unit at the end of its ``name``; shares and areas in three figures."""
    if name.endswith("_w_m2"):
        return irradiance(value)
    if name.endswith("_w"):
        return prefixed(value, "W")
    return _three_figures(value, "m²" if name.endswith("_m2") else "")


def lasting(seconds: float) -> str:
    """A rounded duration in s, min or h."""
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= 1.5 * length:
            return figure(seconds / length, 0, unit)
    return figure(max(seconds, 1.0), 0, "s")


def in_words(value: Any) -> str:
    """A value in words, without braces and quotes; a dash for None."""
    if value is None:
        return "–"
    if isinstance(value, dict):
        return ", ".join(
            f"{name.replace('_', ' ')} {in_words(inner)}" for name, inner in value.items()
        )
    if isinstance(value, list):
        return ", ".join(in_words(inner) for inner in value)
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


CORRECTION = "correction (no cause)"
"""What people read of an adopted discrepancy, so that nobody takes it for a cause."""


def effect_label(name: str) -> str:
    """The name of an effect in words."""
    return CORRECTION if name == "correction" else name.replace("_", " ")


def model_in_words(version: str) -> str:
    """A version of the plant's model in words; ``2:sun_shape+soiling`` is an example."""
    number, _, effects = version.partition(":")
    named = ", ".join(map(effect_label, effects.split("+")))
    names = "no effects" if effects == "none" else named
    return f"version {number}, {names}"


def environment(*packages: str) -> Environment:
    """Jinja environment with the templates of these packages and the filters above.

    If two packages have the same template, the first package counts.
    """
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
        form_time=form_time,
        plant_times=times_in_zone,
        power=partial(prefixed, unit="W"),
        energy=partial(prefixed, unit="Wh"),
        irradiance=irradiance,
        lasting=lasting,
        storage=partial(prefixed, unit="B"),
        in_words=in_words,
        model_in_words=model_in_words,
        path=lambda value: quote(value, ""),
        effect_label=effect_label,
        words=lambda name: name.replace("_", " "),
    )
    return made


TEMPLATES = environment("service.drawing")
"""The template of a study's report."""
