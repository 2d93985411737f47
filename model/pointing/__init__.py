"""Calibrate mounts by motors and spots: parameters, steps, drift, and where the light lands."""

from model.pointing.calibration import FieldPrior
from model.pointing.clock import ClockFault
from model.pointing.drives import Noise
from model.pointing.field import FieldMounts, calibrate_field
from model.pointing.kinematics import PARAMETERS
from model.pointing.mounts import CalibratedMount, Step
from model.pointing.readings import Reading, Weather
from model.pointing.reasons import Contradiction, pointing_error

__all__ = [
    "PARAMETERS",
    "CalibratedMount",
    "ClockFault",
    "Contradiction",
    "FieldMounts",
    "FieldPrior",
    "Noise",
    "Reading",
    "Step",
    "Weather",
    "calibrate_field",
    "pointing_error",
]
