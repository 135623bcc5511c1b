"""Files that end inside an element of their container are recognized."""

from __future__ import annotations

from pathlib import Path

import pytest

from colmap_av1.video.cut_off import is_matroska_cut

_HEAD = 4  # track number, timecode and flags of a block


@pytest.mark.parametrize("length", [100, 0xA388, 0xA1FF, 0xA3_4FFF, 3_000_000])
@pytest.mark.parametrize("kind", [b"\xa3", b"\xa1"])
def test_end_of_the_last_block_is_found(tmp_path: Path, length: int, kind: bytes) -> None:
    """Bytes of the size of a block may look like the beginning of another block."""
    width = next(w for w in range(1, 9) if length < (1 << 7 * w) - 1)
    header = kind + (length | 1 << 7 * width).to_bytes(width, "big")
    file = tmp_path / "video.mkv"
    file.write_bytes(header + bytes(length))
    assert not is_matroska_cut(file, len(header), length - _HEAD)
    file.write_bytes(header + bytes(length - 1))
    assert is_matroska_cut(file, len(header), length - _HEAD)
