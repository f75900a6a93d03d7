"""The pipeline through its API, on streams as they should not be."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from datasets.messages import Array, LaserScan, Odometry
from datasets.recording import Calibration, LidarCalibration
from datasets.se2 import inverse, se2, xyyaw
from slam.config import load_config
from slam.pipeline import Slam

NOW_S = 1_700_000_000
BEARINGS = np.linspace(-math.pi, math.pi, 360, endpoint=False)
ROOM = ((0, 0), (9, 0), (9, 4), (6, 4), (6, 7), (2, 7.5), (0, 5))
PILLAR = ((3, 2), (3.5, 2), (3.5, 2.6), (3, 2.6))
STEP_S = 0.2
T_FRONT_BACK = se2(-0.3, 0.0, math.pi)
PATIENCE_S = 1.0
"""Scans may wait so long until it is clear that no odometry comes."""
SHORT_SUBMAPS = ("nodes.submap_way_m=0.8", "nodes.submap_min_nodes=3")
"""So that a drive of seconds has several."""

MakeSlam = Callable[..., Slam]
BadScan = Callable[[float], LaserScan]


@pytest.fixture(params=["scan-matching", "kiss-icp"])
def make_slam(request: pytest.FixtureRequest) -> MakeSlam:
    """A pipeline with a lidar at the base's origin and one looking back, by front end."""

    def make(*settings: str) -> Slam:
        back = np.eye(4)
        back[:2, :2], back[:2, 3] = T_FRONT_BACK[:2, :2], T_FRONT_BACK[:2, 2]
        calibration = Calibration(
            {"front": LidarCalibration(np.eye(4)), "back": LidarCalibration(back)}
        )
        return Slam(
            load_config(None, [f"frontend={request.param}", *SHORT_SUBMAPS, *settings]), calibration
        )

    return make


def place(time_s: float) -> Array:
    """T_world_base of a drive of 3.7 m through the room in 15 s, with turns."""
    return se2(1.5 + 0.25 * time_s, 1.2, 0.2 * math.sin(time_s))


def stamp(time_s: float, epoch_s: int = NOW_S) -> int:
    return epoch_s * 10**9 + round(time_s * 1e9)


def ranges_from(T_world_lidar: Array, seed: int) -> Array:
    rays = np.column_stack([np.cos(BEARINGS), np.sin(BEARINGS)]) @ T_world_lidar[:2, :2].T
    found = np.full(len(rays), np.inf)
    for corners in (ROOM, PILLAR):
        for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
            start, side = np.subtract(a, T_world_lidar[:2, 2]), np.subtract(b, a)
            with np.errstate(divide="ignore", invalid="ignore"):
                cross = rays[:, 0] * side[1] - rays[:, 1] * side[0]
                r = (start[0] * side[1] - start[1] * side[0]) / cross
                u = (start[0] * rays[:, 1] - start[1] * rays[:, 0]) / cross
                found = np.where((r > 0) & (u >= 0) & (u <= 1), np.minimum(found, r), found)
    return found + np.random.default_rng(seed).normal(0.0, 0.01, len(found))


def scan_at(
    time_s: float,
    *,
    T_world_base: Array | None = None,
    lidar: str = "front",
    seed: int | None = None,
    epoch_s: int = NOW_S,
) -> LaserScan:
    T = place(time_s) if T_world_base is None else T_world_base
    T = T @ T_FRONT_BACK if lidar == "back" else T
    seed = round(time_s * 10) if seed is None else seed
    ranges = ranges_from(T, seed)
    return LaserScan(stamp(time_s, epoch_s), lidar, ranges, BEARINGS, np.empty(0), 0.05, 30.0)


def odometry_at(time_s: float, epoch_s: int = NOW_S) -> Odometry:
    return Odometry(stamp(time_s, epoch_s), se2(4.0, -7.0, 2.0) @ place(time_s))


def times(start_s: float = 0.0, end_s: float = 15.0) -> list[float]:
    return [k * STEP_S for k in range(round(start_s / STEP_S), round(end_s / STEP_S))]


