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
from colmap_av1.options.model import MapperOptions, TriangulateOptions
from colmap_av1.options.place import PlaceOptions
from colmap_av1.options.run import RunOptions
from colmap_av1.options.tracks import DensityOptions, RefineOptions, TrackOptions
from colmap_av1.options.video import EncodeOptions, ReadOptions

OnExisting = Literal["error", "append", "replace"]


@dataclass(frozen=True)
class SourceOptions:
    """The options of finding or making the AV1 stream of a video, see `MatchOptions`."""

    read: ReadOptions = ReadOptions()
    encode: EncodeOptions = EncodeOptions()
    keep_stream: str | os.PathLike[str] | None = None
    reencode: bool = False


@dataclass(frozen=True)
class TrackingOptions:
    """The options of tracking a video, see `MatchOptions`."""

    read: ReadOptions = ReadOptions()
    tracks: TrackOptions = TrackOptions()
    refine: RefineOptions = RefineOptions()


@dataclass(frozen=True)
class MatchOptions(Options):
    """Options of `match`."""

    title: ClassVar[str] = "database and stream"

    images: ImageOptions = part(ImageOptions())
    masks: MaskOptions = part(MaskOptions())
    encode: EncodeOptions = part(EncodeOptions())
    # Its threads are the run's where it has none of its own.
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
        "where listed images have keypoints or matches already: error: refuse the database; "
        "append: add the new ones after them; replace: remove them",
        common=True,
    )
    keep_stream: str | os.PathLike[str] | None = option(
        None,
        "file that keeps the AV1 stream of a video that is not AV1, for further runs; None: the "
        "output folder of reconstruct and compare keeps it, other commands keep none",
    )
    reencode: bool = option(
        False, "convert an AV1 video as well where its structure is poor for matching"
    )

    @property
    def files(self) -> tuple[str | os.PathLike[str] | None, ...]:
        """The files and folders that are read beside videos and images; None: not given."""
        return self.images.frame_list, self.masks.mask_path

    @property
    def reading(self) -> ReadOptions:
        """How the bitstream is read, on the run's threads unless `read` has its own number."""
        if self.read.num_threads is not None:
            return self.read
        return replace(self.read, num_threads=self.run.num_threads)

    @property
    def source(self) -> SourceOptions:
        """How the AV1 stream of a video is found or made."""
        return SourceOptions(self.reading, self.encode, self.keep_stream, self.reencode)

    @property
    def tracking(self) -> TrackingOptions:
        """How a video is tracked."""
        return TrackingOptions(self.reading, self.tracks, self.refine)


@dataclass(frozen=True)
class ReconstructOptions(Options):
    """Options of `reconstruct`; of `match`, all but the selection of tracks applies."""

    title: ClassVar[str] = "reconstruction"

    match: MatchOptions = part(
        MatchOptions(),
        unused=("density", "on_existing", "images.first_number", "verify.verify"),
    )
    mapping: MapperOptions = part(MapperOptions())
    triangulate: TriangulateOptions = part(TriangulateOptions())
    place: PlaceOptions = part(PlaceOptions())
    undistort: bool = option(
        True,
        "write undistorted images with PINHOLE cameras; 0: write the original pictures with the "
        "estimated camera model, for trainers that render distortion",
    )
    image_type: Literal["jpg", "png"] | None = option(
        None,
        "format of the images of videos; None: that of image_name, else jpg; photos keep theirs",
    )
    moving: Literal["keep", "drop", "mask"] = option(
        "drop",
        "what moves by itself, such as people and cars: drop: it gets no points; mask: nor does it "
        "in the masks written for trainers; keep: it is not looked for",
        common=True,
    )
    max_images: int = option(
        300,
        "images of a video with more frames, spread evenly in parallax and as close together as "
        "tracks need to connect them, where no option says which frames are images",
        least=3,
        common=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.match.camera.single_camera is False and not self.mapping.adjust:
            raise OptionError(
                "single_camera is 0, but only the adjustment estimates the cameras: leave out "
                "--adjust 0"
            )
        name = self.match.images.image_name
        if name.count(".") > 1:
            raise OptionError(
                f"image_name '{name}': give one without a dot but that of the extension"
            )
        if self.image_type is not None and "." in name:
            raise OptionError(
                f"image_name '{name}' has an extension, which is the format: leave out image_type "
                "or the extension"
            )

    @property
    def with_extension(self) -> ReconstructOptions:
        """The same with the extension of the images in `image_name`, in place of `image_type`."""
        images = self.match.images
        if "." in images.image_name:
            return self
        named = replace(images, image_name=f"{images.image_name}.{self.image_type or 'jpg'}")
        return replace(self, match=replace(self.match, images=named), image_type=None)


@dataclass(frozen=True)
class DensifyOptions(Options):
    """Options of `densify`; of `match`, all of reading, tracks and existing images apply."""

    title: ClassVar[str] = "dense points"

    match: MatchOptions = part(
        MatchOptions(),
        unused=(
            "camera",
            "density",
            "pairs",
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
