"""The key images of a video, by the options of a run."""

from __future__ import annotations

from colmap_av1.images.key_images import key_images
from colmap_av1.images.track_images import VideoTracks
from colmap_av1.matching.links.plan import images_to_link
from colmap_av1.poses.run import Run
from colmap_av1.util.arrays import Ints


def key_images_of_video(run: Run, video: VideoTracks) -> Ints:
    """Indices of the key images among the images of a video."""
    pose_options, links = run.options.poses, run.options.match.links
    frames = video.chosen.frames
    always = images_to_link(video.inter_share, frames, links)
    if links.links != "none":
        always |= video.fast[frames]
    return key_images(
        video.tracks,
        frames,
        always,
        spacing=pose_options.pose_spacing,
        num_cells=pose_options.pose_tracks_per_image,
    )
