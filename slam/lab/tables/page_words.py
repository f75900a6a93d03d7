"""What the page of results says about each table: how it is measured, and how to read it."""

INTRODUCTION = """\
Written by `slam tables`; not to be edited. The paper is Chi et al., Electronics 2023, 12(12),
2716. Its recordings are not public: here the same application maps simulated drives through
places like the paper's (places.md, simulation.md), and the measures are those of measures.md.
**Every seed counts**: figures are means over the seeds ± their standard deviation, what failed
is said, and nothing was chosen. *Paper mode* is the paper's method to the letter (fusion.md),
*better mode* this project's own, the default."""

POINTS = """\
Place of the corner nearest the start, in map coordinates, whose origin is the start pose;
nothing is aligned. The place `room`, one tour. A corner is fitted to the points that lie in
occupied cells of the final map: what a later ray has freed is not in the map. This project's
SLAM stands in GMapping's place."""

BEAMS = """\
The place `beam-room`; the robot stands, and every scan is compared, the first ones included,
which come before the camera's first image. A beam is the median of what lies within half a
degree of it, in the scan as it goes into the matching; ± is the deviation from scan to scan.
Only the beam at 180 deg tests the fusion: the lidar passes over the object there."""

CORRIDORS = """\
gamma = measured / true length in percent, of the four corridors of `ring-corridor` after one
circle, in the lidar layer (in paper mode the single grid). Each simulated lidar has a scale
error of at most 0.2 %, drawn for the drive: maps are longer or shorter by that, whatever is
done with the camera, and the spread over the seeds is mostly this. It is not in the spread of the
four corridors of one drive, which is what SLAM errs by."""

OBSTACLES = """\
In the same maps: what the camera could have seen of all obstacles between 0.05 m and 1 m, and
of those that the lidar passes over. *Union* lays both scans into a single grid without
association; *Bayes* adds the log odds of the better mode's layers."""

SCORES = """\
The mean probability of a submap's grid under a scan's points at the matched pose, as
Cartographer's constraint builder reports it. Of each circle of `ring-corridor` the 8 accepted
constraints nearest to even times, as the paper has 8. Each sensor's points are scored in the
grid of their own layer, so that the rows are not comparable as they stand: a camera sees near
and fewer things. The last column is: the beams of the lidar alone in grids of the lidar alone,
for the same scans and submaps at the poses that the row's system found. [16] and [17] are
re-implementations from a sentence each."""

WORTH = """\
All constraints that were accepted, and the error of their poses against the truth; false is
beyond 0.5 m or 5 deg. A scan slides along a bare wall without losing score, and may take one
door for the next. What reaches the score but left a direction open, or fits another place nearly as
well, is not accepted, by the same bounds for all systems, and stands in the last three columns."""

CLOSURES = """\
The loop closures of each system's own search, which also asks whether another place fits
nearly as well. ATE is of the final trajectory, SE(2) aligned; CPU seconds are of the system
alone, for one drive."""
