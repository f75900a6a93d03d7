"""The simulated lidar against a room whose ranges are known in closed form."""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError

from datasets.bag_messages import scan as scan_of_message
from datasets.messages import Array
from datasets.normalise import ZERO
from datasets.simulation.drive import Drive, DriveLimits, plan_drive
from datasets.simulation.lidar import (
    EDGE_M,
    G4,
    SLICE_S,
    LidarModel,
    LidarTurn,
    simulate_turn,
    simulate_turns,
)
from tests.datasets.simulation.box_room import BoxRoom, mounting

EXACT = G4.model_copy(
    update={"noise_m": 0.0, "noise_per_m": 0.0, "turn_rate_spread": 0.0, "scale_error_max": 0.0}
)


ROOM = BoxRoom(
    room=((-3.0, -2.0, 0.0), (5.0, 4.0, 2.5)),
    boxes=(((2.0, 1.0, 0.0), (2.6, 2.2, 1.5)), ((-2.5, -1.5, 0.0), (-1.5, -1.0, 2.0))),
)
HALL = BoxRoom(room=((-15.0, -7.0, 0.0), (14.0, 10.0, 3.0)))
MOVING = plan_drive([(-1.0, 0.0), (1.5, 0.0), (1.5, 3.0)], DriveLimits())
STANDING = plan_drive([(0.0, 0.0)], DriveLimits(), start_yaw_rad=0.0, waits_s={0: 1e6})


LEVEL = mounting()
MOUNTINGS = [
    mounting(0.12, 0.03),
    mounting(-0.1, 0.2, roll_deg=180.0, yaw_deg=90.0),
    mounting(0.3, -0.2, 0.6, roll_deg=4.0, pitch_deg=-7.0, yaw_deg=160.0),
]


def turn_at(
    stamp_s: float = 0.0,
    *,
    scene: BoxRoom = ROOM,
    drive: Drive = STANDING,
    T_base_lidar: Array = LEVEL,
    model: LidarModel = EXACT,
    seed: int = 1,
) -> LidarTurn:
    random = np.random.default_rng(seed)
    return simulate_turn(scene, drive.pose, T_base_lidar, model, stamp_s, random)


def beams_by_matrices(
    scene: BoxRoom, drive: Drive, T_base_lidar: Array, bearings: Array, times_s: Array
) -> Array:
    """The true range of each beam by (4, 4) matrices, beam after beam."""
    ranges_m = []
    for bearing, time_s in zip(bearings, times_s, strict=True):
        x, y, yaw = drive.pose([time_s])[0]
        T_map_base = mounting(x, y, 0.0, yaw_deg=math.degrees(yaw))
        T_map_lidar = T_map_base @ T_base_lidar
        direction = T_map_lidar[:3, :3] @ [math.cos(bearing), math.sin(bearing), 0.0]
        hit = scene.cast(
            T_map_lidar[None, :3, 3].astype(np.float32),
            direction[None].astype(np.float32),
            "lidar",
            float(time_s),
        )
        ranges_m.append(float(hit.distance_m[0]))
    return np.array(ranges_m)


@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("T_base_lidar", MOUNTINGS)
def test_each_beam_leaves_from_its_own_pose_at_its_own_time(
    T_base_lidar: Array, clockwise: bool
) -> None:
    model = EXACT.model_copy(update={"clockwise": clockwise})
    stamp_s = float(MOVING.starts_s[np.argmax(MOVING.motions[:, 2] != 0.0)])
    assert MOVING.velocity([stamp_s])[0].min() > 0.3  # driving and turning
    turn = turn_at(stamp_s, drive=MOVING, T_base_lidar=T_base_lidar, model=model)
    scan = turn.normalised(start_ns=10**18, lidar="scan", notes=Counter())
    assert scan.stamp_ns - 10**18 == round(stamp_s * 1e9)
    each = slice(None, None, 5)
    bearings, times_s = scan.bearings_rad[each], stamp_s + scan.beam_offsets_s[each]
    expected = beams_by_matrices(ROOM, MOVING, T_base_lidar, bearings, times_s)
    off_m = np.abs(scan.ranges_m[each] - expected)
    assert (off_m > 2e-5).sum() <= 2  # a beam on the very edge of a box may fall on either side
    # Taken as a snapshot the same scan would be wrong by much more than that.
    frozen = beams_by_matrices(ROOM, MOVING, T_base_lidar, bearings, np.full_like(times_s, stamp_s))
    assert np.median(np.abs(scan.ranges_m[each] - frozen)) > 0.005