def worst_error_m(slam: Slam, epoch_s: int = NOW_S) -> float:
    """Of the base at all scans, against the drive."""
    trajectory = slam.trajectory()
    seconds = (trajectory.stamps_ns - stamp(0.0, epoch_s)) * 1e-9
    true = [inverse(place(seconds[0])) @ place(float(second)) for second in seconds]
    found = trajectory.matrices()
    return float(np.abs(found[:, :2, 2] - np.array(true)[:, :2, 2]).max())


def ask_everything(slam: Slam) -> None:
    """Every question of the API has a finite answer now."""
    assert np.isfinite(slam.T_map_base).all()
    assert np.isfinite(slam.T_map_scans()).all()
    assert len(slam.T_map_scans()) == len(slam.records)
    assert np.isfinite(slam.T_map_nodes()).all()
    assert len(slam.T_map_nodes()) == len(slam.nodes)
    if slam.records:
        poses = slam.poses()
        assert len(slam.scans(poses)) == len(slam.records)
        assert slam.map().shape == slam.map().layers["lidar"].passes.shape
        assert len(slam.graph().nodes_xyyaw) == len(slam.nodes)


def end(slam: Slam) -> None:
    ask_everything(slam)
    slam.finish()
    ask_everything(slam)


def test_a_drive_is_recovered(make_slam: MakeSlam) -> None:
    """What the other tests spoil."""
    slam = make_slam()
    for t in times():
        slam.add(odometry_at(t))
        assert len(slam.add(scan_at(t))) == 1
    end(slam)
    assert worst_error_m(slam) < 0.05
    assert len(slam.submaps) >= 3
    assert slam.local.unmatched == {}
    assert slam.left_out == {}


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_so_few_scans_come_to_an_end_as_well(make_slam: MakeSlam, count: int) -> None:
    slam = make_slam()
    for t in times()[:count]:
        slam.add(scan_at(t))
    end(slam)
    assert len(slam.records) == count
    np.testing.assert_allclose(slam.T_map_scans(), np.tile(np.eye(3), (count, 1, 1)), atol=0.15)


def test_finishing_again_changes_nothing(make_slam: MakeSlam) -> None:
    slam = make_slam()
    for t in times():
        slam.add(scan_at(t))
    slam.finish()
    once, nodes, submaps = slam.T_map_scans(), len(slam.nodes), len(slam.submaps)
    for _ in range(9):
        slam.finish()
    np.testing.assert_allclose(slam.T_map_scans(), once, atol=1e-3)
    assert (len(slam.nodes), len(slam.submaps)) == (nodes, submaps)
    ask_everything(slam)


def test_everything_may_be_asked_after_every_scan(make_slam: MakeSlam) -> None:
    slam, silent = make_slam(), make_slam()
    ask_everything(slam)
    for t in times(0.0, 6.0):
        slam.add(scan_at(t))
        silent.add(scan_at(t))
        ask_everything(slam)
    end(slam)
    end(silent)
    # asking is no part of the run
    assert slam.T_map_scans().tobytes() == silent.T_map_scans().tobytes()


def test_odometry_may_begin_late(make_slam: MakeSlam) -> None:
    slam = make_slam()
    for t in times():
        if t > 7.0:
            slam.add(odometry_at(t))
        slam.add(scan_at(t))
    end(slam)
    assert len(slam.records) == len(times())
    assert worst_error_m(slam) < 0.06


@pytest.mark.parametrize("ahead_s", [-1e6, -30.0, 30.0, 1e6])
def test_odometry_of_another_clock_does_not_hold_up_or_lead_astray(
    make_slam: MakeSlam, ahead_s: float
) -> None:
    slam = make_slam()
    live = 0
    for t in times():
        # what it says is wrong too, so that using it would show
        slam.add(Odometry(stamp(t + ahead_s), se2(0.0, 3.0 * t, t)))
        live += len(slam.add(scan_at(t)))
    assert live > len(times()) - PATIENCE_S / STEP_S - 2
    end(slam)
    assert worst_error_m(slam) < 0.06


