"""What a place file that is wrong is told: file, line, key, remedy."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datasets.errors import InputError
from datasets.section import Section
from datasets.simulation import place_file
from datasets.simulation.place import MATERIALS, SHIPPED, Place, load_drive, load_place
from tests.datasets.simulation.place_meshes import write_place

GOOD = """\
floor: marble
materials:
  velvet: {depth: invisible, reflectance: 0.1}
walls:
  - name: room
    ring: [[-3, -3], [5, -3], [5, 3], [-3, 3], [-3, -3]]
    height_m: 2.5
    openings:
      - {segment: 0, at_m: 3, width_m: 1, head_m: 2, pane: {}}
      - {segment: 1, at_m: 3, width_m: 1, head_m: 2, leaf: {open_deg: 80, swing: right}}
boxes:
  - {name: crate, at_m: [2, 2], size_m: [0.5, 0.4, 0.3], material: velvet}
cylinders:
  - {name: post, at_m: [-2, 2], radius_m: 0.2, height_m: 2}
furniture:
  - {name: desk, kind: table, at_m: [3, -1], size_m: [1.6, 0.8, 0.74]}
people:
  - {name: walker, path_m: [[-2, 0], [-2, -2]]}
moving_boxes:
  - {name: cart, path_m: [[0, 2], [1, 2]], size_m: [0.6, 0.4, 0.9]}
structures:
  width: {from_m: [-3, 0], to_m: [5, 0]}
points:
  corner: [1.75, 1.8, 0]
drives:
  tour: {way_points_m: [[0, 0], [0.5, -1.5]], closed: true}
