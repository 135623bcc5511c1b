"""Dense COLMAP matches read from the motion vectors of an AV1 video.

Public names are imported when they are first used, so that importing the package is fast and
has no side effects.
"""

from __future__ import annotations

import importlib.util
import sys
import types
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from colmap_av1.batch.page import write_page
    from colmap_av1.batch.run import BatchReport, run_batch
    from colmap_av1.check.database import DatabaseCheck, check_database
    from colmap_av1.check.model import ModelCheck, check_model
    from colmap_av1.compare import compare
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
        WriteError,
    )
    from colmap_av1.evaluate.report.results import CompareReport
    from colmap_av1.interop.hloc import HlocMatches, export_hloc, read_hloc
    from colmap_av1.map import MapReport, map_database
    from colmap_av1.match import match
    from colmap_av1.match_report import MatchReport
    from colmap_av1.motion.frame_motion import FrameMotion
    from colmap_av1.motion.info import StreamReport, read_info
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
        MaskOptions,
        MatchOptions,
        PairOptions,
        PlaceOptions,
        PoseOptions,
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
    "ColmapAv1Error",
    "CompareOptions",
    "CompareReport",
    "DatabaseCheck",
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
    "MaskOptions",
    "MatchOptions",
    "MatchReport",
    "ModelCheck",
    "ModelError",
    "NotAv1Error",
    "OptionError",
    "PairOptions",
    "PlaceOptions",
    "PoseOptions",
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
    "WriteError",
    "build_tracks",
    "check_database",
    "check_model",
    "compare",
    "densify",
    "encode",
    "export_hloc",
    "export_motion",
    "map_database",
    "match",
    "read_hloc",
    "read_info",
    "read_motion",
    "reconstruct",
    "run_batch",
    "write_page",
]

# Modules of the public names, except errors and options.
_MODULES = {
    "BatchReport": "batch.run",
    "CompareReport": "evaluate.report.results",
    "DatabaseCheck": "check.database",
    "DensifyReport": "densify",
    "EncodeReport": "video.encode",
    "FrameMotion": "motion.frame_motion",
    "FurtherModel": "splats.reconstruct_models",
    "HlocMatches": "interop.hloc",
    "MapReport": "map",
    "MatchReport": "match_report",
    "ModelCheck": "check.model",
    "ReconstructReport": "reconstruct",
    "StreamReport": "motion.info",
    "Tracks": "tracks.tracks",
    "build_tracks": "tracks.tracks",
    "check_database": "check.database",
    "check_model": "check.model",
    "compare": "compare",
    "densify": "densify",
    "encode": "video.encode",
    "export_hloc": "interop.hloc",
    "export_motion": "motion.motion_file",
    "map_database": "map",
    "match": "match",
    "read_hloc": "interop.hloc",
    "read_info": "motion.info",
    "read_motion": "motion.reading",
    "reconstruct": "reconstruct",
    "run_batch": "batch.run",
    "write_page": "batch.page",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = _MODULES.get(name)
    if module is None:
        module = "errors" if name.endswith("Error") else "options"
    else:
        # PNG files cannot be written if pycolmap is imported before NumPy.
        importlib.import_module("numpy")
    value = getattr(importlib.import_module(f"{__name__}.{module}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(types.ModuleType):
    """Protects public names from submodules of the same name.

    Otherwise, importing the module `colmap_av1.match` would replace the function.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if name not in _MODULES or not isinstance(value, types.ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package

if importlib.util.find_spec(f"{__name__}._core") is None:
    raise ImportError(
        f"{__path__[0]} holds the source of colmap-av1 without its compiled core: run 'pip install "
        "-e .' in the folder above, or leave that folder to import an installed package"
    )
