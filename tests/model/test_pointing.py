"""Mounts calibrated from synthetic motors and spots whose truth is known."""

import json
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
import torch

from model.actuator import LinearActuator
from model.effects import Effect
from model.effects.axis_tilt import AxisTilt
from model.errors import InvalidInputError, UnreachableError
from model.forecast import align
from model.frames import sun_direction_at
from model.mount import Mount
from model.plant import Heliostat, TargetPlane
from model.plant_model import JUELICH_MODEL
from model.pointing import CalibratedMount, Reading, Weather, calibrate_field, pointing_error
from model.pointing.calibration import FieldPrior
from model.pointing.drives import Noise
from model.pointing.kinematics import (
    NAMES,
    SPREAD,
    ZEROS,
    KinematicChain,
    apply_parameters,
    residuals,
)
from model.pointing.plan import best_sun, plan
from model.pointing.readings import pad_readings
from model.pointing.report import (
    clock_in_words,
    day_of,
    field_to_json,
    moment_of,
    mount_from_json,
    mount_to_json,
)
from model.pointing.spots import find_motors, forecast_spot, intersect_plane
from model.setup import Setup
from model.site import JUELICH
from model.surface import control_points
from model.tracing.convolution import central_rays

NOISE = Noise()
QUIET = replace(NOISE, drift_rad=(1e-5, 1e-5), jitter_rad=(1e-5, 1e-5))
SOUTH, UP = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
TARGETS = {
    "upper": TargetPlane("upper", np.array([0.0, -3.2, 43.0]), SOUTH, UP, 8.6, 7.2),
    "lower": TargetPlane("lower", np.array([0.0, -3.2, 35.8]), SOUTH, UP, 8.6, 7.2),
}
ACTUATORS = (
    LinearActuator(154166.6667, 0.0757, 0.3353, 0.3381, 0.0137, False, 69001),
    LinearActuator(154166.6667, 0.0784, 0.3408, 0.3191, 0.9371, True, 75454),
)


def heliostats(count: int) -> dict[str, Heliostat]:
    mount = Mount.juelich(ACTUATORS, mirror_offset=(0, 0, 0.175))
    places = np.stack(
        [np.linspace(-80, 80, count), np.linspace(120, 220, count), np.full(count, 1.7)], axis=-1
    )
    return {
        f"H{i:02d}": Heliostat.juelich(f"H{i:02d}", place, mount=mount)
        for i, place in enumerate(places)
    }


def truth(generator: np.random.Generator) -> np.ndarray:
    return 0.6 * SPREAD * generator.normal(size=len(SPREAD))


def suns(generator: np.random.Generator, count: int) -> np.ndarray:
    declination, hour_angle = generator.uniform(-15, 23, count), generator.uniform(-50, 50, count)
    return sun_direction_at(declination, hour_angle, JUELICH.latitude_deg)


def series(
    heliostat: Heliostat,
    parameters: np.ndarray,
    days: np.ndarray,
    generator: np.random.Generator,
    zeros=None,
) -> list[Reading]:
    """Readings of a heliostat that aims by the mount it takes for its own, and whose true one has
    ``parameters``.

    ``zeros`` (N, 2) [rad] come to those of the drives.
    """
    zeros = np.zeros((len(days), 2)) if zeros is None else zeros
    readings = []
    for place, (day, sun) in enumerate(zip(days, suns(generator, len(days)), strict=True)):
        plane = list(TARGETS.values())[place % 2]
        true = parameters.copy()
        aims = apply_parameters(heliostat.mount, true)
        aim = plane.to_enu(generator.uniform(-1, 1, 2))
        motors = np.round(aims.motors_from_angles(aims.align(heliostat.position, sun, aim)))
        true[ZEROS] += zeros[place]
        mount = apply_parameters(heliostat.mount, true)
        attitude = mount.attitude(mount.angles_from_motors(motors))
        normal, center = attitude[:, 2], mount.mirror_center(heliostat.position, attitude)
        spot = intersect_plane(center, 2 * (normal @ sun) * normal - sun, plane)
        blur = NOISE.spot_rad * np.linalg.norm(spot - center) * generator.normal(size=2)
        spot = plane.to_enu(plane.to_plane(spot) + blur)
        readings.append(Reading(f"{place}", plane.name, motors, sun, spot, float(day)))
    return readings


