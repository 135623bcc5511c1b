from __future__ import annotations

import dataclasses
import json
import sqlite3
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from existing_database import (
    CAMERA,
    CAMERAS,
    LAYOUTS,
    NAMES,
    NUM_IMAGES,
    OURS,
    THEIRS,
    alter,
    make_existing,
    make_layout,
    query,
)
from synthetic_scene import FOCAL, HEIGHT, WIDTH, make_scene, match_scene

from colmap_av1.check.database import DatabaseCheck, check_database
from colmap_av1.cli import main
from colmap_av1.database.reading import pair_id_from_image_ids
from colmap_av1.database.writing import write_matches
from colmap_av1.errors import DatabaseError
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.options import CameraOptions


def found(report: DatabaseCheck) -> list[tuple[str, str]]:
    return [(finding.severity, finding.text) for finding in report.findings]


def maps(path: Path) -> bool:
    """Whether pycolmap's mapper reconstructs all images of the database."""
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    try:
        models = pycolmap.incremental_mapping(path, path.parent, path.parent / "model", options)
    except (ValueError, IndexError):
        return False
    return any(model.num_reg_images() == NUM_IMAGES for model in models.values())


def test_report_of_a_new_database(tmp_path: Path) -> None:
    path = tmp_path / "new.db"
    write_matches(path, NAMES, CAMERAS, OURS)
    report = check_database(path)
    assert (report.layout, report.readers) == ("3.8 or 3.9", "3.8 and later")
    assert report.user_version == 3800
    assert report.num_images == report.num_connected_images == NUM_IMAGES
    assert report.image_sizes == {(WIDTH, HEIGHT): NUM_IMAGES}
    assert (report.num_cameras, report.num_priors) == (1, 1)
    assert report.num_keypoints == sum(len(k.xy) for k in OURS.keypoints)
    assert 0.95 < report.num_matched_keypoints / report.num_keypoints <= 1
    assert report.keypoint_columns == {2: NUM_IMAGES}
    assert report.num_described_images == 0
    assert report.num_pairs == report.num_used_pairs == len(OURS.pairs)
    assert report.num_inliers == sum(len(g.inlier_matches) for g in OURS.geometries)
    assert report.configs == {"CALIBRATED": len(OURS.pairs)}
    assert report.parallax is not None
    # The camera moves 40 degrees around the scene, which only the first and last image span.
    assert 25 < report.parallax.angle < 40
    assert report.parallax.focal_known
    assert set(report.parallax.names) == {NAMES[0], NAMES[-1]}
    assert report.mappable
    assert {finding.severity for finding in report.findings} <= {"note"}


def test_versions_without_a_camera_model_are_not_named(tmp_path: Path) -> None:
    """COLMAP 3.8 aborts on camera models that it does not know."""
    path = tmp_path / "new.db"
    camera = pycolmap.Camera(model="DIVISION", width=WIDTH, height=HEIGHT, params=[300] * 4 + [0])
    write_matches(path, NAMES, [camera] * len(NAMES), OURS)
    assert "DIVISION" in check_database(path).readers


