"""Options of poses and points of a model, and of files for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option

Mapper = Literal["incremental", "global"]


@dataclass(frozen=True)
class TriangulateOptions(Options):
    """Which tracks become points."""

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
        "smallest triangulation angle of a point of a survey, between its two widest rays, in "
        "degrees",
        least=0,
        below=90,
        unit="degrees",
    )
    max_depth_error: float | None = option(
        0.07,
        "largest expected error of the depth of a point of a survey, as a fraction of it, from the "
        "triangulation angle and the reprojection error; None: any",
        above=0,
        unit="a fraction",
    )
    min_observations: int = option(3, "fewest observations of a point", least=2, common=True)
    points: Literal["splats", "survey"] = option(
        "splats",
        "splats: what training of Gaussian splats starts well from, with far points, evenly spread "
        "in the images, holes filled; survey: only points of sure depth, by min_angle and "
        "max_depth_error, and all of them",
        common=True,
    )
    max_points: int | None = option(
        None,
        "largest number of points, of splats; the finest are left out first; None: as many as "
        "images of this size tell apart",
        least=100,
        common=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_points is not None and self.points == "survey":
            raise OptionError("max_points bounds splats: leave it out, or give --points splats")
        if self.points == "survey":
            return
        for name in ("min_angle", "max_depth_error"):
            if getattr(self, name) != getattr(TriangulateOptions, name):
                raise OptionError(
                    f"{name} says which points a survey has, splats have those of any depth: "
                    "leave it out, or give --points survey"
                )


@dataclass(frozen=True)
class MapOptions(Options):
    """How a database is mapped."""

    title: ClassVar[str] = "mapper"

    mapper: Mapper = option("incremental", "which of COLMAP's mappers", common=True)
    forward_motion: bool = option(
        False,
        "the camera moves along its axis: let the incremental mapper start with such a pair",
        common=True,
    )
    refine_intrinsics: bool | None = option(
        None,
        "refine focal length and distortion; None: unless the camera moves along its axis, which "
        "leaves them undetermined",
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
        "threads of the mapper; with several, the last digits of its results vary from run to run; "
        "None: one per CPU that the process may use",
        least=1,
        common=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.forward_motion and self.mapper != "incremental":
            raise OptionError(
                "forward_motion says how the incremental mapper starts: leave it out, or give "
                "--mapper incremental"
            )


@dataclass(frozen=True)
class MapperOptions(Options):
    """How poses are estimated."""

    title: ClassVar[str] = "poses"

    mapper: Literal["auto", "incremental", "global"] = option(
        "auto",
        "COLMAP's incremental or global mapper; auto: the global one where camera_params are given "
        "or the focal length can be estimated from the tracks, else the incremental one",
        common=True,
    )
    refine_intrinsics: bool | None = option(
        None, "refine focal length and distortion; None: unless camera_params are given"
    )
    key_images: bool = option(
        True,
        "map key images, as far apart as tracks connect them well, and place the others between "
        "them by the points they see; 0: map all images",
    )
    pose_tracks_per_image: int = option(
        600, "tracks of each image that poses are estimated from", least=50
    )
    pose_spacing: float = option(
        16.0,
        "width in pixels of the cells of an image; one of these tracks is selected for each",
        least=0,
        unit="pixels",
    )
    mapper_threads: int = option(
        1,
        "threads of the mapper and the bundle adjustment; with several, the last digits of their "
        "results vary from run to run",
        least=1,
    )
    adjust: bool = option(
        True, "refine the mapper's poses in a bundle adjustment on more and shorter tracks"
    )


@dataclass(frozen=True)
class ExportOptions(Options):
    """What is exported from a database for other programs."""

    title: ClassVar[str] = "files"

    format: Literal["hloc"] = option("hloc", "the program whose file layout is written")
    verified: bool = option(True, "only inliers of each pair's two-view geometry")
