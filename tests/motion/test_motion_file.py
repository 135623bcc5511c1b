from __future__ import annotations

import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest

from colmap_av1.errors import OptionError, VideoError, WriteError
from colmap_av1.motion.frame_motion import UNIT_FIELDS, FrameMotion
from colmap_av1.motion.motion_file import export_motion
from colmap_av1.motion.reading import read_motion


def check_frame(frame: FrameMotion, stored: dict[str, np.ndarray]) -> None:
    names = {f.name for f in dataclasses.fields(frame)} - {"blocks", "block_index"}
    expected = {name: getattr(frame, name) for name in names.union(UNIT_FIELDS)}
    header = expected.pop("header")
    expected |= {f"header/{name}": value for name, value in header.items()}
    assert stored.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(stored[name], value)
        assert stored[name].dtype == np.asarray(value).dtype


@pytest.mark.parametrize("ending", ["npz", "h5"])
def test_motion_files_contain_every_field_of_every_frame(
    clip: Path, tmp_path: Path, ending: str
) -> None:
    output = tmp_path / f"m.{ending}"
    done: list[int] = []
    assert export_motion(clip, output, progress=lambda _, n, total: done.append(n)) == 16
    assert done == list(range(1, 17))
    stored: dict[str, np.ndarray] = {}
    if ending == "npz":
        with np.load(output) as archive:
            stored = dict(archive.items())
    else:
        with h5py.File(output) as file:
            file.visititems(
                lambda name, item: (
                    stored.__setitem__(name, item[()]) if isinstance(item, h5py.Dataset) else None
                )
            )
    for i, frame in enumerate(read_motion(clip)):
        prefix = f"{i:06d}/"
        check_frame(
            frame,
            {k.removeprefix(prefix): np.asarray(v) for k, v in stored.items() if prefix in k},
        )


@pytest.mark.parametrize("ending", ["npz", "h5"])
def test_same_video_gives_the_same_bytes(clip: Path, tmp_path: Path, ending: str) -> None:
    for name in "ab":
        export_motion(clip, tmp_path / f"{name}.{ending}")
    first, second = (tmp_path / f"{name}.{ending}" for name in "ab")
    assert first.read_bytes() == second.read_bytes()


def test_failures_leave_nothing(clip: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"\.npz"):
        export_motion(clip, tmp_path / "m.txt")
    with pytest.raises(VideoError, match="no such file"):
        export_motion(tmp_path / "none.mp4", tmp_path / "m.npz")
    with pytest.raises(WriteError, match="cannot be written"):
        export_motion(clip, tmp_path / "absent/m.npz")
    with pytest.raises(WriteError, match="cannot be written"):
        export_motion(clip, tmp_path / "absent/m.h5")
    assert list(tmp_path.iterdir()) == []
