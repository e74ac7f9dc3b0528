"""The training driver: compiled chunks, evaluations between them, checkpoints, and bitwise identical resuming.

A run has a folder with `config.yaml`, `metrics.jsonl`, `tensorboard/` and `checkpoints/`. A checkpoint holds the loop's
state, the best policy so far, and its score. A run that is resumed goes on from the last checkpoint that can be read,
removes from the log what was written after it, and repeats that, with the same numbers.
"""

from __future__ import annotations

import glob
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxba.io import settings
from jaxba.runtime.atomic import TEMPORARY, write_text
from jaxba.training import checkpoint
from jaxba.training.config import TrainConfig, load, to_yaml
from jaxba.training.log import Log, Row
from jaxba.training.sac import Learner
from jaxba.training.train_loop import LoopState, run_chunk, start

CONFIG = "config.yaml"
CHECKPOINTS = "checkpoints"

_METADATA = ("seed", "chunk", "wall_s", "evaluated", "best")
"""What a checkpoint holds besides arrays."""

CHANGEABLE = ("chunks", "keep", "checkpoint_every")
"""Settings that a resumed run may change; `chunks` only with one seed, since all agents are trained equally long."""


class TrainError(ValueError):
    """A run that cannot start or continue. The message is one line for a person."""


class Best(NamedTuple):
    """The best policy on held-out scenes."""

    actor: Any  # parameters
    score: float  # lower is better
    seed: int
    chunk: int


class Outcome(NamedTuple):
    """Result of a call of `train`."""

    finished: bool  # false if `Hooks.stop` ended it
    best: Best | None  # None if nothing was evaluated yet
    state: LoopState  # of the last agent


@dataclass(frozen=True)
class Hooks:
    """Callbacks of a run."""

    stage: Callable[[str], None] = lambda _: None
    """Called with a line of text when something begins that takes a while."""

    row: Callable[[Row], None] = lambda _: None
    """Called with every row of the log."""

    best: Callable[[Best], None] = lambda _: None
    """Called with every policy that is better than all before."""

    stop: Callable[[], bool] = lambda: False
    """Called after each chunk; if it returns true, the run is saved and ends."""


def prepare_folder(
    folder: Path, config: TrainConfig | None, resume: bool, overrides: tuple[str, ...] = ()
) -> TrainConfig:
    """Creates the folder of a new run, or reads the configuration of the run to resume.

    Args:
        folder: of the run.
        config: of a new run; of a resumed one, None for the configuration in its folder.
        resume: whether a run in the folder is resumed.
        overrides: `key=value` of a resumed run.

    Raises:
        TrainError: a new run would overwrite another one, there is no run to resume or its configuration differs, or
            checkpoints could not be read again from a folder of this name.
        SettingsError: the configuration in the folder cannot be read.
    """
    path = folder / CONFIG
    if glob.escape(name := str(folder.absolute())) != name:  # Orbax would take the name for a pattern
        raise TrainError(f"{folder}: checkpoints cannot be kept where a name holds one of * ? [")
    if path.is_file() and not resume and _others(folder):
        raise TrainError(f"{folder} holds a run already; --resume goes on with it, --out names another folder")
    if resume:
        if not path.is_file():
            raise TrainError(f"{folder} holds no run to resume")
        old = load(str(path))
        new = config or load(str(path), overrides)
        allowed = CHANGEABLE if old.seeds == 1 else CHANGEABLE[1:]
        changed = [key for key in settings.differences(old, new) if key not in allowed]
        if changed:
            free = ", ".join(allowed)
            raise TrainError(f"{folder} was begun with another {changed[0]}; a resumed run may change {free}")
        config = new
    if config is None:
        raise AssertionError("a new run needs a configuration")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not resume and _others(folder):
            raise TrainError(f"{folder} is not empty; --out names another folder")
        write_text(path, to_yaml(config))
    except OSError as error:
        raise TrainError(f"{folder}: {error.strerror or error}") from None
    return config


def _others(folder: Path) -> bool:
    """Whether the folder holds anything but a configuration."""
    return any(item.name != CONFIG and not item.match(TEMPORARY.format("*")) for item in folder.iterdir())


def train(
    config: TrainConfig,
    env: Any,
    evaluate: Callable[[Learner], Mapping[str, float]],
    folder: Path,
    hooks: Hooks | None = None,
) -> Outcome:
    """Trains to the end, from the last checkpoint in the folder if there is one.

    Args:
        config: of the run; `bank` and `game` are not used.
        env: a `protocol.Environment`.
        evaluate: metrics of a learner, deterministic; `score` is one of them, lower is better.
        folder: see `prepare_folder`.
        hooks: callbacks.

    Raises:
        TrainError: the losses are not finite any more, or no checkpoint can be used or written.
    """
    run = _Run(config, env, evaluate, folder, hooks or Hooks())
    try:
        return run.finish()
    finally:
        run.log.close()


