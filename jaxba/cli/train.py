"""`jaxba-train`: trains a damping policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxba.cli import common, processes
from jaxba.cli.interrupt import Interrupt

DEFAULT_CONFIG = "default"
"""Default preset of a new run."""

POLICY = "policy.safetensors"
"""File of the best policy."""

OF_AGENT = "policy-{}.safetensors"
"""File of an agent's policy, if there are several agents."""

CURVE = "curve"
"""Stem of the files with the learning curve."""

FILE_WIDTH = 160
"""Width of the table in characters if the output is not a terminal."""


@dataclass(frozen=True)
class Arguments:
    """Options of `jaxba-train`."""

    config: str | None = None
    """A preset (default, plain, driver, fast, paper; bal and kitti with --problems) or the path of a YAML file. A
    resumed run has its configuration in its folder."""

    overrides: Annotated[
        tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="set", metavar="KEY=VALUE ...")
    ] = ()
    """Settings that replace those of the configuration, such as sac.width=128 seed=3; values are YAML."""

    out: str | None = None
    """Folder of the run. Default: runs/NAME for the configuration NAME."""

    seeds: int | None = None
    """Agents that are trained side by side from other random numbers, the setting of this name. Each has a policy file;
    the policy of the best one on training scenes is written once more."""

    problems: tuple[str, ...] = ()
    """Real problems to train on: BAL files, COLMAP models, output of jaxba-kitti. Scenes are windows of neighbouring
    cameras, the last fifth of every problem held out. With a configuration that has classes of the family windows these
    are cut; else all its classes are."""

    resume: bool = False
    """Continue the run in the folder from its last checkpoint, with the same results as without the interruption: bit
    for bit on the same number of devices, to rounding on another."""

    devices: int | None = None
    """Devices of each process, among which agents are divided if their number is a multiple, else environments and
    batches. On a CPU virtual ones, which gain nothing. Default: one; with several processes all that there are."""

    coordinator: str | None = None
    """HOST:PORT of the first of several processes, which prints, reads and writes for all. Each is started with the
    same options but --process."""

    processes: int | None = None
    """Number of processes."""

    process: int | None = None
    """Number of this process, from 0."""

    distributed: bool = False
    """Find the last three under Slurm, Open MPI or Kubernetes."""


def main() -> None:
    """Entry point of `jaxba-train`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 if the policy was written, 2 for bad input, 130 after Ctrl-C (the run is
    saved)."""
    return common.run_command(Arguments, _train, "Trains a damping policy on random scenes.", argv)


def _train(args: Arguments) -> int:
    import jax

    from jaxba.runtime.distributed import MainFailedError, is_main

    jax.config.update("jax_enable_x64", True)  # the game uses float64, the agent's networks float32
    devices = processes.start(args.coordinator, args.processes, args.process, args.distributed, args.devices)
    try:
        return _run(args, devices)
    except MainFailedError:
        return common.BAD_INPUT
    except common.UsageError:  # that all processes have found
        if is_main():
            raise
        return common.BAD_INPUT


def _prepare(args: Arguments, folder: Path, name: str) -> Any:
    """The configuration of the run, and its folder."""
    from jaxba.training import config as configs
    from jaxba.training import driver

    overrides = tuple(item for group in args.overrides for item in group)
    overrides += () if args.seeds is None else (f"seeds={args.seeds}",)
    try:
        config = None if args.resume and args.config is None else configs.load(name, overrides)
        if args.problems and config is None:
            raise common.UsageError("--problems: a resumed run has its scenes in its folder")
        if args.problems and config is not None:
            config = configs.with_problems(config, _check_problems(args.problems))
        return driver.prepare_folder(folder, config, args.resume, overrides)
    except (configs.SettingsError, driver.TrainError) as error:
        raise common.UsageError(str(error)) from None


