"""What tracks, models and front-ends are worth: one module for each family of metrics."""

from colmap_av1.evaluate.poses import PoseErrors, model_poses, pose_errors
from colmap_av1.evaluate.sequence import Sequence, read_sequence
from colmap_av1.evaluate.track_errors import epipolar_errors, exact_errors, pairs_at_span
from colmap_av1.evaluate.track_statistics import TrackStatistics, track_statistics

__all__ = [
    "PoseErrors",
    "Sequence",
    "TrackStatistics",
    "epipolar_errors",
    "exact_errors",
    "model_poses",
    "pairs_at_span",
    "pose_errors",
    "read_sequence",
    "track_statistics",
]