@pytest.mark.parametrize("layout", LAYOUTS)
def test_report_of_a_sift_database(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "sift.db"
    make_existing(path, layout, "sift")
    report = check_database(path)
    expected = {
        "3.8": ("3.8 or 3.9", "3.8 and later"),
        "3.11": ("3.10 or 3.11", "3.10 and later"),
        "3.13": ("3.12 or 3.13", "3.10 and later"),
        "4.2": ("4.x", "4.x"),
    }
    assert (report.layout, report.readers) == expected[layout]
    assert report.keypoint_columns == {6: NUM_IMAGES}
    assert report.num_described_images == NUM_IMAGES
    assert report.num_used_pairs == len(THEIRS.pairs)
    assert report.mappable
    assert {severity for severity, _ in found(report)} == {"note"}
    assert any("order of names" in text for _, text in found(report))


def test_migrated_database_is_recognised(tmp_path: Path) -> None:
    path = tmp_path / "given.db"
    make_existing(path, "3.8", "sift")
    pycolmap.Database.open(path).close()
    report = check_database(path)
    assert report.layout == "3.8 or 3.9, migrated by 4.x"
    assert report.readers == "3.8, 3.9 and 4.x"


# SQL changes to a database, the finding, and whether pycolmap still maps all its images.
CHANGES = {
    "no camera": (
        ["UPDATE images SET camera_id = 7 WHERE image_id = 8"],
        "error",
        "camera",
        False,
    ),
    "one frame missing": (
        [
            "DELETE FROM frame_data WHERE frame_id = 3",
            "DELETE FROM frames WHERE frame_id = 3",
        ],
        "error",
        "frame_005.png",
        False,
    ),
    "rigs without frames": (
        ["DELETE FROM frame_data", "DELETE FROM frames", "UPDATE rigs SET rig_id = 5"],
        "error",
        "rigs",
        False,
    ),
    "image removed": (
        ["DELETE FROM images WHERE image_id = 8"],
        "error",
        "7 pairs",
        False,
    ),
    "no keypoints": (["DELETE FROM keypoints"], "error", "keypoints", False),
    "no keypoints of one": (
        ["DELETE FROM keypoints WHERE image_id = 8"],
        "error",
        "frame_000.png",
        False,
    ),
    "never verified": (
        ["DELETE FROM two_view_geometries"],
        "error",
        "15",
        False,
    ),
    "some never verified": (
        ["DELETE FROM two_view_geometries WHERE pair_id % 3 = 0"],
        "warning",
        "10 pairs",
        True,
    ),
    "degenerate": (
        ["UPDATE two_view_geometries SET config = 1"],
        "warning",
        "degenerate",
        False,
    ),
    "undefined": (
        ["UPDATE two_view_geometries SET config = 0"],
        "warning",
        "never",
        False,
    ),
    "few inliers": (
        ["UPDATE two_view_geometries SET rows = 9, data = SUBSTR(data, 1, 72)"],
        "note",
        "28 pairs",
        False,
    ),
    "too few to start with": (
        ["UPDATE two_view_geometries SET rows = 40, data = SUBSTR(data, 1, 320)"],
        "warning",
        "100 inliers",
        None,
    ),
    "no row of matches": (
        ["DELETE FROM matches"],
        "warning",
        "'matches'",
        True,
    ),
    "empty rows": (
        [
            "UPDATE two_view_geometries SET rows = 0, data = NULL, config = 1 "
            "WHERE pair_id % 3 = 0",
            "UPDATE matches SET rows = 0, data = NULL WHERE pair_id % 3 = 0",
        ],
        "note",
        "10 pairs",
        True,
    ),
    "no model": (
        ["UPDATE two_view_geometries SET E = NULL, F = NULL, H = NULL"],
        "note",
        "parallax",
        True,
    ),
    "no focal length": (
        ["UPDATE cameras SET prior_focal_length = 0"],
        "note",
        "focal length",
        True,
    ),
    "several sizes": (
        [
            "INSERT INTO cameras SELECT 2, model, 320, height, params, prior_focal_length "
            "FROM cameras",
            "UPDATE images SET camera_id = 2 WHERE image_id = 8",
        ],
        "note",
        "2 sizes",
        None,
    ),
    "descriptors removed": (
        ["UPDATE descriptors SET rows = 1, data = SUBSTR(data, 1, 128) WHERE image_id = 2"],
        "warning",
        "frame_006.png",
        True,
    ),
    "astray": (
        [
            "UPDATE keypoints SET rows = rows - 9, data = SUBSTR(data, 1, 24 * (rows - 9)) "
            "WHERE image_id = 8"
        ],
        "warning",
        "keypoints",
        True,
    ),
    "orphan keypoints": (
        ["INSERT INTO keypoints VALUES (99, 0, 2, NULL)"],
        "note",
        "'keypoints'",
        True,
    ),
    "one image apart": (
        ["DELETE FROM two_view_geometries WHERE pair_id % 2147483647 = 8", "DELETE FROM matches"],
        "warning",
        "7 of 8",
        False,
    ),
    "unknown kind": (
        ["UPDATE two_view_geometries SET config = 12"],
        "note",
        "parallax",
        True,
    ),
    "several models": (
        ["UPDATE two_view_geometries SET config = 8"],
        "note",
        "28 pairs",
        True,
    ),
}


@pytest.mark.parametrize(
    ("changes", "severity", "word", "mapped"), CHANGES.values(), ids=CHANGES.keys()
)
def test_changed_database_gives_the_finding(
    tmp_path: Path, changes: list[str], severity: str, word: str, mapped: bool | None
) -> None:
    path = tmp_path / "given.db"
    make_existing(path, "3.13", "sift")
    before = found(check_database(path))
    for sql in changes:
        alter(path, sql)
    report = check_database(path)
    new = [f for f in found(report) if f not in before]
    assert any(severity == kind and word in text for kind, text in new), new
    assert all("\n" not in text for _, text in new)
    order = [("error", "warning", "note").index(f.severity) for f in report.findings]
    assert order == sorted(order)
    if mapped is not None:
        assert report.mappable or not mapped
        assert maps(path) == mapped


@pytest.mark.parametrize(
    ("arc", "severity"),
    [
        (4.0, "warning"),
        (12.0, "note"),
    ],
)
def test_little_parallax_is_reported(tmp_path: Path, arc: float, severity: str) -> None:
    scene = make_scene(num_frames=NUM_IMAGES, num_points=500, noise=0.05, arc_degrees=arc)
    write_matches(tmp_path / "a.db", NAMES, CAMERAS, match_scene(scene, CAMERA))
    report = check_database(tmp_path / "a.db")
    assert any(kind == severity and "parallax" in text for kind, text in found(report))
    assert report.parallax is not None
    assert report.parallax.angle == pytest.approx(0.75 * arc, rel=0.3)


def test_pairs_of_a_calibrated_rig_are_used(tmp_path: Path) -> None:
    """Their pose comes from the essential matrix, as for calibrated pairs."""
    path = tmp_path / "a.db"
    write_matches(path, NAMES, CAMERAS, OURS)
    before = check_database(path)
    alter(path, "UPDATE two_view_geometries SET config = 9")
    report = check_database(path)
    assert report.configs == {"CALIBRATED_RIG": len(OURS.pairs)}
    assert report.num_used_pairs == before.num_used_pairs
    assert report.parallax is not None
    assert report.parallax.angle == pytest.approx(before.parallax.angle)


def test_assumed_focal_length_is_reported(tmp_path: Path) -> None:
    guess = make_camera(CameraOptions(), WIDTH, HEIGHT)
    scene = make_scene(num_frames=NUM_IMAGES, num_points=500)
    write_matches(tmp_path / "a.db", NAMES, [guess] * len(NAMES), match_scene(scene, guess))
    report = check_database(tmp_path / "a.db")
    assert report.configs.keys() == {"UNCALIBRATED"}
    assert report.parallax is not None
    assert not report.parallax.focal_known
    assert report.parallax.angle == pytest.approx(30, rel=0.35)


def test_forward_motion_is_reported(tmp_path: Path) -> None:
    """The keypoints move away from the centre, as in a driving car."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-8, -6, 8], [8, 6, 30], (4000, 3))
    xy = []
    for i in range(NUM_IMAGES):
        seen = points - [0, 0, 0.7 * i]
        xy.append(FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2])
    inside = np.all([((p > 0) & (p < [WIDTH, HEIGHT])).all(axis=1) for p in xy], axis=0)
    num = int(inside.sum())
    scene = make_scene(num_frames=NUM_IMAGES)
    tracks = dataclasses.replace(
        scene.tracks,
        offsets=np.arange(num + 1, dtype=np.int64) * NUM_IMAGES,
        frame=np.tile(np.arange(NUM_IMAGES, dtype=np.int32), num),
        xy=np.stack([p[inside] for p in xy], axis=1).reshape(-1, 2).astype(np.float32),
        sigma=np.full(num * NUM_IMAGES, 0.3, dtype=np.float32),
        confirmed=np.zeros(num * NUM_IMAGES, dtype=np.bool_),
    )
    drive = dataclasses.replace(scene, tracks=tracks)
    write_matches(tmp_path / "a.db", NAMES, CAMERAS, match_scene(drive, CAMERA))
    texts = [text for _, text in found(check_database(tmp_path / "a.db"))]
    assert any("axis" in text for text in texts)


def listing(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("journal", ["delete", "wal"])
@pytest.mark.parametrize("layout", ["3.8", "4.2"])
def test_database_is_not_modified(tmp_path: Path, layout: str, journal: str) -> None:
    path = tmp_path / "given.db"
    make_existing(path, layout, "sift")
    query(path, f"PRAGMA journal_mode = {journal}")
    path.chmod(0o444)
    before = listing(tmp_path)
    time = path.stat().st_mtime_ns
    assert before.keys() == {"given.db"}
    check_database(path)
    assert listing(tmp_path) == before
    assert path.stat().st_mtime_ns == time


def test_write_ahead_log_of_another_process_is_read(tmp_path: Path) -> None:
    path = tmp_path / "given.db"
    make_existing(path, "4.2", "listed")
    writer = sqlite3.connect(path)
    writer.execute("PRAGMA journal_mode = WAL")
    writer.execute("DELETE FROM images WHERE image_id > 5")
    writer.commit()
    assert path.with_name("given.db-wal").stat().st_size > 0
    before = path.read_bytes()
    assert check_database(path).num_images == 5
    assert path.read_bytes() == before
    writer.close()


def test_interrupted_write_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "given.db"
    make_existing(path, "3.8", "sift")
    query(path, "PRAGMA journal_mode = delete")
    script = """
        import os, sqlite3, sys
        connection = sqlite3.connect(sys.argv[1])
        connection.execute("PRAGMA cache_size = 5")
        connection.execute("UPDATE keypoints SET data = ZEROBLOB(LENGTH(data))")
        os._exit(1)
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(script), path], check=False)
    assert path.with_name("given.db-journal").stat().st_size > 0
    before = listing(tmp_path)
    with pytest.raises(DatabaseError, match="interrupted"):
        check_database(path)
    assert listing(tmp_path) == before


