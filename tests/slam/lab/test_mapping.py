"""Several systems on one drive: nobody notices the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datasets.messages import DepthImage
from datasets.recording import CameraCalibration
from datasets.simulation.robot import DEPTH, ROBOTS
from datasets.simulation.simulated_drive import SimulatedDrive
from fusion.pseudo_scan import PseudoScan
from slam.fusing import depth_projection
from slam.lab.drives import mapping
from slam.lab.drives.map_pictures import WIDTH_PX, write_side_by_side
from slam.lab.drives.mapping import Clock, DriveMapped, SharedProjections, map_drive
from slam.lab.drives.systems import CAMERA, FUSED, FUSED_PAPER, LIDAR, UNION
from slam.mapping.layers import draw_map
from slam.mapping.occupancy import OCCUPIED
from slam.mapping.scan_store import CAMERA as CAMERA_LAYER
from slam.mapping.scan_store import LIDAR as LIDAR_LAYER
from slam.pipeline import Slam
from tests.slam.lab.small_drives import corner


def drive(seed: int = 3) -> SimulatedDrive:
    place, spec = corner()
    return SimulatedDrive(place, spec, ROBOTS["low-lidar"].seeing(None, 2.0), seed)


@pytest.fixture(scope="module")
def together() -> DriveMapped:
    return map_drive(drive(), [LIDAR, FUSED, UNION, FUSED_PAPER], Clock())


def test_pictures_show_the_maps(together: DriveMapped, tmp_path: Path) -> None:
    import cv2

    write_side_by_side(tmp_path / "maps.png", list(together.mapped.values())[:3])
    picture = cv2.imread(str(tmp_path / "maps.png"))
    assert picture is not None
    assert picture.shape[1] == 2 * WIDTH_PX
    assert (picture == 255).all(axis=2).mean() < 0.95
    assert [path.name for path in tmp_path.iterdir()] == ["maps.png"]


def test_each_system_maps_as_if_it_were_alone(together: DriveMapped) -> None:
    assert together.failed == {}
    for system in (FUSED, FUSED_PAPER):
        one = drive()
        alone = Slam(system.config(), one.calibration)
        for message in one:
            alone.add(message)
        alone.finish()
        poses = alone.poses()
        found = together.mapped[system.name]
        np.testing.assert_array_equal(found.poses.trajectory.xyyaw, poses.trajectory.xyyaw)
        grid = draw_map(alone.scans(poses), poses.trajectory, alone.config.map)
        np.testing.assert_array_equal(found.classes, grid.classes(alone.config.map))


def test_an_image_is_projected_once_for_all_that_do_it_alike(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[str] = []

    def counting(calibration: CameraCalibration, config: object) -> object:
        project = depth_projection(calibration, config)  # type: ignore[arg-type]

        def projected(image: DepthImage) -> PseudoScan:
            calls.append(type(project).__name__)
            return project(image)

        return projected

    monkeypatch.setattr(mapping, "depth_projection", counting)
    shared, one = SharedProjections(), drive()
    camera = one.calibration.cameras[DEPTH]
    image = next(message for message in one if isinstance(message, DepthImage))
    projections = [shared(camera, s.config()) for s in (FUSED, UNION, CAMERA, FUSED_PAPER)]
    views = [project(image) for project in projections]
    assert calls == ["DepthProjection", "PaperProjection"]
    assert views[0] is views[1] is views[2]
    assert views[3] is not views[0]


def test_what_breaks_one_system_costs_it_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: Slam) -> None:
        if self.config.sensors == "lidar":
            raise RuntimeError("broken")

    monkeypatch.setattr(Slam, "finish", broken)
    place, _ = corner()
    spec = place.drives["tour"]
    still = SimulatedDrive(
        place, type(spec)(spec.way_points[:1], stand_s=1.5), ROBOTS["low-lidar"], 1
    )
    done = map_drive(still, [LIDAR, FUSED], Clock())
    assert done.failed == {LIDAR.name: "RuntimeError: broken"}
    assert list(done.mapped) == [FUSED.name]


def test_points_are_those_that_the_map_shows(together: DriveMapped) -> None:
    fused = together.mapped[FUSED.name]
    for layer in (LIDAR_LAYER, CAMERA_LAYER):
        points, origins = fused.points_map(layer)
        assert len(points) == len(origins) > 1000
        grid = fused.map.layers[layer]
        cells = np.floor((points - grid.corner_map_m) / grid.resolution_m).astype(int)
        classes = grid.classes(fused.slam.config.map)
        assert (classes[cells[:, 1], cells[:, 0]] == OCCUPIED).all()
    walls, origins = fused.points_map(LIDAR_LAYER)
    inside = np.abs(walls).max(axis=1)
    assert inside.max() < 6.5  # the room's walls are 6.25 m away
    assert np.abs(origins).max() < 6.0


def test_occupied_cells_lie_where_the_points_are(together: DriveMapped) -> None:
    fused = together.mapped[LIDAR.name]
    cells = {tuple(cell) for cell in np.floor(fused.occupied_map() / 0.05).astype(int).tolist()}
    points, _ = fused.points_map(LIDAR_LAYER)
    assert {tuple(cell) for cell in np.floor(points / 0.05).astype(int).tolist()} <= cells


def test_a_layer_that_is_not_there_has_no_points(together: DriveMapped) -> None:
    points, origins = together.mapped[LIDAR.name].points_map(CAMERA_LAYER)
    assert points.shape == origins.shape == (0, 2)