def calibrate(field, readings, noise=NOISE, prior=None, requested=None):
    return calibrate_field(
        field, readings, TARGETS, JUELICH, noise=noise, prior=prior, requested=requested
    )


@pytest.fixture(scope="module")
def world():
    """Ten heliostats, their truths, and forty readings of each over a year."""
    generator = np.random.default_rng(3)
    field = heliostats(10)
    truths = {name: truth(generator) for name in field}
    days = np.linspace(0, 365, 40)
    return (
        field,
        truths,
        {name: series(field[name], truths[name], days, generator) for name in field},
    )


def test_derivatives_are_those_of_the_residuals(world):
    field, truths, readings = world
    chain, arrays = KinematicChain.of(list(field.values())), pad_readings(list(readings.values()))
    parameters, zeros = np.array(list(truths.values())), np.zeros(arrays.steps.shape)
    slope = residuals(chain, arrays, parameters, zeros)[1]
    for place, name in enumerate(NAMES):
        step = np.zeros(len(NAMES))
        step[place] = 1e-5 * SPREAD[place] / 0.05
        ahead, behind = (
            residuals(chain, arrays, parameters + sign * step, zeros)[0] for sign in (1, -1)
        )
        difference = (ahead - behind) / (2 * step[place])
        np.testing.assert_allclose(
            slope[..., place], difference, atol=3e-3 * np.abs(difference).max(), err_msg=name
        )


def test_true_mounts_leave_only_the_noise_of_the_spots(world):
    field, truths, readings = world
    chain, arrays = KinematicChain.of(list(field.values())), pad_readings(list(readings.values()))
    left = residuals(chain, arrays, np.array(list(truths.values())), np.zeros(arrays.steps.shape))[
        0
    ]
    assert left.std() == pytest.approx(NOISE.spot_rad, rel=0.1)


def test_known_mounts_are_recovered_where_data_determine_them(world):
    field, truths, readings = world
    done = calibrate(field, readings, QUIET)
    for name, mount in done.mounts.items():
        assert mount.determined[list(NAMES).index("foundation_up")]
        off = (mount.parameters - truths[name]) / np.sqrt(np.diag(mount.covariance))
        assert np.abs(off).max() < 4.5
        assert not mount.steps
        assert not done.contradictions[name]


def test_measurements_left_out_lie_within_their_intervals(world):
    field, truths, readings = world
    generator = np.random.default_rng(5)
    done, inside = calibrate(field, readings, QUIET), []
    for name, mount in done.mounts.items():
        fresh = series(field[name], truths[name], np.linspace(1, 364, 20), generator)
        for reading in fresh:
            forecast = forecast_spot(
                mount,
                field[name],
                TARGETS[reading.target],
                reading.motors,
                reading.sun,
                reading.day,
            )
            inside.append(np.linalg.norm(forecast.point - reading.spot) < 2.146 * forecast.std_m)
    assert 0.84 < np.mean(inside) < 0.96  # 90 % of the plane's two directions


