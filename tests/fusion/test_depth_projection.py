"""Depth images of known scenes, and the pseudo-laser scans that must come of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from datasets.messages import Array, DepthImage
from datasets.recording import CameraCalibration
from datasets.simulation.depth_camera import DepthModel
from fusion.depth_config import DepthConfig
from fusion.depth_labels import FREE, NEAREST
from fusion.depth_projection import DepthProjection
from tests.fusion.depth_scenes import (
    FLOOR,
    box,
    calibration,
    exact_image,
    mounting,
    of_model,
    simulated,
)

GROUND = (np.array([0.0, 0.0, 1.0]), 0.0)
FAR = DepthConfig(max_range_m=5.0)


def wall(distance_m: float, yaw_rad: float = 0.0) -> tuple[Array, float]:
    return np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0]), distance_m


@pytest.mark.parametrize("yaw_rad", [0.0, 0.5, -0.8])
def test_an_exact_wall_is_found_where_it_is(yaw_rad: float) -> None:
    camera = calibration(mounting())
    found = DepthProjection(camera, FAR)(exact_image(camera, GROUND, wall(1.5, yaw_rad)))
    normal = wall(1.5, yaw_rad)[0][:2]
    assert len(found.points_base) > 50
    # A point lies in the middle of its bin, up to 5 mrad beside its pixels in this coarse image.
    assert found.points_base @ normal == pytest.approx(1.5, abs=0.025)
    assert found.surfaces_base @ normal == pytest.approx(1.5, abs=0.025)
    assert (found.points_base @ normal).mean() == pytest.approx(1.5, abs=0.002)
    assert found.stamp_ns == 7
    assert found.sensor == "cam"


@settings(max_examples=60, deadline=None)
@given(
    x=st.floats(-0.5, 0.5),
    y=st.floats(-0.5, 0.5),
    z=st.floats(0.15, 1.2),
    roll_rad=st.floats(-math.pi, math.pi),
    pitch_rad=st.floats(-0.3, 0.6),
    yaw=st.floats(-math.pi, math.pi),
    slant_rad=st.floats(-0.6, 0.6),
)
def test_a_wall_is_found_in_the_base_frame_whatever_the_mounting(
    x: float, y: float, z: float, roll_rad: float, pitch_rad: float, yaw: float, slant_rad: float
) -> None:
    camera = calibration(mounting((x, y, z), roll_rad, pitch_rad, yaw))
    normal = np.array([math.cos(yaw + slant_rad), math.sin(yaw + slant_rad), 0.0])
    distance_m = float(normal[:2] @ [x, y]) + 1.5
    image = exact_image(camera, GROUND, (normal, distance_m))
    found = DepthProjection(camera, FAR)(image)
    assert (np.diff(found.bearings_rad) > 0).all()
    points = found.points_base
    assume(len(points) > 0)
    assert points @ normal[:2] == pytest.approx(distance_m, abs=0.02)
    # Straight ahead of the camera it can't be missed.
    ahead = (
        np.abs(
            found.bearings_rad
            - yaw
            - 2 * np.pi * np.round((found.bearings_rad - yaw) / (2 * np.pi))
        )
        < 0.05
    )
    if -0.2 < pitch_rad < 0.3 and ahead.any():
        assert np.isfinite(found.ranges_m[ahead]).any()


def test_a_camera_that_looks_backwards_has_ascending_bearings_over_pi() -> None:
    camera = calibration(mounting(yaw=math.pi))
    behind = (np.array([-1.0, 0.0, 0.0]), 1.5)
    found = DepthProjection(camera, FAR)(exact_image(camera, GROUND, behind))
    assert (np.diff(found.bearings_rad) > 0).all()
    assert np.ptp(found.bearings_rad) < 2.0
    assert found.points_base[:, 0] == pytest.approx(-1.5, abs=0.01)


def test_nothing_is_mirrored() -> None:
    """An obstacle on the left of the robot (y > 0) stands in the left half of the image."""
    model = DepthModel(mode="640x480", wave_px=0)
    T = mounting()
    image = simulated(T, model, 1, FLOOR, box((1.5, 0.3, 0.0), (1.8, 0.7, 0.4)))
    found = DepthProjection(of_model(T, model), DepthConfig())(image)
    points = found.points_base
    assert len(points) > 20
    assert points[:, 1].min() > 0.25
    assert np.median(points[:, 0]) == pytest.approx(1.5, abs=0.03)
    # Straight ahead of it the floor is seen to be free.
    free = np.isinf(found.ranges_m) & (found.bearings_rad < 0.1) & (found.bearings_rad > -0.4)
    assert free.sum() > 80
    assert np.median(found.free_to_m[free]) == pytest.approx(4.0)


@pytest.mark.parametrize("mode", ["640x480", "1280x720"])
@pytest.mark.parametrize("distance_m", [1.0, 2.0, 3.0, 4.0])
@pytest.mark.parametrize("yaw_rad", [0.0, 0.5])
def test_a_noisy_wall_is_not_nearer_than_it_is(
    mode: str, distance_m: float, yaw_rad: float
) -> None:
    model = DepthModel(mode=mode, wave_px=0)
    T, solid = mounting(yaw=yaw_rad), box((distance_m, -60, -1), (distance_m + 1, 60, 3))
    found = DepthProjection(of_model(T, model), DepthConfig(max_range_m=5.5, wave_px=0))(
        simulated(T, model, 1, FLOOR, solid)
    )
    points = found.points_base[np.isfinite(found.ranges_m[np.isfinite(found.ranges_m)])]
    near = np.hypot(*points.T) < 4.5
    assert near.sum() > 100
    # The noise is alike over some 8 bearings: at 4 m the mean itself has a deviation of 4 mm.
    allowed_m = 0.005 if distance_m < 3.5 else 0.012
    assert points[near, 0].mean() == pytest.approx(distance_m, abs=allowed_m)


def test_holes_everywhere_are_nothing_known() -> None:
    camera = calibration(mounting())
    holes = DepthImage(0, "cam", np.full((120, 160), np.nan, dtype=np.float32))
    found = DepthProjection(camera, DepthConfig())(holes)
    assert np.isnan(found.ranges_m).all()
    assert np.isnan(found.sigma_m).all()
    assert (found.free_to_m <= found.free_from_m).all()
    assert found.surfaces_base.shape == (0, 2)


def test_a_bare_floor_is_free_from_where_it_comes_into_view() -> None:
    camera = calibration(mounting())
    found = DepthProjection(camera, DepthConfig())(exact_image(camera, GROUND))
    seen_m = 0.25 * 96.0 / 59.5  # the last row, straight ahead
    assert np.isinf(found.ranges_m).all()
    assert found.free_from_m == pytest.approx(seen_m, abs=0.15)
    # Rays over the horizon meet nothing in this scene: the last stretch is theirs.
    assert np.median(found.free_to_m) > 2.0


def test_a_hole_in_the_floor_ends_what_is_free() -> None:
    camera = calibration(mounting())
    image = exact_image(camera, GROUND)
    depth = image.depth_m.copy()
    depth[80:84] = np.nan  # 20.5 to 24.5 rows below the horizon: from 0.98 to 1.17 m
    found = DepthProjection(camera, DepthConfig())(DepthImage(0, "cam", depth))
    ahead = np.abs(found.bearings_rad) < 0.2
    assert found.free_to_m[ahead] == pytest.approx(0.95, abs=0.1)


@pytest.mark.parametrize("shape", [(1, 160), (120, 1), (1, 1)])
def test_images_of_one_row_or_column_work(shape: tuple[int, int]) -> None:
    camera = calibration(mounting(), width=shape[1], height=shape[0])
    image = exact_image(camera, GROUND, wall(1.5))
    found = DepthProjection(camera, DepthConfig())(image)
    assert found.ranges_m.shape == found.bearings_rad.shape


def test_an_image_of_another_size_is_refused() -> None:
    project = DepthProjection(calibration(mounting()), DepthConfig())
    with pytest.raises(ValueError, match="320 x 240 pixels, its intrinsics are for 160 x 120"):
        project(DepthImage(0, "cam", np.ones((240, 320), dtype=np.float32)))


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (calibration(None), "nothing says where the camera stands"),
        (CameraCalibration(mounting(), None), "nothing says the camera's intrinsics"),
        (calibration(mounting((0.0, 0.0, -0.3))), "height of -0.300 m"),
        (calibration(mounting((0.0, 0.0, 0.0))), "height of 0.000 m"),
        (calibration(2.0 * mounting()), "no rotation"),
        (calibration(np.full((4, 4), np.nan)), "no finite"),
        (calibration(mounting((0.0, 0.0, 1.2), pitch_rad=-1.2)), "nothing within the height gate"),
        (calibration(mounting(), focal_px=-1.0), "no pinhole"),
    ],
)
def test_a_camera_that_can_not_be_is_refused(camera: CameraCalibration, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        DepthProjection(camera, DepthConfig())


def test_the_gate_must_be_open() -> None:
    with pytest.raises(ValueError, match="must be below"):
        DepthConfig(lower_m=0.5, upper_m=0.4)


@pytest.mark.parametrize(("height_m", "distance_m"), [(0.05, 2.0), (0.1, 3.4)])
@pytest.mark.parametrize("nod_rad", [-0.0087, 0.0, 0.0087])
def test_low_things_are_found_though_the_robot_nods(
    height_m: float, distance_m: float, nod_rad: float
) -> None:
    """Half a degree lifts or sinks the floor by 3 cm at 3.4 m."""
    model = DepthModel(mode="640x480")
    low = box((distance_m, -0.15, 0.0), (distance_m + 0.2, 0.15, height_m))
    image = simulated(mounting(pitch_rad=nod_rad), model, 1, FLOOR, low)
    found = DepthProjection(of_model(mounting(), model), DepthConfig())(image)
    there = np.abs(found.bearings_rad) < 0.12 / distance_m
    off_m = found.ranges_m[there] * np.cos(found.bearings_rad[there]) - distance_m
    assert np.mean(np.abs(off_m) < 0.25) > 0.7
    bare = np.abs(found.bearings_rad) > 0.25 / distance_m
    assert np.isfinite(found.ranges_m[bare]).sum() == 0


@pytest.mark.parametrize("pitch_deg", [0.0, 10.0, 20.0])
@pytest.mark.parametrize("height_m", [0.25, 0.62, 1.2])
def test_bare_floors_have_no_obstacles(pitch_deg: float, height_m: float) -> None:
    """With slow waves, and a mounting that is half a degree wrong."""
    model, pitch = DepthModel(mode="640x480"), math.radians(pitch_deg)
    stands = mounting((0.0, 0.0, height_m), pitch_rad=pitch)
    false, beams = 0, 0
    for seed, (roll_rad, nod_rad) in enumerate([(0.0, 0.0087), (0.0087, 0.0)]):
        really = mounting((0.0, 0.0, height_m), roll_rad, pitch + nod_rad)
        found = DepthProjection(of_model(stands, model), DepthConfig())(
            simulated(really, model, seed, FLOOR)
        )
        false += int(np.isfinite(found.ranges_m).sum())
        beams += found.ranges_m.size
    assert false <= 0.01 * beams


def test_thin_legs_are_found_and_what_is_behind_them_too() -> None:
    model = DepthModel(mode="640x480", wave_px=0)
    places = [-0.4, 0.0, 0.4]
    legs = [box((2.0, y - 0.015, 0.0), (2.03, y + 0.015, 0.45)) for y in places]
    low_wall = box((3.0, -2.0, 0.0), (3.2, 2.0, 0.4))
    image = simulated(mounting(), model, 3, FLOOR, low_wall, *legs)
    found = DepthProjection(of_model(mounting(), model), DepthConfig())(image)
    for y in places:
        assert np.hypot(*(found.points_base - [2.0, y]).T).min() < 0.05
    assert np.abs(found.surfaces_base[:, 0] - 3.0).min() < 0.05
    at_legs = np.abs(found.surfaces_base[:, 0] - 2.0) < 0.2
    at_wall = np.abs(found.surfaces_base[:, 0] - 3.0) < 0.3
    assert (at_legs | at_wall).mean() > 0.97


def test_a_camera_looks_over_low_things_at_what_is_behind() -> None:
    model = DepthModel(mode="640x480", wave_px=0)
    T = mounting((0.0, 0.0, 0.6), pitch_rad=0.2)
    low, wall_behind = (
        box((1.5, -0.3, 0.0), (1.6, 0.3, 0.2)),
        box((2.5, -9.0, 0.0), (3.0, 9.0, 2.0)),
    )
    found = DepthProjection(of_model(T, model), DepthConfig())(
        simulated(T, model, 1, FLOOR, low, wall_behind)
    )
    ahead = np.abs(found.surfaces_base[:, 1]) < 0.2
    x = found.surfaces_base[ahead, 0]
    assert (np.abs(x - 1.5) < 0.1).sum() > 20
    assert (np.abs(x - 2.5) < 0.1).sum() > 20


def test_the_labels_say_what_became_of_the_pixels() -> None:
    model = DepthModel(mode="1280x720", wave_px=0)
    image = simulated(mounting(), model, 1, FLOOR, box((1.5, 0.0, 0.0), (1.6, 0.6, 0.2)))
    project = DepthProjection(of_model(mounting(), model), DepthConfig())
    labels, bins = project.used_pixels(image), project.bins_of_pixels()
    assert labels.shape == bins.shape == (720, 1280)
    nearest = np.unique(bins[labels == NEAREST])
    assert nearest.tolist() == np.flatnonzero(np.isfinite(project(image).ranges_m)).tolist()
    u = np.nonzero(labels == NEAREST)[1]
    assert u.max() < 645  # y > 0 is left
    assert (labels[600:, 200:1000] == FREE).mean() > 0.95
