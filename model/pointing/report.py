"""Calibrated mounts as JSON, and back: MOUNTS.json of the command line, documents of the store."""

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect, effect_to_json, in_light_order
from model.errors import InvalidInputError
from model.pointing.clock import Clock
from model.pointing.covariates import Explained
from model.pointing.drives import Noise
from model.pointing.field import FieldMounts
from model.pointing.kinematics import NAMES, PARAMETERS
from model.pointing.mounts import CalibratedMount, Step
from model.pointing.readings import Reading
from model.pointing.reasons import Contradiction

Array = NDArray[np.float64]

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

# Standard deviations that make a drift sure.
_SURE = 3.0

_DIGITS = 9  # of radians and metres: far below what a step of a motor does


def day_of(moment: datetime | None) -> float:
    """Days [d] since 1970, as readings have them; NaN without a moment."""
    return float("nan") if moment is None else (moment - _EPOCH).total_seconds() / 86400


def moment_of(day: float) -> datetime:
    """When that was, to the second."""
    return _EPOCH + timedelta(seconds=round(day * 86400))


def sun_to_json(effects: Iterable[Effect]) -> list[dict[str, Any]]:
    """Those of a model's effects that move the sun, as JSON: a mount holds under the sun it was calibrated under."""
    return [effect_to_json(one) for one in in_light_order(effects) if type(one).on_sun is not Effect.on_sun]


def parameters_to_json(mount: CalibratedMount) -> dict[str, Any]:
    """Every parameter with its unit, its spread before and after, and whether the data determine it."""
    rows = zip(PARAMETERS, mount.parameters, mount.spread, mount.prior_spread, mount.determined, strict=True)
    return {
        parameter.name: {
            "value": _rounded(value),
            "std": _rounded(spread),
            "prior_std": _rounded(prior),
            "unit": parameter.unit,
            "determined": bool(determined),
        }
        for parameter, value, spread, prior, determined in rows
    }


def mount_to_json(
    mount: CalibratedMount,
    readings: Sequence[Reading],
    contradictions: Mapping[str, Contradiction],
    effects: Iterable[Effect] = (),
) -> dict[str, Any]:
    """A mount as JSON, with what it was made of; ``readings`` in order of time, their suns as ``effects`` move them."""
    believed = 1e3 * mount.off[~mount.foreign]
    return {
        "valid_from": _begin(mount),
        "sun": sun_to_json(effects),
        "measurements": len(readings),
        "residual_mrad": {
            "median": round(float(np.median(believed)), 3) if believed.size else None,
            "p90": round(float(np.percentile(believed, 90)), 3) if believed.size else None,
        },
        "parameters": parameters_to_json(mount),
        "steps": [
            {
                "after": readings[step.before].name,
                "before": readings[step.after].name,
                "from": _iso(mount.days[step.before]),
                "to": _iso(mount.days[step.after]),
                "zeros_mrad": _rounded(1e3 * step.zeros, 3),
                "std_mrad": _rounded(1e3 * step.std, 3),
                "motor_steps": _rounded(step.motors, 1),
                **dict(zip(("change", "detail"), mount.change(step), strict=True)),
            }
            for step in mount.steps
        ],
        "drift": _drift(mount),
        "outliers": {name: vars(one) | {"off_mrad": round(one.off_mrad, 2)} for name, one in contradictions.items()},
        "covariance": _rounded(mount.covariance, 14),
        "history": {
            "at": [_iso(day) for day in mount.days],
            **{name: _rounded(getattr(mount, name)) for name in ("drift", "jitter", "stepped", "residuals")},
            "foreign": np.nonzero(mount.foreign)[0].tolist(),
        },
    }


def _begin(mount: CalibratedMount) -> str | None:
    """Since when the newest state holds: the last step, or the first measurement."""
    if not len(mount.days):
        return None
    return _iso(mount.days[mount.steps[-1].after if mount.steps else 0])


def _drift(mount: CalibratedMount) -> dict[str, Any]:
    """How far the zeros went slowly from the first measurement to the newest, beside all steps."""
    gone = mount.drift[-1] - mount.drift[0] if len(mount.days) else np.zeros(2)
    return {
        "zeros_mrad": _rounded(1e3 * gone, 3),
        "std_mrad": _rounded(1e3 * mount.drifted_std, 3),
        "is_sure": bool((np.abs(gone) > _SURE * np.maximum(mount.drifted_std, 1e-9)).any()),
    }


