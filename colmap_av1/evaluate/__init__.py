"""Metrics of models and renderings, and the front-ends that `compare` runs."""

from colmap_av1.check.model_figures import ModelFigures, model_figures
from colmap_av1.evaluate.frontends.footage import Footage, choose_footage
from colmap_av1.evaluate.frontends.frontend import Frontend, FrontendRun, run_frontend
from colmap_av1.evaluate.frontends.mapping import MapperRun, densify_model, measure_mapper
from colmap_av1.evaluate.frontends.measure import Measured, run_measured
from colmap_av1.evaluate.frontends.registry import make_frontends
from colmap_av1.evaluate.metrics.poses import PoseErrors, pose_errors

__all__ = [
    "Footage",
    "Frontend",
    "FrontendRun",
    "MapperRun",
    "Measured",
    "ModelFigures",
    "PoseErrors",
    "choose_footage",
    "densify_model",
    "make_frontends",
    "measure_mapper",
    "model_figures",
    "pose_errors",
    "run_frontend",
    "run_measured",
]
