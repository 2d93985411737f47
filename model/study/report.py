"""The report of a study: its conclusion in sentences, and its JSON (DESIGN.md, section 7)."""

from typing import Any

import numpy as np

from model.covariates import covariates_of
from model.study.advice import photographs_to_distinguish
from model.study.judging import gain_to_json, rank_correlation
from model.study.outcome import Array, Candidate, Found, Study


def conclude(study: Study) -> str:
    """Conclude in a sentence, with others about a pattern and about images that do not judge."""
    conclusion = _verdict_in_words(study)
    if study.has_unexplained_error and study.is_pattern:
        conclusion += (
            " What is left is the target's own pattern, its marks and grid lines:"
            f" {study.pattern.depth:.1%} of the light, at the same places of the target in all"
            " photographs."
        )
    if hot_share := float(np.mean([image.hot_share for image in study.images])):
        conclusion += (
            f" Hot or dead pixels have {hot_share:.1%} of the light; the study took them"
            " from their neighbours. Repair or mask them in the camera."
        )
    if not (seen := _n_in_sample(study)):
        return conclusion
    return (
        f"{conclusion} {seen} of the {len(study.images)} images that judge are among"
        " those that the surfaces were predicted from, which flatters both accuracies: predict from"
        " fewer, or take more."
    )


def _n_in_sample(study: Study) -> int:
    """Number of the images that judge and that surfaces were predicted from."""
    return sum(image.seen for image in study.images)


def _verdict_in_words(study: Study) -> str:
    before, after = float(study.accuracy_before.mean()), float(study.accuracy_after.mean())
    names = " and ".join(found.described for found in study.found)
    if study.verdict == "effect":
        pairs = [
            f"{found.plain_name} from {', '.join(found.lookalikes).replace('_', ' ')}"
            for found in study.found
            if found.lookalikes
        ]
        lookalikes = f"; these images cannot distinguish {' nor '.join(pairs)}" if pairs else ""
        rest = (
            f"; {study.unexplained_share:.0%} of the error beyond noise stays unexplained"
            if study.has_unexplained_error
            else ""
        )
        return (
            f"The images demand {names}: accuracy on held-out images"
            f" {'rises' if after > before else 'goes'} from {before:.1%} to"
            f" {after:.1%}{_position_in_words(study)}{lookalikes}{rest}."
        )
    if study.verdict == "none":
        return (
            f"The declared model explains the images: accuracy {before:.1%}, no effect improves"
            " it significantly."
        )
    part = f"; {names} explains part of it ({after:.1%})" if names else ""
    reasons = f", but {' and '.join(study.contradicted_by)}" if study.contradicted_by else ""
    unnamed = f" {study.discrepancy.in_words()}" if study.discrepancy is not None else ""
    return (
        "Something is missing that no effect of the catalogue explains: accuracy"
        f" {before:.1%}{part}{reasons}{_position_in_words(study)}.{unnamed}"
    )


def _position_in_words(study: Study) -> str:
    error = study.position_error_mrad
    if error is None:
        return ""
    change = f", {error.before:.1f} mrad before" if study.found else ""
    return f", and the light lies {error.after:.1f} mrad from where motors sent it{change}"


def error_covariates(study: Study) -> dict[str, float]:
    """Rank correlations of the error that is left with covariates, the strongest first."""
    error = 1 - study.accuracy_after
    known = covariates_of([p.setup for p in study.images], study.site)
    found = {covariate.name: round(rank_correlation(error, v), 3) for covariate, v in known.items()}
    return dict(sorted(found.items(), key=lambda item: -abs(item[1])))


def residual_map(study: Study) -> Array:
    """Mean of forecast minus measured (64, 64) with the effects found, in shares of peaks."""
    peaks = study.measured.max(axis=(1, 2), keepdims=True)
    return np.asarray(((study.after - study.measured) / peaks).mean(axis=0))


def study_to_json(study: Study) -> dict[str, Any]:
    """The report of DESIGN.md, section 7."""
    error, n_with_motors = study.position_error_mrad, int(study.has_position.sum())
    before, after = _accuracy(study, study.accuracy_before), _accuracy(study, study.accuracy_after)
    if error is not None:
        before["position_error_mrad"] = round(error.before, 3)
        after["position_error_mrad"] = round(error.after, 3)
    return {
        "verdict": study.verdict,
        "conclusion": conclude(study),
        "images": {
            "fit": study.n_fitted,
            "held_out": len(study.images),
            **({"held_out_but_predicted_from": seen} if (seen := _n_in_sample(study)) else {}),
            **({"held_out_with_motors": n_with_motors} if n_with_motors else {}),
        },
        "window_m": study.window,
        "before": before,
        "after": after,
        "noise_floor": round(study.noise_floor, 5),
        "unexplained_share": round(study.unexplained_share, 4),
        "partly": study.partly,
        "discrepancy": _discrepancy(study),
        "effects": [_effect(found) | _whole_gain(study, found) for found in study.found],
        "candidates": [
            {
                "name": candidate.name,
                "accuracy_after": round(candidate.accuracy_after, 5),
                "score": round(candidate.gain.score, 2),
                "accuracy_gain": gain_to_json(candidate.accuracy_gain),
                **_whole_gain(study, candidate),
            }
            for candidate in study.candidates
        ],
        "residual": {
            "covariates": error_covariates(study),
            "pattern": {
                "is_targets": bool(study.is_pattern),
                "on_target": round(float(study.pattern.on_target), 4),
                "on_spot": round(float(study.pattern.on_spot), 4),
                "depth": round(float(study.pattern.depth), 5),
            },
            "sign": "forecast minus photograph",
            "mean_map_8x8": (
                residual_map(study).reshape(8, 8, 8, 8).mean(axis=(1, 3)).round(4).tolist()
            ),
        },
    }


def _discrepancy(study: Study) -> dict[str, Any] | None:
    found = study.discrepancy
    if found is None:
        return None
    return found.to_json() | {"per_image": _accuracy(study, found.accuracy)["per_image"]}


def _accuracy(study: Study, accuracy: Array) -> dict[str, Any]:
    return {
        "accuracy_mean": round(float(accuracy.mean()), 5),
        "accuracy_median": round(float(np.median(accuracy)), 5),
        "per_image": {
            p.key: round(float(a), 5) for p, a in zip(study.images, accuracy, strict=True)
        },
    }


def _whole_gain(study: Study, effect: Candidate | Found) -> dict[str, Any]:
    """The gain by shape and position, if a position is known."""
    return {"gain": gain_to_json(effect.gain)} if study.has_position.any() else {}


def _effect(found: Found) -> dict[str, Any]:
    return {
        "name": found.name,
        "scope": found.scope,
        "parameters": found.parameters,
        "accuracy_gain": gain_to_json(found.accuracy_gain),
        "lookalikes": found.lookalikes,
        "told_apart_by": {
            name: photographs_to_distinguish(found.name, name) for name in found.lookalikes
        },
    }
