"""Statistics of depth images on images whose numbers are known, and real beside simulated ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datasets.simulation.depth_camera import DepthModel, random_field
from datasets.simulation.depth_kernels import Float32s
from slam.lab.simulation import depth_comparison
from slam.lab.simulation.depth_statistics import (
    correlation,
    left_band,
    plane_patches,
    quantum_px,
    steps,
)

FOCAL_BASELINE = 20.0


def slanted(sigma_px: float = 0.0) -> Float32s:
    """A plane from 1 to 2 m with white noise of the disparity."""
    disparity = np.linspace(20.0, 10.0, 480)[:, None] + np.linspace(0.0, 1.0, 640)
    disparity = disparity + sigma_px * np.random.default_rng(1).standard_normal(disparity.shape)
    return (FOCAL_BASELINE / disparity).astype(np.float32)


def test_noise_on_a_plane_is_measured_in_pixels() -> None:
    depth_m = slanted(0.1)
    depth_m[::50, ::50] = 0
    patches = plane_patches(depth_m, FOCAL_BASELINE, 48)
    assert len(patches.rms_px) == 10 * 12
    assert np.median(patches.rms_px) == pytest.approx(0.1, rel=0.03)
    assert patches.depth_m.min() > 0.95
    assert patches.depth_m.max() < 2.05
    assert patches.holes.mean() == pytest.approx(1 / 2500, rel=0.2)


def test_what_is_no_plane_is_left_out() -> None:
    depth_m = slanted()
    depth_m[:, 320:] *= np.float32(0.5)
    # In 64 columns from the 64th, the step at 320 is a border; in 48 it is not.
    assert len(plane_patches(depth_m, FOCAL_BASELINE, 64).rms_px) == 7 * 9
    assert len(plane_patches(depth_m, FOCAL_BASELINE, 48).rms_px) < 10 * 12


def test_correlation_of_smooth_and_of_white_noise() -> None:
    field = random_field(np.random.default_rng(3), (480, 640), 2, 4.0).astype(np.float64)
    smooth = field.reshape(10, 48, 640)
    smooth[:, ::7, ::7] = np.nan
    assert correlation(smooth, 4, axis=1) == pytest.approx(np.exp(-0.25), abs=0.06)
    assert correlation(smooth, 4, axis=0) == pytest.approx(np.exp(-0.25), abs=0.06)
    white = np.random.default_rng(3).standard_normal((4, 100, 100))
    assert abs(correlation(white, 1, axis=1)) < 0.03


def test_steps_tell_sides_holes_and_mixed_depths() -> None:
    disparity = np.full((8, 100), 5.0)
    disparity[:, 40:60] = 15.0  # near
    depth_m = (FOCAL_BASELINE / disparity).astype(np.float32)
    depth_m[:, 30:40] = 0  # its shadow
    depth_m[:, 60] = FOCAL_BASELINE / 10  # a mixed depth
    depth_m[:, 61:63] = 0
    found = steps(depth_m, FOCAL_BASELINE)
    np.testing.assert_allclose(found, [[10, 0, 10], [-10, 1, 2]] * 2, atol=1e-5)


def test_the_left_band_is_counted_beyond_the_disparity() -> None:
    depth_m = np.full((10, 100), FOCAL_BASELINE / 10, dtype=np.float32)
    depth_m[:, :16] = 0
    depth_m[3] = 0
    np.testing.assert_allclose(left_band(depth_m, FOCAL_BASELINE), [6.0] * 9, atol=1e-5)


def test_the_step_of_the_disparity_is_found_in_millimetres() -> None:
    disparity = np.arange(160, 256) / 32
    depth_m = (np.rint(FOCAL_BASELINE / disparity * 1000) / 1000).astype(np.float32)
    assert quantum_px(depth_m, FOCAL_BASELINE) == pytest.approx(1 / 32, rel=0.05)
    assert np.isnan(quantum_px(np.zeros((4, 4), dtype=np.float32), FOCAL_BASELINE))


def test_simulated_images_measure_like_real_ones(shared_data: Path) -> None:
    real = depth_comparison.read_real(shared_data / "depth" / "d435")[::2]
    model = DepthModel(mode="640x480")
    simulated = depth_comparison.simulate(model)[::2]
    scales = depth_comparison.REAL_FOCAL_BASELINE, model.focal_baseline
    both = tuple(zip((real, simulated), scales, strict=True))

    bands = [np.median(np.concatenate([left_band(i, s) for i in images])) for images, s in both]
    assert bands[0] == pytest.approx(bands[1], abs=2)
    quanta = [np.nanmedian([quantum_px(i, s) for i in images]) for images, s in both]
    assert quanta[0] == pytest.approx(quanta[1], rel=0.02)
    edges = [np.vstack([steps(i, s, 6.0) for i in images]) for images, s in both]
    shadows = [np.median((e[:, 2] - e[:, 0])[e[:, 0] > 0]) for e in edges]
    assert shadows[0] == pytest.approx(shadows[1], abs=1.5)
    seams = [np.median(e[e[:, 0] < 0, 2]) for e in edges]
    assert seams[0] == pytest.approx(seams[1], abs=2)
    noises = []
    for images, scale in both:
        patches = [plane_patches(image, scale, 48) for image in images]
        depth_m = np.concatenate([each.depth_m for each in patches])
        rms_px = np.concatenate([each.rms_px for each in patches])
        noises.append(np.median(rms_px[(depth_m > 1.0) & (depth_m < 2.5)]))
    assert noises[0] == pytest.approx(noises[1], rel=0.35)


def test_the_table_and_the_picture(
    tmp_path: Path,
    shared_data: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    import cv2

    monkeypatch.setattr(depth_comparison, "IMAGES", 4)
    target = tmp_path / "picture.png"
    folder = shared_data / "depth" / "d435"
    assert depth_comparison.main([str(folder), "--picture", str(target)]) == 0
    table = capsys.readouterr().out.splitlines()
    assert table[0] == "| | real | simulated |"
    assert {line.count("|") for line in table} == {4}
    picture = cv2.imread(str(target))
    assert picture is not None
    assert picture.shape == (960, 1920, 3)


def test_a_folder_without_images_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert depth_comparison.main([str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
