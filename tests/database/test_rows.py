"""Writing matches into new databases and into databases that have images only."""

from __future__ import annotations

import hashlib
import os
import sqlite3
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from colmap_command import colmap, needs_colmap
from conftest import TEST_PATHS
from existing_database import CAMERA, alter, query
from half_way import kill, start_writing
from hypothesis import given
from hypothesis import strategies as st
from synthetic_scene import CAMERA_PARAMS, HEIGHT, WIDTH, alignment_error, make_scene, match_scene

from colmap_av1.database.file import open_unaltered
from colmap_av1.database.reading import (
    MAX_NUM_IMAGES,
    image_ids_from_pair_id,
    pair_id_from_image_ids,
    read_cameras,
    read_images,
)
from colmap_av1.database.writing import check_writable, write_matches
from colmap_av1.errors import DatabaseError
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewConfig, TwoViewGeometry
from colmap_av1.options import CameraOptions

SCENE = make_scene()
NAMES = [f"frame_{i:03d}.png" for i in range(SCENE.tracks.num_frames)]
CAMERAS = [CAMERA] * len(NAMES)
ROWS = match_scene(SCENE, CAMERA)


def dump(database: Path) -> list[str]:
    with closing(sqlite3.connect(database)) as connection:
        return list(connection.iterdump())


def write_blank_images(folder: Path) -> Path:
    folder.mkdir()
    for name in NAMES:
        cv2.imwrite(str(folder / name), np.full((HEIGHT, WIDTH), 128, np.uint8))
    return folder


def check_model(model: pycolmap.Reconstruction, min_images: int = len(NAMES)) -> None:
    centers = {
        image.name: image.projection_center() for image in model.images.values() if image.has_pose
    }
    assert len(centers) >= min_images
    names = sorted(centers)
    truth = SCENE.center[[NAMES.index(name) for name in names]]
    assert alignment_error(np.array([centers[name] for name in names]), truth) < 0.05
    assert model.compute_mean_reprojection_error() < 0.6
    assert model.num_points3D() > 800


def check_incremental_mapper(database: Path, folder: Path) -> None:
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.random_seed = 0
    models = pycolmap.incremental_mapping(database, folder, folder / "model", options)
    check_model(max(models.values(), key=lambda m: m.num_reg_images()))


def check_mapper_command(database: Path, folder: Path) -> None:
    (folder / "sparse").mkdir()
    colmap(
        "mapper",
        *("--database_path", database, "--image_path", folder, "--output_path", folder / "sparse"),
        *("--Mapper.extract_colors", 0),
    )
    models = [pycolmap.Reconstruction(path) for path in (folder / "sparse").iterdir()]
    check_model(max(models, key=lambda m: m.num_reg_images()))


def test_incremental_mapper_maps_a_new_database(tmp_path: Path) -> None:
    database = tmp_path / "new.db"
    write_matches(database, NAMES, CAMERAS, ROWS)
    assert [p.name for p in tmp_path.iterdir()] == ["new.db"]
    check_incremental_mapper(database, tmp_path)


def test_global_mapper_maps_a_new_database(tmp_path: Path) -> None:
    database = tmp_path / "new.db"
    write_matches(database, NAMES, CAMERAS, ROWS)
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    models = pycolmap.global_mapping(database, tmp_path, tmp_path / "model", options)
    check_model(max(models.values(), key=lambda m: m.num_reg_images()))


@needs_colmap
def test_colmap_command_maps_a_new_database(tmp_path: Path) -> None:
    write_matches(tmp_path / "new.db", NAMES, CAMERAS, ROWS)
    check_mapper_command(tmp_path / "new.db", tmp_path)


