"""Dense COLMAP matches read from the motion vectors of an AV1 video."""

from colmap_av1.util import start  # first, so that the program ends quietly

if start.is_program():
    start.import_pycolmap()

# isort: split
from colmap_av1.batch.page import write_page
from colmap_av1.batch.run import BatchReport, run_batch
from colmap_av1.check.database import CheckReport, check
from colmap_av1.densify import DensifyReport, densify
from colmap_av1.errors import (
    BitstreamError,
    ColmapAv1Error,
    DatabaseError,
    EncodeError,
    EvaluationError,
    HlocError,
    ImageError,
    LimitError,
    ModelError,
    NotAv1Error,
    OptionError,
    VideoError,
)
from colmap_av1.interop.hloc import HlocMatches, export_hloc, read_hloc
from colmap_av1.map import MapReport, map_database
from colmap_av1.match import MatchReport, match
from colmap_av1.motion.frame_motion import FrameMotion
from colmap_av1.motion.info import StreamReport, inspect
from colmap_av1.motion.motion_file import export_motion
from colmap_av1.motion.reading import read_motion
from colmap_av1.options import (
    BatchOptions,
    CameraOptions,
    CompareOptions,
    DensifyOptions,
    DensityOptions,
    EncodeOptions,
    ExportOptions,
    ImageOptions,
    LearnedOptions,
    LinkOptions,
    MapOptions,
    MapperOptions,
    MaskOptions,
    MatchOptions,
    PairOptions,
    PlaceOptions,
    ReadOptions,
    ReconstructOptions,
    RefineOptions,
    RunOptions,
    TrackOptions,
    TriangulateOptions,
    VerifyOptions,
    ViewOptions,
)
from colmap_av1.reconstruct import ReconstructReport, reconstruct
from colmap_av1.splats.reconstruct_models import FurtherModel
from colmap_av1.tracks.tracks import Tracks, build_tracks
from colmap_av1.video.encode import EncodeReport, encode

__all__ = [
    "BatchOptions",
    "BatchReport",
    "BitstreamError",
    "CameraOptions",
    "CheckReport",
    "ColmapAv1Error",
    "CompareOptions",
    "DatabaseError",
    "DensifyOptions",
    "DensifyReport",
    "DensityOptions",
    "EncodeError",
    "EncodeOptions",
    "EncodeReport",
    "EvaluationError",
    "ExportOptions",
    "FrameMotion",
    "FurtherModel",
    "HlocError",
    "HlocMatches",
    "ImageError",
    "ImageOptions",
    "LearnedOptions",
    "LimitError",
    "LinkOptions",
    "MapOptions",
    "MapReport",
    "MapperOptions",
    "MaskOptions",
    "MatchOptions",
    "MatchReport",
    "ModelError",
    "NotAv1Error",
    "OptionError",
    "PairOptions",
    "PlaceOptions",
    "ReadOptions",
    "ReconstructOptions",
    "ReconstructReport",
    "RefineOptions",
    "RunOptions",
    "StreamReport",
    "TrackOptions",
    "Tracks",
    "TriangulateOptions",
    "VerifyOptions",
    "VideoError",
    "ViewOptions",
    "build_tracks",
    "check",
    "densify",
    "encode",
    "export_hloc",
    "export_motion",
    "inspect",
    "map_database",
    "match",
    "read_hloc",
    "read_motion",
    "reconstruct",
    "run_batch",
    "write_page",
]
