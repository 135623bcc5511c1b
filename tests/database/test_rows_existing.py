"""Writing matches into databases that already have keypoints and matches."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import textwrap
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from colmap_command import COLMAP, colmap, needs_colmap
from existing_database import (
    CAMERAS,
    LAYOUTS,
    NAMES,
    NUM_IMAGES,
    OUR_SCENE,
    OURS,
    THEIRS,
    alter,
    fill_with_sift,
    list_images,
    make_existing,
    query,
    sift_keypoints,
)
from half_way import kill, start_writing
from numpy.typing import NDArray
from synthetic_scene import HEIGHT, WIDTH, alignment_error

from colmap_av1.database.reading import pair_id_from_image_ids, read_images
from colmap_av1.database.writing import write_matches
from colmap_av1.errors import DatabaseError
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewConfig, TwoViewGeometry
from colmap_av1.options import OnExisting

MODES: tuple[OnExisting, ...] = ("append", "replace")

# Schemas that a version of COLMAP opens: its own and older ones, but COLMAP 3.8 only its own.
READS = {
    "3.8": ("3.8",),
    "3.11.1": ("3.8", "3.11", "3.13"),
    "3.13.0": ("3.8", "3.11", "3.13"),
    "installed": LAYOUTS,
}
# Mapper, schema, content of the database before matches are written, and how they are written.
MAPPED: list[tuple[str, str, str, OnExisting]] = [
    (mapper, layout, *state)
    for mapper, layouts in READS.items()
    for layout in layouts
    for state in (("listed", "error"), ("sift", "append"), ("sift", "replace"))
    # Writing does not change the schema, so one schema is enough for the other states.
    if state == ("sift", "append") or layout == layouts[-1]
]


def other_python(version: str) -> str:
    """Path of a Python with another version of pycolmap; skips the test if there is none."""
    folder = os.environ.get("COLMAP_AV1_VENVS")
    if folder is None:
        pytest.skip(
            "set COLMAP_AV1_VENVS to a folder of virtual environments 3.11.1 and 3.13.0 with "
            "these versions of pycolmap"
        )
    python = Path(folder) / version / "bin" / "python"
    if not python.exists():
        pytest.skip(f"no {python}")
    return str(python)


def read_keypoints(database: Path, image_id: int) -> NDArray[np.float32]:
    ((rows, cols, data),) = query(
        database, "SELECT rows, cols, data FROM keypoints WHERE image_id = ?", image_id
    )
    return np.frombuffer(data, np.float32).reshape(rows, cols)


def read_pair(database: Path, table: str, a: int, b: int) -> NDArray[np.uint32]:
    ((rows, data),) = query(
        database,
        f"SELECT rows, data FROM {table} WHERE pair_id = ?",
        pair_id_from_image_ids(a, b),
    )
    found = np.frombuffer(data, np.uint32).reshape(rows, 2)
    return found if a < b else found[:, ::-1]


def schema(database: Path) -> list[Any]:
    return [
        query(database, "SELECT name, sql FROM sqlite_master ORDER BY name"),
        query(database, "PRAGMA user_version"),
        query(database, "PRAGMA journal_mode"),
    ]


def content(database: Path) -> dict[str, list[Any]]:
    tables = query(database, "SELECT name FROM sqlite_master WHERE type = 'table'")
    return {name: query(database, f"SELECT * FROM {name} ORDER BY 1") for (name,) in tables}


def check_model(model: pycolmap.Reconstruction, least_points: int) -> None:
    centers = {i.name: i.projection_center() for i in model.images.values() if i.has_pose}
    assert sorted(centers) == NAMES
    found = np.array([centers[name] for name in NAMES])
    assert alignment_error(found, OUR_SCENE.center) < 0.1
    assert model.num_points3D() > least_points
    assert model.compute_mean_reprojection_error() < 0.6


def map_with(mapper: str, database: Path, folder: Path) -> pycolmap.Reconstruction:
    """Run the incremental mapper of a version, and return the model with the most images."""
    output = folder / "models"
    output.mkdir()
    if mapper == "3.8":
        colmap(
            "mapper",
            *("--database_path", database, "--image_path", folder, "--output_path", output),
            *("--Mapper.extract_colors", 0),
        )
    elif mapper == "installed":
        options = pycolmap.IncrementalPipelineOptions(extract_colors=False)
        pycolmap.incremental_mapping(database, folder, output, options)
    else:
        script = """
            import sys, numpy, pycolmap
            options = pycolmap.IncrementalPipelineOptions()
            options.extract_colors = False
            pycolmap.incremental_mapping(*sys.argv[1:], options)
        """
        subprocess.run(
            [other_python(mapper), "-c", textwrap.dedent(script), database, folder, output],
            check=True,
            capture_output=True,
            env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
        )
    models = [pycolmap.Reconstruction(path) for path in output.iterdir() if path.is_dir()]
    return max(models, key=lambda m: m.num_reg_images())


@pytest.mark.parametrize(("mapper", "layout", "state", "mode"), MAPPED)
def test_every_mapper_maps_every_database_it_can_open(
    tmp_path: Path, mapper: str, layout: str, state: str, mode: OnExisting
) -> None:
    if mapper == "3.8" and COLMAP is None:
        pytest.skip("no colmap command on PATH")
    path = tmp_path / "given.db"
    make_existing(path, layout, state)
    before = schema(path)
    write_matches(path, NAMES, None, OURS, on_existing=mode)
    assert schema(path) == before
    check_model(map_with(mapper, path, tmp_path), 750 if mode == "append" else 380)


@pytest.mark.parametrize("layout", ["3.13", "4.2"])
def test_global_mapper_maps_appended_rows(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "given.db"
    make_existing(path, layout, "sift")
    write_matches(path, NAMES, None, OURS, on_existing="append")
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    models = pycolmap.global_mapping(path, tmp_path, tmp_path / "model", options)
    check_model(max(models.values(), key=lambda m: m.num_reg_images()), 750)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_append_keeps_existing_rows(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "given.db"
    ids = make_existing(path, layout, "sift")
    before = content(path)
    write_matches(path, NAMES, None, OURS, on_existing="append")
    after = content(path)
    changed = {"keypoints", "descriptors", "matches", "two_view_geometries"}
    assert {k: v for k, v in after.items() if k not in changed} == {
        k: v for k, v in before.items() if k not in changed
    }
    num_existing = []
    for index, name in enumerate(NAMES):
        theirs, ours = sift_keypoints(index), OURS.keypoints[index].xy
        found = read_keypoints(path, ids[name])
        num_existing.append(len(theirs))
        assert np.array_equal(found[: len(theirs)], theirs)
        assert np.array_equal(found[len(theirs) :, :2], ours)
        assert (found[len(theirs) :, 2:] == [1, 0, 0, 1]).all()
        ((rows, data),) = query(
            path, "SELECT rows, data FROM descriptors WHERE image_id = ?", ids[name]
        )
        ((old,),) = [
            (row[-1],) if layout != "4.2" else (row[4],)
            for row in before["descriptors"]
            if row[0] == ids[name]
        ]
        assert rows == len(found)
        assert data == old + bytes(128 * len(ours))
    for kind, table in (("matches", "matches"), ("geometries", "two_view_geometries")):
        assert np.array_equal(THEIRS.pairs, OURS.pairs)
        for (i, j), theirs, ours in zip(
            OURS.pairs, getattr(THEIRS, kind), getattr(OURS, kind), strict=True
        ):
            rows = [getattr(k, "inlier_matches", k) for k in (theirs, ours)]
            rows[1] = rows[1] + np.array([num_existing[i], num_existing[j]], np.uint32)
            found = read_pair(path, table, ids[NAMES[i]], ids[NAMES[j]])
            assert np.array_equal(found, np.concatenate(rows))


def test_appending_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "given.db"
    make_existing(path, "4.2", "sift")
    write_matches(path, NAMES, None, OURS, on_existing="append")
    before = path.read_bytes()
    with pytest.raises(DatabaseError, match="already"):
        write_matches(path, NAMES, None, OURS, on_existing="append")
    assert path.read_bytes() == before


@pytest.mark.parametrize("layout", LAYOUTS)
def test_replace_removes_rows_of_the_named_images_only(tmp_path: Path, layout: str) -> None:
    path, fresh = tmp_path / "given.db", tmp_path / "fresh.db"
    ids = make_existing(path, layout, "sift")
    before = content(path)
    named = NAMES[:5]
    index = [k for k, (i, j) in enumerate(OURS.pairs) if max(i, j) < 5]
    rows = replace(
        OURS,
        keypoints=OURS.keypoints[:5],
        pairs=OURS.pairs[index],
        matches=[OURS.matches[k] for k in index],
        geometries=[OURS.geometries[k] for k in index],
    )
    write_matches(path, named, None, rows, on_existing="replace")
    list_images(fresh, layout)
    write_matches(fresh, named, None, rows)
    after, ours = content(path), content(fresh)
    named_ids = {ids[name] for name in named}
    for table in ("keypoints", "descriptors"):
        kept = [row for row in before[table] if row[0] not in named_ids]
        assert len(kept) == NUM_IMAGES - 5
        assert after[table] == sorted(kept + ours[table])
    for table in ("matches", "two_view_geometries"):
        kept = [r for r in before[table] if named_ids.isdisjoint(divmod(r[0], 2147483647))]
        assert len(kept) == 3
        assert after[table] == sorted(kept + ours[table])
    write_matches(path, named, None, rows, on_existing="replace")
    assert content(path) == after


def test_existing_keypoints_are_an_error_by_default(tmp_path: Path) -> None:
    path = tmp_path / "given.db"
    make_existing(path, "3.8", "sift")
    before = path.read_bytes()
    with pytest.raises(DatabaseError, match="on_existing"):
        write_matches(path, NAMES, None, OURS)
    assert path.read_bytes() == before


def one_pair(num: int, config: TwoViewConfig) -> MatchedImages:
    """Rows of two images with 60 matches, `num` of which are inliers."""
    xy = np.arange(200, dtype=np.float32).reshape(100, 2)
    inliers = np.repeat(np.arange(num, dtype=np.uint32), 2).reshape(num, 2)
    return MatchedImages(
        [ImageKeypoints(xy + i, np.arange(100)) for i in range(2)],
        np.array([[0, 1]], np.int32),
        [np.repeat(np.arange(60, dtype=np.uint32), 2).reshape(60, 2)],
        [TwoViewGeometry(config, inliers, F=np.full((3, 3), float(num)))],
        forward_motion=False,
    )


@pytest.mark.parametrize(
    ("theirs", "ours", "merged"),
    [
        ((3, 40), (TwoViewConfig.UNCALIBRATED, 30), (3, 70, -1)),
        ((3, 30), (TwoViewConfig.CALIBRATED, 40), (2, 70, 40)),
        ((6, 20), (TwoViewConfig.CALIBRATED, 20), (6, 40, -1)),
        ((3, 30), (TwoViewConfig.DEGENERATE, 10), (3, 30, -1)),
        ((1, 0), (TwoViewConfig.CALIBRATED, 20), (2, 20, 20)),
        ((1, 12), (TwoViewConfig.CALIBRATED, 20), (2, 20, 20)),  # degenerate, so without inliers
        (
            (7, 50),
            (TwoViewConfig.CALIBRATED, 20),
            (2, 20, 20),
        ),  # a watermark, not the scene
        ((0, 50), (TwoViewConfig.CALIBRATED, 20), (2, 70, 20)),  # imported without an estimate
        ((8, 50), (TwoViewConfig.CALIBRATED, 20), (2, 70, 20)),  # inliers of several models
        ((0, 50), (TwoViewConfig.DEGENERATE, 0), (0, 50, -1)),
    ],
)
def test_geometry_with_more_inliers_is_kept_when_merged(
    tmp_path: Path,
    theirs: tuple[int, int],
    ours: tuple[TwoViewConfig, int],
    merged: tuple[int, int, float],
) -> None:
    """The geometries of a pair, theirs and ours, are merged.

    Each is given as its config and number of inliers, the merged one also with F[0, 0]: -1 in
    theirs and the number of inliers in ours.
    """
    (their_config, their_inliers), (our_config, our_inliers) = theirs, ours
    config, inliers, F = merged
    path = tmp_path / "given.db"
    write_matches(path, NAMES[:2], CAMERAS[:2], one_pair(their_inliers, TwoViewConfig.UNCALIBRATED))
    alter(
        path,
        "UPDATE two_view_geometries SET config = ?, F = ?",
        their_config,
        np.full(9, -1.0).tobytes(),
    )
    rows = one_pair(our_inliers, our_config)
    for keypoints in rows.keypoints:
        keypoints.xy[:] += 0.5
    write_matches(path, NAMES[:2], None, rows, on_existing="append")
    found = read_pair(path, "two_view_geometries", 1, 2)
    ((stored, blob),) = query(path, "SELECT config, F FROM two_view_geometries")
    assert stored == config
    assert np.frombuffer(blob)[0] == F
    assert len(found) == inliers
    assert np.array_equal(found[:, 0], found[:, 1])
    assert set(found[:, 0]) <= {*range(their_inliers), *range(100, 100 + our_inliers)}
    assert len(read_pair(path, "matches", 1, 2)) == 120


def test_inliers_become_the_matches_of_a_pair_without_matches(tmp_path: Path) -> None:
    """Programs that import matches write only geometries.

    Without the inliers among its matches, the pair would lose them: matchers skip a pair that has
    matches and a geometry.
    """
    path = tmp_path / "given.db"
    write_matches(path, NAMES[:2], CAMERAS[:2], one_pair(40, TwoViewConfig.UNCALIBRATED))
    alter(path, "DELETE FROM matches")
    rows = one_pair(30, TwoViewConfig.UNCALIBRATED)
    rows.keypoints[0].xy[:] += 0.5
    write_matches(path, NAMES[:2], None, rows, on_existing="append")
    assert len(read_pair(path, "matches", 1, 2)) == 40 + 60


@pytest.mark.parametrize("layout", LAYOUTS)
def test_empty_rows_are_replaced(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "given.db"
    ids = list_images(path, layout)
    pair_ids = [
        (pair_id_from_image_ids(a, b),) for a in ids.values() for b in ids.values() if a < b
    ]
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.executemany(
            "INSERT INTO keypoints VALUES (?, 0, 6, NULL)", ((i,) for i in ids.values())
        )
        connection.executemany("INSERT INTO matches VALUES (?, 0, 2, NULL)", pair_ids)
        connection.executemany(
            "INSERT INTO two_view_geometries (pair_id, rows, cols, config) VALUES (?, 0, 2, 1)",
            pair_ids,
        )
    write_matches(path, NAMES, None, OURS)
    assert query(path, "SELECT MIN(rows) > 0, MAX(cols) FROM keypoints") == [(1, 2)]
    assert query(path, "SELECT MIN(rows) > 0, MIN(config) FROM two_view_geometries") == [(1, 2)]


@pytest.mark.parametrize(("layout", "mode"), list(zip(LAYOUTS, MODES * 2, strict=True)))
def test_images_are_added_with_their_frames(tmp_path: Path, layout: str, mode: OnExisting) -> None:
    """The database has half of the images before; then it is mapped with all of them."""
    path = tmp_path / "given.db"
    list_images(path, layout, NAMES[:4])
    with pytest.raises(DatabaseError, match="4 images"):
        write_matches(path, NAMES, CAMERAS, OURS)
    with pytest.raises(DatabaseError, match="4 images"):
        write_matches(path, NAMES, None, OURS, on_existing=mode)
    write_matches(path, NAMES, CAMERAS, OURS, on_existing=mode)
    images = read_images(path)
    assert {i.name: i.camera_id for i in images} == {
        name: 1 if name in NAMES[:4] else 2 for name in NAMES
    }
    if layout in ("3.13", "4.2"):
        assert query(path, "SELECT rig_id, ref_sensor_id, ref_sensor_type FROM rigs") == [
            (1, 1, 0),
            (2, 2, 0),
        ]
        framed = query(
            path,
            "SELECT data_id, sensor_id, sensor_type, rig_id FROM frame_data "
            "JOIN frames USING (frame_id) ORDER BY data_id",
        )
        assert framed == [(i.image_id, i.camera_id, 0, i.camera_id) for i in images]
    check_model(map_with("installed", path, tmp_path), 380)


@pytest.mark.parametrize("missing", [1, NUM_IMAGES])
def test_images_without_a_frame_get_one(tmp_path: Path, missing: int) -> None:
    path = tmp_path / "given.db"
    list_images(path, "3.13")
    framed = (
        "SELECT data_id, sensor_id, sensor_type, rig_id FROM frame_data "
        "JOIN frames USING (frame_id) ORDER BY data_id"
    )
    whole = query(path, framed)
    alter(path, "DELETE FROM frames WHERE frame_id > ?", NUM_IMAGES - missing)
    alter(path, "DELETE FROM frame_data WHERE frame_id > ?", NUM_IMAGES - missing)
    write_matches(path, NAMES, None, OURS)
    assert query(path, framed) == whole
    assert query(path, "SELECT * FROM rigs") == [(1, 1, 0)]


def test_no_frames_are_added_to_a_database_without_frames(tmp_path: Path) -> None:
    path = tmp_path / "given.db"
    list_images(path, "4.2")
    for table in ("frame_data", "frames", "rigs"):
        alter(path, f"DELETE FROM {table}")
    write_matches(path, NAMES, None, OURS)
    assert query(path, "SELECT * FROM rigs") == query(path, "SELECT * FROM frames") == []


def test_image_without_a_frame_is_refused_if_its_rig_has_several_cameras(tmp_path: Path) -> None:
    path = tmp_path / "given.db"
    ids = list_images(path, "3.13")
    alter(path, "UPDATE rigs SET ref_sensor_id = 9")
    alter(path, "INSERT INTO rig_sensors VALUES (1, 1, 0, NULL)")
    alter(path, "DELETE FROM frame_data WHERE data_id = ?", ids[NAMES[0]])
    before = content(path)
    with pytest.raises(DatabaseError, match="rig_configurator"):
        write_matches(path, NAMES, None, OURS)
    assert content(path) == before


@pytest.mark.parametrize(
    ("sql", "message"),
    [
        ("UPDATE keypoints SET cols = 5 WHERE image_id = 3", "keypoints"),
        ("UPDATE keypoints SET rows = 7 WHERE image_id = 3", "keypoints"),
        ("UPDATE matches SET data = NULL", "matches"),
        ("UPDATE two_view_geometries SET rows = 9", "matches"),
    ],
)
def test_append_refuses_damaged_rows(tmp_path: Path, sql: str, message: str) -> None:
    """Replacing them works."""
    path = tmp_path / "given.db"
    make_existing(path, "3.11", "sift")
    alter(path, sql)
    before = content(path)
    with pytest.raises(DatabaseError, match=message) as caught:
        write_matches(path, NAMES, None, OURS, on_existing="append")
    assert "\n" not in str(caught.value)
    assert content(path) == before
    write_matches(path, NAMES, None, OURS, on_existing="replace")


def check_matched_again(path: Path, before: list[Any]) -> None:
    """Check that pairs in `before` are unchanged, and others have matches of SIFT keypoints only.

    Appended keypoints have descriptors of zeros, which a matcher must not match.
    """
    num_sift = {
        i.image_id: len(THEIRS.keypoints[NAMES.index(i.name)].xy) for i in read_images(path)
    }
    kept = {row[0]: row for row in before}
    num_new_matches = 0
    for row in query(path, "SELECT pair_id, rows, cols, data FROM matches ORDER BY 1"):
        if row[0] in kept:
            assert row == kept[row[0]]
            continue
        a, b = divmod(row[0], 2147483647)
        found = np.frombuffer(row[3] or b"", np.uint32).reshape(row[1], 2)
        assert (found < [num_sift[a], num_sift[b]]).all()
        num_new_matches += len(found)
    assert len(query(path, "SELECT pair_id FROM matches")) == NUM_IMAGES * (NUM_IMAGES - 1) // 2
    assert num_new_matches > 100


def drop_pairs(path: Path) -> list[Any]:
    """Remove a third of the pairs, for a matcher, and return the matches of the others."""
    for table in ("matches", "two_view_geometries"):
        alter(path, f"DELETE FROM {table} WHERE pair_id % 3 = 0")
    rows = query(path, "SELECT pair_id, rows, cols, data FROM matches ORDER BY 1")
    assert 5 < len(rows) < 25
    return rows


@needs_colmap
def test_colmap_matcher_runs_after_an_append(tmp_path: Path) -> None:
    """Guided matching requires as many descriptors as keypoints."""
    path = tmp_path / "given.db"
    make_existing(path, "3.8", "sift")
    write_matches(path, NAMES, None, OURS, on_existing="append")
    before = drop_pairs(path)
    colmap(
        "exhaustive_matcher",
        *("--database_path", path, "--SiftMatching.use_gpu", 0),
        *("--SiftMatching.guided_matching", 1),
    )
    check_matched_again(path, before)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_pycolmap_matcher_runs_after_an_append(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "given.db"
    make_existing(path, layout, "sift")
    write_matches(path, NAMES, None, OURS, on_existing="append")
    before = drop_pairs(path)
    options = pycolmap.FeatureMatchingOptions()
    options.guided_matching = True
    options.use_gpu = False
    pycolmap.match_exhaustive(path, matching_options=options, device=pycolmap.Device.cpu)
    check_matched_again(path, before)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("journal", ["delete", "wal"])
def test_killed_write_leaves_the_old_content(
    tmp_path: Path, journal: str, mode: OnExisting
) -> None:
    path = tmp_path / "given.db"
    make_existing(path, "4.2", "sift")
    query(path, f"PRAGMA journal_mode = {journal}")
    before = content(path)
    kill(start_writing(path, mode))
    log = path.with_name(f"given.db-{'journal' if journal == 'delete' else 'wal'}")
    assert log.stat().st_size > 0  # the process was killed inside a transaction
    assert content(path) == before
    write_matches(path, NAMES, None, OURS, on_existing=mode)
    assert content(path) != before


def test_partial_file_of_a_killed_process_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "new [1].db"
    process = start_writing(path, "error")
    (partial,) = tmp_path.iterdir()
    assert partial.name.startswith(".new [1].db.")
    try:
        # The first process is still writing the partial file, which must stay.
        write_matches(path, NAMES, CAMERAS, OURS)
        assert sorted(p.name for p in tmp_path.iterdir()) == [partial.name, path.name]
    finally:
        kill(process)
    assert partial.exists()
    path.unlink()
    # A file with a similar name that no process of this package wrote must stay, too.
    (tmp_path / ".new [1].db.1.partial").touch()
    write_matches(path, NAMES, CAMERAS, OURS)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        ".new [1].db.1.partial",
        path.name,
    ]


def test_replaced_database_keeps_cameras_and_other_tables(tmp_path: Path) -> None:
    path = tmp_path / "given.db"
    ids = list_images(path, "3.11")
    fill_with_sift(path, ids)
    alter(path, "INSERT INTO pose_priors VALUES (?, ?, 0, NULL)", 1, np.ones(3).tobytes())
    before = content(path)
    write_matches(path, NAMES, CAMERAS, OURS, on_existing="replace")
    after = content(path)
    for table in ("cameras", "images", "pose_priors"):
        assert after[table] == before[table]
    assert after["descriptors"] == []
    assert query(path, "SELECT width, height FROM cameras") == [(WIDTH, HEIGHT)]
    with sqlite3.connect(path) as connection:
        assert connection.execute("PRAGMA foreign_key_check").fetchall() == []
