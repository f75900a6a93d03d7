"""Walls: corners, thickness, openings, doors, panes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datasets.errors import InputError
from datasets.messages import Array
from datasets.simulation.place import Place, Solid, load_place
from tests.datasets.simulation.place_meshes import (
    corners,
    nearest_hit_m,
    open_edges,
    volume_m3,
    write_place,
)

ROOM = "{name: room, ring: [[0, 0], [6, 0], [6, 4], [0, 4], [0, 0]], height_m: 2.5"


def read(folder: Path, *walls: str, more: str = "") -> Place:
    text = "walls:\n" + "".join(f"  - {wall}\n" for wall in walls) + more
    return load_place(write_place(folder, text))


def named(place: Place, name: str) -> Solid:
    return next(solid for solid in place.solids if solid.name == name)


def first_hit_m(solid: Solid, origin: tuple[float, ...], direction: tuple[float, ...]) -> float:
    return nearest_hit_m(corners(solid), np.array(origin), np.array(direction))


def span(solid: Solid) -> tuple[Array, Array]:
    return solid.vertices.min(0), solid.vertices.max(0)


@pytest.mark.parametrize(
    "ring", ["[0, 0], [6, 0], [6, 4], [0, 4]", "[0, 4], [6, 4], [6, 0], [0, 0]"]
)
@pytest.mark.parametrize("faces", ["inside", "outside"])
def test_a_ring_keeps_the_side_it_faces_free(tmp_path: Path, ring: str, faces: str) -> None:
    first = ring.split("], ", maxsplit=1)[0] + "]"
    wall = f"{{name: w, ring: [{ring}, {first}], faces: {faces}, height_m: 2.5, thickness_m: 0.3}}"
    around = "{name: around, ring: [[-9, -9], [9, -9], [9, 9], [-9, 9], [-9, -9]], height_m: 1}"
    solid = named(read(tmp_path, around, wall), "w")
    low, high = span(solid)
    grown = 0.3 if faces == "inside" else 0.0
    np.testing.assert_allclose(low, [-grown, -grown, 0.0], atol=1e-6)
    np.testing.assert_allclose(high, [6 + grown, 4 + grown, 2.5], atol=1e-6)
    area_m2 = 6.6 * 4.6 - 24 if faces == "inside" else 24 - 5.4 * 3.4
    assert volume_m3(solid) == pytest.approx(area_m2 * 2.5, rel=1e-5)
    assert open_edges(solid) == []


def test_a_line_has_the_wall_on_both_sides_and_mitred_corners(tmp_path: Path) -> None:
    line = "{name: w, line: [[1, 1], [3, 1], [3, 3]], height_m: 2, thickness_m: 0.2}"
    solid = named(read(tmp_path, ROOM + "}", line), "w")
    # An L of 0.2 m around its middle line: the corner's square counts once.
    assert volume_m3(solid) == pytest.approx((2 * 0.2 + 2 * 0.2) * 2, rel=1e-5)
    np.testing.assert_allclose(span(solid), [[1, 0.9, 0], [3.1, 3, 2]], atol=1e-6)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
@given(
    at_m=st.floats(1.0, 5.0),
    width_m=st.floats(0.3, 2.0),
    sill_m=st.floats(0.0, 1.0),
    head_m=st.floats(1.1, 2.5),
)
def test_an_opening_takes_away_its_volume(
    tmp_path: Path, at_m: float, width_m: float, sill_m: float, head_m: float
) -> None:
    hole = f"{{at_m: {at_m}, width_m: {width_m}, sill_m: {sill_m}, head_m: {head_m}}}"
    whole = named(read(tmp_path, ROOM + "}"), "room")
    solid = named(read(tmp_path, f"{ROOM}, openings: [{hole}]}}"), "room")
    taken_m3 = volume_m3(whole) - volume_m3(solid)
    assert taken_m3 == pytest.approx(width_m * (head_m - sill_m) * 0.2, abs=2e-4)
    assert open_edges(solid) == []
    middle_m = (sill_m + head_m) / 2
    assert first_hit_m(solid, (at_m, 1.0, middle_m), (0, -1, 0)) == np.inf
    assert first_hit_m(solid, (at_m, 1.0, (head_m + 2.5) / 2), (0, -1, 0)) == (
        pytest.approx(1.0, abs=1e-5) if head_m < 2.499 else pytest.approx(np.inf)
    )
    for side in (-1, 1):
        beside_m = at_m + side * (width_m / 2 + 0.01)
        if 0.0 < beside_m < 6.0:
            assert first_hit_m(solid, (beside_m, 1.0, middle_m), (0, -1, 0)) == pytest.approx(1.0)


def test_segments_count_from_the_first_point(tmp_path: Path) -> None:
    solid = named(
        read(tmp_path, ROOM + ", openings: [{segment: 1, at_m: 3, width_m: 0.5}]}"), "room"
    )
    assert first_hit_m(solid, (5.0, 3.0, 1.0), (1, 0, 0)) == np.inf
    assert first_hit_m(solid, (5.0, 1.0, 1.0), (1, 0, 0)) == pytest.approx(1.0)


def test_a_closed_door_stands_back_in_its_niche(tmp_path: Path) -> None:
    """The ring runs counter-clockwise, so its right side is the outside."""
    door = "{at_m: 3, width_m: 1, head_m: 2, leaf: {swing: right, thickness_m: 0.05}}"
    place = read(tmp_path, f"{ROOM}, openings: [{door}]}}")
    leaf = named(place, "room/leaf 0")
    np.testing.assert_allclose(span(leaf), [[2.5, -0.2, 0], [3.5, -0.15, 2]], atol=1e-6)
    assert leaf.material.name == "wood"


@pytest.mark.parametrize(
    ("swing", "hinge", "low", "high"),
    [
        ("left", "start", (2.5, 0.0), (2.55, 1.0)),
        ("left", "end", (3.45, 0.0), (3.5, 1.0)),
        ("right", "start", (2.5, -1.2), (2.55, -0.2)),
        ("right", "end", (3.45, -1.2), (3.5, -0.2)),
    ],
)
def test_an_open_door_stands_at_its_hinge(
    tmp_path: Path, swing: str, hinge: str, low: Array, high: Array
) -> None:
    leaf = f"{{swing: {swing}, hinge: {hinge}, open_deg: 90, thickness_m: 0.05}}"
    place = read(
        tmp_path, f"{ROOM}, openings: [{{at_m: 3, width_m: 1, head_m: 2, leaf: {leaf}}}]}}"
    )
    np.testing.assert_allclose(
        span(named(place, "room/leaf 0")), [[*low, 0], [*high, 2]], atol=1e-6
    )


def test_a_pane_has_glass_between_frame_and_bars(tmp_path: Path) -> None:
    window = "{at_m: 3, width_m: 2, sill_m: 1, head_m: 2, pane: {bars: 1, frame_m: 0.1}}"
    place = read(tmp_path, f"{ROOM}, openings: [{window}]}}")
    glass, frame = named(place, "room/pane 0"), named(place, "room/frame 0")
    assert glass.material.lidar == "clear"
    assert volume_m3(glass) == pytest.approx((2 - 0.3) * 0.8 * 0.01, rel=1e-4)
    assert volume_m3(frame) == pytest.approx(
        (3 * 0.1 * 1 + 2 * 1.8 * 0.1 - 2 * 0.01) * 0.1, rel=1e-3
    )
    assert first_hit_m(frame, (3.0, 1.0, 1.5), (0, -1, 0)) == pytest.approx(1.05, abs=1e-5)
    assert first_hit_m(frame, (2.5, 1.0, 1.5), (0, -1, 0)) == np.inf
    assert first_hit_m(glass, (2.5, 1.0, 1.5), (0, -1, 0)) == pytest.approx(1.095, abs=1e-5)


def test_a_pane_without_a_frame_has_none(tmp_path: Path) -> None:
    window = "{at_m: 3, width_m: 2, sill_m: 1, head_m: 2, pane: {frame_m: 0}}"
    place = read(tmp_path, f"{ROOM}, openings: [{window}]}}")
    assert [solid.name for solid in place.solids] == ["room", "room/pane 0"]
    assert volume_m3(named(place, "room/pane 0")) == pytest.approx(2 * 1 * 0.01, rel=1e-4)


def test_floor_and_ceiling_reach_under_and_over_the_walls(tmp_path: Path) -> None:
    place = read(tmp_path, ROOM + "}", more="floor: marble\nceiling_m: 2.5\n")
    floor, ceiling = named(place, "floor"), named(place, "ceiling")
    assert place.floor
    assert (floor.material.name, ceiling.material.name) == ("marble", "wall")
    np.testing.assert_allclose(span(floor), [[-0.5, -0.5, -0.5], [6.5, 4.5, 0]], atol=1e-6)
    np.testing.assert_allclose(span(ceiling), [[-0.5, -0.5, 2.5], [6.5, 4.5, 3]], atol=1e-6)
    assert [solid.name for solid in read(tmp_path, ROOM + "}").solids] == ["room"]
    tall = "boxes: [{name: mast, at_m: [1, 1], size_m: [0.1, 0.1, 2.6]}]\nceiling_m: 2.5\n"
    with pytest.raises(InputError, match=r"mast stands 0\.10 m deep in ceiling"):
        read(tmp_path, ROOM + "}", more=tall)
