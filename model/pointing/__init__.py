"""Motors and spots to calibrated mounts: their parameters, steps and drift, and where the light lands."""

from model.pointing.calibration import Field
from model.pointing.clock import Clock
from model.pointing.drives import Noise
from model.pointing.field import FieldMounts, calibrate_field
from model.pointing.kinematics import PARAMETERS
from model.pointing.mounts import CalibratedMount, Step
from model.pointing.readings import Reading, Weather, days_by_order
from model.pointing.reasons import Contradiction, off_by

__all__ = [
    "PARAMETERS",
    "CalibratedMount",
    "Clock",
    "Contradiction",
    "Field",
    "FieldMounts",
    "Noise",
    "Reading",
    "Step",
    "Weather",
    "calibrate_field",
    "days_by_order",
    "off_by",
]