@needs_colmap
def test_new_database_has_the_schema_of_colmap_3_8(tmp_path: Path) -> None:
    colmap("database_creator", "--database_path", tmp_path / "colmap.db")
    write_matches(tmp_path / "ours.db", NAMES, CAMERAS, ROWS)
    version = query(tmp_path / "colmap.db", "PRAGMA user_version")[0][0]
    if version // 100 != 38:
        pytest.skip(f"the colmap command is not 3.8 but {version}")
    tables = [row[0] for row in query(tmp_path / "colmap.db", "SELECT name FROM sqlite_master")]
    assert tables == [
        row[0] for row in query(tmp_path / "ours.db", "SELECT name FROM sqlite_master")
    ]
    for sql in (
        "PRAGMA user_version",
        *(f"PRAGMA table_info({table})" for table in tables),
        *(f"PRAGMA foreign_key_list({table})" for table in tables),
    ):
        assert query(tmp_path / "ours.db", sql) == query(tmp_path / "colmap.db", sql)


def test_pycolmap_reads_the_written_rows(tmp_path: Path) -> None:
    write_matches(tmp_path / "new.db", NAMES, CAMERAS, ROWS)
    with pycolmap.Database.open(tmp_path / "new.db") as database:
        assert database.num_cameras() == 1
        camera = database.read_camera(1)
        assert camera.params.tolist() == CAMERA.params.tolist()
        assert camera.has_prior_focal_length
        for i, name in enumerate(NAMES):
            image = database.read_image_with_name(name)
            assert image.image_id == i + 1
            keypoints = database.read_keypoints(image.image_id)
            assert np.array_equal(np.asarray(keypoints)[:, :2], ROWS.keypoints[i].xy)
        for (i, j), matches, geometry in zip(
            ROWS.pairs, ROWS.matches, ROWS.geometries, strict=True
        ):
            assert np.array_equal(database.read_matches(i + 1, j + 1), matches)
            stored = database.read_two_view_geometry(i + 1, j + 1)
            assert int(stored.config) == geometry.config
            assert np.array_equal(stored.inlier_matches, geometry.inlier_matches)
            for model in ("E", "F", "H"):
                given = getattr(geometry, model)
                if given is None:
                    assert getattr(stored, model) is None
                else:
                    assert np.array_equal(getattr(stored, model), given)
            if geometry.tvec is not None:
                pose = stored.cam2_from_cam1
                assert np.allclose(pose.translation, geometry.tvec)
                assert np.allclose(pose.rotation.quat, geometry.qvec[[1, 2, 3, 0]])


def test_existing_images_keep_their_ids(tmp_path: Path) -> None:
    """The ids are in reverse order of the names."""
    path = tmp_path / "existing.db"
    with pycolmap.Database.open(path) as database:
        camera_id = database.write_camera(CAMERA)
        for name in reversed(NAMES):
            database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
    before = query(path, "SELECT * FROM images")
    write_matches(path, NAMES, None, ROWS)
    assert query(path, "SELECT * FROM images") == before
    existing = {image.name: image for image in read_images(path)}
    assert existing[NAMES[0]].image_id == len(NAMES)
    assert existing[NAMES[0]].num_keypoints == len(ROWS.keypoints[0].xy)
    assert existing[NAMES[0]].num_matches == sum(
        len(m) for m, (i, _) in zip(ROWS.matches, ROWS.pairs, strict=True) if i == 0
    )
    # If the larger id is given first, COLMAP inverts the stored geometry.
    index = next(k for k, g in enumerate(ROWS.geometries) if g.qvec is not None)
    i, j = ROWS.pairs[index]
    geometry = ROWS.geometries[index]
    with pycolmap.Database.open(path) as database:
        a, b = existing[NAMES[i]].image_id, existing[NAMES[j]].image_id
        assert a > b
        stored = database.read_two_view_geometry(a, b)
    assert np.array_equal(stored.inlier_matches, geometry.inlier_matches)
    assert np.allclose(stored.E, geometry.E)
    assert np.allclose(stored.H / np.linalg.norm(stored.H), geometry.H, atol=1e-6)
    assert np.allclose(stored.cam2_from_cam1.translation, geometry.tvec)
    assert np.allclose(stored.cam2_from_cam1.rotation.quat, geometry.qvec[[1, 2, 3, 0]])
    check_incremental_mapper(path, tmp_path)


