"""Thresholds of COLMAP's mappers for pairs, initial pairs and registration.

They are the defaults, and those that `match` recommends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

# Fewest inliers of a pair that a mapper uses (min_num_matches).
MIN_INLIERS = 15
# Initial pair of the incremental mapper, see `InitialLimits`.
INITIAL_MIN_INLIERS = 100
INITIAL_MAX_FORWARD_MOTION = 0.95
INITIAL_MIN_ANGLE = 16.0
# If no pair has 8 degrees either, the mapper halves the angle again. Before that, it tries hundreds
# or thousands of pairs, and RANSAC may give one of them a wrong pose with a large angle.
INITIAL_SMALL_ANGLE = INITIAL_MIN_ANGLE / 4
# The mapper estimates the poses of pairs anew. It certainly accepts an initial pair whose inliers
# and angle exceed its limits by this factor, with a translation along the optical axis that is
# smaller than its limit by this tolerance.
INITIAL_MARGIN = 1.1
INITIAL_FORWARD_TOLERANCE = 0.02
# Fewest points that an image must observe to be registered (abs_pose_min_num_inliers), and smallest
# triangulation angle of a point in degrees (filter_min_tri_angle).
REGISTRATION_MIN_INLIERS = 30
POINT_MIN_ANGLE = 1.5


@dataclass(frozen=True)
class InitialLimits:
    """Limits of the initial pair, by the names of the options of COLMAP's mapper.

    Attributes:
        init_min_num_inliers: fewest inliers.
        init_max_forward_motion: largest share of the translation along the optical axis; 1 excludes
            no pair.
        init_min_tri_angle: smallest triangulation angle in degrees.
    """

    init_min_num_inliers: int = INITIAL_MIN_INLIERS
    init_max_forward_motion: float = INITIAL_MAX_FORWARD_MOTION
    init_min_tri_angle: float = INITIAL_MIN_ANGLE

    @property
    def options(self) -> dict[str, float]:
        """Options of the mapper that differ from its defaults."""
        default = vars(InitialLimits())
        return {name: value for name, value in vars(self).items() if value != default[name]}

    @property
    def words(self) -> list[str]:
        """These options as words of a command line."""
        options = self.options.items()
        return [word for name, value in options for word in (f"--Mapper.{name}", f"{value:g}")]

    @property
    def relaxed(self) -> list[InitialLimits]:
        """The limits that the mapper tries next if images are left and no pair meets these.

        It halves the number of inliers, then the angle, then both once more in this order.
        """
        inliers, angle = self.init_min_num_inliers, self.init_min_tri_angle
        return [
            replace(self, init_min_num_inliers=inliers // few, init_min_tri_angle=angle / small)
            for few, small in ((2, 1), (2, 2), (4, 2), (4, 4))
        ]


DEFAULT_LIMITS = InitialLimits()
# For videos in which all angles are small.
SMALL_ANGLES = InitialLimits(init_min_tri_angle=INITIAL_SMALL_ANGLE)
# For videos in which the camera moves along its axis, as on a drive: all angles are small, and the
# motion excludes no pair.
FORWARD_MOTION = InitialLimits(init_max_forward_motion=1.0, init_min_tri_angle=INITIAL_SMALL_ANGLE)
