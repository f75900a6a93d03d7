"""How well a trajectory agrees with relative poses checked by hand.

Source: Kuemmerle et al., On Measuring the Accuracy of SLAM Algorithms, Autonomous Robots 2009,
equation 4. Cartographer's program of the same purpose multiplies by the inverse relation on the
other side, so its translational errors hold the rotational ones times the relation's length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.relations_file import Relations
from datasets.se2 import between
from datasets.trajectory import Trajectory
from slam.evaluation.reach import reach

FAR_S = 5.0
BEYOND_S = 1.0
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Spread:
    """Statistics of one kind of error. std : of a sample (n - 1), as Cartographer gives it."""

    mean: float
    std: float
    median: float
    maximum: float


@dataclass(frozen=True, slots=True)
class RelationScore:
    """The errors over one choice of the relations.

    over  : which relations, in words.
    count : how many; at least one.
    abs_translation_m, sqr_translation_m2, abs_rotation_deg, sqr_rotation_deg2 : see Spread.
    worst : index of the relation with the largest translational error.
    """

    over: str
    count: int
    abs_translation_m: Spread
    sqr_translation_m2: Spread
    abs_rotation_deg: Spread
    sqr_rotation_deg2: Spread
    worst: int


@dataclass(frozen=True, slots=True)
class RelationErrors:
    """The error of every relation, in the order of the file.

    translation_m, rotation_rad : (N,), >= 0; NaN where the relation was left out.
    scores   : over all relations, those more than 5 s apart, those whose stamps are scans;
               one that nothing falls under is not there.
    left_out : relations that reach more than a second beyond the trajectory.
    """

    translation_m: Array
    rotation_rad: Array
    scores: tuple[RelationScore, ...]
    left_out: int


def relation_errors(
    relations: Relations, trajectory: Trajectory, odometry: Trajectory | None
) -> RelationErrors:
    """Score a trajectory: error = inverse(relation) * (inverse(T_map_1) T_map_2).

    trajectory : T_map_base of every scan. odometry : T_odom_base at the recorded stamps, by which
    stamps between scans are reached; None interpolates. Only what lies beyond the ends of the
    trajectory is left out (and counted): where scans were lost the error is counted in full.
    """
    pose_1 = reach(trajectory, odometry, relations.stamps_1_ns)
    pose_2 = reach(trajectory, odometry, relations.stamps_2_ns)
    error = between(relations.xyyaw, between(pose_1, pose_2))
    translation_m, rotation_rad = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    inside = _inside(relations, trajectory)
    translation_m[~inside] = np.nan
    rotation_rad[~inside] = np.nan
    apart_ns = np.abs(relations.stamps_2_ns - relations.stamps_1_ns)
    on_scans = np.isin(relations.stamps_1_ns, trajectory.stamps_ns) & np.isin(
        relations.stamps_2_ns, trajectory.stamps_ns
    )
    choices = (
        ("all relations", inside),
        (f"relations more than {FAR_S:g} s apart", inside & (apart_ns > FAR_S * 1e9)),
        ("relations whose stamps are scans", inside & on_scans),
    )
    scores = tuple(
        _score(over, translation_m, rotation_rad, mask) for over, mask in choices if mask.any()
    )
    return RelationErrors(translation_m, rotation_rad, scores, int((~inside).sum()))


def _inside(relations: Relations, trajectory: Trajectory) -> Mask:
    margin_ns = round(BEYOND_S * 1e9)
    stamps = np.stack([relations.stamps_1_ns, relations.stamps_2_ns])
    first_ns, last_ns = trajectory.stamps_ns[0] - margin_ns, trajectory.stamps_ns[-1] + margin_ns
    inside: Mask = ((stamps >= first_ns) & (stamps <= last_ns)).all(axis=0)
    return inside


def _score(over: str, translation_m: Array, rotation_rad: Array, mask: Mask) -> RelationScore:
    chosen_m, chosen_deg = translation_m[mask], np.degrees(rotation_rad[mask])
    return RelationScore(
        over=over,
        count=int(mask.sum()),
        abs_translation_m=_spread(chosen_m),
        sqr_translation_m2=_spread(chosen_m**2),
        abs_rotation_deg=_spread(chosen_deg),
        sqr_rotation_deg2=_spread(chosen_deg**2),
        worst=int(np.flatnonzero(mask)[np.argmax(chosen_m)]),
    )


def _spread(values: Array) -> Spread:
    std = float(values.std(ddof=1)) if values.size > 1 else 0.0
    return Spread(float(values.mean()), std, float(np.median(values)), float(values.max()))


def cartographer_form(score: RelationScore) -> str:
    """Four lines, in the form of Cartographer's ``compute_relations_metrics``."""
    rows = (
        ("Abs translational error", score.abs_translation_m, "m"),
        ("Sqr translational error", score.sqr_translation_m2, "m^2"),
        ("Abs rotational error", score.abs_rotation_deg, "deg"),
        ("Sqr rotational error", score.sqr_rotation_deg2, "deg^2"),
    )
    return "\n".join(f"{name} {s.mean:.5f} +/- {s.std:.5f} {unit}" for name, s, unit in rows)