"""


def read(folder: Path, text: str) -> Place:
    return load_place(write_place(folder, text))


def test_the_file_that_the_others_are_made_from_is_good(tmp_path: Path) -> None:
    place = read(tmp_path, GOOD)
    assert place.name == "place"
    assert [solid.name for solid in place.solids] == [
        *("floor", "room", "room/pane 0", "room/frame 0", "room/leaf 1"),
        *("crate", "post", "desk"),
    ]
    assert {mover.name for mover in place.movers} == {
        *("walker/left leg", "walker/right leg", "walker/body", "cart")
    }
    crate = place.solids[5].material
    assert (crate.name, crate.lidar, crate.depth, crate.reflectance) == (
        *("velvet", "opaque", "invisible"),
        0.1,
    )
    assert place.structures["width"].length_m == 8.0
    assert place.drives["tour"].start_yaw_rad == pytest.approx(-1.2490458)


OPENING = "segment: 0, at_m: 3, width_m: 1, head_m: 2"
CASES = [
    # what is written in place of what, (line, key), what the error says, its remedy
    ("head_m: 2, pane", "haed_m: 2, pane", 9, "walls.0.openings.0.haed_m", "no such key", "head_m"),
    ("reflectance: 0.1", "reflectanze: 0.1", 3, "materials.velvet.reflectanze", "no such", "depth"),
    ("boxes:", "boxs:", 11, "boxs", "no such key", "moving_boxes"),
    ("from_m:", "form_m:", 22, "structures.width.form_m", "", "from_m"),
    (
        ", [-3, 3], [-3, -3]]",
        ", [-3, 3], [-3, -2.8]]",
        6,
        "walls.0.ring",
        "open: it ends 0.2 m",
        "first",
    ),
    (", [-3, 3], [-3, -3]]", ", [-3, 3]]", 6, "walls.0.ring", "open: it ends 6 m", "first"),
    ("[5, -3], [5, 3]", "[5, 3], [5, -3]", 6, "walls.0.ring.2", "through itself", "order"),
    ("[5, -3], [5, 3]", "[5, -3], [5, -3], [5, 3]", 6, "walls.0.ring.2", "twice in a row", "Leave"),
    ("ring: ", "line: ", 6, "walls.0.line.3", "through itself", "ring"),
    (
        "ring: [[-3, -3], [5, -3], [5, 3], [-3, 3], [-3, -3]]",
        "line: [[-3, -3], [5, -3], [5, 3], [-3, 3], [-3, -2.7]]",
        4,
        "walls",
        "no wall closes the place",
        "ring",
    ),
    ("    height_m: 2.5\n", "", 5, "walls.0.height_m", "missing", "docs/places.md"),
    ("height_m: 2.5", "height_m: tall", 7, "walls.0.height_m", "valid number", "docs/places.md"),
    ("height_m: 2.5", "height_m: .nan", 7, "walls.0.height_m", "", "docs"),
    (
        OPENING,
        OPENING.replace("at_m: 3", "at_m: 7.8"),
        9,
        "walls.0.openings.0.at_m",
        "7.30 to 8.30",
        "0.00 to 8.00",
    ),
    (
        OPENING,
        OPENING.replace("0,", "4,", 1),
        9,
        "walls.0.openings.0.segment",
        "no segment 4",
        "0 to 3",
    ),
    (OPENING, OPENING.replace("2", "3"), 9, "walls.0.openings.0.head_m", "2.5 m high", "head"),
    ("segment: 1", "segment: 0", 10, "walls.0.openings.1", "two openings", "2.50 to 3.50"),
    ("pane: {}", "pane: {bars: 20}", 9, "walls.0.openings.0.pane", "frame and bars", "frame_m"),
    (
        "pane: {}",
        "pane: {frame_material: gold}",
        9,
        "walls.0.openings.0.pane.frame_material",
        "'gold'",
        "glass",
    ),
    ("marble", "marbel", 1, "floor", "unknown material 'marbel'", "marble"),
    (", size_m: [0.5, 0.4, 0.3]", "", 12, "boxes.0.size_m", "missing", "docs/places.md"),
    (
        "[0.5, 0.4, 0.3]",
        "[0.5, 0.4, 0]",
        12,
        "boxes.0.size_m.2",
        "greater than or equal to 0.0001",
        "docs/places.md",
    ),
    ("[0.5, 0.4, 0.3]", "[0.5, 0.4]", 12, "boxes.0.size_m.2", "missing", "docs/places.md"),
    ("at_m: [2, 2]", "at_m: [20, 2]", 12, "boxes.0.at_m", "outside the place", "signs"),
    ("at_m: [2, 2]", "at_m: [4.9, 2]", 12, "boxes.0", "0.15 m deep in room", "Move"),
    ("at_m: [2, 2]", "at_m: [3, -0.8], z_m: 0.5", 16, "furniture.0", "deep in", "Move"),
    ("material: velvet", "material: velvit", 12, "boxes.0.material", "unknown", "velvet"),
    ("name: post", "name: crate", 14, "cylinders.0.name", "two things called 'crate'", "name"),
    ("name: post", "name: a/b", 14, "cylinders.0.name", "pattern", "docs"),
    (
        "radius_m: 0.2",
        "radius_m: -0.2",
        14,
        "cylinders.0.radius_m",
        "greater than or equal to 0.0001",
        "docs",
    ),
    ("kind: table", "kind: tabel", 16, "furniture.0.kind", "'table'", "docs"),
    ("[1.6, 0.8, 0.74]", "[0.1, 0.8, 0.74]", 16, "furniture.0.size_m", "at least", "size_m"),
    (
        "[1.6, 0.8, 0.74]",
        "[1.6, 0.8, 0.74], overhang_m: 0.5",
        16,
        "furniture.0.size_m",
        "0.35 m",
        "overhang",
    ),
    (
        "[-2, 0], [-2, -2]",
        "[-2, 0], [-2, 2.5]",
        18,
        "people.0.path_m.0",
        "goes through post",
        "around",
    ),
    (
        "[-2, 0], [-2, -2]",
        "[-2, 0], [-2, -2.9]",
        18,
        "people.0.path_m.0",
        "passes room at 0.10",
        "around",
    ),
    ("[-2, 0], [-2, -2]", "[-2, 0], [-2, 0]", 18, "people.0.path_m", "twice", "Leave"),
    (
        "[0, 2], [1, 2]",
        "[0, 2], [1, 9]",
        20,
        "moving_boxes.0.path_m.1",
        "outside the place",
        "signs",
    ),
    ("to_m: [5, 0]", "to_m: [-3, 0]", 22, "structures.width", "no length", "ends"),
    ("[1.75, 1.8, 0]", "[1.75, 1.8, high]", 24, "points.corner.2", "valid number", "docs"),
    ("[0.5, -1.5]]", "[5.1, 2]]", 26, "drives.tour.way_points_m.1", "inside room", "open"),
    ("[0.5, -1.5]]", "[2, 2]]", 26, "drives.tour.way_points_m.1", "inside crate", "open"),
    ("[0.5, -1.5]]", "[50, 0]]", 26, "drives.tour.way_points_m.1", "outside the place", "signs"),
    (
        "[0.5, -1.5]]",
        "[2.8, 2.8]]",
        26,
        "drives.tour.way_points_m.0",
        "goes through crate",
        "around",
    ),
    ("[0.5, -1.5]]", "[0, 0]]", 26, "drives.tour.way_points_m.0", "the same", "closed"),
    ("[[0, 0], [0.5, -1.5]]", "[]", 26, "drives.tour.way_points_m", "at least 1", "docs"),
    (
        "  width: {",
        "  width: {from_m: [0, 0], to_m: [1, 0]}\n  width: {",
        23,
        "width",
        "second time",
        "one",
    ),
]


@pytest.mark.parametrize(("old", "new", "line", "key", "what", "remedy"), CASES)
def test_a_mistake_is_named_with_line_key_and_remedy(
    tmp_path: Path, old: str, new: str, line: int, key: str, what: str, remedy: str
) -> None:
    assert GOOD.count(old) >= 1
    with pytest.raises(InputError) as caught:
        read(tmp_path, GOOD.replace(old, new, 1))
    error = caught.value
    where = rf"{re.escape(str(tmp_path / 'place.yaml'))}, line (\d+), key ({key})"
    match = re.fullmatch(where, error.where)
    assert match, error
    assert int(match[1]) == line, error
    assert what in error.what, error
    assert re.search(remedy, error.remedy), error
    assert error.remedy.endswith("."), error


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("walls: [{name: a\nboxes: 3", "line 2", "not readable as YAML"),
        ("walls:\n\t- a", "line 2", "not readable as YAML"),
        ("- 1\n- 2", "line 1", "`key: value`"),
        ("", "line 1, key walls", "missing"),
        ("walls: []", "line 1, key walls", "no wall closes the place"),
        ("a: 2020-99-99", "line 1, key a", "no such key"),
        ("walls: &a [*a]", "line 1", ""),
    ],
)
def test_what_is_no_place_at_all(tmp_path: Path, text: str, where: str, what: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert where in caught.value.where
    assert what in caught.value.what


def test_a_place_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file") as caught:
        load_place("rooom")
    assert all(name in caught.value.remedy for name in SHIPPED)
    with pytest.raises(InputError, match="can't be read"):
        load_place(tmp_path)
    binary = tmp_path / "b.yaml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="no text file"):
        load_place(binary)


def test_a_drive_of_its_own_must_fit_the_place(tmp_path: Path) -> None:
    place = read(tmp_path, GOOD)
    path = tmp_path / "drive.yaml"
    path.write_text("way_points_m:\n  - [0, 0]\n  - [1, 0]\nstand_s: 3\n", encoding="utf-8")
    drive = load_drive(path, place)
    assert drive.way_points.tolist() == [[0.0, 0.0], [1.0, 0.0]]
    assert (drive.start_yaw_rad, drive.closed, drive.stand_s) == (0.0, False, 3.0)
    path.write_text("way_points_m:\n  - [0, 0]\n  - [9, 0]\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"line 3, key way_points_m.1.*outside the place"):
        load_drive(path, place)
    path.write_text("way_points_m:\n  - [0, 0]\nstand: 9\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"line 3, key stand: no such key.*stand_s"):
        load_drive(path, place)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
@given(
    place=st.integers(0, len(GOOD) - 1),
    drop=st.integers(0, 12),
    put=st.text(alphabet="0123456789-.[]{}:, \nabcmnx'&*", max_size=6),
)
def test_a_damaged_file_is_read_or_refused(tmp_path: Path, place: int, drop: int, put: str) -> None:
    refusal = None
    try:
        read(tmp_path, GOOD[:place] + put + GOOD[place + drop :])
    except InputError as error:
        refusal = error
    if refusal is not None:
        assert str(tmp_path) in refusal.where
        assert refusal.remedy


def test_the_example_in_the_documentation_is_a_place(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "places.md").read_text(encoding="utf-8")
    match = re.search(r"```yaml\n(.*?)```", text, re.DOTALL)
    assert match
    place = read(tmp_path, match[1])
    crate = next(solid for solid in place.solids if solid.name == "crate")
    x, y, _ = place.points["crate"]
    nearest = min((float(v[0]) - x) ** 2 + (float(v[1]) - y) ** 2 for v in crate.vertices)
    assert nearest**0.5 < 1e-3


def test_the_documentation_names_every_key_and_material() -> None:
    text = (Path(__file__).parents[3] / "docs" / "places.md").read_text(encoding="utf-8")
    sections = [
        value
        for value in vars(place_file).values()
        if isinstance(value, type) and issubclass(value, Section) and value is not Section
    ]
    keys = {key for section in sections for key in section.model_fields}
    assert {key for key in keys | set(MATERIALS) if f"`{key}`" not in text} == set()
    assert len(sections) > 10