def test_images_imported_by_pycolmap_keep_their_rigs_and_are_mapped(tmp_path: Path) -> None:
    path = tmp_path / "imported.db"
    images = write_blank_images(tmp_path / "images")
    pycolmap.Database.open(path).close()
    pycolmap.import_images(path, images, pycolmap.CameraMode.SINGLE)
    assert len(read_images(path)) == len(NAMES)
    rigs = query(path, "SELECT * FROM rigs"), query(path, "SELECT * FROM frames")
    write_matches(path, NAMES, None, ROWS)
    assert (query(path, "SELECT * FROM rigs"), query(path, "SELECT * FROM frames")) == rigs
    check_incremental_mapper(path, tmp_path)


def test_matches_in_an_empty_database_of_pycolmap_are_mapped(tmp_path: Path) -> None:
    path = tmp_path / "empty.db"
    pycolmap.Database.open(path).close()
    write_matches(path, NAMES, CAMERAS, ROWS)
    assert query(path, "SELECT COUNT(*) FROM frames") == [(0,)]
    check_incremental_mapper(path, tmp_path)


@pytest.mark.slow
@needs_colmap
def test_empty_rows_of_the_colmap_matcher_are_replaced(tmp_path: Path) -> None:
    """COLMAP writes empty rows for images without features and for pairs without matches."""
    path = tmp_path / "colmap.db"
    images = write_blank_images(tmp_path / "images")
    colmap(
        "feature_extractor",
        *("--database_path", path, "--image_path", images),
        *("--ImageReader.single_camera", 1, "--SiftExtraction.use_gpu", 0),
        *("--ImageReader.camera_params", CAMERA_PARAMS),
    )
    colmap("exhaustive_matcher", "--database_path", path, "--SiftMatching.use_gpu", 0)
    assert query(path, "SELECT COUNT(*), MAX(rows) FROM matches")[0] == (120, 0)
    assert {i.num_keypoints for i in read_images(path)} == {0}
    write_matches(path, NAMES, None, ROWS)
    assert query(path, "SELECT COUNT(*) FROM matches") == [(120,)]
    assert query(path, "PRAGMA user_version") == [(3800,)]
    check_mapper_command(path, tmp_path)


def test_each_image_can_have_its_own_camera(tmp_path: Path) -> None:
    cameras = [make_camera(CameraOptions(), WIDTH, HEIGHT + i) for i in range(len(NAMES))]
    write_matches(tmp_path / "new.db", NAMES, cameras, ROWS)
    images = read_images(tmp_path / "new.db")
    stored = read_cameras(tmp_path / "new.db")
    assert [stored[image.camera_id].height for image in images] == [c.height for c in cameras]
    assert [image.height for image in images] == [c.height for c in cameras]


def test_same_rows_give_identical_files(tmp_path: Path) -> None:
    for name in ("a.db", "b.db"):
        write_matches(tmp_path / name, NAMES, CAMERAS, ROWS)
    digests = {hashlib.sha256(p.read_bytes()).digest() for p in tmp_path.iterdir()}
    assert len(digests) == 1


@given(st.integers(1, MAX_NUM_IMAGES - 1), st.integers(1, MAX_NUM_IMAGES - 1))
def test_pair_ids_agree_with_pycolmap(a: int, b: int) -> None:
    pair_id = pair_id_from_image_ids(a, b)
    assert image_ids_from_pair_id(pair_id) == (min(a, b), max(a, b))
    assert pair_id == pycolmap.image_pair_to_pair_id(a, b)
    assert pair_id < 2**63


