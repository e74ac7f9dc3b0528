"""Soft actor-critic in two forms, as pure functions of a learner and a batch.

`twin` is Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications": two critics, target
networks of both, a learned temperature. `value` is the form of the paper (Belder et al. 2023), that
of Haarnoja et al. 2018, "Soft Actor-Critic: Off-Policy Maximum Entropy Deep RL": policy, two
critics, a value network and its target network, a fixed temperature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Float, Int

from jaxba.training import networks
from jaxba.training.replay import Transition


@dataclass(frozen=True)
class SacConfig:
    """Settings of the agent, by default chosen for a CPU. Hashable: static in compiled programs."""

    variant: Literal["twin", "value"] = "twin"
    """`twin`: target critics, learned temperature. `value`: the paper's, with a value network and
    its target."""

    width: int = 64
    """Units of a hidden layer. 64 is five times faster on a CPU than the paper's 256 (six without
    layer norm)."""

    layers: int = 2
    """Hidden layers of every network."""

    actor_layers: int | None = None
    """Hidden layers of the policy, if other ones than those of `layers`."""

    layer_norm: bool = True
    """Layer normalisation in critics and value network. Source: Ball et al. 2023, section 4.2."""

    learning_rate: float = 3e-4
    """Adam's, for all networks and the temperature. Source: Haarnoja et al. 2018."""

    gamma: float = 0.99
    """Discount of a step."""

    tau: float = 0.005
    """Fraction by which the target networks move towards the critics at each refresh. Source:
    Haarnoja et al. 2018."""

    target_every: int = 1
    """Updates between refreshes of the target networks."""

    batch: int = 256
    """Transitions in an update."""

    initial_temperature: float = 0.1
    """Initial weight of the entropy, in units of the reward."""

    learn_temperature: bool = True
    """Whether the temperature is adapted to the target entropy; otherwise it is constant."""

    privileged: bool = True
    """Whether critics see what the policy does not (`Environment.privileged_size`), an asymmetric
    actor-critic. Source: Pinto et al. 2017, "Asymmetric Actor Critic for Image-Based Robot
    Learning"."""

    target_entropy: float | None = None
    """Nats, of the action in (-1, 1); if None, minus the numbers of an action. Source: Haarnoja et
    al. 2018."""

    log_std_min: float = -5.0
    """Lower bound of the log standard deviation before tanh."""

    @property
    def policy_layers(self) -> int:
        """Hidden layers of the policy."""
        return self.layers if self.actor_layers is None else self.actor_layers


class Learner(NamedTuple):
    """Parameters and all other state of training. A plain tree of arrays."""

    actor: Any
    critic: Any  # of both critics, stacked
    value: Any  # None with `twin`
    target: Any  # copy of the critics, or of the value network
    log_temperature: Float[Array, ""]
    optimizers: dict[str, Any]  # Adam's states
    key: Array
    updates: Int[Array, ""]


# flax types the outputs of its networks as anything or a pair
def _actor(config: SacConfig, actions: int) -> Any:
    return networks.Actor(config.width, config.policy_layers, actions, config.log_std_min)


def _critic(config: SacConfig) -> Any:
    return networks.Critic(config.width, config.layers, config.layer_norm)


def _value(config: SacConfig) -> Any:
    return networks.Value(config.width, config.layers, config.layer_norm)


def init(
    config: SacConfig, key: Array, observation_size: int, action_size: int, privileged_size: int = 0
) -> Learner:
    """An untrained agent. The key is that of the parameters and of all later random numbers. The
    actor does not see the last `privileged_size` features of an observation."""
    key, actor_key, critic_key, value_key = jax.random.split(key, 4)
    observation = jnp.zeros((1, observation_size), jnp.float32)
    action = jnp.zeros((1, action_size), jnp.float32)
    public = observation[:, : observation_size - privileged_size]
    observation = observation if config.privileged else public
    actor = _actor(config, action_size).init(actor_key, public)
    critic = _critic(config).init(critic_key, observation, action)
    value = _value(config).init(value_key, observation) if config.variant == "value" else None
    log_temperature = jnp.log(jnp.asarray(config.initial_temperature, jnp.float32))
    trained = {"actor": actor, "critic": critic, "temperature": log_temperature}
    if value is not None:
        trained["value"] = value
    return Learner(
        actor=actor,
        critic=critic,
        value=value,
        target=jax.tree.map(jnp.copy, critic if value is None else value),
        log_temperature=log_temperature,
        optimizers={
            name: optax.adam(config.learning_rate).init(params) for name, params in trained.items()
        },
        key=key,
        updates=jnp.zeros((), jnp.int32),
    )


