from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pycolmap
import pytest
from existing_database import CAMERAS, NAMES, OURS, THEIRS, alter, make_existing, make_layout, query
from synthetic_scene import HEIGHT, WIDTH

from colmap_av1.cli import main
from colmap_av1.database.reading import read_images
from colmap_av1.database.writing import write_matches
from colmap_av1.errors import DatabaseError, HlocError, WriteError
from colmap_av1.interop.hloc import HlocMatches, export_hloc, read_hloc
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewConfig, TwoViewGeometry
from colmap_av1.options import ExportOptions

FILES = ["features.h5", "matches.h5", "pairs.txt"]


def read_folder(folder: Path) -> HlocMatches:
    return read_hloc(folder / "features.h5", folder / "matches.h5")


def check_holds(found: HlocMatches, rows: MatchedImages, kind: str) -> None:
    """Check that the rows were read, in any order of images and matches."""
    assert found.names == NAMES
    assert (found.sizes == [WIDTH, HEIGHT]).all()
    for keypoints, expected in zip(found.keypoints, rows.keypoints, strict=True):
        assert keypoints.dtype == np.float32
        assert np.array_equal(keypoints, expected.xy)
    by_pair = {}
    for (i, j), matches in zip(found.pairs.tolist(), found.matches, strict=True):
        by_pair[min(i, j), max(i, j)] = matches if i < j else matches[:, ::-1]
    assert sorted(by_pair) == sorted(map(tuple, rows.pairs.tolist()))
    for pair, expected in zip(rows.pairs.tolist(), getattr(rows, kind), strict=True):
        expected_rows = getattr(expected, "inlier_matches", expected).tolist()
        assert sorted(by_pair[tuple(pair)].tolist()) == sorted(expected_rows)
    assert all((scores == 1).all() for scores in found.scores)


@pytest.mark.parametrize("verified", [True, False])
@pytest.mark.parametrize("layout", ["3.8", "4.2"])
def test_export_and_import_are_inverse(tmp_path: Path, layout: str, verified: bool) -> None:
    path = tmp_path / "sift.db"
    make_existing(path, layout, "sift")
    before = path.read_bytes()
    seen: list[tuple[str, int, int | None]] = []
    counts = export_hloc(
        path,
        tmp_path / "to" / "hloc",
        options=ExportOptions(verified=verified),
        progress=lambda *progress: seen.append(progress),
    )
    assert counts == (len(NAMES), len(THEIRS.pairs))
    assert seen[-1] == ("pairs", counts[1], counts[1])
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["sift.db", "to"]
    assert sorted(p.name for p in (tmp_path / "to" / "hloc").iterdir()) == FILES
    found = read_folder(tmp_path / "to" / "hloc")
    check_holds(found, THEIRS, "geometries" if verified else "matches")


def test_layout_matches_hloc(tmp_path: Path) -> None:
    """Names, shapes and types are those of extract_features and match_features."""
    path = tmp_path / "a.db"
    names = ["left/1.png", "left/2.png", "right/1.png"]
    xy = np.array([[0.5, 0.5], [10.25, 3.5], [99.0, 7.75]], np.float32)
    matches = np.array([[2, 0], [0, 1]], np.uint32)
    geometry = TwoViewGeometry(TwoViewConfig.UNCALIBRATED, matches, F=np.eye(3))
    write_matches(
        path,
        names,
        CAMERAS[:3],
        MatchedImages(
            [ImageKeypoints(xy + i, np.arange(3)) for i in range(3)],
            np.array([[0, 2]], np.int32),
            [matches],
            [geometry],
            forward_motion=False,
        ),
    )
    export_hloc(path, tmp_path / "hloc")
    with h5py.File(tmp_path / "hloc/features.h5") as file:
        keypoints = file["left/1.png/keypoints"]
        assert keypoints[()].tolist() == [[0, 0], [9.75, 3], [98.5, 7.25]]
        assert keypoints.dtype == np.float32
        assert keypoints.attrs["uncertainty"] == 1
        assert file["left/1.png/image_size"][()].tolist() == [WIDTH, HEIGHT]
        assert sorted(file["right/1.png"]) == ["image_size", "keypoints"]
    with h5py.File(tmp_path / "hloc/matches.h5") as file:
        group = file["left-1.png/right-1.png"]
        assert group["matches0"][()].tolist() == [1, -1, 0]
        assert group["matches0"].dtype == np.int16
        assert group["matching_scores0"][()].tolist() == [1, 0, 1]
        assert group["matching_scores0"].dtype == np.float16
    assert (tmp_path / "hloc/pairs.txt").read_text() == "left/1.png right/1.png\n"
    found = read_folder(tmp_path / "hloc")
    assert found.names == names
    assert found.matches[0].tolist() == [[0, 1], [2, 0]]


