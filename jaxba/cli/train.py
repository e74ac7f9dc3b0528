"""`jaxba-train`: trains a damping policy."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jaxba.cli import common
from jaxba.cli.options import options
from jaxba.runtime.interrupt import Interrupt

if TYPE_CHECKING:
    from jaxba.bench.tables import Table

DEFAULT_CONFIG = "default"  # default preset of a new run
POLICY = "policy.safetensors"  # file of the best policy
OF_AGENT = "policy-{}.safetensors"  # file of an agent's policy, if there are several agents
PAGE = "report.html"  # file with curves, episodes and the table, interactive
FILE_WIDTH = 160  # width of the table in characters if the output is not a terminal


@options
class Arguments:
    """What is trained, and where."""

    config: Annotated[str | None, "NAME"] = None
    """Preset (default, paper, paper-tuned) or YAML file. A resumed run has its configuration in its
    folder."""

    overrides: Annotated[
        tuple[tuple[str, ...], ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(name="set", metavar="KEY=VALUE ...", prefix_name=False),
    ] = ()
    """Settings that replace those of the configuration, such as sac.width=128 seed=3; values are
    YAML."""

    out: Annotated[str | None, "FOLDER"] = None
    """Folder of the run. Default: runs/NAME for the configuration NAME."""

    seeds: int | None = None
    """Agents that are trained side by side from other random numbers. Each has a policy file; the
    one that is best on training scenes is written once more."""

    problems: Annotated[tuple[str, ...], "FILE ..."] = ()
    """Real problems to train on: BAL files, COLMAP models, output of jaxba-kitti. Scenes are
    windows of neighbouring cameras; the last fifth of every problem is held out."""

    resume: bool = False
    """Continue the run in the folder from its last checkpoint: the same results as without
    interruption, bit by bit."""


def main() -> None:
    """Entry point of `jaxba-train`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 for a policy, 2 for bad input, 130 after Ctrl-C (the run is
    saved)."""
    command = common.command_line("jaxba-train", argv)
    train = functools.partial(_train, command=command)
    return common.run_command(Arguments, train, "Trains a damping policy on random scenes.", argv)


def _prepare(args: Arguments, folder: Path, name: str) -> Any:
    """The configuration of the run, and its folder."""
    from jaxba.cli.overwriting import check_apart
    from jaxba.settings import configurations
    from jaxba.training import config as configs
    from jaxba.training import driver

    overrides = tuple(item for group in args.overrides for item in group)
    overrides += () if args.seeds is None else (f"seeds={args.seeds}",)
    config = None if args.resume and args.config is None else configs.load(name, overrides)
    resumed = args.problems and config is None
    common.require(not resumed, "--problems: a resumed run has its scenes in its folder")
    if args.problems and config is not None:
        config = configs.with_problems(config, _check_problems(args.problems))
    if config is not None and not args.resume:  # the configuration of a run that goes on is its own
        read = {"the file of --config": [configurations.find("train", name)]}
        check_apart({"--out": [folder / driver.CONFIG]}, read)
    return driver.prepare_folder(folder, config, args.resume, overrides)


def _train(args: Arguments, command: str) -> int:
    import jax

    from jaxba.runtime import process
    from jaxba.training import driver, task, view

    jax.config.update("jax_enable_x64", True)  # the game uses float64, the agent's networks float32
    name = args.config or DEFAULT_CONFIG
    folder = Path(args.out or Path("runs") / Path(name).stem)
    config = _prepare(args, folder, name)
    common.prepare_process()
    console = common.console(FILE_WIDTH, markup=False)
    with process.single_blas_thread(), Interrupt("chunk", graceful=False) as interrupt:
        stages = _Stages(console)
        try:
            # they were printed when the problems were checked
            with common.notes_printed(lambda _: None):
                loops: list[Any] = []

                def compiling(game):
                    return loops.append(driver.begin_compiling(config, game))

                work = task.build(config, folder, stages, on_game=compiling)
            best: list[int] = []  # chunks of the best policies
            began: list[tuple[float, int]] = []  # when training began, and after which chunk
            interrupt.graceful = True

            def keep(policies: tuple[driver.Best, ...]) -> None:
                _write_policies(folder, config, work, policies)
                best[:] = [one.chunk for one in policies]

            def show(rows: list[Any]) -> None:
                agent = config.game.agent
                decades = (agent.high - agent.low) / 2
                row = rows[0]
                if not began:
                    began.append(
                        (
                            time.perf_counter() - row["chunk_s"] - row.get("evaluate_s", 0.0),
                            row["chunk"] - 1,
                        )
                    )
                mean = (time.perf_counter() - began[0][0]) / (row["chunk"] - began[0][1])
                left = mean * (config.chunks - row["chunk"])
                for line in view.lines(
                    rows, config.chunks, work.rules, row["chunk"] in best, decades, left
                ):
                    console.print(line)

            hooks = driver.Hooks(stages, show, keep, lambda: interrupt.requested, console.print)
            outcome = driver.train(config, work.game, work.evaluate, folder, hooks, *loops)
            interrupt.graceful = False
        except KeyboardInterrupt:
            console.print(f"interrupted; go on with {_again(folder)}")
            return common.INTERRUPTED
        except OSError as error:
            raise common.UsageError(
                f"{error.filename or folder}: {error.strerror or error}; go on with "
                f"{_again(folder)}"
            ) from None
        if not outcome.finished:
            console.print(f"interrupted and saved; go on with {_again(folder)}")
            return interrupt.status
        return _finish(folder, work, outcome.best, console, command, stages)


class _Stages:
    """Prints every stage of the work with its seconds once it has ended."""

    def __init__(self, console: Any) -> None:
        self._print, self._text, self._begun = console.print, "starting", time.perf_counter()

    def __call__(self, text: str) -> None:
        """Ends the stage before, and begins another one."""
        now = time.perf_counter()
        self._print(f"{self._text}: {now - self._begun:.1f} s")
        self._text = text
        self._begun = now


def _check_problems(problems: Sequence[str]) -> list[str]:
    """The paths of the problems, once they were read, so that a bad one is refused before anything
    is written."""
    from jaxba.datasets.bal.paths import resolve
    from jaxba.game.windows import read_all

    paths = [str(Path(resolve(name)).absolute()) for name in problems]
    with common.notes_printed():
        read_all(paths)
    return paths


def _again(folder: Path) -> str:
    return f"jaxba-train --out {folder} --resume"


def _write_policies(folder: Path, config: Any, work: Any, best: Sequence[Any]) -> list[Path]:
    """Writes the policy of every agent if there are several, and that of the best agent; the
    files."""
    from jaxba import __version__
    from jaxba.damping.policy_file import save_policy
    from jaxba.settings import to_yaml
    from jaxba.training.driver import best_of

    files = {folder / OF_AGENT.format(one.agent + 1): one for one in best} if len(best) > 1 else {}
    files[folder / POLICY] = best_of(best)
    for path, one in files.items():
        metadata = {
            "jaxba": __version__,
            "config": to_yaml(config),
            "agent_number": str(one.agent),
            "chunk": str(one.chunk),
            "training_score": f"{one.score:.4f}",
        }
        save_policy(path, work.policy(one.actor), metadata)
    return list(files)


def _finish(
    folder: Path,
    work: Any,
    best: Sequence[Any],
    console: Any,
    command: str,
    stages: Callable[[str], None],
) -> int:
    """Writes the policies and the page, and prints the comparison with the rules."""
    from jaxba.bench import run as bench_run
    from jaxba.bench import training_page
    from jaxba.bench.tables import to_rich
    from jaxba.game.rollout import play
    from jaxba.runtime.atomic import write_text
    from jaxba.training import log
    from jaxba.training.driver import best_of

    files = _write_policies(folder, work.config, work, best)
    rows = log.read(folder)
    rules_of_game = work.config.game
    stages("comparing with the rules")
    compared = work.compare([one.actor for one in best])
    table = _table(compared, rules_of_game.tolerance, len(work.held_out.initial_cost))
    stages("episodes and page")
    chosen = best_of(best)
    policy = work.policy(chosen.actor)
    limit = rules_of_game.max_iterations
    episodes = play(work.game.kind, work.held_out, policy, work.game.options, limit)
    facts = {"command": command, "agents": str(work.config.seeds), **bench_run.machine()}
    page = folder / PAGE
    write_text(page, training_page.to_html(rows, work.rules, table, episodes, facts))
    stages("end")
    drawn = to_rich(table)
    drawn.columns[0].no_wrap = drawn.columns[-1].no_wrap = True
    console.print(drawn)
    console.print(f"best on training scenes: agent {chosen.agent + 1} after chunk {chosen.chunk}")
    console.print(f"wrote {', '.join(str(file) for file in [*files, page])}")
    return 0


def _table(compared: Any, tolerance: float, count: int) -> Table:
    """Scores on the held-out scenes, and the iterations of the trained policies over those of each
    other row."""
    from jaxba.bench.tables import Table

    scores, ratios, by_agent = compared
    agents = len(next(iter(by_agent.values())))
    single = tuple(f"agent {k + 1}" for k in range(agents)) if agents > 1 else ()
    rows = []
    for name, score in scores.items():
        own = [f"{x:.2f}" for x in by_agent.get(name, ())] or ["-"] * agents
        numbers = [f"{x:.2f}" for x in (score.mean, score.geometric_mean, score.median, score.p90)]
        ends = f"{100 * score.failures:.1f} %", f"{score.to_convergence:.2f}", f"{score.end:.1e}"
        ratio = "{:.3f} [{:.3f}, {:.3f}]".format(*ratios[name]) if name in ratios else "-"
        rows.append((name, *numbers, *ends, *(own if single else ()), ratio))
    header = ("policy", "mean", "geom. mean", "median", "p90", "failures", "converged", "final gap")
    return Table(
        f"Iterations to f*(1 + {tolerance:g}) on {count} held-out scenes",
        (*header, *single, "trained over it [95%]"),
        rows,
        "A failure counts as the limit. The last column: iterations of the trained policies over "
        "this one's, by scene.",
    )
