"""Options of `match`, and of the commands that build on it."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.camera import CameraOptions
from colmap_av1.options.fields import Options, option, part
from colmap_av1.options.images import ImageOptions, MaskOptions
from colmap_av1.options.matching import LinkOptions, PairOptions, VerifyOptions
from colmap_av1.options.model import PoseOptions, TriangulateOptions
from colmap_av1.options.place import PlaceOptions
from colmap_av1.options.run import RunOptions
from colmap_av1.options.tracks import DensityOptions, RefineOptions, TrackOptions
from colmap_av1.options.video import EncodeOptions, ReadOptions

OnExisting = Literal["error", "append", "replace"]


@dataclass(frozen=True)
class SourceOptions:
    """Options for finding or creating the AV1 stream of a video, see `MatchOptions`."""

    read: ReadOptions = ReadOptions()
    encode: EncodeOptions = EncodeOptions()
    keep_stream: str | os.PathLike[str] | None = None
    reencode: bool = False


@dataclass(frozen=True)
class TrackingOptions:
    """Options for tracking a video, see `MatchOptions`."""

    read: ReadOptions = ReadOptions()
    tracks: TrackOptions = TrackOptions()
    refine: RefineOptions = RefineOptions()


@dataclass(frozen=True)
class MatchOptions(Options):
    """Options of `match`.

    Examples:
        >>> from colmap_av1 import ImageOptions, MatchOptions
        >>> options = MatchOptions(images=ImageOptions(num_images=40), on_existing="append")
        >>> options.images.num_images, options.pairs.min_matches
        (40, 15)
    """

    title: ClassVar[str] = "database and stream"

    images: ImageOptions = part(ImageOptions())
    masks: MaskOptions = part(MaskOptions())
    encode: EncodeOptions = part(EncodeOptions())
    # `read.num_threads` defaults to the run's, see `reading`.
    read: ReadOptions = part(ReadOptions(), unused=("num_threads",))
    tracks: TrackOptions = part(TrackOptions())
    refine: RefineOptions = part(RefineOptions())
    density: DensityOptions = part(DensityOptions())
    pairs: PairOptions = part(PairOptions())
    links: LinkOptions = part(LinkOptions())
    verify: VerifyOptions = part(VerifyOptions())
    camera: CameraOptions = part(CameraOptions())
    run: RunOptions = part(RunOptions())
    on_existing: OnExisting = option(
        "error",
        "if listed images already have keypoints or matches: error: stop; append: add the new ones "
        "after the existing ones; replace: remove the existing ones",
        common=True,
    )
    keep_stream: str | os.PathLike[str] | None = option(
        None,
        "file in which to keep the AV1 stream of a converted video, for further runs; None: "
        "reconstruct and compare keep it in the output folder, other commands do not keep it",
    )
    reencode: bool = option(
        False, "also convert an AV1 video if its structure is poor for matching"
    )

    @property
    def files(self) -> tuple[str | os.PathLike[str] | None, ...]:
        """The files and folders that are read in addition to videos and images; None: not given."""
        return self.images.frame_list, self.masks.mask_path

    @property
    def reading(self) -> ReadOptions:
        """How the bitstream is read, on the run's threads unless `read` has its own number."""
        if self.read.num_threads is not None:
            return self.read
        return replace(self.read, num_threads=self.run.num_threads)

    @property
    def source(self) -> SourceOptions:
        """How the AV1 stream of a video is found or created."""
        return SourceOptions(self.reading, self.encode, self.keep_stream, self.reencode)

    @property
    def tracking(self) -> TrackingOptions:
        """How a video is tracked."""
        return TrackingOptions(self.reading, self.tracks, self.refine)


@dataclass(frozen=True)
class ReconstructOptions(Options):
    """Options of `reconstruct`, including those of `match` except the selection of tracks.

    Examples:
        >>> from dataclasses import replace
        >>> from colmap_av1 import ImageOptions, MatchOptions, ReconstructOptions
        >>> options = ReconstructOptions(match=MatchOptions(images=ImageOptions(every=6)))
        >>> masking = replace(options, moving="mask")
        >>> masking.match.images.every, masking.moving
        (6, 'mask')
    """

    title: ClassVar[str] = "reconstruction"

    match: MatchOptions = part(
        MatchOptions(),
        unused=("density", "on_existing", "images.first_number", "verify.verify"),
    )
    poses: PoseOptions = part(PoseOptions())
    triangulate: TriangulateOptions = part(TriangulateOptions())
    place: PlaceOptions = part(PlaceOptions())
    undistort: bool = option(
        True,
        "write undistorted images with PINHOLE cameras; 0: write the original pictures with the "
        "estimated camera model, for trainers that render distortion",
    )
    image_type: Literal["jpg", "png"] | None = option(
        None,
        "format of video images; None: from the extension of image_name, else jpg; photos keep "
        "their format",
    )
    moving: Literal["keep", "drop", "mask"] = option(
        "drop",
        "dynamic objects, such as people and cars: drop: they get no points; mask: they are also "
        "masked in the images for trainers; keep: do not detect them",
        common=True,
        spellings=("dynamic",),
    )
    max_images: int = option(
        300,
        "if no option chooses the frames: number of images for longer videos, evenly spaced in "
        "parallax and close enough for tracks to connect them",
        least=3,
        common=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.match.camera.single_camera is False and not self.poses.adjust:
            raise OptionError(
                "single_camera 0 needs the bundle adjustment to estimate the cameras: leave out "
                "--adjust 0"
            )
        name = self.match.images.image_name
        if name.count(".") > 1:
            raise OptionError(
                f"image_name '{name}' has several dots: use only the dot of the extension"
            )
        if self.image_type is not None and "." in name:
            raise OptionError(
                f"image_name '{name}' already has an extension: leave out image_type or the "
                "extension"
            )

    @property
    def with_extension(self) -> ReconstructOptions:
        """A copy with the image format as the extension of `image_name`, without `image_type`."""
        images = self.match.images
        if "." in images.image_name:
            return self
        named = replace(images, image_name=f"{images.image_name}.{self.image_type or 'jpg'}")
        return replace(self, match=replace(self.match, images=named), image_type=None)


@dataclass(frozen=True)
class DensifyOptions(Options):
    """Options of `densify`, including those of `match` for reading, tracks and existing images.

    Examples:
        >>> from colmap_av1 import DensifyOptions, TriangulateOptions
        >>> options = DensifyOptions(triangulate=TriangulateOptions(points="survey"))
        >>> options.triangulate.points
        'survey'
    """

    title: ClassVar[str] = "dense points"

    match: MatchOptions = part(
        MatchOptions(),
        unused=(
            "camera",
            "density",
            "pairs",
            "links",
            "verify",
            "on_existing",
            "run.seed",
            "images.image_name",
            "images.num_images",
            "images.fps",
            "images.select",
            "images.skip_blurred",
        ),
    )
    triangulate: TriangulateOptions = part(TriangulateOptions())
