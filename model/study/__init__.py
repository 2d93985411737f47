"""The closed loop: find the physical effects that photographs demand and the model lacks, and their
gain.

    study_to_json(study(flux_images, model))

The modules in the order of the data: `flux_images` (measured images and their forecasts),
`parameters` (effects as a vector), `fitting` (least squares), `trials` (fit one part, forecast the
held-out part), `scopes` and `scope_search` (when and where an effect acts), `judging` and
`selection` (gains on held-out images), `loop`, `generic_terms` and `discrepancy` (what has no
name), `halves` (what drifts is no cause), `outcome` and `report`.
"""

from model.study.flux_images import FluxImage
from model.study.loop import study
from model.study.outcome import Study
from model.study.report import conclude, study_to_json
from model.study.trials import StudyOptions

__all__ = ["FluxImage", "Study", "StudyOptions", "conclude", "study", "study_to_json"]