def test_positions_near_the_edge_are_exact(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    xy = np.concatenate([rng.uniform(0, 1, (500, 2)), rng.uniform(0, 4000, (500, 2))])
    keypoints = ImageKeypoints(xy.astype(np.float32), np.arange(1000))
    none = ImageKeypoints(np.empty((0, 2), np.float32), np.empty(0, np.int64))
    matches = np.array([[7, 8]], np.uint32)
    geometry = TwoViewGeometry(TwoViewConfig.UNCALIBRATED, matches, F=np.eye(3))
    rows = MatchedImages(
        [keypoints, none, keypoints],
        np.array([[0, 2]], np.int32),
        [matches],
        [geometry],
        forward_motion=False,
    )
    write_matches(tmp_path / "a.db", NAMES[:3], CAMERAS[:3], rows)
    export_hloc(tmp_path / "a.db", tmp_path)
    found = read_folder(tmp_path)
    assert np.array_equal(found.keypoints[0], keypoints.xy)
    assert found.keypoints[1].shape == (0, 2)
    # hloc adds half a pixel in the type of the file, and COLMAP stores float32.
    with h5py.File(tmp_path / "features.h5") as file:
        stored = file[f"{NAMES[0]}/keypoints"][()]
        stored += 0.5
        assert np.array_equal(stored.astype(np.float32), keypoints.xy)


def test_many_keypoints_need_wider_integers(tmp_path: Path) -> None:
    xy = np.zeros((40000, 2), np.float32)
    keypoints = [ImageKeypoints(xy, np.arange(40000)) for i in range(2)]
    matches = np.array([[3, 39999]], np.uint32)
    write_matches(
        tmp_path / "a.db",
        NAMES[:2],
        CAMERAS[:2],
        MatchedImages(
            keypoints,
            np.array([[0, 1]], np.int32),
            [matches],
            [TwoViewGeometry(TwoViewConfig.UNCALIBRATED, matches, F=np.eye(3))],
            forward_motion=False,
        ),
    )
    export_hloc(tmp_path / "a.db", tmp_path)
    assert np.array_equal(read_folder(tmp_path).matches[0], matches)


def test_same_database_gives_the_same_bytes(tmp_path: Path) -> None:
    write_matches(tmp_path / "a.db", NAMES, CAMERAS, OURS)
    for folder in ("a", "b"):
        export_hloc(tmp_path / "a.db", tmp_path / folder)
    for name in FILES:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_hloc_reconstructs_from_the_files(tmp_path: Path) -> None:
    """Runs hloc itself if it is installed."""
    pytest.importorskip("hloc.reconstruction", reason="hloc is not installed")
    database, images = tmp_path / "a.db", tmp_path / "images"
    write_matches(database, NAMES, CAMERAS, OURS)
    export_hloc(database, tmp_path)
    images.mkdir()
    for name in NAMES:
        pycolmap.Bitmap.from_array(np.zeros((HEIGHT, WIDTH), np.uint8)).write(images / name)
    words = ["--sfm_dir", tmp_path / "sfm", "--image_dir", images, "--camera_mode", "SINGLE"]
    for kind, name in zip(("features", "matches", "pairs"), FILES, strict=True):
        words += [f"--{kind}", tmp_path / name]
    subprocess.run([sys.executable, "-m", "hloc.reconstruction", *words], check=True)
    model = pycolmap.Reconstruction(tmp_path / "sfm")
    assert model.num_reg_images() == len(NAMES)
    ids = {i.name: i.image_id for i in read_images(tmp_path / "sfm/database.db")}
    for name, expected in zip(NAMES, OURS.keypoints, strict=True):
        ((cols, data),) = query(
            tmp_path / "sfm/database.db",
            "SELECT cols, data FROM keypoints WHERE image_id = ?",
            ids[name],
        )
        stored = np.frombuffer(data, np.float32).reshape(-1, cols)
        assert np.array_equal(stored[:, :2], expected.xy)


def write_hloc(folder: Path, pairs: dict[str, Any], keypoints: dict[str, Any]) -> Path:
    with h5py.File(folder / "features.h5", "w", libver="latest") as file:
        for name, array in keypoints.items():
            file.create_dataset(f"{name}/keypoints", data=array)
            file.create_dataset(f"{name}/descriptors", data=np.zeros((8, len(array))))
    with h5py.File(folder / "matches.h5", "w", libver="latest") as file:
        for name, matches0 in pairs.items():
            file.create_dataset(f"{name}/matches0", data=np.array(matches0, np.int16))
    return folder


HALF = np.array([[0, 0], [10, 20.5], [7, 1]], np.float16)


@pytest.mark.parametrize("separator", ["/", "_"])
def test_files_of_hloc_are_read(tmp_path: Path, separator: str) -> None:
    """Half precision, no scores, no sizes; the first versions separate a pair by '_'."""
    names = ["cam_a/1_1.png", "cam_b/1_1.png"]
    pairs = {separator.join(n.replace("/", "-") for n in reversed(names)): [2, -1, 0]}
    found = read_folder(write_hloc(tmp_path, pairs, dict.fromkeys(names, HALF)))
    assert found.names == names
    assert found.sizes.tolist() == [[0, 0], [0, 0]]
    assert found.keypoints[0].tolist() == [[0.5, 0.5], [10.5, 21], [7.5, 1.5]]
    assert found.pairs.tolist() == [[1, 0]]
    assert found.matches[0].tolist() == [[0, 2], [2, 0]]
    assert found.scores[0].tolist() == [1, 1]


def test_pair_in_both_directions_is_read_once(tmp_path: Path) -> None:
    pairs = {"a.png/b.png": [1, -1, 0], "b.png/a.png": [2, 0, -1]}
    found = read_folder(write_hloc(tmp_path, pairs, {"a.png": HALF, "b.png": HALF}))
    assert found.pairs.tolist() == [[0, 1]]
    assert found.matches[0].tolist() == [[0, 1], [2, 0]]


@pytest.mark.parametrize(
    ("pairs", "keypoints", "message"),
    [
        ({"a.png/c.png": [0, 1, 2]}, {"a.png": HALF, "b.png": HALF}, "images"),
        ({"a.png/b.png": [0, 1]}, {"a.png": HALF, "b.png": HALF}, "matches"),
        ({"a.png/b.png": [0, 1, 3]}, {"a.png": HALF, "b.png": HALF}, "exist"),
        ({"a.png/b.png": [0, -2, 1]}, {"a.png": HALF, "b.png": HALF}, "exist"),
        ({}, {"a.png": HALF}, r"matches\.h5"),
        ({"a.png/b.png": [0]}, {}, r"features\.h5"),
        ({"a_a/b": [0, 1, 2]}, {"a/b": HALF, "a-b": HALF}, "same name"),
        ({"a_b_c": [0, 1, 2]}, dict.fromkeys(("a", "b_c", "a_b", "c"), HALF), "ambiguous"),
        ({"a/b": [0, 1, 2]}, {"a": HALF[:, 0], "b": HALF}, "float16"),
    ],
)
def test_inconsistent_files_are_refused(
    tmp_path: Path, pairs: dict[str, Any], keypoints: dict[str, Any], message: str
) -> None:
    write_hloc(tmp_path, pairs, keypoints)
    with pytest.raises(HlocError, match=message) as caught:
        read_folder(tmp_path)
    assert "\n" not in str(caught.value)


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    write_hloc(tmp_path, {"a/b": [0, 1, 2]}, {"a": HALF, "b": HALF})
    with pytest.raises(HlocError, match="no such file"):
        read_hloc(tmp_path / "none.h5", tmp_path / "matches.h5")
    (tmp_path / "matches.h5").write_text("not HDF5\n" * 100)
    with pytest.raises(HlocError, match=r"matches\.h5"):
        read_folder(tmp_path)


@pytest.mark.parametrize(
    ("sql", "message"),
    [
        ("UPDATE images SET name = 'my image.png' WHERE image_id = 3", "my image.png"),
        (
            "UPDATE images SET name = CASE image_id WHEN 1 THEN 'a/b' ELSE 'a-b' END "
            "WHERE image_id < 3",
            "'a-b' and 'a/b'",
        ),
        ("DELETE FROM keypoints", "no keypoints"),
        ("DELETE FROM keypoints WHERE image_id = 4", "keypoints"),
        ("UPDATE keypoints SET cols = 3", "damaged"),
        (
            "UPDATE two_view_geometries SET data = ZEROBLOB(16), rows = 2",
            "several",
        ),
    ],
)
def test_databases_that_hloc_cannot_represent_are_refused(
    tmp_path: Path, sql: str, message: str
) -> None:
    path = tmp_path / "a.db"
    make_existing(path, "3.11", "sift")
    alter(path, sql)
    with pytest.raises(DatabaseError, match=message) as caught:
        export_hloc(path, tmp_path / "to" / "hloc")
    assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["a.db"]


def test_failures_leave_nothing(tmp_path: Path) -> None:
    make_layout(tmp_path / "a.db", "3.8")
    (tmp_path / "file").touch()
    with pytest.raises(DatabaseError, match="no such file"):
        export_hloc(tmp_path / "none.db", tmp_path / "h")
    with pytest.raises(WriteError, match="cannot be written"):
        export_hloc(tmp_path / "a.db", tmp_path / "file")
    with pytest.raises(DatabaseError, match="no keypoints"):
        export_hloc(tmp_path / "a.db", tmp_path / "h")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.db", "file"]


def test_export_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_matches(tmp_path / "a.db", NAMES, CAMERAS, OURS)
    words = ["export", "--database", str(tmp_path / "a.db"), "--output", str(tmp_path / "h")]
    assert main([*words, "--verified", "0"]) == 0
    table = dict(line.split("\t") for line in capsys.readouterr().out.splitlines())
    assert table == {"images": "8", "pairs": "28", "output": str(tmp_path / "h")}
    check_holds(read_folder(tmp_path / "h"), OURS, "matches")
