"""The package from outside: its names, its documentation, and what importing it does."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import itertools
import os
import pkgutil
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

import jaxba
from jaxba.damping import registry as policies
from jaxba.problem import camera_models
from jaxba.solver import methods

PACKAGE = Path(jaxba.__file__).resolve().parent
REFERENCE = PACKAGE.parent / "docs" / "reference" / "api"


@pytest.mark.parametrize("name", jaxba.__all__)
def test_every_public_name_exists_and_is_documented(name):
    found = getattr(jaxba, name)
    if isinstance(found, Mapping):  # a constant: the text below its assignment
        assert name in set().union(*map(documented_constants, (policies, methods, camera_models)))
        return
    text = inspect.getdoc(found)
    assert text
    assert not text.startswith(f"{name}("), (
        "only the text that dataclasses and named tuples make up"
    )
    if inspect.isclass(found):
        for member, value in vars(found).items():
            if (
                inspect.isfunction(value)
                and not member.startswith("_")
                and value.__module__.startswith("jaxba")
            ):
                assert inspect.getdoc(value), f"{name}.{member}"


def documented_constants(module) -> set[str]:
    body = ast.parse(inspect.getsource(module)).body
    pairs = itertools.pairwise(body)
    return {
        target.id
        for statement, after in pairs
        if isinstance(statement, ast.Assign | ast.AnnAssign)
        and isinstance(after, ast.Expr)
        and isinstance(after.value, ast.Constant)
        for target in (
            statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        )
        if isinstance(target, ast.Name)
    }


def test_the_public_list_is_sorted_and_has_no_name_twice():
    assert len(set(jaxba.__all__)) == len(jaxba.__all__)
    upper = [name for name in jaxba.__all__ if name.isupper()]
    classes = [name for name in jaxba.__all__ if name[0].isupper() and not name.isupper()]
    functions = [name for name in jaxba.__all__ if name[0].islower()]
    assert jaxba.__all__ == sorted(upper) + sorted(classes) + sorted(functions)


@pytest.mark.skipif(not REFERENCE.is_dir(), reason="the documents are not beside the package")
def test_the_reference_describes_every_public_name_and_no_other():
    pages = "\n".join(page.read_text(encoding="utf-8") for page in REFERENCE.glob("*.md"))
    assert sorted(re.findall(r"^::: jaxba\.(\w+)$", pages, re.MULTILINE)) == sorted(jaxba.__all__)


def test_no_public_function_hides_a_module():
    modules = {module.name for module in pkgutil.iter_modules(jaxba.__path__)}
    assert not {name for name in modules if inspect.isfunction(getattr(jaxba, name, None))}
    # where no room has the name of a function, and every other module stands in a room, there is
    # none to hide
    alone = {"__init__.py", "__main__.py", "rotations.py", "typing.py", "py.typed"}
    assert {path.name for path in PACKAGE.iterdir() if path.is_file()} == alone


NEED_VISER = {
    f"jaxba.viewer.{name}"
    for name in ("curve", "extra", "layers", "page", "page_file", "stage", "words")
}


@pytest.mark.extra
@pytest.mark.parametrize(
    "module", [m.name for m in pkgutil.walk_packages(jaxba.__path__, "jaxba.")]
)
def test_every_module_can_be_imported_and_says_what_it_is_for(module):
    missing = [name for name in ("pyceres", "pycolmap") if importlib.util.find_spec(name) is None]
    if module.startswith("jaxba.peers.") and missing:  # then it says in one line what it needs
        with pytest.raises(
            ImportError, match=r"this needs pyceres and pycolmap: pip install jaxba\[ceres\]"
        ):
            importlib.import_module(module)
        return
    if module in NEED_VISER and importlib.util.find_spec("viser") is None:
        with pytest.raises(ImportError, match=r"this needs viser: pip install jaxba\[view\]"):
            importlib.import_module(module)
        return
    assert inspect.getdoc(importlib.import_module(module))


def test_the_version_is_that_of_the_installed_package():
    from importlib.metadata import version

    assert version("jaxba") == jaxba.__version__


def in_a_new_process(code: str, **environment: str) -> subprocess.CompletedProcess:
    path = os.pathsep.join([str(PACKAGE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    env = {**os.environ, "PYTHONPATH": path, **environment}
    command = [sys.executable, "-W", "error::DeprecationWarning:jaxba", "-c", code]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=120)


def test_importing_starts_no_backend_and_does_not_switch_to_64_bits():
    """A platform that does not exist is noticed only when a backend is started."""
    code = (
        "import jaxba, jaxba.cli.solve, jaxba.cli.bench, jax\n"
        "assert not jax.config.jax_enable_x64\n"
        "try:\n"
        "    jax.devices()\n"
        "except RuntimeError:\n"
        "    print('only now')\n"
    )
    done = in_a_new_process(code, JAX_PLATFORMS="none_such", JAX_ENABLE_X64="0")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "only now\n"
    assert done.stderr == ""


def test_solving_in_float64_leaves_the_rest_of_the_process_in_32_bits():
    code = (
        "import jax, jax.numpy as jnp, numpy as np, jaxba\n"
        "problem = jaxba.random_scene(jaxba.scene_like('paper'), 0)\n"
        "solution = jaxba.solve(problem, options=jaxba.SolveOptions(max_iterations=1))\n"
        "assert not jax.config.jax_enable_x64\n"
        "assert jnp.asarray(1.0).dtype == jnp.float32\n"
        "assert solution.problem.cameras.dtype == np.float64\n"
        "assert solution.history.cost.dtype == np.float64\n"
    )
    done = in_a_new_process(code, JAX_ENABLE_X64="0", JAX_PLATFORMS="cpu")
    assert done.returncode == 0, done.stderr


def test_help_starts_no_backend():
    """`--help` should come at once."""
    code = (
        "import sys, jaxba.cli.solve\n"
        "try:\n"
        "    jaxba.cli.solve.run(['--help'])\n"
        "except SystemExit as end:\n"
        "    assert not end.code\n"
    )
    done = in_a_new_process(code, JAX_PLATFORMS="none_such")
    assert done.returncode == 0, done.stderr
    assert "--policy" in done.stdout
    assert "--refine-points" in done.stdout


UNNEEDED = (
    "jaxba.methods",
    *(
        "flax",
        "optax",
        "orbax",
        "matplotlib",
        "PIL",
        "yaml",
        "rich",
        "pycolmap",
        "pyceres",
        "scipy.linalg",
    ),
    *(
        "scipy.sparse",
        "scipy.optimize",
        "scipy.spatial",
        "scipy.special",
        "jaxba.bench",
        "jaxba.game",
        "jaxba.training",
    ),
    *(
        "jaxba.training",
        "jaxba.paper",
        "jaxba.peers.ceres",
        "jaxba.structure.louvain",
        "jaxba.kitti",
    ),
)
"""Modules that a solve of a BAL file with the default options does without. Together they would
take longer to import than many a problem takes to solve."""


def test_the_command_loads_nothing_that_a_solve_does_not_need(tmp_path):
    """A factored system with 70 cameras: the ordering for a band is looked for as well."""
    scene = jaxba.random_scene(jaxba.SceneConfig(cameras=70, points=3000, mean_track=6.0), 0)
    jaxba.write_bal(scene, tmp_path / "problem.txt")
    code = (
        "import sys, jaxba.cli.solve\n"
        f"assert jaxba.cli.solve.run([{str(tmp_path / 'problem.txt')!r}, '--max-iterations', '1']) "
        "== 0\n"
        f"print('loaded:', *sorted(set(sys.modules) & set({UNNEEDED!r})))\n"
        "import numpy as np, scipy.linalg\n"  # the whole of it can still be imported
        "assert scipy.linalg.cholesky(np.eye(2))[0, 0] == 1\n"
    )
    done = in_a_new_process(code, JAX_PLATFORMS="cpu", JAXBA_CACHE="off")
    assert done.returncode == 0, done.stderr
    assert "linear solver explicit" in done.stdout
    assert done.stdout.splitlines()[-1].strip() == "loaded:"
