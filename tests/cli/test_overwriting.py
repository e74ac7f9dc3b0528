"""No output of a command may be a file that it reads, or another of its outputs, whatever the file
is called."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import support

from jaxba import write_bal, write_colmap
from jaxba.cli import bench, kitti, paper, solve, train, view
from jaxba.cli.common import UsageError
from jaxba.cli.overwriting import check_apart

linux = pytest.mark.skipif(
    sys.platform != "linux", reason="other systems have other links and devices"
)


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """A folder with inputs of all commands, in which the test runs."""
    pytest.importorskip("cv2")
    from PIL import Image

    monkeypatch.chdir(tmp_path)
    write_colmap(support.tiny(), "model")
    os.symlink("model", "link")
    os.link("model/images.bin", "hard.txt")
    shutil.copytree("model", "photos")
    write_bal(support.tiny(), "p.txt")
    for name in ("g.yaml", "own.yaml"):
        Path(name).write_text("gauge: two-cameras\n" if name == "g.yaml" else "")
    Path("run").mkdir()
    Path("run/config.yaml").write_text("extends: default\n")
    Path("run/settings.json").write_text("problems: [scene:tiny:1]\n")
    Path("kitti/image_0").mkdir(parents=True)
    for number in range(3):
        Image.fromarray(np.zeros((40, 60), np.uint8)).save(f"kitti/image_0/{number:06d}.png")
    Path("kitti/calib.txt").write_text("P0: 50 0 30 0 0 50 20 0 0 0 1 0\n")
    Path("kitti/times.txt").write_text("0\n1\n2\n")
    Path("kitti/poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


CASES = [
    (
        solve,
        "model --output model/images.txt",
        "--output model/images.txt: is a file of the problem",
    ),
    (solve, "model --output link/frames.txt", "--output link/frames.txt: is a file of the problem"),
    (solve, "model --output hard.txt", "--output hard.txt: is a file of the problem"),
    (solve, "link --log model/points3D.bin", "--log model/points3D.bin: is a file of the problem"),
    # would belong to it
    (solve, "model --log model/rigs.txt", "--log model/rigs.txt: is a file of the problem"),
    (solve, "p.txt --log ./model/../p.txt", "is a file of the problem"),
    (
        solve,
        "model --constraints g.yaml --log g.yaml",
        "--log g.yaml: is the file of --constraints",
    ),
    (solve, "p.txt --constraints g.yaml --output g.yaml", "g.yaml"),
    (solve, "p.txt --output new.txt --log ./new.txt", "--output and --log name the same file"),
    (
        solve,
        "p.txt --record new.npz --covariance model/../new.npz --gauge two-cameras",
        "name the same file",
    ),
    (solve, "model --output new/ --log new/points3D.bin", "folder new does not exist"),
    (
        solve,
        "model --output photos --log photos/points3D.bin",
        "--output and --log name the same file",
    ),
    (view, "model --html model/cameras.bin", "--html model/cameras.bin: is a file of the problem"),
    (view, "p.txt --html p.frames.json", "is a file of the problem"),
    (
        view,
        "model --images kitti/image_0 --html kitti/image_0/000001.png",
        "000001.png: is an image",
    ),
    (
        kitti,
        "kitti --poses kitti/poses.txt --out kitti/poses.txt",
        "--out kitti/poses.txt: is the file of --poses",
    ),
    (kitti, "kitti --out kitti/calib.txt", "kitti/calib.txt: is a file of the sequence"),
    (kitti, "kitti --out kitti/times.txt", "kitti/times.txt: is a file of the sequence"),
    (bench, "scene:street --suite run/settings.json --out run", "is the file of --suite"),
    (train, "--config run/config.yaml --out run", "--out run/config.yaml: is the file of --config"),
    (paper, "--config own.yaml --report own.yaml", "--report own.yaml: is the file of --config"),
]


@linux
@pytest.mark.parametrize(
    ("command", "words", "message"), CASES, ids=[words for _, words, _ in CASES]
)
def test_nothing_is_computed_and_no_file_changes(command, words, message, place, capsys):
    before = contents(place)
    assert command.run(words.split()) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert contents(place) == before


@linux
def test_other_files_devices_and_streams_may_be_written(place):
    free = ["new.txt", "missing/new.txt", "/dev/null", "/dev/stdout"]
    check_apart(
        {"--output": free, "--log": ["other.txt", None], "--record": ["/dev/null"]},
        {"an input": ["p.txt"]},
    )
    with pytest.raises(UsageError, match="--output and --log name the same file, /dev/fd/1"):
        check_apart({"--output": ["/dev/stdout"], "--log": ["/dev/fd/1"]}, {})


@linux
def test_a_stream_that_a_shell_sends_to_an_input_is_that_input(place):
    code = (
        "from jaxba.cli.overwriting import check_apart; check_apart({'--log': "
        "['/dev/stdout']}, "
        "{'it': ['p.txt']})"
    )
    with open("p.txt", "a") as redirected:
        ran = subprocess.run(
            [sys.executable, "-c", code], stdout=redirected, stderr=subprocess.PIPE, text=True
        )
    assert "--log /dev/stdout: is it" in ran.stderr
