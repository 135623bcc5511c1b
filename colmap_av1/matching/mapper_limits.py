"""Default limits of COLMAP's mappers for using an image pair or starting with it."""

# Fewest inliers of a pair that a mapper uses (min_num_matches).
MIN_INLIERS = 15
# Initial pair of the incremental mapper: fewest inliers (init_min_num_inliers), largest share of
# the translation along the optical axis (init_max_forward_motion), smallest triangulation angle in
# degrees (init_min_tri_angle).
INITIAL_MIN_INLIERS = 100
INITIAL_MAX_FORWARD_MOTION = 0.95
INITIAL_MIN_ANGLE = 16.0
# If no pair meets these limits, the mapper halves the number of inliers, then the angle.
LOWER_INITIAL_LIMITS = {
    "init_min_num_inliers": INITIAL_MIN_INLIERS // 2,
    "init_min_tri_angle": INITIAL_MIN_ANGLE / 2,
}
# If no pair has that angle, the mapper halves it twice.
INITIAL_LEAST_ANGLE = INITIAL_MIN_ANGLE / 4
# The mapper's options for the initial pair if the camera moves along its axis, as on a drive. Its
# motion then excludes no pair. All angles are small: with the default limit the mapper would try
# hundreds of pairs, and begin with the first to which RANSAC gives a wrong pose with a large angle.
FORWARD_MOTION_OPTIONS = {
    "init_max_forward_motion": 1.0,
    "init_min_tri_angle": INITIAL_LEAST_ANGLE,
}


def forward_motion_words() -> list[str]:
    """`FORWARD_MOTION_OPTIONS` as words of a command line of COLMAP's mapper."""
    options = FORWARD_MOTION_OPTIONS.items()
    return [word for name, value in options for word in (f"--Mapper.{name}", f"{value:g}")]
