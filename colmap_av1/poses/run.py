"""The inputs and options that every stage of the estimate gets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from colmap_av1.images.image_set import ImageSet, Pictures, ShownVideo, pictures_of
from colmap_av1.images.inputs import Inputs
from colmap_av1.images.positions import ImagePositions
from colmap_av1.matching.cameras import ImageCameras
from colmap_av1.options import ReconstructOptions
from colmap_av1.tracks.tracks import Tracks, least_length
from colmap_av1.tracks.video_tracks import VideoSource
from colmap_av1.util.digests import file_digest
from colmap_av1.util.progress import Clock, Progress
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.unchanged import FileState


@dataclass(frozen=True)
class Run:
    """Inputs and options of a run.

    Attributes:
        inputs: the videos and photos.
        sources: for each video, where its motion and pictures come from.
        shown: for each video, how its pictures are decoded and displayed.
        output: the output folder.
        stages: its subfolder with the results that later runs resume from.
        options: options of all stages.
        context: clock, progress, threads and seed of the run.
        positions: positions of the images, for the database; None leaves them out.
        cameras: cameras of all images in an existing database; None creates them.
    """

    inputs: Inputs
    sources: tuple[VideoSource, ...]
    shown: tuple[ShownVideo, ...]
    output: Path
    stages: Path
    options: ReconstructOptions
    context: RunContext
    positions: ImagePositions | None = None
    cameras: ImageCameras | None = None

    @property
    def clock(self) -> Clock:
        """Measures the time of each stage."""
        return self.context.clock

    @property
    def progress(self) -> Progress:
        """Called in each stage."""
        return self.context.progress

    @property
    def files(self) -> tuple[FileState, ...]:
        """The state of all input files at the start."""
        photos = [photo.state for photo in self.inputs.photos]
        return (*(file for source in self.sources for file in source.files), *photos)

    @property
    def photo_digests(self) -> list[list[str]]:
        """Name and digest of each photo, which stages depend on."""
        return [[photo.name, file_digest(photo.path)] for photo in self.inputs.photos]

    def pose_tracks(self, tracks: Tracks) -> Tracks:
        """The tracks that poses are estimated from; shorter ones are used for points only."""
        return tracks.keep_lasting(least_length(self.options.match.tracks))

    def pictures(self, image_set: ImageSet) -> Pictures:
        """Reader of the pictures of images, see `pictures_of`."""
        photos = [photo.path for photo in self.inputs.photos]
        return pictures_of(image_set, self.shown, photos, self.options.match.reading)
