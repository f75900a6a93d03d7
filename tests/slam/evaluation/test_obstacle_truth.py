"""Which obstacles a camera could have seen, in a room where it can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.messages import Array
from datasets.recording import Intrinsics
from datasets.simulation.place import Place, load_place
from datasets.trajectory import Trajectory
from slam.evaluation.obstacle_score import score_obstacles
from slam.evaluation.obstacle_truth import CameraView, ObstacleTruth, by_visit, obstacle_truth
from slam.evaluation.surfaces import sample_surfaces, section_points

ROOM = """
walls:
  - {name: walls, ring: [[-3, -3], [3, -3], [3, 3], [-3, 3], [-3, -3]], height_m: 2.5}
boxes:
  - {name: low, at_m: [1.75, 0.5], size_m: [0.5, 0.4, 0.3], material: cardboard}
  - {name: tall, at_m: [1.75, -1.0], size_m: [0.3, 0.4, 1.5], material: cardboard}
  - {name: black, at_m: [2.2, 1.4], size_m: [0.3, 0.3, 0.5], material: black}
furniture:
  - {name: desk, kind: table, at_m: [2.4, -0.2], size_m: [0.5, 0.5, 0.7]}
moving_boxes:
  - {name: trolley, path_m: [[-2, 2], [-1, 2]], size_m: [0.3, 0.3, 0.9], speed_m_s: 0.05}
