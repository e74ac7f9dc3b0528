"""The documents: their code runs, their commands exist, their links lead somewhere, and they stay
short."""

from __future__ import annotations

import importlib
import importlib.util
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
import tyro

import jaxba
from jaxba.cli import colmap_options
from jaxba.damping.registry import file_of
from jaxba.solver.names import parse_solver, split_refinement

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"

FENCE = re.compile(
    r"(?:^<!-- (no test)[^\n]*-->\n)?^```(\w+)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL
)
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)(?:#[^)]*)?\)")
FILE = re.compile(r"`((?:jaxba|tests|benchmarks|configs|docs|examples)/[\w/.-]+\.\w+)`")
COMMAND = re.compile(r"(?:.*/)?jaxba-(\w+)")

spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
assert spec is not None
assert spec.loader is not None
generate = importlib.util.module_from_spec(spec)
spec.loader.exec_module(generate)

PAGES = [ROOT / "README.md", *(DOCS / page for page in generate.navigation())]
"""README, and the pages of the site in the order of the navigation."""

TEXTS = [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path, language: str) -> list[tuple[str, bool]]:
    """The code of a page in one language, and whether it says that it cannot be run in a test."""
    found = FENCE.findall(page.read_text(encoding="utf-8"))
    return [(code, bool(unfit)) for unfit, kind, code in found if kind == language]


def commands(page: Path) -> Iterator[list[str]]:
    """The calls of jaxba's commands in the shell blocks of a page, and in its text where they have
    options."""
    lines = [line for code, _ in blocks(page, "sh") for line in code.splitlines()]
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    lines += [
        " ".join(code.split()) for code in re.findall(r"`(jaxba-\w+(?: [^`]*)? --[^`]*)`", text)
    ]
    for line in lines:
        splitter = shlex.shlex(line, posix=True, punctuation_chars=";&|")
        splitter.whitespace_split = True
        call: list[str] = []
        for word in [*splitter, ";"]:
            if not set(word) <= set(";&|"):
                call.append(word)
                continue
            if call and COMMAND.fullmatch(call[0]):
                yield call
            call = []


@pytest.fixture
def workplace(tmp_path, monkeypatch) -> Path:
    """A folder with small files under the names that the documents use."""
    scene = jaxba.random_scene(jaxba.SceneConfig(cameras=6, points=30), seed=0)
    jaxba.write_problem(scene, tmp_path / "problem-49-7776-pre.txt.bz2")
    (tmp_path / "runs/mine").mkdir(parents=True)
    shutil.copy(
        ROOT / "jaxba/policies/default.safetensors", tmp_path / "runs/mine/policy.safetensors"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    return tmp_path


SLOW = {"docs/how-to/residuals.md", "docs/reference/api/residuals.md"}
"""Pages whose code takes longest: it solves problems of several kinds."""


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(
            page, marks=pytest.mark.slow if name_of(page) in SLOW else (), id=name_of(page)
        )
        for page in PAGES
        if blocks(page, "python")
    ],
)
def test_the_code_of_a_page_runs_from_top_to_bottom(page, workplace):
    names: dict[str, object] = {"__name__": "__main__"}
    try:
        for number, (code, unfit) in enumerate(blocks(page, "python"), 1):
            program = compile(code, f"{name_of(page)}, block {number}", "exec", dont_inherit=True)
            if not unfit:
                exec(program, names)
    finally:
        jax.config.update("jax_enable_x64", True)
        if "plt" in names:
            names["plt"].close("all")  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_the_commands_of_a_page_have_the_options_that_it_names(page):
    for program, *words in commands(page):
        match = COMMAND.fullmatch(program)
        assert match
        module = importlib.import_module(f"jaxba.cli.{match[1]}")
        arguments = module.Arguments
        if match[1] == "kitti" and words[0] == module.EVALUATE:
            arguments = module.EvaluateArguments
            words = words[1:]
        try:
            parsed = tyro.cli(arguments, args=words)
        except SystemExit:
            pytest.fail(f"{name_of(page)}: {shlex.join([program, *words])}")
        if solvers := getattr(parsed, "solvers", None):
            for name in solvers.split(","):
                # of a file that the page has the reader make
                if not file_of(split_refinement(name)[0]):
                    parse_solver(name)


def test_the_documents_name_commands_at_all():
    assert sum(len(list(commands(page))) for page in PAGES) > 30


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_and_benchmarks_that_a_page_names_are_in_the_repository(page):
    text = page.read_text(encoding="utf-8")
    missing = [path for path in FILE.findall(text) if not (ROOT / path).exists()]
    for name in re.findall(r"python -m (benchmarks\.\w+)", text):
        place = ROOT / name.replace(".", "/")
        missing += [] if place.is_dir() or place.with_suffix(".py").exists() else [name]
    assert not missing


@pytest.mark.parametrize("page", TEXTS, ids=name_of)
def test_links_lead_to_files_of_the_repository(page):
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    assert not [link for link in LINK.findall(text) if not (page.parent / link).exists()]


def test_every_page_is_in_the_navigation_once():
    pages = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")}
    navigation = generate.navigation()
    assert sorted(navigation) == sorted(pages)


def test_the_page_for_users_of_colmap_names_every_option_that_the_command_understands():
    page = (DOCS / "how-to/from-colmap.md").read_text(encoding="utf-8")
    assert [
        name for name in (*colmap_options.OPTIONS, *colmap_options.PATHS) if name not in page
    ] == []


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 80


def test_documents_that_the_code_names_are_in_the_repository():
    places = [
        *ROOT.glob("jaxba/**/*.py"),
        *ROOT.glob("benchmarks/**/*.py"),
        *ROOT.glob("configs/**/*.yaml"),
    ]
    named = {
        (name_of(place), path)
        for place in places
        for path in re.findall(r"docs/[\w/-]+\.md", place.read_text())
    }
    assert not [(place, path) for place, path in sorted(named) if not (ROOT / path).exists()]
