"""Furniture fills its size, stands on the floor and leaves open what is open."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datasets.simulation.place import MATERIALS, Solid
from datasets.simulation.place_file import FurnitureSection
from datasets.simulation.place_furniture import furniture
from datasets.simulation.place_geometry import mesh
from tests.datasets.simulation.place_meshes import corners, nearest_hit_m, open_edges, volume_m3

KINDS = ("table", "chair", "swivel-chair", "sofa", "shelf")


def made(kind: str, size_m: tuple[float, float, float], **more: object) -> Solid:
    fields = {"name": "f", "kind": kind, "at_m": (0, 0), "size_m": size_m} | more
    prisms = furniture(FurnitureSection.model_validate(fields))
    return Solid("f", *mesh(prisms), MATERIALS["wood"])


@given(st.sampled_from(KINDS), st.floats(0.3, 2.0), st.floats(0.3, 2.0), st.floats(0.6, 2.0))
def test_it_fills_its_size_and_no_more(kind: str, x: float, y: float, z: float) -> None:
    solid = made(kind, (x, y, z))
    low, high = solid.vertices.min(0), solid.vertices.max(0)
    # The arms of a swivel chair end in corners, on castors that are left out.
    slack_m = 0.041 if kind == "swivel-chair" else 1e-5
    np.testing.assert_allclose(low, [-x / 2, -y / 2, 0.0], atol=slack_m)
    np.testing.assert_allclose(high, [x / 2, y / 2, z], atol=slack_m)
    assert open_edges(solid) == []
    assert volume_m3(solid) < 0.9 * x * y * z


def test_a_table_has_the_volume_of_its_boards_and_legs() -> None:
    solid = made("table", (1.6, 0.8, 0.73))
    assert volume_m3(solid) == pytest.approx(1.6 * 0.8 * 0.03 + 4 * 0.05**2 * 0.7, rel=1e-4)


@pytest.mark.parametrize("overhang_m", [0.0, 0.05, 0.3])
def test_the_top_of_a_table_reaches_over_its_legs(overhang_m: float) -> None:
    table = corners(made("table", (1.6, 0.8, 0.74), overhang_m=overhang_m))
    for y in (-0.375 + overhang_m, 0.375 - overhang_m):
        beam = (np.array([-2.0, y, 0.3]), np.array([1.0, 0.0, 0.0]))
        assert nearest_hit_m(table, *beam) == pytest.approx(1.2 + overhang_m, abs=1e-5)
    assert nearest_hit_m(table, np.array([-2, 0.0, 0.3]), np.array([1.0, 0, 0])) == np.inf


def test_who_sits_on_a_chair_looks_along_its_x() -> None:
    """The back is behind: from ahead a beam above the seat meets it at its far end."""
    ahead, backwards = np.array([2.0, 0.0, 0.7]), np.array([-1.0, 0.0, 0.0])
    chair = corners(made("chair", (0.5, 0.45, 0.9)))
    assert nearest_hit_m(chair, ahead, backwards) == pytest.approx(2.25 - 0.03, abs=1e-5)
    turned = corners(made("chair", (0.5, 0.45, 0.9), yaw_deg=180))
    assert nearest_hit_m(turned, ahead, backwards) == pytest.approx(1.75, abs=1e-5)


def test_under_a_sofa_is_a_gap_and_a_shelf_is_open_to_the_front() -> None:
    sofa = corners(made("sofa", (0.9, 1.8, 0.8)))
    assert nearest_hit_m(sofa, np.array([2.0, 0.1, 0.06]), np.array([-1.0, 0, 0])) == np.inf
    assert nearest_hit_m(sofa, np.array([2.0, 0.1, 0.2]), np.array([-1.0, 0, 0])) == pytest.approx(
        1.55, abs=1e-5
    )
    shelf = corners(made("shelf", (0.4, 1.0, 1.8)))
    assert nearest_hit_m(shelf, np.array([2.0, 0.0, 0.2]), np.array([-1.0, 0, 0])) == pytest.approx(
        2.18, abs=1e-5
    )
