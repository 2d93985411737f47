"""Convert calibrated mounts to JSON and back: MOUNTS.json, and documents of the store."""

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect, effect_to_json, in_light_order
from model.errors import InvalidInputError
from model.pointing.clock import ClockFault
from model.pointing.covariates import ExplainedShare
from model.pointing.drives import Noise
from model.pointing.field import FieldMounts
from model.pointing.kinematics import NAMES, PARAMETERS
from model.pointing.mounts import CalibratedMount, PredictedError, Step, cause_of
from model.pointing.readings import Reading
from model.pointing.reasons import Contradiction
from model.times import format_time

Array = NDArray[np.float64]

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

# Standard deviations of a significant drift.
_SIGNIFICANT = 3.0

_DIGITS = 9  # of radians and metres: far below the effect of a motor step


def day_of(moment: datetime | None) -> float:
    """Return days [d] since 1970, as in readings; NaN without a time."""
    return float("nan") if moment is None else (moment - _EPOCH).total_seconds() / 86400


def moment_of(day: float) -> datetime:
    """Return the time of a day [d] since 1970, to the second."""
    return _EPOCH + timedelta(seconds=round(day * 86400))


def sun_to_json(effects: Iterable[Effect]) -> list[dict[str, Any]]:
    """Return the effects that move the sun as JSON: a calibration is valid for its sun."""
    moving = (
        effect for effect in in_light_order(effects) if type(effect).on_sun is not Effect.on_sun
    )
    return [effect_to_json(effect) for effect in moving]


def parameters_to_json(mount: CalibratedMount) -> dict[str, Any]:
    """Return each parameter with its unit, and its standard deviations by posterior and prior."""
    rows = zip(
        PARAMETERS,
        mount.parameters,
        mount.spread,
        mount.prior_spread,
        mount.determined,
        strict=True,
    )
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
    """Return a mount with its ``readings`` in order of time; ``effects`` moved their suns."""
    return {
        "valid_from": _begin(mount),
        "sun": sun_to_json(effects),
        "measurements": len(readings),
        "undated": mount.n_undated,
        "predicted_error_mrad": _prediction(mount),
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
                "change": cause_of(step, mount).code,
                "detail": cause_of(step, mount).detail,
            }
            for step in mount.steps
        ],
        "drift": _drift(mount),
        "outliers": {
            name: {"reason": one.reason, "detail": one.detail, "off_mrad": round(one.error_mrad, 2)}
            for name, one in contradictions.items()
        },
        "covariance": _rounded(mount.covariance, 14),
        "history": {
            "at": [None if np.isnan(day) else _iso(day) for day in mount.days],
            **{
                name: _rounded(getattr(mount, name))
                for name in ("drift", "jitter", "stepped", "residuals")
            },
            "predicted": [None if np.isnan(e) else _rounded(e) for e in mount.predicted],
            "foreign": np.nonzero(mount.foreign)[0].tolist(),
        },
    }


def _prediction(mount: CalibratedMount) -> dict[str, Any]:
    """Describe the predicted pointing error; null if too few measurements are predicted."""
    found = mount.prediction
    if found is None:
        count = int(np.isfinite(mount.predicted).sum())
        return {"median": None, "ci90": None, "measurements": count}
    return {
        "median": _rounded(1e3 * found.median, 3),
        "ci90": _rounded([1e3 * found.low, 1e3 * found.high], 3),
        "measurements": found.measurements,
    }


def _prediction_from_json(document: Any) -> PredictedError | None:
    """Read a document of `_prediction`."""
    if document["median"] is None:
        return None
    low, high = document["ci90"]
    return PredictedError(
        1e-3 * document["median"], 1e-3 * low, 1e-3 * high, document["measurements"]
    )


def _begin(mount: CalibratedMount) -> str | None:
    """Return the time of the last step, or of the first measurement; None if no time is known."""
    if mount.until is None:
        return None
    return _iso(mount.days[mount.steps[-1].after if mount.steps else mount.n_undated])


def _drift(mount: CalibratedMount) -> dict[str, Any]:
    """Describe the drift of the zeros from the first measurement to the newest."""
    drift = np.zeros(2) if mount.until is None else mount.drift[-1] - mount.drift[mount.n_undated]
    return {
        "zeros_mrad": _rounded(1e3 * drift, 3),
        "std_mrad": _rounded(1e3 * mount.drifted_std, 3),
        "is_sure": bool((np.abs(drift) > _SIGNIFICANT * np.maximum(mount.drifted_std, 1e-9)).any()),
    }


