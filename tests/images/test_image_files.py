from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import Encode, encode_two_sizes
from numpy.typing import NDArray

from colmap_av1.errors import ImageError, OptionError, WriteError
from colmap_av1.images.files import (
    check_image_folder,
    image_size,
    read_image,
    size_of_images,
    write_image,
    write_images,
)
from colmap_av1.images.names import frames_of_images, image_names
from colmap_av1.images.photos import photo_files, read_photos
from colmap_av1.util.files import whole_file
from colmap_av1.video.decoding import decode_frames

SIZE = (192, 128)


def test_image_names_count_from_zero() -> None:
    assert image_names("frame_%06d.png", [0, 12]) == ["frame_000000.png", "frame_000012.png"]


@pytest.mark.parametrize(
    "pattern",
    [
        "frame.png",
        "%d_%d.png",
        "%s.png",
        "a%%%d.png",
        "%d.bmp",
        "sub/%d.png",
        "../%d.png",
        ".%d.png",
    ],
)
def test_invalid_name_patterns_are_refused(pattern: str) -> None:
    with pytest.raises(OptionError):
        image_names(pattern, [0])


@pytest.mark.parametrize(
    ("names", "num_frames", "frames"),
    [
        (["b.png", "a.png"], 2, [1, 0]),
        (["0001.jpg", "0002.jpg", "0003.jpg"], 3, [0, 1, 2]),
        (["f10.png", "f9.png", "f11.png"], 3, [1, 0, 2]),
        (["in/v2_0003.png", "in/v2_0001.png", "in/v2_0000.png"], 4, [3, 1, 0]),
        (["f_0.png", "f_4.png"], 10, [0, 4]),
        (["f_10.png", "f_4.png"], 10, [9, 3]),
    ],
)
def test_frames_are_found_from_image_names(
    names: list[str], num_frames: int, frames: list[int]
) -> None:
    assert frames_of_images(names, num_frames).tolist() == frames


@pytest.mark.parametrize(
    ("names", "num_frames", "reason"),
    [
        (["1.png", "2.png", "3.png"], 10, "frames"),  # cut at a lower rate?
        (["0.png", "1.png", "2.png"], 10, "frames"),
        (["2.png", "4.png"], 10, "frames"),
        (["0.png", "12.png"], 10, "frames"),
        (["left.png", "right.png", "top.png"], 10, "left"),
        ([f"{i}.png" for i in range(11)], 10, "11"),
        (["a/0.png", "b/0.png", "b/5.png"], 10, "same"),
    ],
)
def test_image_names_without_clear_frames_are_refused(
    names: list[str], num_frames: int, reason: str
) -> None:
    with pytest.raises(ImageError, match=reason) as caught:
        frames_of_images(names, num_frames)
    assert "\n" not in str(caught.value)


def test_first_number_resolves_ambiguous_names() -> None:
    assert frames_of_images(["2.png", "3.png"], 10, first_number=1).tolist() == [1, 2]
    assert frames_of_images(["2.png", "3.png"], 2, first_number=2).tolist() == [0, 1]
    with pytest.raises(ImageError, match="10"):
        frames_of_images(["0.png", "3.png"], 10, first_number=1)


def test_size_of_images() -> None:
    assert size_of_images({}, SIZE) == SIZE
    assert size_of_images({"a": SIZE}, SIZE) == SIZE
    assert size_of_images({"a": (96, 64), "b": (96, 64)}, SIZE) == (96, 64)
    assert size_of_images({"a": (683, 384)}, (1366, 769)) == (683, 384)
    with pytest.raises(ImageError, match="96x64"):
        size_of_images({"a": SIZE, "b": (96, 64)}, SIZE)
    with pytest.raises(ImageError, match="players"):
        size_of_images({"a": (128, 192)}, SIZE)
    with pytest.raises(ImageError, match="192x144"):
        size_of_images({"a": (192, 144)}, SIZE)


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_images_are_written(clip: Path, tmp_path: Path, ending: str) -> None:
    frames = [0, 3, 15]
    names = image_names(f"frame_%06d.{ending}", frames)
    done: list[int] = []
    assert write_images(clip, tmp_path / "a/b", names, frames, progress=done.append) == 3
    assert sorted(p.name for p in (tmp_path / "a/b").iterdir()) == names
    assert done == [0, 1, 2, 3]
    decoded = dict(decode_frames(clip))
    for frame, name in zip(frames, names, strict=True):
        image, truth = cv2.imread(str(tmp_path / "a/b" / name)), decoded[frame]
        if ending == "jpg":  # JPEG subsamples colour
            image, truth = (cv2.cvtColor(i, cv2.COLOR_BGR2GRAY) for i in (image, truth))
        assert cv2.absdiff(image, truth).mean() <= (0 if ending == "png" else 4)


