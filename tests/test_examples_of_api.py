"""The examples in the docstrings of the public API work."""

from __future__ import annotations

import doctest
import functools
import inspect
import shutil
from collections.abc import Callable, Iterator

import pytest
from conftest import PROJECT, Ffmpeg

import colmap_av1

FUNCTIONS = [name for name in colmap_av1.__all__ if name.islower()]
OPTIONS = [name for name in colmap_av1.__all__ if name.endswith("Options")]
CLASSES = ["FrameMotion", "Tracks"]
# Examples that read the output of another example.
NEEDS = {
    "check_database": "match",
    "check_model": "map_database",
    "map_database": "match",
    "densify": "map_database",
    "export_hloc": "match",
    "read_hloc": "export_hloc",
    "write_page": "run_batch",
}

# Runs the example of a name; returns the number of statements and the failures.
Run = Callable[[str], tuple[int, str]]


@pytest.fixture(scope="module")
def run(ffmpeg: Ffmpeg, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """Run each example once, in a folder with the videos that the examples name."""
    folder = tmp_path_factory.mktemp("examples")
    scene = PROJECT / "examples" / "scene.mp4"
    shutil.copyfile(scene, folder / "video.mp4")
    ffmpeg("-i", scene, "-c:v", "libx264", folder / "phone.mp4")
    (folder / "my_videos").mkdir()
    shutil.copyfile(scene, folder / "my_videos" / "good.mp4")
    (folder / "my_videos" / "text.mp4").write_text("no video")

    @functools.cache
    def run_example(name: str) -> tuple[int, str]:
        if name in NEEDS:
            run_example(NEEDS[name])
        text = inspect.getdoc(getattr(colmap_av1, name)) or ""
        example = doctest.DocTestParser().get_doctest(text, {}, name, None, 0)
        failures: list[str] = []
        # Otherwise doctest would interpret pytest's option -v.
        runner = doctest.DocTestRunner(verbose=False, optionflags=doctest.ELLIPSIS)
        runner.run(example, out=failures.append)
        return len(example.examples), "".join(failures)

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield run_example


@pytest.mark.parametrize("name", [*FUNCTIONS, *CLASSES, *OPTIONS])
def test_docstring_example_works(run: Run, name: str) -> None:
    if name == "compare":
        pytest.importorskip("matplotlib")
    count, failures = run(name)
    assert count > 0, f"the docstring of {name} has no example"
    assert failures == ""
