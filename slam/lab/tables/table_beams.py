"""Table 3 beside the paper's: ten beams over many scans."""

from __future__ import annotations

from collections.abc import Sequence

from slam.lab.drives.rows import BeamErrorRow, BeamRow
from slam.lab.page import table
from slam.lab.tables import paper_tables as paper
from slam.lab.tables.spread import by_system, mean_of, mean_spread, number


def beams_table(beams: Sequence[BeamRow], errors: Sequence[BeamErrorRow]) -> str:
    """Each beam's mean over all scans, with its deviation from scan to scan; MAE and RMSE."""
    columns = list(by_system(beams))
    head = ["beam, deg", "actual, m", "paper, lidar", "paper, fused", *columns]
    body = []
    for printed in paper.BEAMS:
        cells = [f"{printed.beam_deg:g}", number(printed.actual_m)]
        cells += [number(printed.lidar_m), number(printed.fused_m)]
        for name in columns:
            own = [r for r in beams if r.system == name and r.beam_deg == printed.beam_deg]
            mean_m, std_m = mean_of(r.mean_m for r in own), mean_of(r.std_m for r in own)
            cells.append(f"{number(mean_m)} ± {number(std_m)}")
        body.append(cells)
    lidar_m, fused_m = (_recomputed(which) for which in ("lidar", "fused"))
    of_system = by_system(errors)
    body.append(
        [
            "**MAE**",
            "",
            f"{paper.BEAM_MAE_LIDAR_M:g} (recomputed {lidar_m[0]:.4f})",
            f"{paper.BEAM_MAE_FUSED_M:g} (recomputed {fused_m[0]:.4f})",
            *(f"**{mean_spread((r.mae_m for r in of_system[name]), 4)}**" for name in columns),
        ]
    )
    body.append(
        [
            "**RMSE**",
            "",
            f"{paper.BEAM_RMSE_LIDAR_M:g} (recomputed {lidar_m[1]:.4f})",
            f"{paper.BEAM_RMSE_FUSED_M:g} (recomputed {fused_m[1]:.4f})",
            *(f"**{mean_spread((r.rmse_m for r in of_system[name]), 4)}**" for name in columns),
        ]
    )
    scans = [str(sum(row.scans for row in of_system[name])) for name in columns]
    body.append(["scans", "", "1", "1", *scans])
    missing = [str(sum(row.missing for row in of_system[name])) for name in columns]
    body.append(["readings missing", "", "", "", *missing])
    return table(head, body)


def _recomputed(which: str) -> tuple[float, float]:
    """(MAE, RMSE) that the printed rows give."""
    read_m = [row.lidar_m if which == "lidar" else row.fused_m for row in paper.BEAMS]
    off_m = [read - row.actual_m for read, row in zip(read_m, paper.BEAMS, strict=True)]
    mae_m = sum(abs(each) for each in off_m) / len(off_m)
    return mae_m, (sum(each**2 for each in off_m) / len(off_m)) ** 0.5
