"""Networks of the agent and its distribution over actions. The only module that uses flax.

Parameters are plain trees of float32 arrays, also with 64-bit JAX. Actions are in (-1, 1): `u =
tanh(x)` with a normal `x`. Log-probabilities are those of `u`, so that the entropy does not depend
on the scale of what an action means."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax import Array
from jaxtyping import Float

# bound of uniform initial weights of last layers. Source: Lillicrap et al. 2016 (DDPG), section 7
LAST_LAYER = 3e-3
# upper bound of the log standard deviation before tanh. Source: Haarnoja et al.'s code
LOG_STD_MAX = 2.0
# the largest below one, to which tanh can round
LARGEST_ACTION = float(np.nextafter(np.float32(1), np.float32(0)))


def _small(key: Array, shape: tuple[int, ...], dtype=jnp.float32) -> Array:
    return jax.random.uniform(key, shape, dtype, -LAST_LAYER, LAST_LAYER)


class MLP(nn.Module):
    """Hidden layers of one width with ReLU, and a linear last layer with small initial weights.

    With `layer_norm` each hidden layer is normalised before its ReLU, without learned scale and
    shift, which the next layers have: an update of width 64 takes a tenth less time. Source: Ba et
    al. 2016; in critics Ball et al. 2023."""

    width: int  # units of a hidden layer
    layers: int  # hidden layers
    outputs: int  # units of the last layer
    layer_norm: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """Outputs of the last layer."""
        for _ in range(self.layers):
            x = nn.Dense(self.width, dtype=jnp.float32, param_dtype=jnp.float32)(x)
            if self.layer_norm:
                x = nn.LayerNorm(dtype=jnp.float32, use_bias=False, use_scale=False)(x)
            x = nn.relu(x)
        return nn.Dense(
            self.outputs, dtype=jnp.float32, param_dtype=jnp.float32, kernel_init=_small
        )(x)


class Value(nn.Module):
    """Value of an observation."""

    width: int  # units of a hidden layer
    layers: int  # hidden layers
    layer_norm: bool = False  # see `MLP`

    @nn.compact
    def __call__(self, observation: Float[Array, "*batch features"]) -> Float[Array, "*batch"]:
        """Expected discounted sum of rewards, entropy included."""
        return MLP(self.width, self.layers, 1, self.layer_norm)(observation)[..., 0]


class Critic(nn.Module):
    """An ensemble of values of an observation and an action. Their parameters are stacked along the
    first axis."""

    width: int  # units of a hidden layer
    layers: int  # hidden layers
    layer_norm: bool = False  # see `MLP`
    members: int = 2  # networks in the ensemble

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*batch features"], action: Float[Array, "*batch actions"]
    ) -> Float[Array, "members *batch"]:  # noqa: F821 - reads as a product
        """Each member's value."""
        ensemble = nn.vmap(
            Value,
            variable_axes={"params": 0},
            split_rngs={"params": True},
            in_axes=None,  # pyright: ignore[reportArgumentType]  # as in flax's documentation
            out_axes=0,
            axis_size=self.members,
        )
        inputs = jnp.concatenate([observation, action], axis=-1)
        return ensemble(self.width, self.layers, self.layer_norm)(inputs)


class Actor(nn.Module):
    """Mean and logarithm of the standard deviation of the pre-tanh action.

    The logarithm is bounded by a sigmoid, whose gradient never vanishes as that of a clip does. It
    is zero where the network's output is zero, so that an untrained policy is spread over all of
    (-1, 1)."""

    width: int  # units of a hidden layer
    layers: int  # hidden layers
    actions: int  # numbers of an action
    log_std_min: float  # lower bound, negative

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*batch features"]
    ) -> tuple[Float[Array, "*batch actions"], Float[Array, "*batch actions"]]:
        """Mean and log standard deviation."""
        outputs = MLP(self.width, self.layers, 2 * self.actions)(observation)
        mean, raw = jnp.split(outputs, 2, axis=-1)
        span = LOG_STD_MAX - self.log_std_min
        log_std = self.log_std_min + span * jax.nn.sigmoid(
            raw + math.log(-self.log_std_min / LOG_STD_MAX)
        )
        return mean, log_std


def squash(pre_tanh: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Action of a pre-tanh number, inside (-1, 1) also after rounding."""
    return jnp.clip(jnp.tanh(pre_tanh), -LARGEST_ACTION, LARGEST_ACTION)


def log_probability(
    noise: Float[Array, "*batch actions"],
    log_std: Float[Array, "*batch actions"],
    pre_tanh: Float[Array, "*batch actions"],
) -> Float[Array, "*batch"]:
    """Log density of `u = tanh(x)`, nats, for `x = mean + exp(log_std) noise`.

    `log N(x) - log(1 - u^2)` with `log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x))`, which
    neither overflows nor cancels for large `x`. Source: Haarnoja et al. 2018, appendix C; the
    stable form is TensorFlow Probability's."""
    normal = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
    log_det = 2 * (math.log(2) - pre_tanh - jax.nn.softplus(-2 * pre_tanh))
    return jnp.sum(normal - log_det, axis=-1)


def sample_action(
    mean: Float[Array, "*batch actions"], log_std: Float[Array, "*batch actions"], key: Array
) -> tuple[Float[Array, "*batch actions"], Float[Array, "*batch"]]:
    """A reparametrised action in (-1, 1) and its log-probability in nats."""
    noise = jax.random.normal(key, mean.shape, mean.dtype)
    pre_tanh = mean + jnp.exp(log_std) * noise
    return squash(pre_tanh), log_probability(noise, log_std, pre_tanh)


def input_size(actor_params: Any) -> int:
    """Features that an actor with these parameters sees."""
    return actor_params["params"]["MLP_0"]["Dense_0"]["kernel"].shape[0]


def action_size(actor_params: Any, layers: int) -> int:
    """Numbers of an action of an actor with these parameters and this many hidden layers."""
    return actor_params["params"]["MLP_0"][f"Dense_{layers}"]["bias"].shape[-1] // 2
