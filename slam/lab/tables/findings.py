"""Where the figures do not favour fusion, and why: said only where the figures say so."""

from __future__ import annotations

from collections.abc import Iterator

from slam.lab.drives.rows import Rows
from slam.lab.drives.systems import CAMERA, FUSED, FUSED_PAPER, LIDAR, UNION
from slam.lab.tables.spread import mean_of
from slam.lab.tables.table_corridors import low_f1, off_by_seed
from slam.lab.tables.table_points import mean_error_m
from slam.lab.tables.table_scores import mean_errors

SINGLE_GRID = """\
**Paper mode loses low obstacles again.** Both sensors share a single grid there: wherever the
camera does not look, the lidar's beams pass over a low thing and free its cells, and all around
the robot that is most of the time. The same holds for the union, and for Bayes' rule, which
takes what the lidar did not see for a view against it. Only layers of their own keep what a
sensor alone can see. ({figures})"""

SHORT_BEAMS = """\
**Paper mode makes corridors worse than the lidar alone does.** A beam keeps the smallest of the
noisy ranges of ten rows, and of that and the lidar's: most beams within the camera's view come
out short, the farther the more, since the noise of depth grows with the square of the distance
and nothing bounds the range. What moved between image and scan is not made up for either. Walls
ahead are matched too near, and lengths suffer. The paper's own lidar rows are far shorter than
those here, which leaves room for a gain that there isn't with this lidar. ({figures})"""

EVEN_LENGTHS = """\
**In better mode the corridors are no better than with the lidar alone.** Their length rests on
the lidar in both, and on how true its scale is; the camera reaches 4 m and adds what is low.
The difference between the two is far below the bar. ({figures})"""

SCORES = """\
**Fusion does not raise the match score here.** In the better mode a scan has the lidar's points
and, in a layer of their own, the camera's, which are noisier, so that their cells fill less
sharply: the mean falls slightly, while the lidar's own beams score as before at the poses that
fusion found. The paper's difference between its rows is that of other points under other grids,
not of better poses: what the poses are worth stands below table 5. ({figures})"""

PAPER_POSES = """\
**The constraints of paper mode are worse than those of the lidar alone**, for the same reason
as its corridors: beams that come out short, by how much changes with the distance, are no
surface that a scan could be laid on truly. Its score does not show it. ({figures})"""

CAMERA_ALONE = """\
**The camera alone is lost along bare walls.** It sees 86 deg and 4 m; between two doors of a
corridor nothing in view tells how far it has come, and only odometry, which errs by 1 to 2 %,
holds it. Its scores are as high as the lidar's all the same. ({figures})"""


def findings(rows: Rows) -> list[str]:
    """Paragraphs about rows without hard conditions; empty if there is nothing to explain."""
    parts = (_single_grid, _corridors, _scores, _paper_poses, _camera)
    return [each for part in parts for each in part(rows)]


def _single_grid(rows: Rows) -> Iterator[str]:
    _, missing = mean_error_m(rows.points, FUSED_PAPER.name)
    corners = sum(row.system == FUSED_PAPER.name for row in rows.points)
    paper, fused = low_f1(rows.obstacles, FUSED_PAPER.name), low_f1(rows.obstacles, FUSED.name)
    figures = []
    if missing:
        figures.append(f"{missing} of {corners} corners are not in its maps of the room")
    if paper is not None and fused is not None and paper < fused:
        figures.append(f"F1 of low obstacles in the ring {paper:.3f}, better mode {fused:.3f}")
        union = low_f1(rows.obstacles, UNION.name)
        figures += [f"union {union:.3f}"] if union is not None else []
    if figures:
        yield SINGLE_GRID.format(figures=", ".join(figures))


def _corridors(rows: Rows) -> Iterator[str]:
    mean = {
        system.name: mean_of(
            off_by_seed([row for row in rows.restoration if row.system == system.name])
        )
        for system in (LIDAR, FUSED_PAPER, FUSED)
    }
    lidar, paper, fused = mean[LIDAR.name], mean[FUSED_PAPER.name], mean[FUSED.name]
    if lidar is not None and paper is not None and paper > lidar:
        yield SHORT_BEAMS.format(
            figures=f"mean of abs(100 - gamma): {paper:.3f} %, lidar alone {lidar:.3f} %"
        )
    if lidar is not None and fused is not None and fused > lidar:
        yield EVEN_LENGTHS.format(
            figures=f"mean of abs(100 - gamma): {fused:.4f} %, lidar alone {lidar:.4f} %"
        )


def _scores(rows: Rows) -> Iterator[str]:
    lidar, fused = mean_score(rows, LIDAR.name), mean_score(rows, FUSED.name)
    if lidar is None or fused is None or fused > lidar:
        return
    beams = mean_of(
        row.lidar_score for row in rows.constraints if row.system == FUSED.name and row.accepted
    )
    words = f"mean of all accepted: {fused:.3f}, lidar alone {lidar:.3f}"
    if beams is not None:
        words += f"; the lidar's beams at the fused poses {beams:.3f}"
    yield SCORES.format(figures=words)


def _paper_poses(rows: Rows) -> Iterator[str]:
    paper_m = mean_errors(rows.constraints, FUSED_PAPER.name)[0]
    lidar_m = mean_errors(rows.constraints, LIDAR.name)[0]
    if paper_m is not None and lidar_m is not None and paper_m > lidar_m:
        yield PAPER_POSES.format(figures=f"mean error {paper_m:.3f} m, lidar alone {lidar_m:.3f} m")


def _camera(rows: Rows) -> Iterator[str]:
    own = [row for row in rows.constraints if row.system == CAMERA.name and row.accepted]
    false = sum(row.false for row in own)
    if false:
        yield CAMERA_ALONE.format(figures=f"{false} of {len(own)} accepted constraints are false")


def mean_score(rows: Rows, system: str) -> float | None:
    """Of all accepted constraints."""
    return mean_of(r.score for r in rows.constraints if r.system == system and r.accepted)