@given(st.permutations(range(4)), st.data())
def test_columns_of_matches_are_in_order_of_image_ids(
    order: list[int], data: st.DataObject
) -> None:
    pairs = np.array([[0, 1], [0, 3], [1, 2], [2, 3]], dtype=np.int32)
    index = st.integers(0, 9)
    matches = [
        np.array(data.draw(st.lists(st.tuples(index, index), min_size=1)), dtype=np.uint32)
        for _ in pairs
    ]
    F = np.arange(9.0).reshape(3, 3)
    geometries = [TwoViewGeometry(TwoViewConfig.UNCALIBRATED, m[::2], F=F) for m in matches]
    keypoints = [ImageKeypoints(np.full((10, 2), i, np.float32), np.arange(10)) for i in range(4)]
    names = [f"{i}.jpg" for i in range(4)]
    # hypothesis would run all examples with the same tmp_path.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "example.db"
        write_matches(path, [names[i] for i in order], CAMERAS[:4], without_keypoints(4))
        rows = MatchedImages(keypoints, pairs, matches, geometries, forward_motion=False)
        write_matches(path, names, None, rows)
        ids = {image.name: image.image_id for image in read_images(path)}
        for (i, j), m in zip(pairs, matches, strict=True):
            a, b = ids[names[i]], ids[names[j]]
            pair_id = pair_id_from_image_ids(a, b)
            expected = m if a < b else m[:, ::-1]
            ((rows, blob),) = query(path, f"SELECT rows, data FROM matches WHERE pair_id={pair_id}")
            assert np.array_equal(np.frombuffer(blob, np.uint32).reshape(rows, 2), expected)
            ((blob, stored),) = query(
                path, f"SELECT data, F FROM two_view_geometries WHERE pair_id={pair_id}"
            )
            assert np.array_equal(np.frombuffer(blob, np.uint32).reshape(-1, 2), expected[::2])
            assert np.array_equal(np.frombuffer(stored).reshape(3, 3), F if a < b else F.T)


def without_keypoints(num_images: int) -> MatchedImages:
    nothing = ImageKeypoints(np.empty((0, 2), np.float32), np.empty(0))
    pairs = np.empty((0, 2), np.int32)
    return MatchedImages([nothing] * num_images, pairs, [], [], forward_motion=False)


def write_images_only(path: Path) -> None:
    """Write a database in the schema of COLMAP 3.8 with images and without keypoints."""
    write_matches(path, NAMES, CAMERAS, without_keypoints(len(NAMES)))


def write_text(path: Path) -> None:
    path.write_text("not a database, but as long as one\n" * 100)


def write_other_schema(path: Path) -> None:
    alter(path, "CREATE TABLE images (id INTEGER)")


def write_with_matches(path: Path) -> None:
    write_matches(path, NAMES, CAMERAS, ROWS)


def write_other_images(path: Path) -> None:
    write_matches(path, [f"x{name}" for name in NAMES], CAMERAS, ROWS)


