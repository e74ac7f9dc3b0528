"""Everything that a training run depends on, and the YAML files that say it.

A file in `configs/train` states differences to the file that it extends, or to the defaults of the classes
(jaxba/io/configurations.py); a run writes all settings into its folder.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

from jaxba.damping.agent_config import AgentConfig, EffortMode
from jaxba.damping.features import observation_size
from jaxba.damping.policy_file import LARGEST_FILE
from jaxba.game.env import GameConfig
from jaxba.game.scene_bank import BankConfig
from jaxba.io import configurations
from jaxba.methods.registry import DEFAULT_METHOD, MethodName, make_method
from jaxba.problem.options import StepOptions
from jaxba.training import settings
from jaxba.training.sac import SacConfig
from jaxba.training.settings import SettingsError
from jaxba.training.train_loop import LoopConfig

METADATA_BYTES = 1 << 14
"""Left for what a policy file says about itself: the configuration in 3 kB."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run."""

    seed: int = 0
    """Decides the scenes and, with the number of the agent, all of its training."""

    seeds: int = 1
    """Agents trained one after the other on the same scenes with one compiled program; the best on held-out scenes is
    kept. One after the other, since on a CPU neither the small matrix products of several agents nor the LM steps of
    their scenes gain anything from a further batch axis, while replay buffers would all be held at once."""

    chunks: int = 40
    """Length of the training of each agent: calls of the compiled loop, of `loop.steps_per_chunk` vector steps."""

    evaluate_every: int = 4
    """Chunks from one evaluation on held-out scenes to the next; after the last chunk there always is one."""

    checkpoint_every: int = 4
    """Chunks from one checkpoint to the next: what a kill loses at most."""

    keep: int = 2
    """Checkpoints kept. Each holds the best policy so far too."""

    envs: tuple[int, ...] = (64,)
    """Environments of each class of scenes."""

    method: MethodName = "lm"
    """How a step is made (jaxba/methods/registry.py). Best costs and the selection of scenes are those of plain LM."""

    cluster_cameras: int = 4
    """Cameras of a cluster at most, for methods with clusters: scenes are too small for those of real problems."""

    bank: BankConfig = field(default_factory=BankConfig)
    """Scenes."""

    game: GameConfig = field(default_factory=GameConfig)
    """Rules of the game, and what the agent sees and does."""

    sac: SacConfig = field(default_factory=SacConfig)
    """The agent."""

    loop: LoopConfig = field(default_factory=LoopConfig)
    """Sizes of the training loop."""

    @property
    def step_options(self) -> StepOptions:
        """Of the method's steps, without embedded iterations."""
        plain = StepOptions(intrinsics=self.bank.intrinsics)
        if self.method == DEFAULT_METHOD:
            return plain
        method = make_method(self.method)
        if method.options(plain).cluster_cameras is not None:
            method = make_method(f"{self.method}:{self.cluster_cameras}")
        return method.options(plain)

    def __post_init__(self) -> None:
        for name in ("seeds", "chunks", "evaluate_every", "checkpoint_every", "keep", "cluster_cameras"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must lie in 0 to 2147483647, not {self.seed}")
        if len(self.envs) != len(self.bank.classes):
            raise ValueError(f"envs: {len(self.envs)} numbers for {len(self.bank.classes)} classes of scenes")
        if min(self.envs) < 1:
            raise ValueError(f"envs: every class needs at least one environment, not {min(self.envs)}")
        if sum(self.envs) > self.loop.replay_capacity:
            raise ValueError(f"loop.replay_capacity must be at least the {sum(self.envs)} environments")
        if self.bank.dtype not in ("float64", "float32"):
            raise ValueError(f"bank.dtype must be float64 or float32, not {self.bank.dtype!r}")
        _check_agent(self.sac)
        _check_size(self.sac, self.game.agent)
        _check_effort(self.game.agent.effort, self.method, self.step_options)


def _check_effort(effort: EffortMode, method: str, options: StepOptions) -> None:
    """What an agent chooses must be something that the method has."""
    if effort != "fixed" and not options.single_solve:
        raise ValueError(
            f"game.agent.effort: {effort!r} means nothing to method {method}, "
            "whose rounds always take all point iterations"
        )
    if effort == "points+forcing" and options.truncated is None:
        raise ValueError("game.agent.effort: a forcing term needs conjugate gradients, as method deeplm has them")


def _check_agent(sac: SacConfig) -> None:
    """Numbers of `sac` that make no sense would otherwise show as a program that cannot be traced, or as nan."""
    for name in ("width", "layers", "batch", "target_every"):
        if getattr(sac, name) < 1:
            raise ValueError(f"sac.{name} must be at least 1, not {getattr(sac, name)}")
    for name in ("learning_rate", "initial_temperature", "reward_scale", "log_std_max"):
        if not getattr(sac, name) > 0:
            raise ValueError(f"sac.{name} must be positive, not {getattr(sac, name)}")
    for name in ("gamma", "tau"):
        if not 0 < getattr(sac, name) <= 1:
            raise ValueError(f"sac.{name} must lie in (0, 1], not {getattr(sac, name)}")
    if not sac.log_std_min < 0:
        raise ValueError(f"sac.log_std_min must be negative, not {sac.log_std_min}")
    if sac.max_grad_norm is not None and not sac.max_grad_norm > 0:
        raise ValueError(f"sac.max_grad_norm must be positive or null, not {sac.max_grad_norm}")


def _check_size(sac: SacConfig, agent: AgentConfig) -> None:
    """A policy that is too large for its file would be noticed when all is trained."""
    sizes = [observation_size(agent), *[sac.width] * sac.layers, 2 * agent.action_size]
    numbers = sum((inputs + 1) * outputs for inputs, outputs in itertools.pairwise(sizes))
    if 4 * numbers > LARGEST_FILE - METADATA_BYTES:
        raise ValueError(
            f"sac.width {sac.width} with sac.layers {sac.layers} makes a policy of {4 * numbers} bytes, "
            f"more than the {LARGEST_FILE - METADATA_BYTES} of a policy file"
        )


def load(name: str, overrides: Sequence[str] = ()) -> TrainConfig:
    """The configuration of a preset or a file.

    Args:
        name: a preset (`preset_names`), or the path of a YAML file: anything with a slash or an ending.
        overrides: `key.key=value` each, the value in YAML; they win over the file.

    Raises:
        SettingsError: no such file or base, not YAML, an unknown key or an impossible value; one line.
    """
    data = configurations.read("train", name)
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or not key:
            raise SettingsError(f"--set {override}: must be key=value")
        try:
            settings.assign(data, key.strip(), configurations.parse(value, "the value"), TrainConfig)
        except SettingsError as error:
            raise SettingsError(f"--set {override}: {error}") from None
    try:
        return settings.read(TrainConfig, data)
    except SettingsError as error:
        raise SettingsError(f"{name}{' with --set' if overrides else ''}: {error}") from None


def to_yaml(config: TrainConfig) -> str:
    """All settings, defaults included; `load` of it gives the same configuration."""
    import yaml

    return yaml.safe_dump(settings.plain(config), sort_keys=False)


def preset_names() -> list[str]:
    """Names that `load` finds without a path."""
    return configurations.names("train")
