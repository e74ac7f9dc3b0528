"""On which devices the arrays of a run lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from jaxba.game.devices import AXIS
from jaxba.training import checkpoint
from jaxba.training.config import TrainConfig


class Placement:
    """A mesh over devices; with fewer than two there is none, and everything stays where it is."""

    def __init__(self, devices: Sequence[jax.Device]) -> None:
        """
        Args:
            devices: the same in all processes.
        """
        self.mesh = Mesh(np.asarray(devices), (AXIS,)) if len(devices) > 1 else None

    def divide(self, config: TrainConfig, env: Any) -> Any:
        """The environment as the devices play it: divided among them if they cannot divide the agents.

        Raises:
            ValueError: environments or batches cannot be divided either.
        """
        if self.check(config):
            return env
        assert self.mesh is not None
        return replace(env, devices=self.mesh.size)

    def check(self, config: TrainConfig) -> bool:
        """Whether the devices divide the agents, or there is nothing to divide.

        Raises:
            ValueError: they divide neither the agents nor environments and batches.
        """
        if self.mesh is None or config.seeds % self.mesh.size == 0:
            return True
        for name, count in (*(("envs", count) for count in config.envs), ("sac.batch", config.sac.batch)):
            if count % self.mesh.size:
                raise ValueError(f"{name} must be a multiple of the {self.mesh.size} devices, is {count}")
        return False

    def described(self, tree: Any, shares: Any) -> Any:
        """Shapes and types of a tree, and how it lies on the devices: as a prefix of it says."""
        if self.mesh is None:
            return tree
        lie = lambda share: NamedSharding(self.mesh, share)  # pyright: ignore[reportArgumentType]
        one = lambda share, x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=lie(share))
        return jax.tree.map(lambda share, part: jax.tree.map(lambda x: one(share, x), part), shares, tree)

    def spread(self, tree: Any, shares: Any) -> Any:
        """The tree on the devices, as a prefix of it says."""
        if self.mesh is None:
            return tree
        tree = jax.tree.map(jnp.asarray, tree)
        return checkpoint.unpack(checkpoint.pack(tree), self.described(tree, shares))

    def on_all(self, tree: Any) -> Any:
        """The whole tree on every device."""
        return self.spread(tree, P())