class _Run:
    """A run between two chunks."""

    def __init__(self, config: TrainConfig, env: Any, evaluate: Any, folder: Path, hooks: Hooks) -> None:
        self.config, self.env, self.evaluate, self.hooks = config, env, evaluate, hooks
        self.folder = folder / CHECKPOINTS
        self.seed, self.chunk, self.wall_s = 0, 0, 0.0
        self.evaluated = 0  # chunk of the agent after which it was evaluated last
        self.best: Best | None = None
        like = jax.eval_shape(lambda: start(config.sac, config.loop, env, self._key()))
        self.step = 0
        if checkpoint.steps(self.folder):
            self._restore_latest(like)
        else:
            self._begin()
        hooks.stage("compiling the training loop")
        self._compiled = run_chunk.lower(config.sac, config.loop, env, self.state).compile()
        self.log = Log(folder, self.seed, self.chunk, hooks.stage)

    def _key(self) -> Any:
        """Random key of the agent; scenes have another one."""
        return jax.random.fold_in(jax.random.key(self.config.seed), 1 + self.seed)

    def _begin(self) -> None:
        self.hooks.stage(f"filling the replay buffer of agent {self.seed + 1}")
        fresh = start(self.config.sac, self.config.loop, self.env, self._key())
        self.state: LoopState = checkpoint.unpack(
            checkpoint.pack(fresh), fresh
        )  # the same memory layout as after a checkpoint

    def _restore_latest(self, like: Any) -> None:
        """Restores the last checkpoint that can be used; one that was cut short says nothing about those before."""
        reasons = []
        for step in reversed(checkpoint.steps(self.folder)):
            try:
                self._restore(step, like)
            except checkpoint.CheckpointError as error:
                reasons.append(str(error))
                continue
            if reasons:
                self.hooks.stage(f"{reasons[0]}; going on from the one before, after chunk {self.chunk}")
            return
        others = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
        raise TrainError(f"the last checkpoint does not fit: {reasons[0]}{others}; begin in a new folder")

    def _restore(self, step: int, like: Any) -> None:
        arrays, metadata = checkpoint.restore(self.folder, step)
        try:
            seed, chunk, wall_s, evaluated, best = (metadata[name] for name in _METADATA)
            tree: dict[str, Any] = {"state": like}
            if best is not None:
                tree["best"] = like.learner.actor
            tree = checkpoint.unpack(arrays, tree)
            self.best = None if best is None else Best(tree["best"], **best)
        except (KeyError, TypeError) as error:
            raise checkpoint.CheckpointError(f"checkpoint {step} was written by another version: {error}") from None
        self.state, self.step = tree["state"], step
        self.seed, self.chunk, self.wall_s, self.evaluated = seed, chunk, wall_s, evaluated

    def _save(self) -> None:
        tree: dict[str, Any] = {"state": self.state}
        if self.best is not None:
            tree["best"] = self.best.actor
        best = None if self.best is None else {k: getattr(self.best, k) for k in ("score", "seed", "chunk")}
        values = self.seed, self.chunk, self.wall_s, self.evaluated, best
        metadata: dict[str, Any] = dict(zip(_METADATA, values, strict=True))
        try:
            checkpoint.save(self.folder, self.step, checkpoint.pack(tree), metadata, self.config.keep)
        except checkpoint.CheckpointError as error:
            raise TrainError(f"{error}; --resume goes on from the one before") from None

    def finish(self) -> Outcome:
        """Trains the remaining chunks of all agents."""
        config = self.config
        while True:
            while self.chunk < config.chunks:
                self._advance()
                stopping = self.hooks.stop()
                if stopping or self.chunk % config.checkpoint_every == 0 or self.chunk == config.chunks:
                    self._save()
                if stopping:
                    return Outcome(False, self.best, self.state)
            if self.evaluated != self.chunk:  # `chunks` was larger when the run began
                self.hooks.stage("evaluating the last policy")
                self._evaluate()
            if self.seed + 1 >= config.seeds:
                return Outcome(True, self.best, self.state)
            self.seed, self.chunk, self.evaluated = self.seed + 1, 0, 0
            self._begin()

    def _advance(self) -> None:
        """One chunk, its evaluation if one is due, and its row of the log."""
        steps, updates = int(self.state.env_steps), int(self.state.updates)
        wall, cpu = time.perf_counter(), time.process_time()
        self.state, found = self._compiled(self.env, self.state)
        means = {name: float(value) for name, value in found.items()}
        seconds, cpu = time.perf_counter() - wall, time.process_time() - cpu
        self.chunk, self.step = self.chunk + 1, self.step + 1
        self.wall_s += seconds
        if not all(math.isfinite(means[name]) for name in ("critic_loss", "actor_loss", "q_mean")):
            raise TrainError(f"chunk {self.chunk} of agent {self.seed + 1}: the losses are not finite any more")
        row: Row = {"seed": self.seed, "chunk": self.chunk, "env_steps": int(self.state.env_steps)}
        row |= {"updates": int(self.state.updates), "wall_s": self.wall_s, "chunk_s": seconds}
        row |= {"steps_per_s": (row["env_steps"] - steps) / seconds}
        row |= {"updates_per_s": (row["updates"] - updates) / seconds, "cpu_per_wall": cpu / seconds, **means}
        if self.chunk % self.config.evaluate_every == 0 or self.chunk == self.config.chunks:
            wall = time.perf_counter()
            row |= {f"held_out/{name}": value for name, value in self._evaluate().items()}
            row["evaluate_s"] = time.perf_counter() - wall
        self.hooks.row(self.log.write(row))

    def _evaluate(self) -> dict[str, float]:
        """Scores of the current policy, which is kept if it is better than all before."""
        scores = {name: float(value) for name, value in self.evaluate(self.state.learner).items()}
        self.evaluated = self.chunk
        if self.best is None or scores["score"] < self.best.score:
            actor = jax.tree.map(jnp.copy, self.state.learner.actor)  # the next chunk donates the state's memory
            self.best = Best(actor, scores["score"], self.seed, self.chunk)
            self.hooks.best(self.best)
        return scores