def parameters_from_json(document: Any, where: str) -> Array:
    """Read the parameters (P,) from a document of `mount_to_json`."""
    try:
        return np.array([document["parameters"][name]["value"] for name in NAMES], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise _format_error(where, error) from None


def _format_error(where: str, error: Exception) -> InvalidInputError:
    fault = f"{error} is missing" if isinstance(error, KeyError) else "a field has another form"
    return InvalidInputError(f"{where}: not a calibrated mount of `heliotwin calibrate`: {fault}")


def mount_from_json(document: Any, where: str) -> CalibratedMount:
    """Read a mount from a document of `mount_to_json`; `InvalidInputError` for any other."""
    try:
        history = document["history"]
        times = [
            None if moment is None else datetime.fromisoformat(moment) for moment in history["at"]
        ]
        days = np.array([day_of(time) for time in times], dtype=np.float64)
        count = len(days)
        values = {
            name: np.array(history[name], dtype=np.float64).reshape(count, 2)
            for name in ("drift", "jitter", "stepped", "residuals")
        }
        foreign = np.isin(np.arange(count), history["foreign"])
        predicted = np.array(history["predicted"], dtype=np.float64).reshape(count)
        prediction = _prediction_from_json(document["predicted_error_mrad"])
        entries = [document["parameters"][name] for name in NAMES]
        parameters, spread, prior = (
            np.array([e[key] for e in entries]) for key in ("value", "std", "prior_std")
        )
        covariance = np.array(document["covariance"], dtype=np.float64).reshape(
            len(NAMES), len(NAMES)
        )
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
        finite = all(
            np.isfinite(value).all()
            for value in (*values.values(), parameters, covariance, drifted)
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _format_error(where, error) from None
    if not finite:
        raise InvalidInputError(f"{where}: a calibrated mount must have finite numbers only")
    return CalibratedMount(
        parameters=parameters,
        covariance=covariance,
        spread=spread,
        prior_spread=prior,
        drifted_std=drifted,
        days=days,
        foreign=foreign,
        steps=steps,
        predicted=predicted,
        prediction=prediction,
        noise=Noise(),
        **values,
    )


def field_to_json(
    done: FieldMounts, skipped: Mapping[str, str], effects: Sequence[Effect] = ()
) -> dict[str, Any]:
    """Return MOUNTS.json: the field's prior, each mount, and skipped heliostats with reasons."""
    means, spreads = done.prior.mean, np.sqrt(np.diag(done.prior.covariance))
    return {
        "parameters": {
            p.name: {
                "unit": p.unit,
                "about": p.about,
                "field_mean": _rounded(mean),
                "field_std": _rounded(spread),
            }
            for p, mean, spread in zip(PARAMETERS, means, spreads, strict=True)
        },
        "heliostats": {
            name: (
                mount_to_json(mount, done.readings[name], done.contradictions[name], effects)
                | ({"note": _UNUSUAL} if name in done.unusual else {})
            )
            for name, mount in done.mounts.items()
        },
        "clock": clock_to_json(done.clock),
        "covariates": {name: _covariate(one) for name, one in done.covariates.items()},
        "skipped": dict(skipped),
    }


def clock_to_json(clock: ClockFault | None) -> dict[str, Any] | None:
    """Return a clock fault: minutes from the recorded sun to the true one, since a day."""
    if clock is None:
        return None
    since = moment_of(clock.since).date().isoformat()
    return {
        "minutes": round(clock.minutes, 2),
        "std_minutes": round(clock.std_minutes, 2),
        "since": since,
    }


def _covariate(one: ExplainedShare) -> dict[str, Any]:
    """Return the number of measurements, and the shares of squared errors if there are any."""
    shares = {
        way: {"value": round(value, 4), "ci95": _rounded(one.ci95[way], 4)}
        for way, value in one.share.items()
    }
    return {"measurements": one.measurements, "share": shares or None}


def clock_in_words(document: Mapping[str, Any]) -> str:
    """Describe the clock fault of `clock_to_json` in a sentence."""
    minutes = document["minutes"]
    way = "slow" if minutes > 0 else "fast"
    return (
        f"from {document['since']} on the clock was {abs(minutes):.1f} ±"
        f" {document['std_minutes']:.1f} minutes {way}: this explains the spots of most heliostats"
    )


_UNUSUAL = (
    "its property file has spindles of unusual length; the calibration started from the field's"
    " median"
)


def _iso(day: float) -> str:
    return format_time(moment_of(float(day)))


def _rounded(value: Any, digits: int = _DIGITS) -> Any:
    return np.round(np.asarray(value, dtype=np.float64), digits).tolist()