def test_unreadable_databases_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.db").touch()
    (tmp_path / "text.db").write_text("no database, but long enough to be one\n" * 99)
    make_layout(tmp_path / "damaged.db", "3.8")
    alter(tmp_path / "damaged.db", "INSERT INTO keypoints VALUES (1, 5, 2, X'00')")
    alter(
        tmp_path / "damaged.db", "INSERT INTO images (image_id, name, camera_id) VALUES (1, 'a', 1)"
    )
    for name, message in (
        ("absent.db", "no such file"),
        ("empty.db", "empty"),
        ("text.db", "COLMAP"),
        ("damaged.db", "keypoints"),
        (".", "folder"),
    ):
        with pytest.raises(DatabaseError, match=message) as caught:
            check_database(tmp_path / name)
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "absent.db").exists()


def test_empty_database_is_reported(tmp_path: Path) -> None:
    make_layout(tmp_path / "a.db", "4.2")
    ((severity, text),) = found(check_database(tmp_path / "a.db"))
    assert severity == "error"
    assert "images" in text


def test_check_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.db"
    make_existing(path, "4.2", "sift")
    assert main(["check", "--database", str(path), "--strict"]) == 0
    rows = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert ["for mapping", "good"] in rows
    assert all(len(row) == 2 for row in rows), json.dumps(rows)
    alter(path, "DELETE FROM two_view_geometries")
    assert main(["check", "--database_path", str(path)]) == 0
    assert "for mapping\tnot ready" in capsys.readouterr().out
    assert main(["check", "--database", str(path), "--strict"]) == 1
    assert main(["check", "--database", str(tmp_path / "none.db")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_large_image_ids_are_read(tmp_path: Path) -> None:
    """The ids are near the limit of COLMAP's pair ids."""
    path = tmp_path / "a.db"
    write_matches(path, NAMES[:2], CAMERAS[:2], two_images())
    big = 2147483646
    for table in ("images", "keypoints"):
        alter(path, f"UPDATE {table} SET image_id = ? WHERE image_id = 2", big)
    for table in ("matches", "two_view_geometries"):
        alter(path, f"UPDATE {table} SET pair_id = ?", pair_id_from_image_ids(1, big))
    assert check_database(path).num_used_pairs == 1


def two_images() -> MatchedImages:
    (index,) = [k for k, pair in enumerate(OURS.pairs.tolist()) if pair == [0, 1]]
    return dataclasses.replace(
        OURS,
        keypoints=OURS.keypoints[:2],
        pairs=OURS.pairs[[index]],
        matches=[OURS.matches[index]],
        geometries=[OURS.geometries[index]],
    )
