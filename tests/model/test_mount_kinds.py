"""Mounts and drives of every kind: calibrated from motors and spots whose truth is known.

Readings are made by `Mount`, which shares nothing with the calibration's kinematic chain.
"""

from dataclasses import replace

import numpy as np
import pytest

from model.actuator import LinearActuator, RotaryActuator
from model.frames import sun_direction
from model.heliostat_type import MOUNT_KINDS, HeliostatType, MountDesign, facet_grid
from model.mount import rotation
from model.plant import Heliostat, TargetPlane
from model.pointing import CalibratedMount, Reading, calibrate_field, pointing_error
from model.pointing.kinematics import NAMES, KinematicChain, apply_parameters, residuals
from model.pointing.readings import pad_readings
from model.site import JUELICH

TARGET = TargetPlane(
    "target", np.array([0.0, 0, 60.0]), np.array([0, 1.0, 0]), np.array([0, 0, 1.0]), 12.0, 12.0
)
ROTARY = (RotaryActuator(8000.0, 0.1), RotaryActuator(6000.0, -0.2, clockwise=True))
MIXED = (ROTARY[0], LinearActuator(1e5, 0.2, 0.6, 0.7, -1.4, False, 1e6))


def heliostat(name: str, kind: str, drives: tuple[object, object], foot: tuple[float, ...]):
    design = MountDesign(kind, 4.0, 0.25, drives)  # type: ignore[arg-type]
    plain = HeliostatType("plain", facet_grid(1, 1, 4.0, 3.0, 0.0), design)
    return plain.heliostat(name, foot, TARGET.center)


def true_parameters(seed: int, lengths: bool) -> np.ndarray:
    """A mount that was built with small errors."""
    rng = np.random.default_rng(seed)
    spread = dict.fromkeys(NAMES, 0.0) | {
        "east": 0.02,
        "north": 0.02,
        "up": 0.02,
        "foundation_north": 4e-3,
        "foundation_up": 4e-3,
        "axes_skew": 1e-3,
        "mirror_tilt": 2e-3,
        "first_zero": 8e-3,
        "second_zero": 8e-3,
    }
    if lengths:
        spread |= {f"{which}_stroke": 1e-3 for which in ("first", "second")}
    return np.array([rng.normal(0, spread[name]) for name in NAMES])


def readings(
    one: Heliostat, parameters: np.ndarray, suns: list[tuple[float, float]], noise_rad: float
) -> list[Reading]:
    """What motors and a camera record of a heliostat with these errors."""
    rng, mount = np.random.default_rng(7), apply_parameters(one.mount, parameters)
    found = []
    for day, angles in enumerate(suns):
        sun = sun_direction(*angles)
        aim = TARGET.center + rng.uniform(-2, 2, 3) * [1, 0, 1]
        turned = mount.align(one.position, sun, aim)
        motors = mount.motors_from_angles(turned)
        attitude = mount.attitude(turned)
        center = mount.mirror_center(one.position, attitude)
        normal = attitude[:, 2] + rng.normal(0, noise_rad / 2, 3)
        normal /= np.linalg.norm(normal)
        out = 2 * (normal @ sun) * normal - sun
        distance = ((TARGET.center - center) @ TARGET.normal) / (out @ TARGET.normal)
        found.append(
            Reading(f"{one.name}-{day}", "target", motors, sun, center + distance * out, float(day))
        )
    return found


SHOWN = [(100.0 + 16 * n, 25.0 + 13 * (n % 4)) for n in range(10)]
UNSEEN = [(110.0, 52.0), (150.0, 30.0), (185.0, 61.0), (215.0, 22.0), (240.0, 45.0)]


@pytest.mark.parametrize("kind", MOUNT_KINDS)
@pytest.mark.parametrize("drives", [ROTARY, MIXED], ids=["rotary", "mixed"])
def test_ten_spots_point_at_unseen_suns(kind: str, drives: tuple[object, object]):
    field = {
        f"H{n}": heliostat(f"H{n}", kind, drives, (-60.0 + 25 * n, 70.0 + 15 * n, 0.0))
        for n in range(4)
    }
    truth = {name: true_parameters(n, drives is MIXED) for n, name in enumerate(field)}
    shown = {name: readings(one, truth[name], SHOWN, 2e-4) for name, one in field.items()}
    done = calibrate_field(field, shown, {"target": TARGET}, JUELICH)
    before, after = [], []
    for name, one in field.items():
        unseen = readings(one, truth[name], UNSEEN, 0.0)
        before += list(pointing_error(one, CalibratedMount.uncalibrated(), unseen))
        after += list(pointing_error(one, done.mounts[name], unseen))
    assert np.median(before) > 3e-3
    assert np.mean(after) < 3e-4


@pytest.mark.parametrize("axis", [(1.0, 0, 0), (0, 1.0, 0)], ids=["east", "north"])
def test_a_vertical_axis_that_leans_is_calibrated_from_ten_spots(axis: tuple[float, ...]):
    """The lean is that of `Mount.tilted`, about either level direction."""
    one = heliostat("H", "azimuth_elevation", ROTARY, (-40.0, 90.0, 0.0))
    lean = replace(one, mount=one.mount.tilted(rotation(axis, 8e-3)))
    parameters = true_parameters(5, lengths=False) * [name.endswith("_zero") for name in NAMES]
    shown = {"H": readings(lean, parameters, SHOWN, 2e-4)}
    done = calibrate_field({"H": one}, shown, {"target": TARGET}, JUELICH)
    unseen = readings(lean, parameters, UNSEEN, 0.0)
    assert np.median(pointing_error(one, CalibratedMount.uncalibrated(), unseen)) > 3e-3
    assert np.mean(pointing_error(one, done.mounts["H"], unseen)) <= 3e-4


@pytest.mark.parametrize("kind", MOUNT_KINDS)
def test_chain_and_mount_are_the_same_and_derivatives_are_right(kind: str):
    one = heliostat("H", kind, MIXED, (-40.0, 90.0, 0.0))
    parameters = true_parameters(3, lengths=True)
    exact = readings(one, parameters, SHOWN[:4], 0.0)
    chain, arrays = KinematicChain.of([one]), pad_readings([exact])
    none = np.zeros((1, 4, 2))
    at_truth = residuals(chain, arrays, parameters[None], none)
    np.testing.assert_allclose(at_truth.values, 0, atol=1e-9)
    for column, name in enumerate(NAMES):
        step = np.zeros((1, len(NAMES)))
        step[0, column] = 1e-6
        ends = [residuals(chain, arrays, parameters + s * step, none).values for s in (1, -1)]
        np.testing.assert_allclose(
            (ends[0] - ends[1]) / 2e-6, at_truth.jacobian[..., column], atol=2e-7, err_msg=name
        )


def test_a_rotary_drive_is_its_inverse():
    angles = np.linspace(-3, 3, 7)
    for drive in ROTARY:
        np.testing.assert_allclose(drive.angle(drive.steps(angles)), angles)
        drive.require_within(1e12)