def act(
    config: SacConfig, actor: Any, observation: Float[Array, "*batch features"], key: Array | None
) -> Float[Array, "*batch actions"]:
    """Actions in (-1, 1): sampled, or without a key the hyperbolic tangent of the mean.
    Observations are of any floating point type; what the actor does not see may follow."""
    network = _actor(config, networks.action_size(actor, config.policy_layers))
    seen = jnp.asarray(observation, jnp.float32)[..., : networks.input_size(actor)]
    mean, log_std = network.apply(actor, seen)
    return networks.squash(mean) if key is None else networks.sample_action(mean, log_std, key)[0]


def act_with_value(
    config: SacConfig, learner: Learner, observation: Float[Array, "envs features"], key: Array
) -> tuple[Float[Array, "envs actions"], Float[Array, " envs"], Float[Array, " envs"]]:
    """A sampled action as by `act`, the critics' mean value of it, and its reward for entropy."""
    public = observation[:, : networks.input_size(learner.actor)]
    actions = networks.action_size(learner.actor, config.policy_layers)
    mean, log_std = _actor(config, actions).apply(learner.actor, public)
    action, log_prob = networks.sample_action(mean, log_std, key)
    values = _critic(config).apply(
        learner.critic, observation if config.privileged else public, action
    )
    return action, jnp.mean(values, axis=0), -jnp.exp(learner.log_temperature) * log_prob


def update(
    config: SacConfig, learner: Learner, batch: Transition
) -> tuple[Learner, dict[str, Float[Array, ""]]]:
    """One gradient step: critics, then actor, then temperature or value network, then target
    network. Returns the new learner, and `critic_loss`, `actor_loss`, `q_mean`, `entropy` (nats, of
    the action in (-1, 1)), `temperature` (before its step) and, with a value network,
    `value_loss`."""
    observation, action, reward, next_observation, discount = (
        jnp.asarray(x, jnp.float32) for x in batch
    )
    inputs = networks.input_size(learner.actor)
    public = observation[:, :inputs]
    next_public = next_observation[:, :inputs]
    if not config.privileged:
        observation = public
        next_observation = next_public
    key, next_key, policy_key = jax.random.split(learner.key, 3)
    actor_network = _actor(config, action.shape[-1])
    critic_network = _critic(config)
    temperature = jnp.exp(learner.log_temperature)
    optimizer = optax.adam(config.learning_rate)
    optimizers = dict(learner.optimizers)

    def step(name: str, params: Any, gradient: Any) -> Any:
        change, optimizers[name] = optimizer.update(gradient, optimizers[name], params)
        return optax.apply_updates(params, change)

    if config.variant == "twin":
        mean, log_std = actor_network.apply(learner.actor, next_public)
        next_action, next_log = networks.sample_action(mean, log_std, next_key)
        values = critic_network.apply(learner.target, next_observation, next_action)
        future = jnp.min(values, axis=0) - temperature * next_log
    else:
        future = _value(config).apply(learner.target, next_observation)
    target_value = reward + config.gamma * discount * future

    def critic_loss(params):
        values = critic_network.apply(params, observation, action)
        return jnp.sum(jnp.mean((values - target_value) ** 2, axis=-1)), jnp.mean(values)

    (critic_error, q_mean), gradient = jax.value_and_grad(critic_loss, has_aux=True)(learner.critic)
    critic = step("critic", learner.critic, gradient)

    def actor_loss(params):
        mean, log_std = actor_network.apply(params, public)
        chosen, log_prob = networks.sample_action(mean, log_std, policy_key)
        soft = (
            jnp.min(critic_network.apply(critic, observation, chosen), axis=0)
            - temperature * log_prob
        )
        return -jnp.mean(soft), (soft, -jnp.mean(log_prob))

    (actor_error, (soft, entropy)), gradient = jax.value_and_grad(actor_loss, has_aux=True)(
        learner.actor
    )
    actor = step("actor", learner.actor, gradient)
    metrics = {
        "critic_loss": critic_error,
        "actor_loss": actor_error,
        "q_mean": q_mean,
        "entropy": entropy,
        "temperature": temperature,
    }

    log_temperature = learner.log_temperature
    value = learner.value
    source = critic
    if config.learn_temperature:  # gradient of log_temperature (entropy - target_entropy)
        target_entropy = (
            -float(action.shape[-1]) if config.target_entropy is None else config.target_entropy
        )
        log_temperature = step("temperature", log_temperature, entropy - target_entropy)
    if config.variant == "value":

        def value_loss(params):
            return jnp.mean((_value(config).apply(params, observation) - soft) ** 2)

        metrics["value_loss"], gradient = jax.value_and_grad(value_loss)(value)
        source = value = step("value", value, gradient)

    updates = learner.updates + 1
    due = updates % config.target_every == 0
    target = jax.tree.map(
        lambda old, new: jnp.where(due, (1 - config.tau) * old + config.tau * new, old),
        learner.target,
        source,
    )
    return Learner(actor, critic, value, target, log_temperature, optimizers, key, updates), metrics
