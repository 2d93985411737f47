"""The closed loop: the physical effect that photographs demand and the model lacks, and what it buys.

    study(photographs, optics, effects).to_json()

`photographs` holds the data and cuts them for comparison, `unknowns` turns effects into numbers to be fitted, `fitting`
fits them, `judging` decides with images that no fit has seen, `loop` adds effect after effect, `report` says it.
"""

from model.study.loop import StudyOptions, study
from model.study.photographs import Photograph
from model.study.report import Study

__all__ = ["Photograph", "Study", "StudyOptions", "study"]
