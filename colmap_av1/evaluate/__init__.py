"""Metrics of tracks, models and renderings, and the front-ends that `compare` runs."""

from colmap_av1.check.model_figures import ModelFigures, model_figures
from colmap_av1.evaluate.frontends.footage import Footage, choose_footage, prepare_footage
from colmap_av1.evaluate.frontends.frontend import Frontend, FrontendRun
from colmap_av1.evaluate.frontends.mapping import (
    MapperRun,
    densify_model,
    measure_mapper,
)
from colmap_av1.evaluate.frontends.measure import Measured, run_measured
from colmap_av1.evaluate.frontends.registry import FRONTENDS, make_frontends, run_frontend
from colmap_av1.evaluate.metrics.database_tracks import database_tracks
from colmap_av1.evaluate.metrics.poses import PoseErrors, model_poses, pose_errors
from colmap_av1.evaluate.metrics.sequence import Sequence, read_sequence
from colmap_av1.evaluate.metrics.track_errors import (
    SPANS,
    epipolar_errors,
    exact_errors,
    pairs_at_span,
)
from colmap_av1.evaluate.metrics.track_statistics import TrackStatistics, track_statistics
from colmap_av1.evaluate.training.splatting import (
    Milestone,
    share_of_time,
    split_images,
    train_gaussians,
)

__all__ = [
    "FRONTENDS",
    "SPANS",
    "Footage",
    "Frontend",
    "FrontendRun",
    "MapperRun",
    "Measured",
    "Milestone",
    "ModelFigures",
    "PoseErrors",
    "Sequence",
    "TrackStatistics",
    "choose_footage",
    "database_tracks",
    "densify_model",
    "epipolar_errors",
    "exact_errors",
    "make_frontends",
    "measure_mapper",
    "model_figures",
    "model_poses",
    "pairs_at_span",
    "pose_errors",
    "prepare_footage",
    "read_sequence",
    "run_frontend",
    "run_measured",
    "share_of_time",
    "split_images",
    "track_statistics",
    "train_gaussians",
]
