"""The training driver: compiled chunks, evaluations between them, checkpoints, and bitwise
identical resuming.

A run has a folder with `config.yaml`, `metrics.jsonl` and `checkpoints/`. A checkpoint holds the
loop's state, the best policy of every agent so far, and its score. A run that is resumed goes on
from the last checkpoint that can be read, removes from the log what was written after it, and
repeats that, with the same numbers.

All agents of a run are trained side by side, in one program over an axis of agents."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxba import settings
from jaxba.io.files import visible
from jaxba.runtime.atomic import write_text
from jaxba.runtime.numerics import for_traces
from jaxba.training import checkpoint, log
from jaxba.training.checkpoint import TrainError
from jaxba.training.config import TrainConfig, load
from jaxba.training.log import Row
from jaxba.training.train_loop import LoopState, run_agents, start_agents

CONFIG = "config.yaml"
CHECKPOINTS = "checkpoints"

_METADATA = ("chunk", "wall_s", "evaluated", "best")  # what a checkpoint holds besides arrays
CHANGEABLE = "chunks"  # the setting that a resumed run may change
KEPT = 2  # checkpoints: of a damaged one the one before is left
SCORE = "training/score"  # the metric by which policies are chosen: lower is better


class Best(NamedTuple):
    """The best policy of an agent on training scenes."""

    actor: Any  # parameters
    score: float  # lower is better
    agent: int  # its number, from 0
    chunk: int


class Outcome(NamedTuple):
    """Result of a call of `train`."""

    finished: bool  # false if `Hooks.stop` ended it
    best: tuple[Best, ...]  # of every agent; empty if nothing was evaluated yet
    state: LoopState  # of all agents, on a leading axis


def best_of(policies: Sequence[Best]) -> Best:
    """The one with the lowest score."""
    return min(policies, key=lambda best: best.score)


@dataclass(frozen=True)
class Hooks:
    """Callbacks of a run."""

    stage: Callable[[str], None] = lambda _: None  # gets a line of text when something long begins
    # gets the rows of a chunk, one of every agent
    rows: Callable[[list[Row]], None] = lambda _: None
    # gets the best policies of all agents when one is new
    best: Callable[[tuple[Best, ...]], None] = lambda _: None
    # asked after each chunk: if true, the run is saved and ends
    stop: Callable[[], bool] = lambda: False
    note: Callable[[str], None] = lambda _: None  # gets a line of text on damaged files


def prepare_folder(
    folder: Path, config: TrainConfig | None, resume: bool, overrides: tuple[str, ...] = ()
) -> TrainConfig:
    """Creates the folder of a new run, or reads the configuration of the run to resume. For a
    resumed run, `config` None is the configuration in its folder, and `overrides` change that by
    `key=value`. Raises TrainError: a new run would overwrite another one, there is no run to
    resume, or its configuration differs. Raises SettingsError: the configuration in the folder
    cannot be read."""
    path = folder / CONFIG
    if path.is_file() and not resume and _others(folder):
        raise TrainError(
            f"{folder} holds a run already; --resume goes on with it, --out names another folder"
        )
    if resume:
        if not path.is_file():
            raise TrainError(f"{folder} holds no run to resume")
        old = load(str(path))
        new = config or load(str(path), overrides)
        changed = [key for key in settings.differences(old, new) if key != CHANGEABLE]
        if changed:
            raise TrainError(
                f"{folder} was begun with another {changed[0]}; a resumed run may change "
                f"{CHANGEABLE}"
            )
        config = new
    if config is None:
        raise AssertionError("a new run needs a configuration")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not resume and _others(folder):
            raise TrainError(f"{folder} is not empty; --out names another folder")
        write_text(path, settings.to_yaml(config))
    except OSError as error:
        raise TrainError(f"{folder}: {error.strerror or error}") from None
    return config


def _others(folder: Path) -> bool:
    """Whether the folder holds anything but a configuration."""
    return any(item.name != CONFIG for item in visible(folder))


@for_traces
def begin_compiling(config: TrainConfig, env: Any) -> Future[Any]:
    """Compiles the training loop in another thread: XLA compiles one program on little more than
    one core."""
    lowered = run_agents.lower(config.sac, config.loop, env, _shapes(config, env))
    other = ThreadPoolExecutor(1)
    compiled = other.submit(lowered.compile)
    other.shutdown(wait=False)
    return compiled


def _keys(config: TrainConfig) -> Any:
    """Random keys of the agents; scenes have another one."""
    return jax.vmap(jax.random.fold_in, (None, 0))(
        jax.random.key(config.seed), 1 + jnp.arange(config.seeds)
    )


def _shapes(config: TrainConfig, env: Any) -> Any:
    return jax.eval_shape(lambda: start_agents(config.sac, config.loop, env, _keys(config)))


@for_traces
def train(
    config: TrainConfig,
    env: Any,
    evaluate: Callable[[Any], Mapping[str, float]],
    folder: Path,
    hooks: Hooks | None = None,
    loop: Future[Any] | None = None,
) -> Outcome:
    """Trains to the end, from the last checkpoint in the folder if there is one.

    Args:
        config: of the run; `bank` and `game` are not used.
        env: a `protocol.Environment`.
        evaluate: metrics of an actor's parameters by their names in the log, deterministic; `SCORE`
            is one of them.
        folder: see `prepare_folder`.
        hooks: callbacks.
        loop: of `begin_compiling`; None: it is called now.

    Raises:
        TrainError: losses or all transitions are not finite, or no checkpoint can be used or
            written."""
    return _Run(
        config, env, evaluate, folder, hooks or Hooks(), loop or begin_compiling(config, env)
    ).finish()


class _Run:
    """A run between two chunks."""

    def __init__(
        self,
        config: TrainConfig,
        env: Any,
        evaluate: Any,
        folder: Path,
        hooks: Hooks,
        loop: Future[Any],
    ) -> None:
        self.config = config
        self.env = env
        self.evaluate = evaluate
        self.hooks = hooks
        self.log = folder
        self.folder = folder / CHECKPOINTS
        self.chunk = 0
        self.wall_s = 0.0
        self.evaluated = 0  # chunk after which the agents were evaluated last
        self.best: tuple[Best, ...] = ()
        like = _shapes(config, env)
        hooks.stage("compiling the training loop")
        if checkpoint.steps(self.folder):
            self._restore_latest(like)
        else:
            fresh = start_agents(config.sac, config.loop, env, _keys(config))
            # laid out as after a checkpoint
            self.state: LoopState = checkpoint.unpack(checkpoint.pack(fresh), like)
        evaluate(_agent(self.state.learner.actor, 0))  # compiles its programs
        self._compiled = loop.result()
        log.begin(folder, self.chunk, hooks.note)
        hooks.stage("training")

    def _restore_latest(self, like: Any) -> None:
        """Restores the last checkpoint that can be used; one that was cut short says nothing about
        those before."""
        reasons = []
        for step in reversed(checkpoint.steps(self.folder)):
            try:
                self._restore(step, like)
            except TrainError as error:
                reasons.append(str(error))
                continue
            if reasons:
                self.hooks.note(
                    f"{reasons[0]}; going on from the one before, after chunk {self.chunk}"
                )
            return
        others = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
        raise TrainError(
            f"the last checkpoint does not fit: {reasons[0]}{others}; begin in a new folder"
        )

    def _restore(self, step: int, like: Any) -> None:
        arrays, metadata = checkpoint.restore(self.folder, step)
        try:
            self.chunk, self.wall_s, self.evaluated, best = (metadata[name] for name in _METADATA)
            found = [Best(None, agent=k, **one) for k, one in enumerate(best)]
        except (KeyError, TypeError) as error:
            raise TrainError(f"checkpoint {step} was written by another version: {error}") from None
        self.state = checkpoint.unpack(arrays, {"state": like})["state"]
        if found:
            host = jax.tree.map(
                lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), like.learner.actor
            )
            actors = checkpoint.unpack(arrays, {"best": host})["best"]
            self.best = tuple(one._replace(actor=_agent(actors, one.agent)) for one in found)

    def _save(self) -> None:
        arrays = checkpoint.pack({"state": self.state})
        if self.best:
            actors = jax.tree.map(lambda *x: jnp.stack(x), *(one.actor for one in self.best))
            arrays = {**checkpoint.pack({"best": actors}), **arrays}
        best = [{"score": one.score, "chunk": one.chunk} for one in self.best]
        metadata: dict[str, Any] = dict(
            zip(_METADATA, (self.chunk, self.wall_s, self.evaluated, best), strict=True)
        )
        try:
            checkpoint.save(self.folder, self.chunk, arrays, metadata, KEPT)
        except TrainError as error:
            raise TrainError(f"{error}; --resume goes on from the one before") from None

    def finish(self) -> Outcome:
        """Trains the remaining chunks."""
        while self.chunk < self.config.chunks:
            stopping = self._advance()
            if stopping or self.evaluated == self.chunk:
                self._save()
            if stopping:
                return Outcome(False, self.best, self.state)
        if self.evaluated != self.chunk:  # `chunks` was larger when the run began
            self.hooks.stage("evaluating the last policies")
            self._evaluate(self._actors())
        return Outcome(True, self.best, self.state)

    def _actors(self) -> list[Any]:
        """Copies of the policies of all agents, to be evaluated."""
        self.evaluated = self.chunk
        whole = jax.tree.map(np.asarray, self.state.learner.actor)
        return [_agent(whole, k) for k in range(self.config.seeds)]

    def _advance(self) -> bool:
        """One chunk, its evaluation if one is due, and its rows of the log. Whether the run is to
        end."""
        before = [np.asarray(x) for x in (self.state.env_steps, self.state.updates)]
        wall = time.perf_counter()
        cpu = time.process_time()
        self.state, found = self._compiled(self.env, self.state)
        means = jax.tree.map(np.asarray, found)
        seconds = time.perf_counter() - wall
        cpu = time.process_time() - cpu
        self.chunk += 1
        self.wall_s += seconds
        bad = np.flatnonzero(
            ~np.all(
                [np.isfinite(means[x]) for x in ("critic_loss", "actor_loss", "q_mean")], axis=0
            )
        )
        if len(bad):
            raise TrainError(
                f"chunk {self.chunk} of agent {bad[0] + 1}: the losses are not finite any more"
            )
        counts = [np.asarray(x) for x in (self.state.env_steps, self.state.updates)]
        if np.any(means["dropped"] >= counts[0] - before[0]):
            raise TrainError(
                f"chunk {self.chunk}: all transitions hold numbers that are not finite; look at "
                "the reward"
            )
        steps, updates = (
            float(np.sum(new - old)) / seconds for new, old in zip(counts, before, strict=True)
        )
        clocks = {
            "wall_s": self.wall_s,
            "chunk_s": seconds,
            "steps_per_s": steps,
            "updates_per_s": updates,
        }
        clocks |= {"cpu_per_wall": cpu / seconds}
        rows: list[Row] = []
        for k in range(self.config.seeds):
            row: Row = {
                "seed": k,
                "chunk": self.chunk,
                "env_steps": int(counts[0][k]),
                "updates": int(counts[1][k]),
            }
            rows.append(
                {**row, **clocks, **{name: float(value[k]) for name, value in means.items()}}
            )
        due = self.chunk % self.config.evaluate_every == 0 or self.chunk == self.config.chunks
        if due:
            wall = time.perf_counter()
            scored = self._evaluate(self._actors())
            clocks = {"evaluate_s": time.perf_counter() - wall}
            rows = [{**row, **scores, **clocks} for row, scores in zip(rows, scored, strict=True)]
        self.hooks.rows([log.write(self.log, row) for row in rows])
        return self.hooks.stop()

    def _evaluate(self, actors: list[Any]) -> list[dict[str, float]]:
        """Metrics of every agent's policy, which is kept if it is better than all before of this
        agent."""
        found = []
        best = []
        for k, actor in enumerate(actors):
            scores = {name: float(value) for name, value in self.evaluate(actor).items()}
            better = not self.best or scores[SCORE] < self.best[k].score
            best.append(Best(actor, scores[SCORE], k, self.chunk) if better else self.best[k])
            found.append(scores)
        if any(one.chunk == self.chunk for one in best):
            self.best = tuple(best)
            self.hooks.best(self.best)
        return found


def _agent(tree: Any, number: int) -> Any:
    """A copy of one agent's part: the next chunk donates the memory of all."""
    return jax.tree.map(lambda x: jnp.array(x[number], copy=True), tree)