def write_rigs_without_images(path: Path) -> None:
    pycolmap.Database.open(path).close()
    alter(path, "INSERT INTO rigs (ref_sensor_id, ref_sensor_type) VALUES (1, 0)")


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (write_text, "COLMAP"),
        (write_other_schema, "COLMAP"),
        (write_with_matches, "frame_000.png"),
        (write_other_images, "frame_000.png"),
        (write_rigs_without_images, "rigs"),
        (Path.mkdir, "folder"),
    ],
)
def test_refused_path_is_not_changed(
    tmp_path: Path, prepare: Callable[[Path], None], message: str
) -> None:
    path = tmp_path / "given.db"
    prepare(path)
    before = path.read_bytes() if path.is_file() else None
    with pytest.raises(DatabaseError, match=message) as caught:
        write_matches(path, NAMES, CAMERAS, ROWS)
    assert "\n" not in str(caught.value)
    assert (path.read_bytes() if path.is_file() else None) == before
    assert [p.name for p in tmp_path.iterdir()] == ["given.db"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs Unix pipes and links")
def test_special_files_are_refused_and_links_are_followed(tmp_path: Path) -> None:
    """All programs share a device such as /dev/null, so a file must not replace it."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    for name in ("pipe", "loop"):
        with pytest.raises(DatabaseError, match=name):
            write_matches(tmp_path / name, NAMES, CAMERAS, ROWS)
        with pytest.raises(DatabaseError, match=name), open_unaltered(tmp_path / name):
            pass
    assert (tmp_path / "pipe").is_fifo()
    (tmp_path / "link").symlink_to("new.db")
    write_matches(tmp_path / "link", NAMES, CAMERAS, ROWS)
    assert (tmp_path / "link").is_symlink()
    assert len(read_images(tmp_path / "new.db")) == len(NAMES)


def test_new_database_needs_an_existing_folder(tmp_path: Path) -> None:
    with pytest.raises(DatabaseError, match="folder"):
        write_matches(tmp_path / "no" / "new.db", NAMES, CAMERAS, ROWS)


def test_new_database_is_refused_next_to_an_old_log(tmp_path: Path) -> None:
    """SQLite would apply the old log to the new database."""
    (tmp_path / "new.db-wal").write_bytes(b"old")
    (tmp_path / "link.db").symlink_to("new.db")
    for name in ("new.db", "link.db"):
        with pytest.raises(DatabaseError, match=r"new\.db-wal"):
            write_matches(tmp_path / name, NAMES, CAMERAS, ROWS)


def test_database_without_keypoints_but_with_matches_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "given.db"
    write_matches(path, NAMES, CAMERAS, ROWS)
    alter(path, "DELETE FROM keypoints")
    with pytest.raises(DatabaseError, match="matches"):
        write_matches(path, NAMES, None, ROWS)


def test_missing_and_empty_files_have_no_images(tmp_path: Path) -> None:
    assert read_images(tmp_path / "missing.db") == []
    assert read_cameras(tmp_path / "missing.db") == {}
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "empty.db").touch()
    assert read_images(tmp_path / "empty.db") == []
    write_matches(tmp_path / "empty.db", NAMES, CAMERAS, ROWS)
    assert len(read_images(tmp_path / "empty.db")) == len(NAMES)


def test_reading_needs_no_write_permission_and_creates_no_file(tmp_path: Path) -> None:
    """Also in WAL mode, for which SQLite usually creates files next to the database."""
    folder = tmp_path / "closed"
    folder.mkdir()
    path = folder / "given.db"
    write_matches(path, NAMES, CAMERAS, ROWS)
    query(path, "PRAGMA journal_mode = WAL")
    before = path.read_bytes()
    folder.chmod(0o500)
    try:
        assert [image.name for image in read_images(path)] == NAMES
        assert len(read_cameras(path)) == 1
        if not os.access(folder, os.W_OK):  # root may write anywhere
            with pytest.raises(DatabaseError, match="no permission"):
                check_writable(path)
    finally:
        folder.chmod(0o700)
    assert [p.name for p in folder.iterdir()] == ["given.db"]
    assert path.read_bytes() == before


def test_locked_database_is_reported_and_not_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("colmap_av1.database.file._BUSY_TIMEOUT", 0.2)
    path = tmp_path / "locked.db"
    write_images_only(path)
    before = dump(path)
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    with pytest.raises(DatabaseError, match="in use"):
        write_matches(path, NAMES, None, ROWS)
    with pytest.raises(DatabaseError, match="in use"):
        check_writable(path)
    other.execute("ROLLBACK")
    other.close()
    assert dump(path) == before
    write_matches(path, NAMES, None, ROWS)


class Interruption(BaseException):
    """Stands for KeyboardInterrupt: no `except Exception` catches it."""


@pytest.mark.parametrize("existing", [False, True])
def test_interrupted_write_leaves_the_file_unchanged(tmp_path: Path, existing: bool) -> None:
    path = tmp_path / "given.db"
    if existing:
        write_images_only(path)
    before = path.read_bytes() if existing else None

    class Interrupting(list):  # type: ignore[type-arg]
        def __getitem__(self, index: Any) -> Any:
            if index == len(self) - 1:
                raise Interruption
            return super().__getitem__(index)

    rows = replace(ROWS, geometries=Interrupting(ROWS.geometries))
    with pytest.raises(Interruption):
        write_matches(path, NAMES, CAMERAS, rows)
    assert (path.read_bytes() if existing else None) == before
    assert [p.name for p in tmp_path.iterdir()] == (["given.db"] if existing else [])


@pytest.mark.parametrize("journal", ["delete", "wal"])
def test_killed_write_leaves_the_old_content(tmp_path: Path, journal: str) -> None:
    path = tmp_path / "given.db"
    write_images_only(path)
    query(path, f"PRAGMA journal_mode = {journal}")
    before = dump(path)
    kill(start_writing(path, "error", "test_rows", "ROWS"))
    check_writable(path)
    assert [image.num_keypoints for image in read_images(path)] == [0] * len(NAMES)
    assert dump(path) == before
    write_matches(path, NAMES, None, ROWS)
    assert len(query(path, "SELECT * FROM matches")) == len(ROWS.pairs)


@pytest.mark.parametrize("existing", [False, True])
def test_failed_write_leaves_the_file_unchanged(tmp_path: Path, existing: bool) -> None:
    """The disk is full."""
    path = tmp_path / "given.db"
    if existing:
        write_images_only(path)
    before = path.read_bytes() if existing else None
    script = """
        import os, resource, signal, sys
        sys.path[:0] = sys.argv[2].split(os.pathsep)
        from test_rows import CAMERAS, NAMES, ROWS
        from colmap_av1.database.writing import write_matches
        from colmap_av1.errors import DatabaseError

        # Writing more than this fails, as on a full disk.
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
        try:
            write_matches(sys.argv[1], NAMES, CAMERAS, ROWS)
        except DatabaseError as error:
            print(error)
    """
    output = subprocess.check_output(
        [sys.executable, "-c", textwrap.dedent(script), path, TEST_PATHS],
        text=True,
        cwd=tmp_path,  # in the checkout, its package would hide the installed one
    )
    assert "disk" in output
    assert output.count("\n") == 1
    assert (path.read_bytes() if existing else None) == before
    assert [p.name for p in tmp_path.iterdir()] == (["given.db"] if existing else [])


def test_default_camera_has_an_assumed_focal_length() -> None:
    camera = make_camera(CameraOptions(), 450, 800)
    assert camera.model_name == "SIMPLE_RADIAL"
    assert camera.params.tolist() == [720, 225, 400, 0]
    assert not camera.has_prior_focal_length


def test_given_focal_length_selects_two_distortion_parameters() -> None:
    camera = make_camera(CameraOptions(), 450, 800, focal_length=500)
    assert camera.model_name == "RADIAL"
    assert camera.params.tolist() == [500, 225, 400, 0, 0]
    assert camera.has_prior_focal_length
    # Parameters without a model belong to COLMAP's default model.
    given = make_camera(CameraOptions(camera_params="480,225,400,0.1"), 450, 800, focal_length=500)
    assert (given.model_name, given.params[0]) == ("SIMPLE_RADIAL", 480)


@pytest.mark.parametrize(
    "model",
    [
        name
        for name in pycolmap.CameraModelId.__members__
        if name not in ("INVALID", "EQUIRECTANGULAR")
    ],
)
def test_every_camera_model_is_read_back_as_written(tmp_path: Path, model: str) -> None:
    default = make_camera(CameraOptions(model), WIDTH, HEIGHT)
    text = ",".join(str(p + 0.25) for p in default.params)
    camera = make_camera(CameraOptions(model, text), WIDTH, HEIGHT)
    write_matches(tmp_path / "new.db", NAMES, [camera] * len(NAMES), ROWS)
    stored = read_cameras(tmp_path / "new.db")[1]
    assert stored.model_name == model
    assert stored.params.tolist() == [p + 0.25 for p in default.params]
    assert stored.has_prior_focal_length
    with pycolmap.Database.open(tmp_path / "new.db") as database:
        assert database.read_camera(1).model_name == model
