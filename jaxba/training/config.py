"""The configuration of a training run, and the YAML files that hold it.

A file in `configs/train` lists differences to the file that it extends, or to the defaults of the
classes (jaxba/settings/configurations.py); a run writes all settings into its folder."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from jaxba import settings
from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.features import observation_size
from jaxba.damping.policy_file import LARGEST_FILE
from jaxba.game.env import GameConfig
from jaxba.game.scene_bank import BankConfig
from jaxba.problem.options import ConjugateGradients, StepOptions, check_count
from jaxba.settings import SettingsError, configurations
from jaxba.solver.methods import make_method
from jaxba.training.sac import SacConfig
from jaxba.training.train_loop import LoopConfig

MethodName = Literal["lm", "stba", "deeplm"]

# most cameras in a cluster: the default of methods is too large for scenes of the game
CLUSTER_CAMERAS = 4
# iterations of `cg` per camera unknown: predicted decrease within 1e-10, 10 x 10 scenes, lambda
# 1e-10
CG_ROUNDS = 2
# reserved for the metadata of a policy file, of which the configuration takes 3 kB
METADATA_BYTES = 1 << 14


@dataclass(frozen=True)
class TrainConfig:
    """A training run."""

    seed: int = 0
    """Of all random numbers: the scenes, and with the number of an agent its training."""

    seeds: int = 1
    """Agents trained side by side on the same scenes, in one program. Their replay buffers are held
    at once."""

    chunks: int = 40
    """Length of each agent's training in calls of the compiled loop, each of `loop.steps_per_chunk`
    vector steps."""

    evaluate_every: int = 4
    """Chunks between evaluations, each followed by a checkpoint, of which the last two are kept;
    the last chunk has both. A checkpoint also holds the best policy so far."""

    envs: int = 64
    """Environments that step together."""

    method: MethodName = "lm"
    """How a step is computed (jaxba/solver/methods.py). Scenes are solved and selected with plain
    LM."""

    linear_solver: Literal["explicit", "cg"] = "explicit"
    """Linear solver of the game's steps: `explicit`: a factorisation; `cg`:
    `jax.scipy.sparse.linalg.cg`, to the accuracy of one. Methods other than `lm` have their own."""

    bank: BankConfig = field(default_factory=BankConfig)
    """Scenes."""

    game: GameConfig = field(default_factory=GameConfig)
    """Rules of the game, and what the agent observes and decides."""

    sac: SacConfig = field(default_factory=SacConfig)
    """Networks and learning."""

    loop: LoopConfig = field(default_factory=LoopConfig)
    """Sizes of the training loop."""

    @property
    def step_options(self) -> StepOptions:
        """Options of the method's steps, without embedded iterations."""
        plain = StepOptions(self.linear_solver, intrinsics=self.bank.intrinsics)
        if self.linear_solver == "cg":
            unknowns = (9 if self.bank.intrinsics == "free" else 6) * self.bank.kind.cameras
            rule = ConjugateGradients("schur-jacobi", forcing=0.0, budget=CG_ROUNDS * unknowns)
            plain = replace(plain, conjugate_gradients=rule)
        method = make_method(self.method)
        if method.cluster_cameras is not None:
            method = make_method(f"{self.method}:{CLUSTER_CAMERAS}")
        return method.options(plain)

    def __post_init__(self) -> None:
        for name in ("seeds", "chunks", "evaluate_every", "envs"):
            check_count(name, getattr(self, name), 1)
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must lie in 0 to 2147483647, not {self.seed}")
        if self.envs > self.loop.replay_capacity:
            raise ValueError(f"loop.replay_capacity must be at least the {self.envs} environments")
        _check_agent(self.sac)
        _check_size(self.sac, self.game.agent)
        _ = self.step_options  # raises ValueError if impossible


def _check_agent(sac: SacConfig) -> None:
    """Refuses impossible numbers, which would otherwise fail in tracing or give NaN."""
    for name in ("width", "layers", "batch", "target_every"):
        check_count(f"sac.{name}", getattr(sac, name), 1)
    check_count("sac.actor_layers", sac.policy_layers, 1)
    for name in ("learning_rate", "initial_temperature"):
        if not getattr(sac, name) > 0:
            raise ValueError(f"sac.{name} must be positive, not {getattr(sac, name)}")
    for name in ("gamma", "tau"):
        if not 0 < getattr(sac, name) <= 1:
            raise ValueError(f"sac.{name} must lie in (0, 1], not {getattr(sac, name)}")
    if not sac.log_std_min < 0:
        raise ValueError(f"sac.log_std_min must be negative, not {sac.log_std_min}")


def _check_size(sac: SacConfig, agent: AgentConfig) -> None:
    """Refuses networks that are too large for a policy file."""
    sizes = [observation_size(agent), *[sac.width] * sac.policy_layers, 2]
    numbers = sum((inputs + 1) * outputs for inputs, outputs in itertools.pairwise(sizes))
    if 4 * numbers > LARGEST_FILE - METADATA_BYTES:
        raise ValueError(
            f"sac.width {sac.width} with sac.layers {sac.policy_layers} makes a policy of "
            f"{4 * numbers} bytes, "
            f"more than the {LARGEST_FILE - METADATA_BYTES} of a policy file"
        )


def load(name: str, overrides: Sequence[str] = ()) -> TrainConfig:
    """The configuration of a preset, or of a YAML file by its path: anything with a slash or an
    ending. `overrides` are `key.key=value` each, the value in YAML; they override the file. Raises
    SettingsError: no such file or base, not YAML, an unknown key or an impossible value; one
    line."""
    data = configurations.read("train", name)
    for override in overrides:
        if not isinstance(override, str):
            raise SettingsError(f"settings are text such as 'sac.width=128', not {override!r}")
        key, equals, value = override.partition("=")
        if not equals or not key:
            raise SettingsError(f"--set {override}: must be key=value")
        try:
            settings.assign(
                data, key.strip(), configurations.parse(value, "the value"), TrainConfig
            )
        except SettingsError as error:
            raise SettingsError(f"--set {override}: {error}") from None
    try:
        return settings.read(TrainConfig, data)
    except SettingsError as error:
        raise SettingsError(f"{name}{' with --set' if overrides else ''}: {error}") from None


def with_problems(config: TrainConfig, problems: Sequence[str]) -> TrainConfig:
    """The configuration with windows of real problems for scenes."""
    kind = replace(config.bank.kind, family="windows")
    return replace(config, bank=replace(config.bank, problems=tuple(problems), kind=kind))
