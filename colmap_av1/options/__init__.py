"""Options of every stage: frozen dataclasses that check their values."""

from colmap_av1.options.batch import BatchOptions
from colmap_av1.options.camera import CameraOptions
from colmap_av1.options.commands import (
    DensifyOptions,
    MatchOptions,
    OnExisting,
    ReconstructOptions,
    SourceOptions,
    TrackingOptions,
)
from colmap_av1.options.compare import CompareOptions, LearnedOptions
from colmap_av1.options.images import ImageOptions, MaskOptions
from colmap_av1.options.matching import LinkOptions, PairOptions, VerifyOptions
from colmap_av1.options.model import (
    ExportOptions,
    MapOptions,
    Mapper,
    PoseOptions,
    TriangulateOptions,
)
from colmap_av1.options.place import PlaceOptions
from colmap_av1.options.run import RunOptions
from colmap_av1.options.tracks import DensityOptions, RefineOptions, TrackOptions
from colmap_av1.options.video import EncodeOptions, ReadOptions
from colmap_av1.options.view import ViewOptions

__all__ = [
    "BatchOptions",
    "CameraOptions",
    "CompareOptions",
    "DensifyOptions",
    "DensityOptions",
    "EncodeOptions",
    "ExportOptions",
    "ImageOptions",
    "LearnedOptions",
    "LinkOptions",
    "MapOptions",
    "Mapper",
    "MaskOptions",
    "MatchOptions",
    "OnExisting",
    "PairOptions",
    "PlaceOptions",
    "PoseOptions",
    "ReadOptions",
    "ReconstructOptions",
    "RefineOptions",
    "RunOptions",
    "SourceOptions",
    "TrackOptions",
    "TrackingOptions",
    "TriangulateOptions",
    "VerifyOptions",
    "ViewOptions",
]