def _run(args: Arguments, devices: Sequence[Any]) -> int:
    from jaxba.game import scene_bank
    from jaxba.io.settings import SettingsError
    from jaxba.runtime import process
    from jaxba.runtime.distributed import is_main, together
    from jaxba.training import driver, task

    name = args.config or DEFAULT_CONFIG
    folder = Path(args.out or Path("runs") / Path(name).stem)
    config = together(lambda: _prepare(args, folder, name))
    common.prepare_process()
    console = _console(quiet=not is_main())
    with (
        process.single_blas_thread(),
        Interrupt("chunk", graceful=False, announce=is_main()) as interrupt,
        _Progress(console, config) as progress,
    ):
        try:
            with common.notes_printed(lambda _: None):  # they were printed when the problems were checked
                work = task.build(config, folder, progress.stage)
            progress.rules = work.rules
            interrupt.graceful = True

            def keep(best: tuple[driver.Best, ...]) -> None:
                _write_policies(folder, config, work, best)
                progress.best = best

            hooks = driver.Hooks(progress.stage, progress.rows, keep, lambda: interrupt.requested)
            outcome = driver.train(config, work.game, work.evaluate, folder, hooks, devices)
            interrupt.graceful = False
        except KeyboardInterrupt:
            console.print(f"interrupted; go on from the last checkpoint with {_again(folder)}")
            return common.INTERRUPTED
        except (driver.TrainError, SettingsError, scene_bank.TooFewScenes) as error:
            raise common.UsageError(str(error)) from None
        except OSError as error:
            raise common.UsageError(
                f"{error.filename or folder}: {error.strerror or error}; go on with {_again(folder)}"
            ) from None
        if not outcome.finished:
            console.print(f"interrupted and saved; go on with {_again(folder)}")
            return common.INTERRUPTED
        return together(lambda: _finish(folder, work, outcome.best, console, progress))


def _check_problems(problems: Sequence[str]) -> list[str]:
    """The paths of the problems, once they were read, so that a bad one is refused before anything is written."""
    from jaxba.datasets.bal.paths import resolve
    from jaxba.game.windows import read_all

    paths = [str(Path(resolve(name)).absolute()) for name in problems]
    with common.notes_printed():
        read_all(paths)
    return paths


def _console(quiet: bool) -> Any:
    """A console for the progress. Brackets in names are not interpreted as markup."""
    from rich.console import Console

    options: dict[str, Any] = {"soft_wrap": True, "highlight": False, "markup": False, "quiet": quiet}
    console = Console(**options)
    return console if console.is_terminal else Console(**options, width=FILE_WIDTH)


def _again(folder: Path) -> str:
    return f"jaxba-train --out {folder} --resume"


def _write_policies(folder: Path, config: Any, work: Any, best: Sequence[Any]) -> list[Path]:
    """Writes the policy of every agent if there are several, and that of the best agent; the files."""
    from jaxba import __version__
    from jaxba.damping.policy_file import save_policy
    from jaxba.training.config import to_yaml
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


def _finish(folder: Path, work: Any, best: Sequence[Any], console: Any, progress: _Progress) -> int:
    """Writes the policies and the learning curve, and prints the comparison with the rules."""
    from jaxba.bench.plots import save_figure
    from jaxba.cli.training_curve import plot_curve
    from jaxba.training import log
    from jaxba.training.driver import best_of

    files = _write_policies(folder, work.config, work, best)
    paid = work.config.game.reward == "price"
    rules = {name: {**one._asdict(), "score": one.price if paid else one.mean} for name, one in work.rules.items()}
    figure = plot_curve(log.read(folder), rules, work.config.game.tolerance)
    files += save_figure(figure, folder / CURVE)
    progress.stage("comparing with the rules")
    compared = work.compare([one.actor for one in best])
    progress.__exit__()
    count = sum(len(scene_bank.initial_cost) for scene_bank in work.held_out)
    console.print(_table(compared, work.config.game.tolerance, count))
    chosen = best_of(best)
    console.print(f"best on training scenes: agent {chosen.agent + 1} after chunk {chosen.chunk}")
    console.print(f"wrote {', '.join(str(file) for file in files)}")
    return 0


