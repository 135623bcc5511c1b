"""The report on the links, and its warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from colmap_av1.matching.gaps import Gap, GapReason
from colmap_av1.util.texts import some_names

# Number of gaps that a warning names.
_NUM_NAMED = 4


@dataclass(frozen=True)
class LinkReport:
    """Result of linking. Frames are counted through all videos.

    Attributes:
        num_images: images whose pictures were examined.
        searched_loops: whether loop closures were searched in all videos.
        num_links: pairs that were linked.
        num_loop_closures: linked pairs that close a loop.
        num_between: linked pairs of different videos or photos.
        gaps: gaps that motion does not bridge, in order.
        fast: first and last frame of each stretch in which the camera moves fast and all pictures
            were matched with their neighbours.
        videos: (name, first frame) of each video if there are several.
        parts: the names of the videos in each connected group, if there are several groups.
        unlinked_photos: names of photos that nothing connects to a video.
        same_videos: (name, name) of videos that show the same pictures.
    """

    num_images: int = 0
    searched_loops: bool = False
    num_links: int = 0
    num_loop_closures: int = 0
    num_between: int = 0
    gaps: tuple[Gap, ...] = ()
    fast: tuple[tuple[int, int], ...] = ()
    videos: tuple[tuple[str, int], ...] = ()
    parts: tuple[tuple[str, ...], ...] = ()
    unlinked_photos: tuple[str, ...] = ()
    same_videos: tuple[tuple[str, str], ...] = ()

    def frames_of_gaps(self, reason: GapReason = "doubtful motion") -> list[tuple[int, int]]:
        """Frames on either side of each gap with a reason; every gap has the default reason."""
        return [gap.frames for gap in self.gaps if gap.frames and reason in gap.reasons]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about unconnected images and about videos that are the same."""
        same = (
            f"'{first}' and '{second}' show the same pictures, like two encodings of one video: "
            "give only one of them, the other takes time and adds nothing"
            for first, second in self.same_videos
        )
        return (*self._gap_warnings(), *self._part_warnings(), *self._photo_warnings(), *same)

    def _gap_warnings(self) -> tuple[str, ...]:
        gaps = self.frames_of_gaps("no overlap")
        if not gaps:
            return ()
        shown = []
        for gap in gaps[:_NUM_NAMED]:
            name, before, after = gap_in_video(gap, self.videos)
            shown.append(f"{before} and {after} of '{name}'" if name else f"{before} and {after}")
        more = f" and {len(gaps) - _NUM_NAMED} more pairs" if len(gaps) > _NUM_NAMED else ""
        return (
            f"nothing connects frames {', '.join(shown)}{more}: the camera jerks, or a picture is "
            "blurred, or there is a cut, and the pictures have nothing in common; the images on "
            "either side are in separate models, or not registered",
        )

    def _part_warnings(self) -> tuple[str, ...]:
        if not self.parts:
            return ()
        if self.num_images == 0:
            names = ", ".join(f"'{name}'" for part in self.parts for name in part)
            return (
                f"--links none does not connect {names}: they become separate models unless other "
                "matches connect them; leave it out to connect them by SIFT features",
            )
        groups = " with ".join(", ".join(f"'{name}'" for name in part) for part in self.parts)
        return (
            f"nothing in the pictures connects {groups}: they become {len(self.parts)} separate "
            "models; film what both have in view, or match videos of different scenes separately",
        )

    def _photo_warnings(self) -> tuple[str, ...]:
        if not self.unlinked_photos:
            return ()
        names = some_names(self.unlinked_photos)
        return (
            f"{len(self.unlinked_photos)} of the photos have nothing in common with any video and "
            f"are not connected: {names}",
        )


def gap_in_video(gap: Sequence[int], videos: Sequence[tuple[str, int]]) -> tuple[str, int, int]:
    """Name of a gap's video ('' for a single video), and the gap's frames counted in that video."""
    name, first = next((v for v in reversed(videos) if v[1] <= gap[0]), ("", 0))
    return name, gap[0] - first, gap[1] - first
