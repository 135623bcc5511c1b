"""The default limits of COLMAP's mappers for using an image pair or starting with it."""

# Inliers of a pair that any mapper uses (min_num_matches).
MIN_INLIERS = 15
# The initial pair of the incremental mapper: least inliers (init_min_num_inliers), largest share of
# the translation along the camera's axis (init_max_forward_motion), least triangulation angle in
# degrees (init_min_tri_angle).
INITIAL_MIN_INLIERS = 100
INITIAL_MAX_FORWARD_MOTION = 0.95
INITIAL_MIN_ANGLE = 16.0
# Least points with that angle: the third image needs them (abs_pose_min_num_inliers).
INITIAL_MIN_POINTS = 30
# If no pair has that angle, the mapper halves it twice.
INITIAL_LEAST_ANGLE = INITIAL_MIN_ANGLE / 4
# With this init_max_forward_motion, forward motion excludes no pair.
ANY_FORWARD_MOTION = 1.0