@pytest.mark.full
@pytest.mark.parametrize("count", [6, 12, 30])
def test_the_predicted_error_is_that_of_spots_of_other_days(world, count: int):
    """The fit's residuals are smaller, the more so the fewer measurements there are."""
    field, truths, readings = world
    generator = np.random.default_rng(6)
    few = {name: own[:: 40 // count][:count] for name, own in readings.items()}
    done = calibrate(field, few, QUIET)
    inside, unseen, fitted, predicted = [], [], [], []
    for name, mount in done.mounts.items():
        fresh = series(field[name], truths[name], np.linspace(1.5, 300.5, 30), generator)
        errors = pointing_error(field[name], mount, fresh)
        found = mount.prediction
        assert found is not None
        assert found.measurements == count
        inside += ((errors >= found.low) & (errors <= found.high)).tolist()
        unseen.append(np.median(errors))
        predicted.append(found.median)
        fitted.append(np.median(np.linalg.norm(mount.residuals, axis=-1)))
    assert 0.85 < np.mean(inside) < 0.97
    assert np.mean(predicted) == pytest.approx(np.mean(unseen), rel=0.3)
    assert np.mean(fitted) < (0.8 if count < 30 else 0.95) * np.mean(unseen)


def test_too_few_measurements_or_too_many_outliers_predict_nothing(world):
    field, _, readings = world
    few = {name: own[:2] if name < "H05" else own for name, own in readings.items()}
    generator = np.random.default_rng(7)
    few["H09"] = [
        replace(one, spot=one.spot + generator.uniform(-4, 4, 3) * (place < 8))
        for place, one in enumerate(generator.permutation(np.array(readings["H09"]))[:20])
    ]
    done = calibrate(field, few)
    assert done.mounts["H09"].foreign.mean() > 0.25
    for name, mount in done.mounts.items():
        assert (mount.prediction is not None) == ("H05" <= name < "H09")
    report = field_to_json(done, {})["heliostats"]["H00"]["predicted_error_mrad"]
    assert (report["median"], report["ci90"]) == (None, None)


def test_five_measurements_lean_on_the_field(world):
    field, _, readings = world
    prior = calibrate(field, {name: own for name, own in readings.items() if name != "H03"}).prior
    five = calibrate(field, {"H03": readings["H03"][::8]}, prior=prior).mounts["H03"]
    rest = [one for place, one in enumerate(readings["H03"]) if place % 8]
    uncorrected = pointing_error(field["H03"], CalibratedMount.uncalibrated(), rest)
    assert (
        np.median(pointing_error(field["H03"], five, rest))
        < 2.5e-3
        < 10e-3
        < np.median(uncorrected)
    )


@pytest.mark.parametrize("size", [2e-3, -8e-3])
def test_a_step_is_dated_and_measured(world, size):
    field, truths, readings = world
    days = np.linspace(0, 365, 40)
    zeros = np.where(np.arange(40)[:, None] >= 23, [0.0, size], 0.0)
    moved = series(field["H04"], truths["H04"], days, np.random.default_rng(7), zeros)
    mount = calibrate(field, {**readings, "H04": moved}).mounts["H04"]
    assert [step.after for step in mount.steps] == [23]
    step = mount.steps[0]
    assert np.abs(step.zeros - [0.0, size]).max() < 4 * step.std.max()
    assert np.sign(step.motors[1]) == -np.sign(size)  # the second drive is clockwise
    np.testing.assert_allclose(
        mount.zeros_at([days[22] + 1, days[23] - 1])[:, 1].round(3), [0, size], atol=1.1e-3
    )


def test_a_slow_drift_is_no_step(world):
    field, truths, readings = world
    days = np.linspace(0, 365, 40)
    drift = np.stack([np.zeros(40), 2.5e-3 * days / 365], axis=-1)
    drifting = series(field["H05"], truths["H05"], days, np.random.default_rng(8), drift)
    done = calibrate(field, {**readings, "H05": drifting})
    document = field_to_json(done, {})["heliostats"]["H05"]
    assert document["steps"] == []
    assert document["drift"]["is_sure"]
    assert document["drift"]["zeros_mrad"][1] == pytest.approx(2.5, abs=0.8)


def test_effect_of_the_weather_on_spots_is_reported(world):
    """A field whose light goes up in the heat and westwards in the wind from the east, and one that
    does neither.
    """
    field, _, readings = world
    generator = np.random.default_rng(11)
    moved, still = {}, {}
    for name, own in readings.items():
        moved[name], still[name] = [], []
        for one in own:
            weather = Weather(
                generator.uniform(0, 8), generator.uniform(0, 360), generator.normal(15, 8)
            )
            east = weather.wind_speed_m_s**2 * np.sin(np.radians(weather.wind_from_deg))
            apart = np.linalg.norm(one.spot - field[name].position)
            shift = (
                1e-3 * apart * np.array([-0.02 * east, 0.0, 0.06 * (weather.temperature_c - 15)])
            )
            moved[name].append(replace(one, spot=one.spot + shift, weather=weather))
            still[name].append(replace(one, weather=weather))
    found, none = calibrate(field, moved).covariates, calibrate(field, still).covariates
    assert found["temperature"].share["upwards"] > 0.3
    assert found["temperature"].ci95["upwards"][0] > 0.2
    assert found["wind"].ci95["sidewards"][0] > 0.2
    for covariate, way in (
        ("temperature", "sidewards"),
        ("wind", "upwards"),
        ("season", "upwards"),
    ):
        assert abs(found[covariate].share[way]) < 0.1
    for explained in none.values():
        assert explained.measurements == 400
        assert max(map(abs, explained.share.values())) < 0.05


def test_weather_that_is_not_stored_is_not_asked(world):
    field, _, readings = world
    some = {
        name: own
        if name < "H08"
        else [replace(one, weather=Weather(temperature_c=9.0)) for one in own]
        for name, own in readings.items()
    }
    covariates = field_to_json(calibrate(field, some), {})["covariates"]
    assert covariates["wind"] == {"measurements": 0, "share": None}
    assert covariates["temperature"] == {"measurements": 80, "share": None}  # of two heliostats


def test_nothing_is_explained_of_a_measurement_that_is_foreign(world):
    field, _, readings = world
    (one,) = readings["H00"][:1]
    done = calibrate({"H00": field["H00"]}, {"H00": [replace(one, motors=one.motors + 2e4)]})
    assert done.mounts["H00"].foreign.all()
    assert {one.measurements for one in done.covariates.values()} == {0}


def recorded_by(
    clock_minutes: float, since: float, readings: dict[str, list[Reading]]
) -> dict[str, list[Reading]]:
    """Readings whose suns are computed by a clock that goes so many minutes fast from a day on."""
    return {
        name: [
            replace(one, sun=JUELICH.advance_sun(one.sun, clock_minutes))
            if one.day >= since
            else one
            for one in own
        ]
        for name, own in readings.items()
    }


@pytest.mark.full
@pytest.mark.parametrize("minutes", [-1.0, 0.5, 20.0])
def test_a_clock_that_goes_wrong_is_dated_and_measured(world, minutes):
    field, _, readings = world
    since = readings["H00"][23].day
    done = calibrate(field, recorded_by(minutes, since, readings))
    assert done.clock is not None
    assert done.clock.since == np.floor(since)
    assert done.clock.minutes == pytest.approx(-minutes, abs=4 * done.clock.std_minutes)
    assert done.clock.std_minutes < 0.1
    reported = field_to_json(done, {})["clock"]
    assert ("slow" if minutes < 0 else "fast") in clock_in_words(reported)
    assert reported["since"] == f"{moment_of(since):%Y-%m-%d}"


def test_a_clock_that_is_right_is_no_fault(world):
    field, _, readings = world
    assert calibrate(field, readings).clock is None
    assert field_to_json(calibrate(field, readings), {})["clock"] is None


def test_steps_of_some_heliostats_are_no_clock(world):
    """Of one, of several on one day that do not agree, and of one whose sun alone is wrong."""
    field, truths, readings = world
    days = np.linspace(0, 365, 40)
    moved = dict(readings)
    for number, (name, size) in enumerate({"H01": 3e-3, "H02": -3e-3, "H04": 8e-3}.items()):
        zeros = np.where(np.arange(40)[:, None] >= 23, [0.0, size], 0.0)
        moved[name] = series(field[name], truths[name], days, np.random.default_rng(number), zeros)
    done = calibrate(field, moved)
    assert all(done.mounts[name].steps for name in ("H01", "H02", "H04"))
    assert done.clock is None
    alone = recorded_by(1.0, days[23], {"H05": readings["H05"]})
    assert calibrate(field, readings | alone).clock is None
    assert calibrate(field, alone).clock is None


@pytest.mark.parametrize(
    ("steps", "changes"),
    [
        ({12: (0.0, 6e-3)}, ["lost_steps"]),
        ({12: (6e-3, -8e-3)}, ["referenced"]),
        ({12: (8e-3, 0.0), 27: (-8e-3, 0.0)}, ["lost_steps", "referenced"]),
        ({12: (8e-3, 0.0), 27: (0.0, 8e-3)}, ["lost_steps", "lost_steps"]),
    ],
)
def test_lost_steps_are_distinguished_from_referenced_drives(world, steps, changes):
    field, truths, readings = world
    zeros = np.zeros((40, 2))
    for place, size in steps.items():
        zeros[place:] += size
    days = np.linspace(0, 365, 40)
    moved = series(field["H04"], truths["H04"], days, np.random.default_rng(7), zeros)
    done = calibrate(field, {**readings, "H04": moved})
    reported = field_to_json(done, {})["heliostats"]["H04"]["steps"]
    assert [step["change"] for step in reported] == changes
    assert [step.after for step in done.mounts["H04"].steps] == list(steps)


@pytest.mark.parametrize("hours", [-0.5, 1.5])
def test_a_clock_half_an_hour_off_is_named(world, hours):
    field, _, readings = world
    own = list(readings["H06"])
    mount = calibrate(field, readings).mounts["H06"]
    true_sun, reported = (
        sun_direction_at(5.0, 20.0 + 15 * shift, JUELICH.latitude_deg) for shift in (0.0, hours)
    )
    motors = find_motors(mount, field["H06"], true_sun, TARGETS["upper"].center, own[10].day)
    own[10] = replace(
        own[10], motors=motors, sun=reported, spot=TARGETS["upper"].center, target="upper"
    )
    (found,) = calibrate(field, {**readings, "H06": own}).contradictions["H06"].values()
    assert found.reason == "clock"
    assert f"{abs(hours):g} h {'earlier' if hours > 0 else 'later'}" in found.detail


def test_contradictions_are_named(world):
    field, _, readings = world
    own = list(readings["H06"])
    plane, other = TARGETS[own[4].target], TARGETS[own[5].target]
    own[4] = replace(own[4], spot=other.to_enu(plane.to_plane(own[4].spot)), target=other.name)
    hour = np.degrees(15 * np.pi / 180)
    declination, angle = 5.0, 20.0
    true_sun, reported = (
        sun_direction_at(declination, angle + shift, JUELICH.latitude_deg) for shift in (0.0, hour)
    )
    mount = calibrate(field, readings).mounts["H06"]
    motors = find_motors(mount, field["H06"], true_sun, TARGETS["upper"].center, own[10].day)
    own[10] = replace(
        own[10], motors=motors, sun=reported, spot=TARGETS["upper"].center, target="upper"
    )
    own[15] = replace(readings["H07"][15], name="15")
    own[20] = replace(own[20], spot=own[20].spot + np.array([1.8, 0.0, 0.3]))
    done = calibrate(field, {**readings, "H06": own})
    named = done.contradictions["H06"]
    assert {name: one.reason for name, one in named.items()} == {
        "4": "wrong_target",
        "10": "clock",
        "15": "wrong_heliostat",
        "20": "foreign_spot",
    }
    assert "1 h earlier" in named["10"].detail
    assert "H07" in named["15"].detail
    assert {name: one.other for name, one in named.items() if one.other} == {"15": "H07"}
    listed = field_to_json(done, {})["heliostats"]["H06"]["outliers"]
    assert {name: one["off_mrad"] for name, one in listed.items()} == {
        name: round(one.error_mrad, 2) for name, one in named.items()
    }


def test_odd_property_files_start_from_the_field(world):
    field, _, readings = world
    odd = tuple(
        replace(drive, initial_stroke_length=0.236, initial_angle=angle)
        for drive, angle in zip(ACTUATORS, (-0.22, 0.385), strict=True)
    )
    changed = {
        **field,
        "H01": replace(field["H01"], mount=Mount.juelich(odd, mirror_offset=(0, 0, 0.175))),
    }
    done = calibrate(changed, readings)
    assert done.unusual == ("H01",)
    assert np.median(pointing_error(changed["H01"], done.mounts["H01"], readings["H01"])) < 1e-3


def test_motors_send_the_light_where_it_shall_go_and_keep_their_travel(world):
    field, _, readings = world
    mount, heliostat = calibrate(field, readings).mounts["H02"], field["H02"]
    sun, aim = suns(np.random.default_rng(0), 1)[0], TARGETS["lower"].center
    motors = find_motors(mount, heliostat, sun, aim)
    np.testing.assert_allclose(
        forecast_spot(mount, heliostat, TARGETS["lower"], motors, sun).point, aim, atol=1e-6
    )
    with pytest.raises(UnreachableError, match=r"travel|far"):
        find_motors(mount, heliostat, np.array([0.0, 1.0, 0.05]), np.array([0.0, 900.0, -100.0]))


def test_most_informative_photograph_has_an_unseen_sun(world):
    """Of a mount that was measured in the morning only, in the late afternoon; of no sun where none
    is in reach.
    """
    field, _, readings = world
    morning = [one for one in readings["H02"] if one.sun[0] > 0.1]
    mount = calibrate(field, {**readings, "H02": morning}, QUIET).mounts["H02"]
    hours = np.arange(8.0, 16.25, 0.25)
    sky = [sun_direction_at(10.0, 15 * (hour - 12), JUELICH.latitude_deg) for hour in hours]
    days, planes = [366.0] * len(sky), list(TARGETS.values())
    best = best_sun(field["H02"], mount, planes, sky, days)
    assert best is not None
    assert hours[best.slot] > 15
    reported = []
    for sun in sky:
        (proposal,) = plan({"H02": field["H02"]}, {"H02": mount}, planes[:1], [sun], [366.0])
        reported.append(proposal.information_bits)
    assert best.information_bits == pytest.approx(max(reported))
    assert best_sun(field["H02"], mount, [], sky, days) is None


def test_documents_bring_the_mount_back(world):
    field, _, readings = world
    done = calibrate(field, readings)
    document = field_to_json(done, {})["heliostats"]["H08"]
    mount, back = done.mounts["H08"], mount_from_json(document, "here")
    reading = readings["H08"][9]
    for day in (reading.day, 9999.0, np.nan):
        first, again = (
            forecast_spot(m, field["H08"], TARGETS["upper"], reading.motors, reading.sun, day)
            for m in (mount, back)
        )
        np.testing.assert_allclose(first.point, again.point, atol=1e-4)
        assert first.std_m == pytest.approx(again.std_m, rel=1e-3)
    np.testing.assert_allclose(mount.predicted, back.predicted, atol=1e-8)
    assert back.prediction is not None
    assert back.prediction.high == pytest.approx(mount.prediction.high, abs=1e-6)
    incomplete = {key: value for key, value in document.items() if key != "predicted_error_mrad"}
    with pytest.raises(InvalidInputError, match="'predicted_error_mrad' is missing"):
        mount_from_json(incomplete, "here")
    with pytest.raises(InvalidInputError, match="here"):
        mount_from_json({**document, "covariance": [1]}, "here")
    with pytest.raises(InvalidInputError, match="finite"):
        mount_from_json({**document, "covariance": np.full((16, 16), np.nan).tolist()}, "here")


def by_motors(heliostat: Heliostat, reading: Reading, effects: list[Effect]) -> np.ndarray:
    """Where the light's centre lies (3,) [m] as the forecast from a reading's motors has it under
    effects.
    """
    angles, plane = heliostat.mount.angles_from_motors(reading.motors), TARGETS[reading.target]
    shot = Setup(heliostat, control_points(heliostat), reading.sun, plane, angles=angles)
    scene = align([shot], JUELICH_MODEL.with_effects(effects), dtype=torch.float64).groups[0].scene
    return plane.to_enu(central_rays(scene, 8).spot[0].numpy())


def test_a_tilt_is_in_the_calibrated_mount_and_not_applied_again(world):
    """Foundations lean by 1 and 2 degrees: found by calibration and, in images, as an effect."""
    field, _, _ = world
    leaning = np.zeros(len(NAMES))
    leaning[[NAMES.index("foundation_north"), NAMES.index("foundation_up")]] = np.radians(
        [1.0, -2.0]
    )
    own = series(field["H03"], leaning, np.linspace(0, 365, 30), np.random.default_rng(6))
    mount = calibrate({"H03": field["H03"]}, {"H03": own}).mounts["H03"].mount(field["H03"].mount)
    tilt, found = AxisTilt(1.0, -2.0), replace(field["H03"], mount=mount)
    np.testing.assert_allclose(
        found.mount.first_axis, tilt.on_mount(field["H03"].mount, "H03").first_axis, atol=5e-3
    )
    for reading in own[:5]:
        distance = np.linalg.norm(reading.spot - found.position)
        off = [
            np.linalg.norm(by_motors(one, reading, [tilt]) - reading.spot)
            for one in (found, field["H03"])
        ]
        assert (
            max(off) < 3e-3 * distance
        )  # the surveyed mount with the tilt, and the calibrated one as it is
        assert (
            np.linalg.norm(by_motors(field["H03"], reading, []) - reading.spot) > 15e-3 * distance
        )


def with_drives(heliostat: Heliostat, factor: float) -> Heliostat:
    """The heliostat with drives ``factor`` times as long."""
    drives = tuple(
        replace(
            drive,
            increment=drive.increment / factor,
            initial_stroke_length=factor * drive.initial_stroke_length,
            offset=factor * drive.offset,
            pivot_radius=factor * drive.pivot_radius,
        )
        for drive in ACTUATORS
    )
    return replace(heliostat, mount=Mount.juelich(drives, mirror_offset=(0, 0, 0.175)))


@pytest.mark.full
def test_kinds_of_drives_make_priors_of_their_own(world):
    """Those of a second kind stand straight, whatever those of the first do; one of a third has no
    others.
    """
    field, truths, readings = world
    generator, days = np.random.default_rng(9), np.linspace(0, 365, 40)
    tight = {f"L{place}": with_drives(heliostats(6)[f"H0{place}"], 1.5) for place in range(6)}
    alone = {"Z0": with_drives(heliostats(1)["H00"], 2.0)}
    straight = {name: 0.1 * truth(generator) for name in tight}
    mixed = readings | {
        name: series(one, straight[name], days, generator) for name, one in tight.items()
    }
    mixed |= {"Z0": series(alone["Z0"], truths["H00"], days, generator)}
    done = calibrate(field | tight | alone, mixed)
    assert done.unusual == ()
    spreads = {name: mount.prior_spread for name, mount in done.mounts.items()}
    np.testing.assert_allclose(
        spreads["H01"], calibrate(field, readings).mounts["H01"].prior_spread
    )
    up = NAMES.index("foundation_up")
    assert spreads["L1"][up] < 0.85 * spreads["H01"][up]
    np.testing.assert_allclose(spreads["Z0"], spreads["H01"])
    for name, heliostat in (tight | alone).items():
        assert np.median(pointing_error(heliostat, done.mounts[name], mixed[name])) < 1e-3


def test_drives_that_single_heliostats_are_adjusted_by_are_of_one_kind(world):
    field, _, _ = world
    adjusted = [
        replace(
            one,
            mount=Mount.juelich(
                tuple(replace(d, offset=d.offset + 1e-3 * place) for d in ACTUATORS)
            ),
        )
        for place, one in enumerate(field.values())
    ]
    assert [len(rows) for rows in KinematicChain.of(adjusted).kinds()] == [10]


def test_mounts_of_some_lean_on_all_that_were_read(world):
    field, _, readings = world
    foreign = replace(readings["H07"][15], name="other")
    few = {**readings, "H03": [*readings["H03"][::8], foreign]}
    whole, some = calibrate(field, few), calibrate(field, few, requested=["H03"])
    assert list(some.mounts) == list(some.readings) == list(some.contradictions) == ["H03"]
    np.testing.assert_array_equal(some.mounts["H03"].parameters, whole.mounts["H03"].parameters)
    assert "H07" in some.contradictions["H03"]["other"].detail  # which is not wanted


def test_heliostats_without_measurements_have_the_prior(world):
    field, _, readings = world
    mount = calibrate(field, {**readings, "H09": []}).mounts["H09"]
    assert not mount.determined.any()
    assert (
        forecast_spot(
            mount, field["H09"], TARGETS["upper"], readings["H09"][0].motors, readings["H09"][0].sun
        ).std_m
        > 0.5
    )


def test_the_unseen_field_has_the_spreads_of_its_parameters(world):
    field, _, _ = world
    unseen = FieldPrior.default(KinematicChain.of(list(field.values())))
    np.testing.assert_allclose(np.sqrt(np.diag(unseen.covariance)), SPREAD)


def test_mounts_without_actuators_are_refused():
    bare = Heliostat.juelich("bare", (0.0, 100.0, 1.7))
    with pytest.raises(InvalidInputError, match="bare has no actuators"):
        KinematicChain.of([bare])


@pytest.mark.full
def test_measurements_of_unknown_time_determine_parameters_but_no_changes():
    """Half of each heliostat's measurements lose their time, some of them from before a step and
    some from after.
    """
    generator = np.random.default_rng(11)
    field, days = heliostats(6), np.linspace(0, 365, 40)
    zeros = np.where(days[:, None] > 180, (8e-3, 0.0), 0.0)
    truths = {name: truth(generator) for name in field}
    readings = {name: series(field[name], truths[name], days, generator, zeros) for name in field}
    half = {
        name: [replace(one, day=np.nan) if int(one.name) % 2 else one for one in own]
        for name, own in readings.items()
    }
    dated = {name: [one for one in own if np.isfinite(one.day)] for name, own in half.items()}
    alone, done = calibrate(field, dated), calibrate(field, half)
    for name, mount in done.mounts.items():
        assert mount.n_undated == 20
        assert [(one.before - 20, one.after - 20) for one in mount.steps] == [
            (one.before, one.after) for one in alone.mounts[name].steps
        ]
        assert len(mount.steps) == 1
        assert not done.contradictions[name]
    spreads = [np.mean([mount.spread for mount in one.mounts.values()]) for one in (alone, done)]
    assert spreads[1] < spreads[0]
    document = json.loads(json.dumps(field_to_json(done, {})))["heliostats"]["H01"]
    assert document["history"]["at"][:20] == [None] * 20
    assert mount_from_json(document, "H01").n_undated == document["undated"] == 20


@pytest.mark.full
def test_order_of_measurements_without_times_changes_nothing():
    generator = np.random.default_rng(12)
    field, days = heliostats(3), np.linspace(0, 365, 30)
    zeros = np.where(days[:, None] > 180, (8e-3, 0.0), 0.0)
    readings = {
        name: [
            replace(one, day=np.nan)
            for one in series(field[name], truth(generator), days, generator, zeros)
        ]
        for name in field
    }
    shuffled = {
        name: [own[place] for place in generator.permutation(30)] for name, own in readings.items()
    }
    done, again = calibrate(field, readings), calibrate(field, shuffled)
    for name, mount in done.mounts.items():
        assert not mount.steps
        assert mount.until is None
        np.testing.assert_allclose(mount.parameters, again.mounts[name].parameters, atol=1e-9)
        assert mount_to_json(mount, done.readings[name], {})["valid_from"] is None


def test_days_and_moments_invert():
    moment = datetime(2024, 6, 1, 12, 30, 7, tzinfo=UTC)
    assert moment_of(day_of(moment)) == moment
    assert np.isnan(day_of(None))
