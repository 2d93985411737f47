"""The closed loop: the physical effect that photographs demand and the model lacks, and what it buys.

    study(flux_images, optics, effects).to_json()

`flux_images` holds the data and cuts them for comparison, `unknowns` turns effects into numbers to be fitted, `fitting`
fits them, `judging` decides with images that no fit has seen, `loop` adds effect after effect, `report` says it.
"""

from model.study.flux_images import FluxImage
from model.study.loop import StudyOptions, study
from model.study.report import Study

__all__ = ["FluxImage", "Study", "StudyOptions", "study"]
