"""The training driver: compiled chunks, evaluations in between, checkpoints, and going on after a kill, bit for bit.

A run lives in a folder: `config.yaml`, `metrics.jsonl`, `tensorboard/`, `checkpoints/`. A checkpoint holds all of the
driver: the loop's state, the best policy so far, its score, and how far the log had come. A run that is started again
cuts the log there and repeats what followed, with the same numbers.
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

from jaxba.runtime.atomic import TEMPORARY, write_text
from jaxba.training import checkpoint, settings
from jaxba.training.config import TrainConfig, load, to_yaml
from jaxba.training.log import Log, Row
from jaxba.training.sac import Learner
from jaxba.training.train_loop import LoopState, run_chunk, start

CONFIG = "config.yaml"
CHECKPOINTS = "checkpoints"

CHANGEABLE = ("chunks", "keep", "checkpoint_every")
"""Settings that a resumed run may change; `chunks` only with one seed, or its agents would be trained unequally."""


class TrainError(ValueError):
    """A run that cannot start or go on. The message is one line for a person."""


class Best(NamedTuple):
    """The best policy on held-out scenes."""

    actor: Any  # parameters
    score: float  # lower is better
    seed: int
    chunk: int


class Outcome(NamedTuple):
    """What a call of `train` came to."""

    finished: bool  # false where it was asked to stop
    best: Best | None  # None where nothing was evaluated yet
    state: LoopState  # of the last agent


@dataclass(frozen=True)
class Hooks:
    """Who is told what; each may be left out."""

    stage: Callable[[str], None] = lambda _: None
    """Told in words what begins and takes a while."""

    row: Callable[[Row], None] = lambda _: None
    """Given every row of the log."""

    best: Callable[[Best], None] = lambda _: None
    """Given every policy that is better than all before."""

    stop: Callable[[], bool] = lambda: False
    """Asked after each chunk; if true, the run is saved and ends."""


def prepare_folder(
    folder: Path, config: TrainConfig | None, resume: bool, overrides: tuple[str, ...] = ()
) -> TrainConfig:
    """Makes the folder of a new run, or finds the configuration of the one in it.

    Args:
        folder: of the run.
        config: of a new run; of a resumed one, None for what its folder says.
        resume: whether a run in the folder goes on.
        overrides: `key=value` of a resumed run.

    Raises:
        TrainError: there is a run where a new one should be, or none to resume, or another one; or the folder's name
            is one with which checkpoints could not be read again.
        SettingsError: the folder's configuration cannot be read.
    """
    path = folder / CONFIG
    if glob.escape(place := str(folder.absolute())) != place:  # Orbax would look for parts of checkpoints elsewhere
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
    """Whether there is more than the configuration of a run that never came to anything."""
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
        config: `bank` and `game` are not looked at.
        env: a `protocol.Environment`.
        evaluate: numbers about a learner, among them `score`, lower is better; the same learner gives the same ones.
        folder: see `prepare_folder`.
        hooks: who is told.

    Raises:
        TrainError: the losses are no numbers any more, or the last checkpoint does not fit.
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
        self.seed, self.chunk, self.wall_s, size = 0, 0, 0.0, 0
        self.evaluated = 0  # chunk of the agent after which it was evaluated last
        self.best: Best | None = None
        like = jax.eval_shape(lambda: start(config.sac, config.loop, env, self._key()))
        found = checkpoint.steps(self.folder)
        if found:
            self.step = found[-1]
            size = self._restore(like)
        else:
            self.step = 0
            self._begin()
        hooks.stage("compiling the training loop")
        self._compiled = run_chunk.lower(config.sac, config.loop, env, self.state).compile()
        self.log = Log(folder, size, self.seed, self.chunk)

    def _key(self) -> Any:
        """Of the agent; the scenes have one of their own."""
        return jax.random.fold_in(jax.random.key(self.config.seed), 1 + self.seed)

    def _begin(self) -> None:
        self.hooks.stage(f"filling the replay buffer of agent {self.seed + 1}")
        fresh = start(self.config.sac, self.config.loop, self.env, self._key())
        self.state: LoopState = checkpoint.unpack(checkpoint.pack(fresh), fresh)  # exactly as from a checkpoint

    def _restore(self, like: Any) -> int:
        try:
            arrays, facts = checkpoint.restore(self.folder, self.step)
            whole: dict[str, Any] = {"state": like}
            if facts["best"] is not None:
                whole["best"] = like.learner.actor
            whole = checkpoint.unpack(arrays, whole)
        except checkpoint.CheckpointError as error:
            raise TrainError(f"the last checkpoint does not fit: {error}") from None
        self.state = whole["state"]
        self.seed, self.chunk, self.wall_s = facts["seed"], facts["chunk"], facts["wall_s"]
        self.evaluated = facts.get("evaluated", 0)
        if facts["best"] is not None:
            self.best = Best(whole["best"], **facts["best"])
        return facts["log_size"]

    def _save(self) -> None:
        tree: dict[str, Any] = {"state": self.state}
        if self.best is not None:
            tree["best"] = self.best.actor
        facts = {
            "seed": self.seed,
            "chunk": self.chunk,
            "wall_s": self.wall_s,
            "evaluated": self.evaluated,
            "log_size": self.log.size,
            "best": None if self.best is None else {k: getattr(self.best, k) for k in ("score", "seed", "chunk")},
        }
        checkpoint.save(self.folder, self.step, checkpoint.pack(tree), facts, self.config.keep)

    def finish(self) -> Outcome:
        config = self.config
        while True:
            while self.chunk < config.chunks:
                self._advance()
                stopping = self.hooks.stop()
                if stopping or self.chunk % config.checkpoint_every == 0 or self.chunk == config.chunks:
                    self._save()
                if stopping:
                    return Outcome(False, self.best, self.state)
            if self.evaluated != self.chunk:  # it was to end later when it was begun
                self.hooks.stage("evaluating the last policy")
                self._evaluate()
            if self.seed + 1 >= config.seeds:
                return Outcome(True, self.best, self.state)
            self.seed, self.chunk, self.evaluated = self.seed + 1, 0, 0
            self._begin()

    def _advance(self) -> None:
        """One chunk, its evaluation if one is due, and its row."""
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
        """Scores of the policy as it is; it is kept if it is better than all before."""
        scores = {name: float(value) for name, value in self.evaluate(self.state.learner).items()}
        self.evaluated = self.chunk
        if self.best is None or scores["score"] < self.best.score:
            actor = jax.tree.map(jnp.copy, self.state.learner.actor)  # the next chunk uses the state's memory up
            self.best = Best(actor, scores["score"], self.seed, self.chunk)
            self.hooks.best(self.best)
        return scores
