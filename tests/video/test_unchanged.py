from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from colmap_av1.errors import ImageError, OptionError, VideoError
from colmap_av1.video.unchanged import file_state, unchanged


def write_on(video: Path) -> None:
    before = video.stat()
    with video.open("ab") as file:
        file.write(b"more")
    os.utime(video, ns=(before.st_atime_ns, before.st_mtime_ns))


def write_anew(video: Path) -> None:
    video.write_bytes(b"VIDEO")
    os.utime(video, ns=(0, 0))


def point_elsewhere(video: Path) -> None:
    """Replace the video by a link to a file of the same size and time."""
    other = video.with_name("other")
    other.write_bytes(video.read_bytes())
    os.utime(other, ns=(video.stat().st_atime_ns, video.stat().st_mtime_ns))
    video.unlink()
    video.symlink_to(other)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    (tmp_path / "v.mp4").write_bytes(b"video")
    return tmp_path / "v.mp4"


def test_unchanged_video_is_accepted(video: Path) -> None:
    with unchanged(file_state(video)) as check:
        video.read_bytes()
        check()


def read(video: Path, change: Callable[[Path], None], error: Exception | None = None) -> None:
    """Read a video that changes; raise `error` if the check notices."""
    with unchanged(file_state(video)) as check:
        change(video)
        try:
            check()
        except VideoError:
            if error is not None:
                raise error from None


@pytest.mark.parametrize("change", [write_on, write_anew, point_elsewhere, Path.unlink])
def test_changed_video_is_refused(video: Path, change: Callable[[Path], None]) -> None:
    with pytest.raises(VideoError, match="changed"):
        read(video, change)


def test_change_does_not_hide_internal_errors(video: Path) -> None:
    with pytest.raises(ZeroDivisionError):  # an internal error is not replaced
        read(video, write_on, ZeroDivisionError())


def test_errors_after_a_change_name_the_change(video: Path) -> None:
    with pytest.raises(ImageError, match="own"), unchanged(file_state(video)):
        raise ImageError("of its own")
    with pytest.raises(VideoError, match="changed"):
        read(video, write_on, ImageError("no frame 7"))


def test_missing_video_is_not_reported_as_changed(tmp_path: Path) -> None:
    none = file_state(tmp_path / "none.mp4")
    with pytest.raises(OptionError, match="no such file"), unchanged(none):
        raise OptionError("no such file")