"""
START_NS = 5_000_000_000


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    path = tmp_path_factory.mktemp("place") / "place.yaml"
    path.write_text(ROOM, encoding="utf-8")
    return load_place(path)


def view(times_s: Array) -> CameraView:
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = 0.15, 0.0, 0.25
    K = np.array([[384.0, 0, 319.5], [0, 384.0, 239.5], [0, 0, 1]])
    stamps_ns = START_NS + (times_s * 1e9).astype(np.int64)
    return CameraView(T, Intrinsics(K, 640, 480), stamps_ns)


def standing(times_s: Array, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Trajectory:
    stamps_ns = START_NS + (times_s * 1e9).astype(np.int64)
    return Trajectory(stamps_ns, np.tile([x, y, yaw], (times_s.size, 1)))


TIMES_S = np.arange(4) * 0.2


@pytest.fixture(scope="module")
def truth(place: Place) -> ObstacleTruth:
    return obstacle_truth(place, standing(TIMES_S), [view(TIMES_S)], [0.895], START_NS)


def of(truth: ObstacleTruth, name: str) -> Array:
    return np.flatnonzero(truth.solid == truth.names.index(name))


def test_every_face_has_points_on_it_and_covers_its_area(place: Place) -> None:
    box = [solid for solid in place.solids if solid.name == "low"]
    points = sample_surfaces(box, 0.05, 1.0)
    sides = points.upright & (np.abs(points.normals[:, 2]) < 0.5)
    assert points.areas_m2[sides].sum() == pytest.approx(2 * (0.5 + 0.4) * 0.25)
    assert points.areas_m2[~points.upright].sum() == pytest.approx(0.5 * 0.4)  # its top only
    offset = np.abs(points.points_map[sides, :2] - [1.75, 0.5]) / [0.25, 0.2]
    np.testing.assert_allclose(offset.max(axis=1), 1.0, atol=1e-6)
    outwards = (points.points_map[:, :2] - [1.75, 0.5]) * points.normals[:, :2]
    assert (outwards.sum(axis=1)[sides] > 0).all()


def test_thin_legs_and_boards_have_points(place: Place) -> None:
    desk = [solid for solid in place.solids if solid.name == "desk"]
    points = sample_surfaces(desk, 0.05, 1.0)
    legs = points.points_map[(points.points_map[:, 2] < 0.6) & points.upright]
    quarters = {tuple(np.sign(row)) for row in legs[:, :2] - [2.4, -0.2]}
    assert len(quarters) == 4
    assert (points.upright & (points.points_map[:, 2] > 0.67)).sum() >= 4 * 10


def test_a_plane_cuts_only_what_reaches_it(place: Place) -> None:
    cut = section_points(place.solids, 0.895)
    near_tall = np.abs(cut - [1.75, -1.0]).max(axis=1) < 0.3
    assert np.hypot(*np.ptp(cut[near_tall], axis=0)) == pytest.approx(0.5, abs=1e-6)
    assert not (np.abs(cut - [1.75, 0.5]).max(axis=1) < 0.3).any()


def test_only_the_faces_towards_the_camera_are_seen(truth: ObstacleTruth) -> None:
    low = truth.cells_map[of(truth, "low")]
    front, side = np.abs(low[:, 0] - 1.5) < 0.02, np.abs(low[:, 1] - 0.3) < 0.02  # and their corner
    assert (front | side).all()
    assert front.sum() >= 8  # 0.4 m in cells of 5 cm
    assert side.sum() >= 9
    assert truth.heights_m[of(truth, "low"), 0].min() < 0.08
    assert truth.heights_m[of(truth, "low"), 1].max() > 0.27


def test_what_stands_behind_is_hidden_as_far_as_the_shadow_reaches(truth: ObstacleTruth) -> None:
    """The low box shadows the wall at 3 m up to 0.25 + 0.05 * 2.85 / 1.85 m at most."""
    wall = of(truth, "walls")
    at = truth.cells_map[wall]
    shadow = (at[:, 0] > 2.9) & (at[:, 1] > 0.75) & (at[:, 1] < 0.95)
    assert shadow.sum() >= 3
    lowest_m = truth.heights_m[wall[shadow], 0]
    assert lowest_m.min() > 0.25 + 0.05 * 2.85 / 1.85 - 0.025
    assert lowest_m.max() < 0.25 + 0.05 * 2.85 / 1.35 + 0.05
    tall = (at[:, 0] > 2.9) & (at[:, 1] < -1.6) & (at[:, 1] > -1.8)
    assert not tall.any()


def test_what_returns_nothing_or_stands_beside_the_view_is_not_seen(truth: ObstacleTruth) -> None:
    assert of(truth, "black").size == 0
    bearings = np.arctan2(truth.cells_map[:, 1], truth.cells_map[:, 0] - 0.15)
    assert np.degrees(np.abs(bearings)).max() < 40.0
    distance_m = np.hypot(truth.cells_map[:, 0] - 0.15, truth.cells_map[:, 1])
    assert distance_m.max() < 3.5


def test_low_is_what_the_lidar_passes_over(truth: ObstacleTruth) -> None:
    assert truth.low[of(truth, "low")].all()
    assert truth.low[of(truth, "desk")].all()
    assert not truth.low[of(truth, "tall")].any()
    assert not truth.low[of(truth, "walls")].any()


def test_two_images_are_not_enough(place: Place) -> None:
    few = TIMES_S[:2]
    truth = obstacle_truth(place, standing(few), [view(few)], [0.895], START_NS)
    assert len(truth.cells_map) == 0


def test_movers_hide_but_are_not_there(place: Place) -> None:
    there = standing(TIMES_S, -1.5, 0.0, np.pi / 2)
    truth = obstacle_truth(place, there, [view(TIMES_S)], [0.895], START_NS)
    wall = truth.cells_map[of(truth, "walls")]
    # The trolley begins at (-2, 2) and creeps to the right: seen from (-1.5, 0.15) it hides the
    # wall between the rays past its corners (-2.15, 1.85) and (-1.85, 2.15).
    seen = wall[wall[:, 1] > 2.99, 0]
    left, right = -1.5 - 0.65 * 2.85 / 1.7, -1.5 - 0.35 * 2.85 / 2.0
    assert not ((seen > left + 0.04) & (seen < right)).any()
    assert ((seen > left - 0.15) & (seen < left)).any()
    assert ((seen > right + 0.04) & (seen < right + 0.15)).any()
    assert truth.movers == ("trolley",)
    assert "trolley" not in truth.names


def test_the_same_question_is_answered_once(place: Place, truth: ObstacleTruth) -> None:
    again = obstacle_truth(place, standing(TIMES_S), [view(TIMES_S)], [0.895], START_NS)
    assert again is truth
    other = obstacle_truth(place, standing(TIMES_S), [view(TIMES_S)], [0.2], START_NS)
    assert other is not truth
    assert not other.low[of(other, "low")].any()


def test_each_visit_counts_once() -> None:
    stamps_ns = np.array([0, 1, 2, 20, 21, 22, 23, 5], dtype=np.int64) * 1_000_000_000
    thing = np.array([7, 7, 7, 7, 7, 7, 7, 9])
    visits = by_visit(thing, stamps_ns)
    assert visits.thing.tolist() == [7, 7, 9]
    assert (visits.stamps_ns // 1_000_000_000).tolist() == [1, 22, 5]
    nearest = by_visit(thing, stamps_ns, np.array([3.0, 2, 1, 4, 5, 6, 7, 1]))
    assert (nearest.stamps_ns // 1_000_000_000).tolist() == [2, 20, 5]


def cells_of(points: Array) -> Array:
    cells: Array = np.unique(np.floor(points / 0.05), axis=0) * 0.05 + 0.025
    return cells


def test_the_true_map_scores_full(truth: ObstacleTruth) -> None:
    score = score_obstacles(truth, cells_of(truth.cells_map), truth.T_map_base)
    assert score.structure.f1 == score.low.f1 == 1.0
    assert score.objects_found.value == score.low_objects_found.value == 1.0
    assert {item.name for item in score.objects if item.is_low} == {"low", "desk"}


def test_a_map_of_the_lidar_lacks_the_low_ones(truth: ObstacleTruth) -> None:
    score = score_obstacles(truth, cells_of(truth.section_map), truth.T_map_base)
    assert score.structure.precision.value == 1.0
    assert score.low.recall.value == 0.0
    assert score.low.f1 == 0.0
    found = {item.name: item.found for item in score.objects}
    assert found == {"low": False, "desk": False, "tall": True, "walls": True}


def test_an_error_of_the_trajectory_is_taken_out_and_one_of_the_map_is_not(
    truth: ObstacleTruth,
) -> None:
    """The estimate is 0.6 m and 20 deg off: so is its map."""
    shift, turn = np.array([0.5, -0.33]), np.radians(20.0)
    c, s = np.cos(turn), np.sin(turn)
    drawn = cells_of(truth.cells_map @ np.array([[c, s], [-s, c]]) + shift)
    estimate = standing(TIMES_S, *shift, turn)
    score = score_obstacles(truth, drawn, estimate)
    assert score.structure.f1 == 1.0
    assert score.structure.precision.total == len(drawn)
    unexcused = score_obstacles(truth, drawn, truth.T_map_base)
    assert (unexcused.structure.recall.value or 0.0) < 0.5


def test_false_cells_cost_precision_only_where_they_were_in_view(truth: ObstacleTruth) -> None:
    true_cells = cells_of(truth.cells_map)
    amid = np.array([[1.0, 0.0], [1.0, 0.2], [0.8, -0.1]])
    outside = np.array([[-1.0, 0.0], [0.2, 2.0], [2.0, -2.8], [-2.5, -2.5]])
    score = score_obstacles(truth, np.vstack([true_cells, amid, outside]), truth.T_map_base)
    assert score.structure.precision.total - score.structure.precision.hits == 3
    assert score.structure.precision.total == len(true_cells) + 3
    assert score.judged[-4:].tolist() == [False] * 4
    assert score.low.precision.total - score.low.precision.hits == 3


def test_nothing_in_the_map_finds_nothing(truth: ObstacleTruth) -> None:
    score = score_obstacles(truth, np.empty((0, 2)), truth.T_map_base)
    assert score.structure.recall.value == 0.0
    assert score.structure.precision.value is None
    assert score.structure.f1 == 0.0
    with pytest.raises(ValueError, match="finite"):
        score_obstacles(truth, np.array([[np.nan, 0.0]]), truth.T_map_base)


def test_ten_centimetres_are_near_enough_and_twelve_are_not(truth: ObstacleTruth) -> None:
    front = of(truth, "low")
    front = front[np.abs(truth.cells_map[front, 0] - 1.5) < 0.001]
    for off_m, expected in ((0.098, True), (0.102, False)):
        drawn = truth.cells_map[front] - [off_m, 0.0]
        assert score_obstacles(truth, drawn, truth.T_map_base).hit[front].all() == expected