def _table(compared: Any, tolerance: float, count: int) -> Any:
    from rich.table import Table

    table = Table(
        title=f"iterations to f*(1 + {tolerance:g}) on {count} held-out scenes",
        title_justify="left",
        title_style="bold",
    )
    table.add_column("policy", no_wrap=True)
    agents = len(next(iter(compared.by_agent.values())))
    single = [f"{k + 1}" for k in range(agents)] if agents > 1 else []
    for name in (
        "mean",
        "geom. mean",
        "median",
        "p90",
        "failures",
        "converged",
        "final gap",
        "price",
        *single,
        "trained over it [95%]",
    ):
        table.add_column(name, justify="right")
    for name, score in compared.scores.items():
        own = [f"{x:.2f}" for x in compared.by_agent.get(name, ())] or [""] * agents
        numbers = [f"{x:.2f}" for x in (score.mean, score.geometric_mean, score.median, score.p90)]
        table.add_row(
            name,
            *numbers,
            f"{100 * score.failures:.1f} %",
            f"{score.to_convergence:.2f}",
            f"{score.end:.1e}",
            f"{score.price:.2f}",
            *(own if single else ()),
            "{:.3f} [{:.3f}, {:.3f}]".format(*compared.ratios[name]) if name in compared.ratios else "",
        )
    return table


class _Progress:
    """A progress bar on a terminal; otherwise lines of text."""

    def __init__(self, console: Any, config: Any) -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        self.console, self.config = console, config
        self.rules: Mapping[str, Any] = {}
        self.best: Sequence[Any] = ()  # the best policies that this process has trained
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TimeElapsedColumn(),
            TextColumn("ETA"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[now]}"),
            console=console,
            transient=True,
            speed_estimate_period=600,
            disable=not console.is_terminal,
        )
        self._task: Any = None

    def __enter__(self) -> _Progress:
        self._bar.start()
        self._task = self._bar.add_task("starting", total=None, now="")
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def stage(self, description: str) -> None:
        """Reports the start of a stage."""
        self._bar.update(self._task, description=description, now="")
        if not self.console.is_terminal:
            self.console.print(description)

    def rows(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Reports a finished chunk, by its rows of the training log."""
        row, total = rows[0], self.config.chunks
        now = f"{row['steps_per_s']:.0f} steps/s, {row['updates_per_s']:.0f} updates/s"
        ended = [(one["episode/length"], one["episode/ceres"]) for one in rows if one["episodes"]]
        if ended:
            length, rule = (sum(x) / len(ended) for x in zip(*ended, strict=True))
            now += f", {length:.1f} iterations (Ceres' rule {rule:.1f})"
        description = f"chunk {row['chunk']}/{total}"
        if self._bar.tasks[0].total is None:
            self._bar.reset(self._task, total=total, completed=row["chunk"] - 1)
        self._bar.update(self._task, description=description, total=total, completed=row["chunk"], now=now)
        if not self.console.is_terminal:
            self.console.print(f"{description}: {now}, {row['wall_s']:.0f} s")
        if "held_out/score" in row:
            self.console.print(f"{description}: {self._held_out(rows)}")

    def _held_out(self, rows: Sequence[Mapping[str, Any]]) -> str:
        from jaxba.training.task import CONSTANT

        values = lambda name: [row[name] for row in rows if row.get(name) is not None]
        mean = lambda name: sum(values(name)) / len(rows)
        paid = self.config.game.reward == "price"
        text = f"held out {mean('held_out/score'):.2f} {'plain steps paid' if paid else 'iterations'}"
        if len(rows) > 1:
            text += f" ({min(values('held_out/score')):.2f} to {max(values('held_out/score')):.2f})"
        text += f", p90 {mean('held_out/p90'):.0f}, failures {100 * mean('held_out/failures'):.1f} %"
        shown = [name for name in ("ceres", "ceres+embedded", CONSTANT) if name in self.rules]
        rules = [f"{name} {self.rules[name].price if paid else self.rules[name].mean:.2f}" for name in shown]
        if rules:
            text += f" ({', '.join(rules)})"
        if any(one.chunk == rows[0]["chunk"] for one in self.best):
            text += ", best so far"
        return text
