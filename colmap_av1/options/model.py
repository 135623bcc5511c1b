"""Options of poses and points, and of export to other programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option

Mapper = Literal["incremental", "global"]


@dataclass(frozen=True)
class TriangulateOptions(Options):
    """Which tracks become points.

    Examples:
        >>> from colmap_av1 import ReconstructOptions, TriangulateOptions
        >>> options = ReconstructOptions(triangulate=TriangulateOptions(points="survey"))
        >>> options.triangulate.points
        'survey'
    """

    title: ClassVar[str] = "points"

    max_reprojection_error: float = option(
        2.0,
        "largest reprojection error of an observation, in pixels",
        above=0,
        unit="pixels",
        common=True,
    )
    min_angle: float = option(
        1.5,
        "smallest triangulation angle of survey points, between the two widest rays, in degrees",
        least=0,
        below=90,
        unit="degrees",
    )
    max_depth_error: float | None = option(
        0.07,
        "largest expected depth error of survey points, as a fraction of the depth, from the "
        "triangulation angle and the reprojection error; None: no limit",
        above=0,
        unit="a fraction",
    )
    min_observations: int = option(3, "fewest observations of a point", least=2, common=True)
    points: Literal["splats", "survey"] = option(
        "splats",
        "splats: a point cloud for training Gaussian splats: keeps distant points, covers the "
        "images evenly, fills holes; survey: all points with a reliable depth, by min_angle and "
        "max_depth_error",
        common=True,
    )
    max_points: int | None = option(
        None,
        "largest number of points with splats; the finest detail is dropped first; None: as many "
        "as images of this size resolve",
        least=100,
        common=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_points is not None and self.points == "survey":
            raise OptionError(
                "max_points applies to splats only: leave it out, or give --points splats"
            )
        if self.points == "survey":
            return
        for name in ("min_angle", "max_depth_error"):
            if getattr(self, name) != getattr(TriangulateOptions, name):
                raise OptionError(
                    f"{name} applies to survey points only: leave it out, or give --points survey"
                )


@dataclass(frozen=True)
class MapOptions(Options):
    """How a database is mapped.

    Examples:
        >>> from colmap_av1 import MapOptions
        >>> options = MapOptions(mapper="global")
        >>> options.mapper, options.refine_intrinsics
        ('global', True)
    """

    title: ClassVar[str] = "mapper"

    mapper: Mapper = option("incremental", "COLMAP's mapper to use", common=True)
    forward_motion: bool | None = option(
        None,
        "let the incremental mapper start with a pair that moves along the optical axis, and with "
        "a small angle; None: if most pairs of the database move so, or if less than half of the "
        "connected images are registered otherwise",
        common=True,
    )
    init_min_tri_angle: float | None = option(
        None,
        "smallest triangulation angle of the incremental mapper's initial pair, in degrees; None: "
        "COLMAP's 16, or 4 with forward_motion",
        above=0,
        below=90,
        unit="degrees",
        colmap="Mapper.init_min_tri_angle",
    )
    refine_intrinsics: bool = option(
        True,
        "refine focal length and distortion; turn it off if they are known and the camera moves "
        "along its axis, where they are hardly observable",
        common=True,
    )
    seed: int = option(
        0,
        "seed of the mapper's random numbers",
        least=0,
        spellings=("random_seed",),
        common=True,
    )
    num_threads: int | None = option(
        None,
        "number of threads of the mapper; with several, results vary slightly from run to run; "
        "None: one per CPU that the process may use",
        least=1,
        common=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        of_initial_pair = {
            "forward_motion": bool(self.forward_motion),
            "init_min_tri_angle": self.init_min_tri_angle is not None,
        }
        for name, is_given in of_initial_pair.items():
            if is_given and self.mapper != "incremental":
                raise OptionError(
                    f"{name} applies to the incremental mapper only: leave it out, or give "
                    "--mapper incremental"
                )


@dataclass(frozen=True)
class PoseOptions(Options):
    """How poses are estimated.

    Examples:
        >>> from colmap_av1 import PoseOptions, ReconstructOptions
        >>> options = ReconstructOptions(poses=PoseOptions(mapper="incremental"))
        >>> options.poses.mapper
        'incremental'
    """

    title: ClassVar[str] = "poses"

    mapper: Literal["auto", "incremental", "global"] = option(
        "auto",
        "COLMAP's incremental or global mapper; auto: global if camera_params are given or the "
        "focal length can be estimated from the tracks, else incremental",
        common=True,
    )
    refine_intrinsics: bool | None = option(
        None, "refine focal length and distortion; None: unless camera_params are given"
    )
    key_images: bool = option(
        True,
        "map only key images, as far apart as tracks connect them well, and register the others by "
        "resection; 0: map all images",
    )
    pose_tracks_per_image: int = option(
        600, "number of tracks per image from which poses are estimated", least=50
    )
    pose_spacing: float = option(
        16.0,
        "width in pixels of the cells of an image, each of which selects one track for the poses",
        least=0,
        unit="pixels",
    )
    mapper_threads: int = option(
        1,
        "number of threads of the mapper and the bundle adjustment; with several, results vary "
        "slightly from run to run",
        least=1,
    )
    adjust: bool = option(
        True, "refine the mapper's poses by bundle adjustment with more and shorter tracks"
    )


@dataclass(frozen=True)
class ExportOptions(Options):
    """What is exported from a database.

    Examples:
        >>> from colmap_av1 import ExportOptions
        >>> ExportOptions(verified=False)
        ExportOptions(verified=False)
    """

    title: ClassVar[str] = "files"

    verified: bool = option(True, "export only inliers of each pair's two-view geometry")