def test_existing_images_are_kept(clip: Path, tmp_path: Path) -> None:
    names = ["sub/x.png", "y.png"]
    mine = np.full((128, 192, 3), 77, np.uint8)
    cv2.imwrite(str(tmp_path / "y.png"), mine)
    check_image_folder(tmp_path, names, SIZE)
    assert write_images(clip, tmp_path, names, [0, 1]) == 1
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "y.png")), mine)
    assert (tmp_path / "sub/x.png").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not allow such names")
@pytest.mark.parametrize("locale", ["C", "C.UTF-8"])
@pytest.mark.parametrize("name", [b"loc\xe9", "locé".encode()])
def test_paths_need_not_be_utf_8(tmp_path: Path, name: bytes, locale: str) -> None:
    """OpenCV's functions for files crash on some of these paths."""
    folder = tmp_path / os.fsdecode(name)
    folder.mkdir()
    picture = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)
    write_image(folder / "a.png", picture)
    code = """
import sys
from pathlib import Path
from colmap_av1.images.files import image_size, read_image
path = next(next(Path(sys.argv[1]).iterdir()).iterdir())
sys.stdout.buffer.write(bytes([*image_size(path)]) + read_image(path).tobytes())
"""
    words = [sys.executable, "-c", code, str(tmp_path)]
    environment = {**os.environ, "LC_ALL": locale, "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    done = subprocess.run(words, env=environment, cwd=tmp_path, capture_output=True, check=True)
    assert done.stdout == bytes([8, 8]) + picture.tobytes()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs the pipes of a Unix system")
def test_pipes_are_refused_as_images(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.png")
    for read in (image_size, read_image):
        with pytest.raises(ImageError):
            read(tmp_path / "a.png")


def test_image_names_must_be_utf_8(tmp_path: Path) -> None:
    name = os.fsdecode(b"\xe9")
    with pytest.raises(OptionError, match="not UTF-8"):
        image_names(f"{name}%d.png", [0])
    write_image(tmp_path / f"{name}.png", np.zeros((8, 8, 3), dtype=np.uint8))
    files, _ = photo_files(tmp_path)
    with pytest.raises(ImageError, match="not UTF-8"):
        read_photos(tmp_path, files, "photos", for_trainers=False)
    (photo,) = read_photos(tmp_path, files, "photos", for_trainers=True)
    assert photo.name == "photos/_.png"


def test_photos_whose_masks_would_have_one_name_are_refused(tmp_path: Path) -> None:
    """Masks for trainers are PNG files with the name of the image."""
    files = [Path("a.jpg"), Path("a.png")]
    for file in files:
        write_image(tmp_path / file, np.zeros((8, 8, 3), dtype=np.uint8))
    assert len(read_photos(tmp_path, files, "photos", for_trainers=False)) == 2
    with pytest.raises(ImageError, match="rename"):
        read_photos(tmp_path, files, "photos", for_trainers=True)


def test_only_photos_that_are_cut_short_are_refused(tmp_path: Path) -> None:
    """A thumbnail in the header and a video after the image may have any markers of JPEG."""
    picture = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    thumbnail = cv2.imencode(".jpg", picture[:8, :8])[1].tobytes()
    segment = b"\xff\xff\xe5" + (2 + len(thumbnail)).to_bytes(2, "big") + thumbnail
    photos = {
        "plain.jpg": data,
        "with_thumbnail.jpg": data[:2] + segment + data[2:],
        "motion.jpg": data + b"\0\0\0\x08ftyp\xff\xd9\xff\xda",
    }
    for name, content in photos.items():
        (tmp_path / name).write_bytes(content)
        assert len(read_photos(tmp_path, [Path(name)], "photos", for_trainers=False)) == 1
        end = content.index(data[2:]) + len(data) - 2
        for length in (end - 2, end - len(data) // 2):
            (tmp_path / name).write_bytes(content[:length])
            with pytest.raises(ImageError, match=f"{name}: is damaged"):
                read_photos(tmp_path, [Path(name)], "photos", for_trainers=False)


@pytest.mark.parametrize("ending", ["png", "tiff"])
def test_truncated_photos_without_loss_are_refused(tmp_path: Path, ending: str) -> None:
    picture = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    data = cv2.imencode(f".{ending}", picture)[1].tobytes()
    photo = Path(f"a.{ending}")
    (tmp_path / photo).write_bytes(data)
    assert len(read_photos(tmp_path, [photo], "photos", for_trainers=False)) == 1
    (tmp_path / photo).write_bytes(data[: len(data) // 2])
    with pytest.raises(ImageError):
        read_photos(tmp_path, [photo], "photos", for_trainers=False)


def test_hidden_photos_are_not_mentioned(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.zeros((8, 8, 3), dtype=np.uint8))
    (tmp_path / "._b.HEIC").touch()
    files, warning = photo_files(tmp_path)
    assert (files, warning) == ([Path("a.png")], None)


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_existing_images_of_another_size_are_refused(tmp_path: Path, ending: str) -> None:
    name = f"frame_000003.{ending}"
    cv2.imwrite(str(tmp_path / name), np.zeros((64, 96, 3), np.uint8))
    with pytest.raises(ImageError, match=name):
        check_image_folder(tmp_path, f"frame_%06d.{ending}", SIZE)
    with pytest.raises(ImageError, match=name):
        check_image_folder(tmp_path, [name], SIZE)
    check_image_folder(tmp_path, f"other_%06d.{ending}", SIZE)


def test_unusable_image_folders_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("no image")
    with pytest.raises(ImageError, match="file"):
        check_image_folder(file, "%d.png", SIZE)
    with pytest.raises(ImageError, match="outside"):
        check_image_folder(tmp_path, ["../a.png"], SIZE)
    shutil.copy(file, tmp_path / "a.png")
    with pytest.raises(ImageError, match=r"a\.png"):
        check_image_folder(tmp_path, ["a.png"], SIZE)


def test_missing_frames_are_an_error(clip: Path, tmp_path: Path) -> None:
    names = [f"{frame}.png" for frame in range(17)]
    with pytest.raises(ImageError, match="16"):
        write_images(clip, tmp_path, names, range(17))
    assert {path.name for path in tmp_path.iterdir()} == set(names[:16])


def test_changed_pictures_are_written_and_shown_in_order(clip: Path, tmp_path: Path) -> None:
    names = [f"{frame}.png" for frame in range(16)]
    seen: list[int] = []

    def look(frame: int, picture: NDArray[np.uint8]) -> None:
        seen.append(frame)
        assert (picture == frame).all()
        assert (cv2.imread(str(tmp_path / names[frame])) == frame).all()

    write_images(
        clip,
        tmp_path,
        names,
        range(16),
        num_threads=3,
        change=lambda frame, picture: np.full_like(picture, frame),
        look=look,
    )
    assert seen == list(range(16))


def test_no_image_is_written_after_an_error_of_the_caller(clip: Path, tmp_path: Path) -> None:
    def stop(frame: int, _: NDArray[np.uint8]) -> None:
        raise KeyboardInterrupt

    names = [f"{frame}.png" for frame in range(16)]
    with pytest.raises(KeyboardInterrupt):
        write_images(clip, tmp_path, names, range(16), num_threads=2, look=stop)
    written = sorted(tmp_path.iterdir())
    time.sleep(0.2)
    assert sorted(tmp_path.iterdir()) == written
    assert len(written) < 16


@contextmanager
def no_space() -> Iterator[None]:
    """Limit files to 10 kB, which fails in the same place as a full disk."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_full_disk_leaves_no_partial_image(clip: Path, tmp_path: Path) -> None:
    # Only around the call, because the output of the test may also go to a file.
    with no_space(), pytest.raises(WriteError, match=r"a\.png"):
        write_images(clip, tmp_path, ["a.png"], [0])
    assert list(tmp_path.iterdir()) == []


def test_leftovers_of_killed_processes_are_removed(clip: Path, tmp_path: Path) -> None:
    with whole_file(tmp_path / "b [1].png") as partial:
        killed = partial.name
    others = [".b.png.1.partial", ".b.png.partial", ".b.png.x.partial", "b.partial"]
    (tmp_path / "b [1].png").unlink()
    for name in [killed, *others]:
        (tmp_path / name).touch()
    write_images(clip, tmp_path, ["a.png"], [0])
    assert {p.name for p in tmp_path.iterdir()} == {"a.png", *others}


def test_change_of_size_is_an_error(encode: Encode, tmp_path: Path) -> None:
    both = encode_two_sizes(encode, tmp_path / "both.obu", 2)
    with pytest.raises(ImageError, match="128x128"):
        write_images(both, tmp_path / "out", [f"{i}.png" for i in range(4)], range(4))