def test_one_jump_of_the_odometry_is_not_believed(make_slam: MakeSlam) -> None:
    slam = make_slam()
    for k, t in enumerate(times()):
        away = se2(1e7, -1e7, 1.0) if k == 30 else np.eye(3)
        slam.add(Odometry(stamp(t), away @ place(t)))
        slam.add(scan_at(t))
    end(slam)
    assert worst_error_m(slam) < 0.05


@pytest.mark.parametrize("with_odometry", [True, False])
def test_a_gap_of_a_minute_is_bridged(make_slam: MakeSlam, with_odometry: bool) -> None:
    slam = make_slam()
    for t in times():
        now_s = t if t < 7.0 else t + 60.0
        if with_odometry:
            slam.add(Odometry(stamp(now_s), place(t)))
        slam.add(scan_at(now_s, T_world_base=place(t)))
    end(slam)
    away = xyyaw(inverse(inverse(place(0.0)) @ place(times()[-1])) @ slam.T_map_base)
    assert np.hypot(*away[:2]) < 0.05
    assert slam.local.unobserved_m < 0.5


def bad_scan(ranges: list[float], range_max_m: float = 30.0) -> BadScan:
    values = np.array(ranges)
    bearings = BEARINGS[: len(values)]

    def make(time_s: float) -> LaserScan:
        return LaserScan(stamp(time_s), "front", values, bearings, np.empty(0), 0.05, range_max_m)

    return make


BAD_SCANS = {
    "NaN": bad_scan([math.nan] * 360),
    "no return": bad_scan([math.inf] * 360),
    "too near": bad_scan([-math.inf] * 360),
    "no beams": bad_scan([]),
    "one beam": bad_scan([1.0]),
    "two beams": bad_scan([1.0, 1.0]),
    "huge": bad_scan([1e30] * 360, 1e300),
    "one point": bad_scan([1e-300] * 360),
}


@pytest.mark.parametrize("kind", BAD_SCANS)
def test_bad_scans_among_good_ones_cost_themselves_only(make_slam: MakeSlam, kind: str) -> None:
    slam = make_slam()
    for k, t in enumerate(times()):
        slam.add(odometry_at(t))
        slam.add(BAD_SCANS[kind](t) if k % 3 == 1 or k < 4 else scan_at(t))
    end(slam)
    assert worst_error_m(slam) < 0.05
    matched = sum(record.matched for record in slam.records)
    good = sum(not (k % 3 == 1 or k < 4) for k in range(len(times())))
    assert good - 2 <= matched <= good


@pytest.mark.parametrize("kind", BAD_SCANS)
def test_bad_scans_alone_follow_the_odometry(make_slam: MakeSlam, kind: str) -> None:
    slam = make_slam()
    for t in times():
        slam.add(odometry_at(t))
        slam.add(BAD_SCANS[kind](t))
    end(slam)
    assert not any(record.matched for record in slam.records)
    assert slam.local.unmatched.total() == len(times()) - 1
    assert worst_error_m(slam) < 0.05


@pytest.mark.parametrize("lidars", [("front",), ("front", "back")])
def test_standing_still_nothing_grows_or_drifts(
    make_slam: MakeSlam, lidars: tuple[str, ...]
) -> None:
    slam = make_slam()
    sizes = []
    for k in range(600):
        slam.add(Odometry(stamp(0.1 * k), np.eye(3)))
        for lidar in lidars:
            slam.add(scan_at(0.1 * k, T_world_base=place(3.0), lidar=lidar, seed=k))
        if k in (100, 599):
            sizes.append((len(slam.nodes), len(slam.submaps), len(slam.global_slam.constraints)))
    slam.flush()
    assert sizes[0] == sizes[1]
    x, y, yaw = np.array([xyyaw(record.T_odom_base) for record in slam.records]).T
    assert np.hypot(x, y).max() < 0.02
    assert np.abs(yaw).max() < 0.01
    end(slam)
    assert np.abs(slam.T_map_scans()[:, :2, 2]).max() < 0.02


def test_standing_still_is_no_way_driven(make_slam: MakeSlam) -> None:
    slam = make_slam()
    for k in range(300):
        slam.add(scan_at(0.1 * k, T_world_base=place(3.0), seed=k))
    slam.finish()
    assert slam.local.keeper.way_m < 0.1


