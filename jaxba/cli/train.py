"""`jaxba-train`: trains a damping policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxba.cli import common
from jaxba.cli.interrupt import Interrupt

DEFAULT_CONFIG = "default"
"""Default preset of a new run."""

POLICY = "policy.safetensors"
"""File of the best policy."""

CURVE = "curve"
"""Stem of the files with the learning curve."""

FILE_WIDTH = 120
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

    problems: tuple[str, ...] = ()
    """Real problems to train on: BAL files, COLMAP models, output of jaxba-kitti. Scenes are windows of neighbouring
    cameras, the last fifth of every problem held out. With a configuration that has classes of the family windows these
    are cut; else all its classes are."""

    resume: bool = False
    """Continue the run in the folder from its last checkpoint, with the same results as without the interruption."""


def main() -> None:
    """Entry point of `jaxba-train`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command. Exit status: 0 if the policy was written, 2 for bad input, 130 after Ctrl-C (the run is
    saved)."""
    return common.run_command(Arguments, _train, "Trains a damping policy on random scenes.", argv)


def _train(args: Arguments) -> int:
    import jax

    from jaxba.game import scene_bank
    from jaxba.runtime import process
    from jaxba.training import config as configs
    from jaxba.training import driver, task

    jax.config.update("jax_enable_x64", True)  # the game uses float64, the agent's networks float32
    overrides = tuple(item for group in args.overrides for item in group)
    name = args.config or DEFAULT_CONFIG
    folder = Path(args.out or Path("runs") / Path(name).stem)
    try:
        config = None if args.resume and args.config is None else configs.load(name, overrides)
        if args.problems and config is None:
            raise common.UsageError("--problems: a resumed run has its scenes in its folder")
        if args.problems and config is not None:
            config = configs.with_problems(config, _check_problems(args.problems))
        config = driver.prepare_folder(folder, config, args.resume, overrides)
    except (configs.SettingsError, driver.TrainError) as error:
        raise common.UsageError(str(error)) from None
    common.prepare_process()
    console = _console()
    with (
        process.single_blas_thread(),
        Interrupt("chunk", graceful=False) as interrupt,
        _Progress(console, config) as progress,
    ):
        try:
            with common.notes_printed(lambda _: None):  # they were printed when the problems were checked
                work = task.build(config, folder, progress.stage)
            progress.rules = work.rules
            interrupt.graceful = True

            def keep(best: driver.Best) -> None:
                _write_policy(folder, config, work, best)
                progress.best = best

            hooks = driver.Hooks(progress.stage, progress.row, keep, lambda: interrupt.requested)
            outcome = driver.train(config, work.game, work.evaluate, folder, hooks)
            interrupt.graceful = False
        except KeyboardInterrupt:
            console.print(f"interrupted; go on from the last checkpoint with {_again(folder)}")
            return common.INTERRUPTED
        except (driver.TrainError, configs.SettingsError, scene_bank.TooFewScenes) as error:
            raise common.UsageError(str(error)) from None
        except OSError as error:
            raise common.UsageError(
                f"{error.filename or folder}: {error.strerror or error}; go on with {_again(folder)}"
            ) from None
        if not outcome.finished:
            console.print(f"interrupted and saved; go on with {_again(folder)}")
            return common.INTERRUPTED
        return _finish(folder, work, outcome.best, console, progress)


def _check_problems(problems: Sequence[str]) -> list[str]:
    """The paths of the problems, once they were read, so that a bad one is refused before anything is written."""
    from jaxba.datasets.bal.paths import resolve
    from jaxba.game.windows import read_all

    paths = [str(Path(resolve(name)).absolute()) for name in problems]
    with common.notes_printed():
        read_all(paths)
    return paths


def _console() -> Any:
    """A console for the progress. Brackets in names are not interpreted as markup."""
    from rich.console import Console

    options: dict[str, Any] = {"soft_wrap": True, "highlight": False, "markup": False}
    console = Console(**options)
    return console if console.is_terminal else Console(**options, width=FILE_WIDTH)


def _again(folder: Path) -> str:
    return f"jaxba-train --out {folder} --resume"


def _write_policy(folder: Path, config: Any, work: Any, best: Any) -> None:
    from jaxba import __version__
    from jaxba.damping.policy_file import save_policy
    from jaxba.training.config import to_yaml

    metadata = {
        "jaxba": __version__,
        "config": to_yaml(config),
        "agent_number": str(best.seed),
        "chunk": str(best.chunk),
        "held_out_iterations": f"{best.score:.4f}",
    }
    save_policy(folder / POLICY, work.policy(best.actor), metadata)


def _finish(folder: Path, work: Any, best: Any, console: Any, progress: _Progress) -> int:
    """Writes the policy and the learning curve, and prints the comparison with the rules."""
    from jaxba.bench.plots import save_figure
    from jaxba.cli.training_curve import plot_curve
    from jaxba.training import log

    _write_policy(folder, work.config, work, best)
    paid = work.config.game.reward == "price"
    rules = {name: {**one._asdict(), "score": one.price if paid else one.mean} for name, one in work.rules.items()}
    figure = plot_curve(log.read(folder), rules, work.config.game.tolerance)
    files = [folder / POLICY, *save_figure(figure, folder / CURVE)]
    progress.stage("comparing with the rules")
    scores, ratios = work.compare(best.actor)
    progress.__exit__()
    count = sum(len(scene_bank.initial_cost) for scene_bank in work.held_out)
    console.print(_table(scores, ratios, work.config.game.tolerance, count))
    console.print(f"best: agent {best.seed + 1} after chunk {best.chunk}")
    console.print(f"wrote {', '.join(str(file) for file in files)}")
    return 0


def _table(scores: Mapping[str, Any], ratios: Mapping[str, Any], tolerance: float, count: int) -> Any:
    from rich.table import Table

    table = Table(
        title=f"iterations to f*(1 + {tolerance:g}) on {count} held-out scenes",
        title_justify="left",
        title_style="bold",
    )
    table.add_column("policy", no_wrap=True)
    for name in (
        "mean",
        "geom. mean",
        "median",
        "p90",
        "failures",
        "converged",
        "final gap",
        "price",
        "learned over it [95%]",
    ):
        table.add_column(name, justify="right")
    for name, score in scores.items():
        numbers = [f"{x:.2f}" for x in (score.mean, score.geometric_mean, score.median, score.p90)]
        table.add_row(
            name,
            *numbers,
            f"{100 * score.failures:.1f} %",
            f"{score.to_convergence:.2f}",
            f"{score.end:.1e}",
            f"{score.price:.2f}",
            "{:.3f} [{:.3f}, {:.3f}]".format(*ratios[name]) if name in ratios else "",
        )
    return table


class _Progress:
    """A progress bar on a terminal; otherwise lines of text."""

    def __init__(self, console: Any, config: Any) -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        self.console, self.config = console, config
        self.rules: Mapping[str, Any] = {}
        self.best: Any = None  # the best policy that this process has trained
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

    def row(self, row: Mapping[str, Any]) -> None:
        """Reports a finished chunk, by its row of the training log."""
        config = self.config
        done = row["seed"] * config.chunks + row["chunk"]
        total = config.seeds * config.chunks
        now = f"{row['steps_per_s']:.0f} steps/s, {row['updates_per_s']:.0f} updates/s"
        if row["episodes"]:
            now += f", {row['episode/length']:.1f} iterations (Ceres' rule {row['episode/ceres']:.1f})"
        description = f"agent {row['seed'] + 1}/{config.seeds}, chunk {row['chunk']}/{config.chunks}"
        if self._bar.tasks[0].total is None:
            self._bar.reset(self._task, total=total, completed=done - 1)
        self._bar.update(self._task, description=description, total=total, completed=done, now=now)
        if not self.console.is_terminal:
            self.console.print(f"{description}: {now}, {row['wall_s']:.0f} s")
        if row.get("held_out/score") is not None:
            self.console.print(f"{description}: {self._held_out(row)}")

    def _held_out(self, row: Mapping[str, Any]) -> str:
        from jaxba.training.task import CONSTANT

        score = row["held_out/score"]
        paid = self.config.game.reward == "price"
        text = f"held out {score:.2f} {'plain steps paid' if paid else 'iterations'}"
        if row.get("held_out/p90") is not None:
            text += f", p90 {row['held_out/p90']:.0f}, failures {100 * row['held_out/failures']:.1f} %"
        shown = [name for name in ("ceres", "ceres+embedded", CONSTANT) if name in self.rules]
        rules = [f"{name} {self.rules[name].price if paid else self.rules[name].mean:.2f}" for name in shown]
        if rules:
            text += f" ({', '.join(rules)})"
        if self.best is not None and (self.best.seed, self.best.chunk) == (row["seed"], row["chunk"]):
            text += ", best so far"
        return text
