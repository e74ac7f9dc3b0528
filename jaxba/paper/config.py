"""Configuration of a reproduction run, and its YAML files.

A file in `configs/paper` states differences to the file that it extends, or to the defaults of the
classes (jaxba/settings/configurations.py)."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxba import settings
from jaxba.problem.options import check_count
from jaxba.settings import SettingsError, configurations

CONFIG = "config.yaml"  # settings of a run, in its folder


@dataclass(frozen=True)
class AgentsConfig:
    """The agents that are trained for the ablation tables."""

    length: float = 1.0  # of every training, relative to that of its preset of `jaxba-train`
    overrides: tuple[str, ...] = ()  # changes of the presets of all agents as `key=value`
    seeds: int = 3  # training runs of each kind of agent; all of them enter the tables
    # last errors observed, for the state-size table; with 5, the paper's
    state_sizes: tuple[int, ...] = (1, 5, 10, 20)
    # training scenes of the agent that is trained on few. Source: the paper, synthetic data
    trajectories: int = 10


@dataclass(frozen=True)
class ZeroNetConfig:
    """The Zero-net, which the paper calls non-holistic, and its training."""

    width: int = 1280  # units of each layer. Source: the paper
    layers: int = 3  # hidden layers. Source: the paper
    batch: int = 16  # scenes in a batch; the gradient is averaged over them
    updates: int = 4000  # gradient updates; there is one after each step of the batch
    # iterations after which a scene that has not converged is replaced by another
    max_iterations: int = 30
    learning_rate: float = 1e-4  # of Adam; the paper does not give it


@dataclass(frozen=True)
class FamilyConfig:
    """A family of real problems.

    Files are paths, in which $VARIABLES and wildcards are expanded, or names of downloaded BAL
    problems. Missing ones are left out and listed in the report."""

    name: str  # in tables; the paper's numbers are found by it
    files: tuple[str, ...]
    # numbers of cameras of the sub-problems that are made of each file
    cameras: tuple[int, ...] = ()
    whole: bool = True  # whether the complete problems are used too


@dataclass(frozen=True)
class RealConfig:
    """Real problems."""

    bal: tuple[FamilyConfig, ...] = ()  # families of the BAL data set
    # such as `jaxba-kitti` writes
    kitti: FamilyConfig = field(default_factory=lambda: FamilyConfig("KITTI", ()))
    repeats: int = 1  # solves of each problem with each solver; times are medians


@dataclass(frozen=True)
class FigureConfig:
    """Problems in the figures."""

    # of the lambda chart and the small convergence plot, without real problems
    scene: str = "scene:ladybug-49"
    # of the large convergence plot, instead of the problem Ladybug-1197
    large_scene: str = "scene:ladybug-1197"
    large_iterations: int = 100  # limit of linear solves on the large scene
    # random scenes in the performance profiles, in addition to the BAL problems
    profile_scenes: int = 6


@dataclass(frozen=True)
class PaperConfig:
    """Configuration of a reproduction run."""

    seed: int = 0  # of the scenes and agents
    agents: AgentsConfig = field(default_factory=AgentsConfig)
    zero_net: ZeroNetConfig = field(default_factory=ZeroNetConfig)
    real: RealConfig = field(default_factory=RealConfig)
    figures: FigureConfig = field(default_factory=FigureConfig)
    # cameras, and also points, of scenes in the table of small problems
    small: tuple[int, ...] = (5, 8)
    small_scenes: int = 30  # scenes of each size

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must lie in 0 to 2147483647, not {self.seed}")
        counts = {
            "agents.seeds": self.agents.seeds,
            "agents.trajectories": self.agents.trajectories,
        }
        counts |= {
            "zero_net.updates": self.zero_net.updates,
            "zero_net.layers": self.zero_net.layers,
        }
        counts |= {"real.repeats": self.real.repeats, "small_scenes": self.small_scenes}
        counts |= {"figures.large_iterations": self.figures.large_iterations}
        if not self.agents.length > 0:
            raise ValueError(f"agents.length must be positive, not {self.agents.length}")
        for name, value in counts.items():
            check_count(name, value, 1)
        if PAPER_STATE not in self.agents.state_sizes:
            raise ValueError(
                f"agents.state_sizes must have {PAPER_STATE}, the paper's own, among them"
            )
        if len(set(self.agents.state_sizes)) < len(self.agents.state_sizes):
            raise ValueError("agents.state_sizes has a size twice")


PAPER_STATE = 5  # number of last errors that the paper's agent observes


def load(name: str) -> PaperConfig:
    """The configuration of a preset, or of a YAML file by its path: anything with a slash or an
    ending. Raises SettingsError: no such file or base, not YAML, an unknown key or an impossible
    value; one line."""
    data = configurations.read("paper", name)
    try:
        return settings.read(PaperConfig, data)
    except SettingsError as error:
        raise SettingsError(f"{name}: {error}") from None
