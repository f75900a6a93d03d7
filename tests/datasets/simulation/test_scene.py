"""Rays into simple places, with known answers."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest

from datasets.simulation.place import MATERIALS, Material, Mover, Place, Solid
from datasets.simulation.scene import Float32s, Hits, Scene
from datasets.simulation.scene_kernels import rays_near_spheres

WALL, GLASS, BLACK = MATERIALS["wall"], MATERIALS["glass"], MATERIALS["black"]
BOX_FACES = [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5), (2, 3, 7), (2, 7, 6)]
BOX_FACES += [(0, 2, 6), (0, 6, 4), (1, 7, 3), (1, 5, 7)]


def box(
    name: str, low: tuple[float, float, float], high: tuple[float, float, float], material: Material
) -> Solid:
    corners = np.array(list(product(*zip(low, high, strict=True))), dtype=np.float32)
    return Solid(name, corners, np.array(BOX_FACES, dtype=np.uint32), material)


def place(*solids: Solid, movers: tuple[Mover, ...] = ()) -> Place:
    return Place("test", solids, movers, floor=False)


def look(
    scene: Scene, sensor: str, *directions: tuple[float, float, float], at: float = 0.0
) -> Hits:
    way = np.array(directions, dtype=np.float32)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    origins = np.zeros_like(way) + np.float32([0, 0, 1])
    return scene.cast(origins, way.astype(np.float32), sensor, at)  # type: ignore[arg-type]


FAR_WALL = box("wall", (4, -5, 0), (4.2, 5, 3), WALL)
PANE = box("pane", (2, -1, 0), (2.01, 1, 2), GLASS)


def test_distance_normal_and_material_of_a_wall() -> None:
    scene = Scene(place(FAR_WALL))
    hits = look(scene, "lidar", (1, 0, 0), (1, 1, 0), (-1, 0, 0))
    np.testing.assert_allclose(hits.distance_m, [4, 4 * math.sqrt(2), np.inf], rtol=1e-6)
    np.testing.assert_allclose(np.abs(hits.normals), [[1, 0, 0], [1, 0, 0], [0, 0, 0]], atol=1e-6)
    assert [scene.materials[i].name for i in hits.materials[:2]] == ["wall", "wall"]
    assert hits.materials[2] == -1
    assert hits.distance_m.dtype == np.float32


def test_glass_lets_the_lidar_through_and_gives_the_camera_nothing() -> None:
    scene = Scene(place(PANE, FAR_WALL))
    ways = ((1, 0, 0), (1, 0.6, 0))  # through the pane, and beside it
    lidar, depth = look(scene, "lidar", *ways), look(scene, "depth", *ways)
    np.testing.assert_allclose(lidar.distance_m, [4, 4 * math.hypot(1, 0.6)], rtol=1e-6)
    assert [scene.materials[i].name for i in lidar.materials] == ["wall", "wall"]
    assert depth.distance_m[0] == np.inf
    assert scene.materials[depth.materials[0]] == GLASS
    assert depth.distance_m[1] == pytest.approx(4 * math.hypot(1, 0.6))


def test_black_things_are_there_for_the_lidar_only() -> None:
    scene = Scene(place(box("bin", (2, -1, 0), (3, 1, 2), BLACK), FAR_WALL))
    assert look(scene, "lidar", (1, 0, 0)).distance_m[0] == pytest.approx(2)
    assert look(scene, "depth", (1, 0, 0)).distance_m[0] == np.inf


def test_an_empty_place_gives_nothing() -> None:
    hits = look(Scene(place()), "lidar", (1, 0, 0))
    assert hits.distance_m.tolist() == [np.inf]
    assert hits.materials.tolist() == [-1]
    none = np.zeros((0, 3), dtype=np.float32)
    assert Scene(place(FAR_WALL)).cast(none, none, "depth", 0.0).distance_m.shape == (0,)


def mover(material: Material = BLACK) -> Mover:
    solid = box("cart", (-0.25, -0.25, 0), (0.25, 0.25, 1.5), material)
    path = np.array([[2.0, -2.0, 0.0], [2.0, 2.0, 0.0]])
    return Mover("cart", solid, np.array([0.0, 4.0]), path, loop=False)


def test_a_mover_is_where_it_is_at_the_time() -> None:
    scene = Scene(place(FAR_WALL, movers=(mover(),)))
    seen = [float(look(scene, "lidar", (1, 0, 0), at=at).distance_m[0]) for at in (0.0, 2.0, 4.0)]
    assert seen == pytest.approx([4, 1.75, 4])
    hits = look(scene, "depth", (1, 0, 0), at=2.0)
    assert hits.distance_m[0] == np.inf
    assert scene.materials[hits.materials[0]] == BLACK


def test_a_mover_hides_behind_what_stands_before_it_and_glass_moves_too() -> None:
    screen = box("screen", (1, -1, 0), (1.1, 1, 2), WALL)
    hits = look(Scene(place(screen, movers=(mover(),))), "lidar", (1, 0, 0), at=2.0)
    assert hits.distance_m[0] == pytest.approx(1)
    clear = Scene(place(FAR_WALL, movers=(mover(GLASS),)))
    assert look(clear, "lidar", (1, 0, 0), at=2.0).distance_m[0] == pytest.approx(4)
    assert look(clear, "depth", (1, 0, 0), at=2.0).distance_m[0] == np.inf


def test_a_turned_mover_is_turned() -> None:
    solid = box("plank", (-1, -0.05, 0), (1, 0.05, 2), WALL)
    turned = Mover("plank", solid, np.array([0.0]), np.array([[3.0, 0.0, math.pi / 2]]), loop=False)
    hits = look(Scene(place(movers=(turned,))), "lidar", (1, 0, 0), (1, 0.3, 0))
    np.testing.assert_allclose(hits.distance_m, [2.95, 2.95 * math.hypot(1, 0.3)], rtol=1e-5)


def test_wrong_shapes_are_refused() -> None:
    flat = np.zeros((4, 2), dtype=np.float32)
    with pytest.raises(ValueError, match="not \\(N, 3\\)"):
        Scene(place(FAR_WALL)).cast(flat, flat, "lidar", 0.0)


def near_plain(rays: Float32s, spheres: Float32s) -> list[int]:
    """By the distance of the sphere's centre from the half line."""
    origins, ways = rays[:, :3].astype(float), rays[:, 3:].astype(float)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    to_centres = spheres[None, :, :3] - origins[:, None]
    along = np.clip(np.einsum("nmk,nk->nm", to_centres, ways), 0, None)
    beside = np.linalg.norm(to_centres - along[..., None] * ways[:, None], axis=2)
    return [int(i) for i in np.flatnonzero((beside < spheres[:, 3]).any(axis=1))]


def test_rays_near_spheres_against_the_plain_twin() -> None:
    rng = np.random.default_rng(3)
    rays = rng.normal(size=(500, 6)).astype(np.float32)
    spheres = np.column_stack([rng.normal(size=(3, 3)) * 3, [0.4, 0.9, 1.4]]).astype(np.float32)
    near = rays_near_spheres(rays, spheres).tolist()
    assert near == near_plain(rays, spheres)
    assert 0 < len(near) < 500