def parameters_from_json(document: Any, where: str) -> Array:
    """The parameters (P,) of a document that `mount_to_json` wrote: all but how its drives' zeros went in time."""
    try:
        return np.array([document["parameters"][name]["value"] for name in NAMES], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise _no_mount(where, error) from None


def _no_mount(where: str, error: Exception) -> InvalidInputError:
    what = f"{error} is missing" if isinstance(error, KeyError) else "a field of it has another form"
    return InvalidInputError(f"{where}: no calibrated mount as `heliotwin calibrate` writes it; {what}")


def mount_from_json(document: Any, where: str, noise: Noise | None = None) -> CalibratedMount:
    """The mount of a document that `mount_to_json` wrote; `InvalidInputError` for any other."""
    try:
        history = document["history"]
        days = np.array([day_of(datetime.fromisoformat(moment)) for moment in history["at"]], dtype=np.float64)
        count = len(days)
        values = {
            name: np.array(history[name], dtype=np.float64).reshape(count, 2)
            for name in ("drift", "jitter", "stepped", "residuals")
        }
        foreign = np.isin(np.arange(count), history["foreign"])
        entries = [document["parameters"][name] for name in NAMES]
        parameters, spread, prior = (np.array([e[key] for e in entries]) for key in ("value", "std", "prior_std"))
        covariance = np.array(document["covariance"], dtype=np.float64).reshape(len(NAMES), len(NAMES))
        by_moment = {moment: place for place, moment in enumerate(history["at"])}
        steps = tuple(
            Step(
                by_moment[step["from"]],
                by_moment[step["to"]],
                1e-3 * np.array(step["zeros_mrad"]),
                1e-3 * np.array(step["std_mrad"]),
                np.array(step["motor_steps"]),
            )
            for step in document["steps"]
        )
        drifted = 1e-3 * np.array(document["drift"]["std_mrad"], dtype=np.float64).reshape(2)
        finite = all(np.isfinite(value).all() for value in (*values.values(), parameters, covariance, drifted))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _no_mount(where, error) from None
    if not finite:
        raise InvalidInputError(f"{where}: a calibrated mount has finite numbers only")
    return CalibratedMount(
        parameters=parameters,
        covariance=covariance,
        spread=spread,
        prior_spread=prior,
        drifted_std=drifted,
        days=days,
        foreign=foreign,
        steps=steps,
        noise=noise or Noise(),
        **values,
    )


def field_to_json(done: FieldMounts, skipped: Mapping[str, str], effects: Sequence[Effect] = ()) -> dict[str, Any]:
    """MOUNTS.json: the field's prior, each mount, and what was left out with the reasons."""
    means, spreads = done.field.mean, np.sqrt(np.diag(done.field.covariance))
    return {
        "parameters": {
            p.name: {"unit": p.unit, "about": p.about, "field_mean": _rounded(mean), "field_std": _rounded(spread)}
            for p, mean, spread in zip(PARAMETERS, means, spreads, strict=True)
        },
        "heliostats": {
            name: mount_to_json(mount, done.readings[name], done.contradictions[name], effects)
            | ({"note": _ODD} if name in done.odd else {})
            for name, mount in done.mounts.items()
        },
        "clock": clock_to_json(done.clock),
        "covariates": {name: _covariate(one) for name, one in done.covariates.items()},
        "skipped": dict(skipped),
    }


def clock_to_json(clock: Clock | None) -> dict[str, Any] | None:
    """A fault of the clock: minutes that the sun stood later than recorded, since a day."""
    if clock is None:
        return None
    since = moment_of(clock.since).date().isoformat()
    return {"minutes": round(clock.minutes, 2), "std_minutes": round(clock.std_minutes, 2), "since": since}


def _covariate(one: Explained) -> dict[str, Any]:
    """How many measurements tell it, and the shares of squared errors that it explains; None where too few do."""
    shares = {way: {"value": round(value, 4), "ci95": _rounded(one.ci95[way], 4)} for way, value in one.share.items()}
    return {"measurements": one.measurements, "share": shares or None}


def clock_in_words(document: Mapping[str, Any]) -> str:
    """The same in words."""
    minutes = document["minutes"]
    way = "slow" if minutes > 0 else "fast"
    return (
        f"from {document['since']} on the clock was {abs(minutes):.1f} ± {document['std_minutes']:.1f} minutes {way}: "
        "that explains where the light of most heliostats went"
    )


_ODD = "its property file has spindles of another length than all others; the field's median was the start"


def _iso(day: float) -> str:
    return moment_of(float(day)).isoformat()


def _rounded(value: Any, digits: int = _DIGITS) -> Any:
    return np.round(np.asarray(value, dtype=np.float64), digits).tolist()
