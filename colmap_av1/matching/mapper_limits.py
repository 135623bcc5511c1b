"""Default limits of COLMAP's mappers for using an image pair or starting with it."""

# Fewest inliers of a pair that a mapper uses (min_num_matches).
MIN_INLIERS = 15
# Initial pair of the incremental mapper: fewest inliers (init_min_num_inliers), largest share of
# the translation along the optical axis (init_max_forward_motion), smallest triangulation angle in
# degrees (init_min_tri_angle).
INITIAL_MIN_INLIERS = 100
INITIAL_MAX_FORWARD_MOTION = 0.95
INITIAL_MIN_ANGLE = 16.0
# Fewest points with that angle: registering the third image needs them (abs_pose_min_num_inliers).
INITIAL_MIN_POINTS = 30
# If no pair has that angle, the mapper halves it twice.
INITIAL_LEAST_ANGLE = INITIAL_MIN_ANGLE / 4
# With this init_max_forward_motion, forward motion excludes no pair.
ANY_FORWARD_MOTION = 1.0
