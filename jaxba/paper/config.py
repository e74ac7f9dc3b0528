"""What a reproduction run depends on, and the YAML files that say it.

A file in `configs/paper` states differences to the file that it extends, or to the defaults of the classes
(jaxba/io/configurations.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxba.io import configurations
from jaxba.training import settings
from jaxba.training.settings import SettingsError

CONFIG = "config.yaml"
"""Settings of a run, in its folder."""


@dataclass(frozen=True)
class AgentsConfig:
    """The agents that the ablation tables train."""

    preset: str = "paper"
    """Of `jaxba-train`; what the tables vary is put on top."""

    overrides: tuple[str, ...] = ()
    """`key=value` on the preset, for all agents; such as its length."""

    seeds: int = 3
    """Agents of each kind. All of them enter the tables, none is picked."""

    state_sizes: tuple[int, ...] = (1, 5, 10, 20)
    """Last errors that the agents of the state-size table see. 5 is the paper's own agent and must be among them."""

    trajectories: int = 10
    """Training scenes of the agent that is trained on as few as the paper's. Source: the paper, synthetic data."""


@dataclass(frozen=True)
class ZeroNetConfig:
    """The non-holistic network."""

    width: int = 1280
    """Units of each layer. Source: the paper."""

    layers: int = 3
    """Hidden layers. Source: the paper."""

    batch: int = 16
    """Scenes that step together, and over whose next errors a gradient is averaged."""

    updates: int = 4000
    """Gradient updates: one after each step of the batch."""

    max_iterations: int = 30
    """Steps after which a scene that has not converged makes place for another."""

    learning_rate: float = 1e-4
    """Adam's; not in the paper."""


@dataclass(frozen=True)
class FamilyConfig:
    """Real problems of one kind."""

    name: str
    """For tables, and to find the paper's row."""

    files: tuple[str, ...]
    """Paths with $VARIABLES and wildcards, or names of downloaded problems of BAL. What is not there is left out, and
    the report says so."""

    cameras: tuple[int, ...] = ()
    """Sizes of sub-problems that are cut from each file."""

    whole: bool = True
    """Whether the files enter whole too."""


@dataclass(frozen=True)
class RealConfig:
    """Real problems."""

    bal: tuple[FamilyConfig, ...] = ()
    """Families of BAL."""

    kitti: FamilyConfig = field(default_factory=lambda: FamilyConfig("KITTI", ()))
    """Sequences, such as those that `jaxba-kitti` writes, and windows of the first of them."""

    repeats: int = 1
    """Runs of each solver on each problem; times are medians."""


@dataclass(frozen=True)
class FigureConfig:
    """Problems of the figures."""

    scene: str = "scene:ladybug-49"
    """Of the lambda chart and the small convergence plot where there are no real problems."""

    large_scene: str = "scene:ladybug-1197"
    """Stand-in for Ladybug-1197."""

    large_solvers: tuple[str, ...] = (
        "classic/implicit",
        "ceres/implicit",
        "learned/implicit",
        "learned-driver/implicit",
    )
    """`solver/linear solver` on the large scene."""

    large_iterations: int = 100
    """Linear solves of each there, at most."""

    profile_scenes: int = 6
    """Random scenes that join the real problems of BAL in the performance profiles; each has its own seed."""


@dataclass(frozen=True)
class PaperConfig:
    """A reproduction run."""

    seed: int = 0
    """Decides scenes and agents."""

    agents: AgentsConfig = field(default_factory=AgentsConfig)
    """Trained agents."""

    zero_net: ZeroNetConfig = field(default_factory=ZeroNetConfig)
    """The non-holistic network."""

    real: RealConfig = field(default_factory=RealConfig)
    """Real problems."""

    figures: FigureConfig = field(default_factory=FigureConfig)
    """Problems of the figures."""

    small: tuple[int, ...] = (5, 8)
    """Sizes of the smallest scenes: as many cameras as points."""

    small_scenes: int = 30
    """Scenes of each of these sizes."""

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must lie in 0 to 2147483647, not {self.seed}")
        counts = {"agents.seeds": self.agents.seeds, "agents.trajectories": self.agents.trajectories}
        counts |= {"zero_net.updates": self.zero_net.updates, "zero_net.layers": self.zero_net.layers}
        counts |= {"real.repeats": self.real.repeats, "small_scenes": self.small_scenes}
        counts |= {"figures.large_iterations": self.figures.large_iterations}
        for name, value in counts.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, not {value}")
        if PAPER_STATE not in self.agents.state_sizes:
            raise ValueError(f"agents.state_sizes must have {PAPER_STATE}, the paper's own, among them")
        if len(set(self.agents.state_sizes)) < len(self.agents.state_sizes):
            raise ValueError("agents.state_sizes has a size twice")


PAPER_STATE = 5
"""Errors that the paper's agent sees."""


def load(name: str) -> PaperConfig:
    """The configuration of a preset or a file.

    Args:
        name: a preset (`preset_names`), or the path of a YAML file: anything with a slash or an ending.

    Raises:
        SettingsError: no such file or base, not YAML, an unknown key or an impossible value; one line.
    """
    data = configurations.read("paper", name)
    try:
        return settings.read(PaperConfig, data)
    except SettingsError as error:
        raise SettingsError(f"{name}: {error}") from None


def to_yaml(config: PaperConfig) -> str:
    """All settings, defaults included; `load` of it gives the same configuration."""
    import yaml

    return yaml.safe_dump(settings.plain(config), sort_keys=False)


def preset_names() -> list[str]:
    """Names that `load` finds without a path."""
    return configurations.names("paper")
