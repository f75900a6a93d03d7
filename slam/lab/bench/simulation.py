"""The parts of the benchmark about simulated recordings: what they cost, how well they are made."""

from __future__ import annotations

from statistics import median
from typing import Final

from slam.lab.bench.images import cost_of_simulating, noise_against_formula
from slam.lab.bench.jobs import alone
from slam.lab.bench.measure import SLAM, measure
from slam.lab.bench.session import Part, Session
from slam.lab.page import Bar, Measured, Value, table

MODES: Final = ("1280x720", "848x480", "640x480")
DISTANCES_M: Final = (1.0, 2.0, 3.0, 4.0)
SAME_SEED: Final = ("beam-room", "ring-corridor --drive stretch")


def depth_image(session: Session) -> Measured:
    """One depth image with all effects, on one core."""
    cpu_ms = alone(cost_of_simulating, 1).cpu_ms
    span = f"{min(cpu_ms):.1f} to {max(cpu_ms):.1f} ms"
    return Measured((Value(median(cpu_ms), f"median of {len(cpu_ms)}, {span}, in one process"),))


def ring(session: Session) -> Measured:
    """One full circle of the ring as a bag."""
    bag = session.scratch / "ring-corridor.mcap"
    command = [SLAM, "simulate", "ring-corridor", "--drive", "circle", "--depth-rate", "5"]
    used = measure([*command, "-o", str(bag), "--quiet"])
    size_mb = bag.stat().st_size * 1e-6
    bag.unlink()
    return Measured(
        (
            Value(used.wall_s, f"{used.cpu_s:.0f} s CPU; {size_mb:.0f} MB, images packed"),
            Value(used.peak_mb, "of the whole process; does not grow with the drive"),
        )
    )


def plane_noise(session: Session) -> Measured:
    """Residuals of plane fits against the formula of the noise."""
    off = {
        (mode, z_m): 100.0 * noise_against_formula(mode, z_m)
        for mode in MODES
        for z_m in DISTANCES_M
    }
    rows = [(mode, *(f"{off[mode, z_m]:+.1f} %" for z_m in DISTANCES_M)) for mode in MODES]
    head = (
        "rms of a plane's residual against z^2 0.08 px / (f B)",
        *(f"{z:g} m" for z in DISTANCES_M),
    )
    worst = max(off.values(), key=abs)
    how = f"worst of {len(off)}: {worst:+.1f} %; four images each"
    return Measured((Value(abs(worst), how),), table(head, rows))


def same_seed(session: Session) -> Measured:
    """Drives simulated twice, and once with another seed, byte by byte."""
    differing, total_mb = 0, 0.0
    for words in SAME_SEED:
        bags = []
        for number, seed in enumerate((3, 3, 4)):
            bags.append(session.scratch / f"same-{number}.mcap")
            command = [SLAM, "simulate", *words.split(), "--seed", str(seed), "--force", "--quiet"]
            measure([*command, "-o", str(bags[-1])])
        first, again, other = (bag.read_bytes() for bag in bags)
        differing += (first != again) + (first == other)
        total_mb += len(first) * 1e-6
        for bag in bags:
            bag.unlink()
    how = f"{len(SAME_SEED)} bags, {total_mb:.0f} MB; another seed gives others"
    return Measured((Value(differing, how, met=differing == 0),))


PARTS: Final = (
    Part(
        "depth-image",
        "A simulated depth image",
        (Bar("simulated depth image 1280 x 720, all effects, one core, CPU", "ms", 150, 110, 1),),
        (),
        depth_image,
    ),
    Part(
        "ring",
        "The ring as a bag",
        (
            Bar("`slam simulate ring-corridor`, a circle, wall time", "s", 180, 90, 0),
            Bar("the same, peak memory", "MB", 500, 300, 0),
        ),
        (),
        ring,
    ),
    Part(
        "plane-noise",
        "Noise of a simulated plane",
        (Bar("noise of a simulated plane at 1 to 4 m, off the formula", "%", 15, 5, 1),),
        (),
        plane_noise,
    ),
    Part(
        "same-seed",
        "The same seed twice",
        (Bar("the same seed twice, bags that differ", "bags", "identical bytes", None, 0),),
        (),
        same_seed,
    ),
)
