"""Which programs are kept on disk, and who may say so."""

from __future__ import annotations

import os
import subprocess
import sys

import jax
import pytest

import jaxba
from jaxba.runtime import compilation, program_cache

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="tried on a CPU alone")


@pytest.fixture(autouse=True)
def nothing_chosen(monkeypatch):
    """A process in which nobody has chosen yet, and JAX's own cache is off."""
    cache = jax.config.values["jax_compilation_cache_dir"]
    monkeypatch.setattr(program_cache, "_is_chosen", False)
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    compilation.use_cache(None)
    jax.config.update("jax_compilation_cache_dir", cache)


def folder_in_use():
    return None if compilation._cache is None else compilation._cache.folder


def test_programs_are_kept_where_the_caller_says(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXBA_CACHE", str(tmp_path / "of the environment"))
    jaxba.keep_programs(tmp_path / "of the caller")
    assert folder_in_use().parent == tmp_path / "of the caller"
    jaxba.keep_programs()
    assert folder_in_use().parent == tmp_path / "of the environment"


@pytest.mark.parametrize("said", ["by the caller", "by the environment", "by JAX"])
def test_nothing_is_kept_where_that_is_said(said, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXBA_CACHE", "off" if said == "by the environment" else str(tmp_path))
    if said == "by JAX":
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "of JAX"))
    jaxba.keep_programs("off" if said == "by the caller" else None)
    assert folder_in_use() is None


def test_a_default_does_not_undo_what_was_chosen(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXBA_CACHE", str(tmp_path))
    jaxba.keep_programs("off")
    program_cache.keep_programs_by_default()
    assert folder_in_use() is None


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path):
    file = tmp_path / "file"
    file.touch()
    jaxba.keep_programs(file / "folder")
    assert folder_in_use() is None


MAPPER = """
import pycolmap
from jax import monitoring
traced = []

def listen(event, _, **facts):
    if "compile/jaxpr_trace" in event:
        traced.append(facts.get("fun_name"))

monitoring.register_event_duration_secs_listener(listen)
import jaxba
pycolmap.set_random_seed(0)
options = pycolmap.SyntheticDatasetOptions()
options.num_rigs = options.num_cameras_per_rig = 1
options.num_frames_per_rig = {images}
options.num_points3D = 60
reconstruction = pycolmap.synthesize_dataset(options)
noise = pycolmap.SyntheticNoiseOptions()
noise.point2D_stddev = 0.5
pycolmap.synthesize_noise(noise, reconstruction)
jaxba.bundle_adjustment(reconstruction)
print("traced", sum(str(name) in ("propose", "try_candidate") for name in traced))
"""


@pytest.mark.extra
@pytest.mark.slow
def test_another_process_with_a_model_of_another_size_compiles_nothing(tmp_path):
    pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")
    environment = {**os.environ, "JAXBA_CACHE": str(tmp_path)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    ends = []
    for images in (5, 7):
        command = [sys.executable, "-c", MAPPER.format(images=images)]
        printed = subprocess.run(
            command, env=environment, check=True, capture_output=True, text=True
        ).stdout
        ends.append(printed.splitlines()[-1])
    assert ends[0] != "traced 0"
    assert ends[1] == "traced 0"