def test_waiting_before_a_step_makes_it_no_less_certain(make_slam: MakeSlam) -> None:
    sigmas_m = []
    for wait in (1, 300):
        slam = make_slam()
        for k in range(wait):
            slam.add(scan_at(0.1 * k, T_world_base=place(0.0), seed=k))
        for k in range(10):
            slam.add(scan_at(0.1 * (wait + k), T_world_base=place(0.1 * k), seed=k))
        slam.flush()
        sigmas_m.append(math.sqrt(slam.nodes[1].step_covariance[0, 0]))
    assert sigmas_m[1] < 1.5 * sigmas_m[0]


@pytest.mark.parametrize("epoch_s", [0, -1000, 4_102_444_800], ids=["1970", "1969", "2100"])
def test_stamps_of_any_year_will_do(make_slam: MakeSlam, epoch_s: int) -> None:
    slam = make_slam()
    for t in times():
        slam.add(odometry_at(t, epoch_s))
        slam.add(scan_at(t, epoch_s=epoch_s))
    end(slam)
    assert slam.records[-1].stamp_ns == stamp(times()[-1], epoch_s)
    assert slam.left_out == {}
    assert worst_error_m(slam, epoch_s) < 0.05


def test_two_lidars_of_one_stamp_are_both_taken(make_slam: MakeSlam) -> None:
    slam = make_slam()
    for t in times():
        slam.add(odometry_at(t))
        slam.add(scan_at(t))
        slam.add(scan_at(t, lidar="back"))
    end(slam)
    assert len(slam.records) == 2 * len(times())
    assert slam.left_out == {}
    assert worst_error_m(slam) < 0.05
    assert slam.T_map_scans().shape == (2 * len(times()), 3, 3)
    assert len(slam.trajectory().stamps_ns) == len(times())


def test_a_repeated_scan_is_left_out_and_counted(make_slam: MakeSlam) -> None:
    slam = make_slam()
    for t in times(0.0, 4.0):
        slam.add(scan_at(t))
        slam.add(scan_at(t))
    end(slam)
    assert len(slam.records) == len(times(0.0, 4.0))
    assert slam.left_out.total() == len(times(0.0, 4.0))


def test_a_lidar_whose_clock_is_decades_behind_is_left_out_and_counted(
    make_slam: MakeSlam,
) -> None:
    slam = make_slam()
    for t in times():
        slam.add(scan_at(t))
        slam.add(scan_at(t, lidar="back", epoch_s=100))
    end(slam)
    assert worst_error_m(slam) < 0.06
    assert slam.left_out.total() == len(times())


def test_the_same_stream_gives_the_same_bits(make_slam: MakeSlam) -> None:
    found = []
    for _ in range(2):
        slam = make_slam()
        for t in times():
            slam.add(odometry_at(t))
            slam.add(scan_at(t))
        slam.finish()
        found.append(slam.T_map_scans().tobytes() + slam.map().layers["lidar"].hits.tobytes())
    assert found[0] == found[1]


@pytest.mark.parametrize("question", ["trajectory", "poses", "map"])
def test_questions_before_the_first_scan_are_answered_or_refused(
    make_slam: MakeSlam, question: str
) -> None:
    with pytest.raises(ValueError, match="scan"):
        getattr(make_slam(), question)()


def test_scans_after_the_finish_are_refused_and_change_nothing(make_slam: MakeSlam) -> None:
    slam = make_slam()
    for t in times(0.0, 5.0):
        slam.add(scan_at(t))
    slam.finish()
    before = slam.trajectory().xyyaw.tobytes()
    with pytest.raises(RuntimeError, match="finish"):
        slam.add(scan_at(5.2))
    assert slam.trajectory().xyyaw.tobytes() == before
    ask_everything(slam)


def test_one_stamp_in_the_future_costs_no_more_than_its_scan(make_slam: MakeSlam) -> None:
    slam = make_slam()
    for k, t in enumerate(times()):
        slam.add(scan_at(t + 1e6 if k == 20 else t, T_world_base=place(t)))
    slam.finish()
    assert len(slam.records) >= len(times()) - 2