def test_a_clockwise_lidar_looks_behind_left_ahead_right() -> None:
    turn = turn_at(model=EXACT.model_copy(update={"turn_rate_hz": 7.5}))
    count = turn.ranges_m.size
    assert count == 1200
    assert turn.angle_min_rad == pytest.approx(math.pi)
    assert turn.angle_increment_rad == pytest.approx(-2 * math.pi / count)
    assert turn.angle_max_rad == pytest.approx(-math.pi + 2 * math.pi / count)
    quarters = turn.ranges_m[[0, count // 4, count // 2, 3 * count // 4]]
    np.testing.assert_allclose(quarters, [3.0, 4.0, 5.0, 2.0], atol=1e-5)


def test_counter_clockwise_and_upside_down_see_the_room_from_the_other_side() -> None:
    model = EXACT.model_copy(update={"turn_rate_hz": 7.5, "clockwise": False})
    turn = turn_at(model=model)
    assert turn.angle_min_rad == pytest.approx(-math.pi)
    np.testing.assert_allclose(turn.ranges_m[[0, 300, 600, 900]], [3, 2, 5, 4], atol=1e-5)
    hanging = turn_at(model=model, T_base_lidar=mounting(roll_deg=180.0))
    np.testing.assert_allclose(hanging.ranges_m[[0, 300, 600, 900]], [3, 4, 5, 2], atol=1e-5)
    clockwise = turn_at(model=EXACT.model_copy(update={"turn_rate_hz": 7.5}))
    # Hung upside down it turns the other way: the same rays in the same order.
    np.testing.assert_allclose(hanging.ranges_m, clockwise.ranges_m, atol=1e-4)


@pytest.mark.parametrize(("rate_hz", "count"), [(7.0, 1286), (12.0, 750), (5.0, 1800)])
def test_the_count_of_beams_varies_about_that_of_the_rate(rate_hz: float, count: int) -> None:
    model = LidarModel(turn_rate_hz=rate_hz)
    turns = list(
        simulate_turns(
            ROOM, STANDING.pose, LEVEL, model, np.random.default_rng(2), start_s=3.0, end_s=13.0
        )
    )
    assert abs(len(turns) - 10.0 * rate_hz) <= 1.5
    counts = np.array([turn.ranges_m.size for turn in turns])
    sigma = model.turn_rate_spread * count
    assert abs(counts.mean() - count) < 4.0 * sigma / math.sqrt(counts.size) + 0.5
    assert 0.5 * sigma < counts.std() < 1.6 * sigma
    assert turns[0].stamp_s == 3.0
    for before, after in pairwise(turns):
        assert after.stamp_s == before.stamp_s + before.scan_time_s
        lasts_s = before.time_increment_s * before.ranges_m.size
        assert before.scan_time_s == pytest.approx(lasts_s, rel=1e-6)
    assert turns[-1].stamp_s + turns[-1].scan_time_s <= 13.0


def test_noise_is_white_and_grows_with_the_range() -> None:
    true_m = turn_at(scene=HALL).ranges_m.astype(np.float64)
    model = G4.model_copy(update={"turn_rate_spread": 0.0, "scale_error_max": 0.0})
    turns = simulate_turns(HALL, STANDING.pose, LEVEL, model, np.random.default_rng(8), end_s=10.0)
    off_m = np.array([turn.ranges_m - true_m for turn in turns])
    inside = (true_m > 0.0) & (true_m < 15.5)  # beyond, noise takes some out of range
    off_m, true_m = off_m[:, inside], true_m[inside]
    sigmas = off_m / (0.010 + 0.003 * true_m)
    assert abs(sigmas.mean()) < 4.0 / math.sqrt(sigmas.size)
    for part in (sigmas[:, true_m < 8.0], sigmas[:, true_m > 12.0]):
        assert abs(part.var() - 1.0) < 4.0 * math.sqrt(2.0 / part.size)
    assert abs(np.mean(sigmas**4) - 3.0) < 4.0 * math.sqrt(96.0 / sigmas.size)
    for neighbours in (sigmas[:, 1:] * sigmas[:, :-1], sigmas[1:] * sigmas[:-1]):
        assert abs(neighbours.mean()) < 4.0 / math.sqrt(neighbours.size)


def test_the_scale_error_is_one_for_a_drive() -> None:
    model = EXACT.model_copy(update={"scale_error_max": 0.002})
    true_m, errors = turn_at(scene=HALL).ranges_m, []
    seen = true_m > 0.0
    for seed in range(60):
        random = np.random.default_rng(seed)
        turns = list(simulate_turns(HALL, STANDING.pose, LEVEL, model, random, end_s=0.5))
        ratios = np.concatenate([(t.ranges_m / np.where(seen, true_m, 1))[seen] for t in turns])
        assert len(turns) == 3
        assert np.ptp(ratios[ratios > 0.0]) < 1e-6
        errors.append(float(np.median(ratios)) - 1.0)
    sizes = np.array(errors)
    assert np.abs(sizes).max() <= 0.002 + 1e-7
    assert abs(sizes.mean()) < 4.0 * 0.002 / math.sqrt(3 * sizes.size)
    assert sizes.std() == pytest.approx(0.002 / math.sqrt(3), rel=0.3)


def test_no_return_is_zero_and_reads_as_no_return() -> None:
    box = ((0.1, -0.5, 0.0), (0.25, 0.5, 2.0))
    scene = BoxRoom(room=((-30.0, -7.0, 0.0), (14.0, 1e9, 3.0)), boxes=(box,))
    turn = turn_at(scene=scene, model=G4.model_copy(update={"turn_rate_hz": 7.5}))
    behind, left, ahead, right = turn.ranges_m[[0, 300, 600, 900]]
    assert behind == left == ahead == 0.0  # too far, nothing, too near
    assert 6.8 < right < 7.2
    returned = turn.ranges_m[turn.ranges_m != 0.0]
    assert 0.28 <= returned.min() < returned.max() < 16.0
    notes: Counter[str] = Counter()
    scan = turn.normalised(start_ns=0, lidar="scan", notes=notes)
    np.testing.assert_array_equal(np.isposinf(scan.ranges_m), turn.ranges_m == 0.0)
    assert notes == {ZERO: int((turn.ranges_m == 0.0).sum())}


def test_the_lidar_looks_through_glass() -> None:
    glazed = BoxRoom(room=ROOM.room, pane=((1.0, -2.0, 0.0), (1.01, 4.0, 2.5)))
    bare = BoxRoom(room=ROOM.room)
    np.testing.assert_array_equal(turn_at(scene=glazed).ranges_m, turn_at(scene=bare).ranges_m)
    ray = np.array([[0, 0, 1]], dtype=np.float32), np.array([[1, 0, 0]], dtype=np.float32)
    assert glazed.cast(*ray, "depth", 0.0).distance_m[0] == pytest.approx(1.0)  # it is there


def test_what_moves_is_met_where_it_is_at_the_time_of_the_beam() -> None:
    # A wall-like box comes nearer at 2 m/s; half a turn later it is 14 cm nearer.
    scene = BoxRoom(
        room=((-50, -50, 0), (50, 50, 3)),
        boxes=(((8.0, -40.0, 0.0), (8.5, 40.0, 3.0)),),
        mover_m_s=(-2.0, 0.0, 0.0),
    )
    turn = turn_at(1.0, scene=scene)
    bearings = turn.angle_min_rad + turn.angle_increment_rad * np.arange(turn.ranges_m.size)
    times_s = 1.0 + turn.time_increment_s * np.arange(turn.ranges_m.size)
    met = np.abs(bearings) < math.radians(50)
    gaps_m = turn.ranges_m[met] * np.cos(bearings[met]) - (8.0 - 2.0 * times_s[met])
    assert np.abs(gaps_m).max() <= 2.0 * SLICE_S * 0.51
    assert abs(gaps_m.mean()) < 0.002


def test_edges_within_a_beam_give_ranges_between_both_sides() -> None:
    wide = EXACT.model_copy(update={"beam_width_rad": 0.0035})
    box = ((2.0, -0.5, 0.0), (2.4, 0.5, 2.0))
    scene = BoxRoom(room=((-30.0, -0.6, 0.0), (6.0, 3.0, 2.5)), boxes=(box,))
    mixed = []
    plain = turn_at(scene=scene).ranges_m
    for seed in range(40):
        ranges_m = turn_at(0.0, scene=scene, model=wide, seed=seed).ranges_m
        changed = np.flatnonzero(ranges_m != plain)
        mixed.append(changed)
        bearings = math.pi - 2 * math.pi / plain.size * changed
        # Only at the box's two visible edges, never along the wall seen at 2 deg and less.
        assert (np.abs(np.abs(bearings) - math.atan2(0.5, 2.0)) < 0.0035).all()
        near_m, far_m = plain[changed - 1], plain[changed + 1]
        low, high = np.minimum(near_m, far_m), np.maximum(near_m, far_m)
        assert ((ranges_m[changed] > low - EDGE_M) & (ranges_m[changed] < high + EDGE_M)).all()
    assert max(changed.size for changed in mixed) >= 1
    # A standing lidar mixes the same beams each time; without a width it never does.
    assert len({tuple(changed) for changed in mixed}) == 1


def test_as_many_edges_mix_as_the_beam_is_wide() -> None:
    # Lidars turned by random yaws: an edge falls into a beam with the share of its width.
    wide = EXACT.model_copy(update={"beam_width_rad": 0.003})
    box = ((2.0, -0.5, 0.0), (2.4, 0.5, 2.0))
    scene = BoxRoom(room=((-5.0, -3.0, 0.0), (6.0, 3.0, 2.5)), boxes=(box,))
    hits = 0
    for yaw_deg in np.random.default_rng(3).uniform(0.0, 360.0, 120):
        T_base_lidar = mounting(yaw_deg=float(yaw_deg))
        ranges_m = turn_at(scene=scene, T_base_lidar=T_base_lidar, model=wide).ranges_m
        plain = turn_at(scene=scene, T_base_lidar=T_base_lidar).ranges_m
        hits += int((ranges_m != plain).sum())
    share = 0.003 / (2 * math.pi / 1286)
    assert abs(hits / 240 - share) < 4.0 * math.sqrt(share * (1 - share) / 240)


def test_a_turn_is_what_its_message_says() -> None:
    turn = turn_at(2.0, drive=MOVING, T_base_lidar=MOUNTINGS[0], model=G4)
    message = SimpleNamespace(
        ranges=turn.ranges_m,
        **{
            name: np.float32(value)
            for name, value in (
                ("angle_min", turn.angle_min_rad),
                ("angle_max", turn.angle_max_rad),
                ("angle_increment", turn.angle_increment_rad),
                ("time_increment", turn.time_increment_s),
                ("scan_time", turn.scan_time_s),
                ("range_min", turn.range_min_m),
                ("range_max", turn.range_max_m),
            )
        },
    )
    notes: Counter[str] = Counter()
    read = scan_of_message(message, stamp_ns=7_000_000_000, lidar="scan", masks_rad=(), notes=notes)
    direct = turn.normalised(start_ns=5_000_000_000, lidar="scan", notes=Counter())
    assert read is not None
    assert not notes  # the fields agree with each other
    for name in ("ranges_m", "bearings_rad", "beam_offsets_s"):
        np.testing.assert_array_equal(getattr(read, name), getattr(direct, name))
    assert (read.stamp_ns, read.range_min_m, read.range_max_m) == (
        direct.stamp_ns,
        direct.range_min_m,
        direct.range_max_m,
    )


def test_a_seed_repeats_bit_by_bit() -> None:
    def bytes_of(seed: int) -> bytes:
        model = G4.model_copy(update={"beam_width_rad": 0.003})
        turns = simulate_turns(
            ROOM, MOVING.pose, MOUNTINGS[0], model, np.random.default_rng(seed), end_s=1.0
        )
        return b"".join(turn.ranges_m.tobytes() for turn in turns)

    assert bytes_of(4) == bytes_of(4)
    assert bytes_of(4) != bytes_of(5)


def test_a_slow_lidar_of_few_beams_has_a_beam_in_every_slice() -> None:
    sparse = EXACT.model_copy(update={"sample_rate_hz": 8.0, "turn_rate_hz": 1.0})
    np.testing.assert_allclose(turn_at(model=sparse).ranges_m[::2], [3.0, 4.0, 5.0, 2.0], atol=1e-5)


@pytest.mark.parametrize(
    "fields",
    [{"range_min_m": 20.0}, {"sample_rate_hz": 20.0}, {"noise_m": -1.0}, {"typo": 1}],
)
def test_a_lidar_that_cannot_be_is_refused(fields: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        LidarModel(**fields)
