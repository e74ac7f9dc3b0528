"""Training as one compiled program: act, step, store, sample and update in one scan.

No data leaves the device within a chunk, which compiles once; the driver evaluates and saves
between chunks."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.game.protocol import Environment, Step
from jaxba.problem.options import check_count
from jaxba.runtime.jit import jit
from jaxba.training import replay as ring
from jaxba.training import sac as agent
from jaxba.training.replay import Replay, Transition
from jaxba.training.sac import Learner, SacConfig


@dataclass(frozen=True)
class LoopConfig:
    """Sizes of the training loop. Hashable: static in compiled programs."""

    replay_capacity: int = 100_000
    """Transitions in the replay buffer; the oldest are overwritten first."""

    warmup_steps: int = 500
    """Environment steps, over all environments, with actions of `Environment.demonstrate` before
    the agent acts. Rounded up to whole vector steps. Source of the default: Belder et al. 2023."""

    updates_per_step: int = 1
    """Gradient updates after each vector step, that is, of all environments."""

    steps_per_chunk: int = 1000
    """Vector steps in one call of `run_chunk`."""

    def __post_init__(self) -> None:
        """Checks that all counts are positive and fit 32 bits."""
        for name in ("replay_capacity", "warmup_steps", "updates_per_step", "steps_per_chunk"):
            check_count(name, getattr(self, name), 1)


class LoopState(NamedTuple):
    """Complete state of a run, from which it continues bitwise identically."""

    learner: Learner
    replay: Replay
    env_state: Any
    observation: Float[Array, "envs features"]  # for the next action
    key: Array
    env_steps: Int[Array, ""]  # over all environments, warm-up included
    updates: Int[Array, ""]


def _play(
    env: Environment, state: LoopState, action: Float[Array, "envs actions"]
) -> tuple[LoopState, Step]:
    """One vector step, stored in the buffer. A truncated episode has discount 1 and its true last
    observation."""
    env_state, step = env.step(state.env_state, action)
    # refuses an environment whose shapes are not those of the protocol, when it is traced: the
    # buffer would broadcast
    chex.assert_shape(
        [step.observation, step.final_observation], (env.num_envs, env.observation_size)
    )
    chex.assert_shape(
        [step.reward, step.terminated, step.truncated, *step.metrics.values()], (env.num_envs,)
    )
    transitions = Transition(
        state.observation,
        action,
        step.reward,
        step.final_observation,
        1.0 - jnp.asarray(step.terminated, jnp.float32),
    )
    after = state._replace(
        replay=ring.add(state.replay, transitions),
        env_state=env_state,
        observation=jnp.asarray(step.observation, jnp.float32),
        env_steps=state.env_steps + env.num_envs,
    )
    return after, step


@functools.partial(jit, static_argnames=("sac", "loop"))
def start(sac: SacConfig, loop: LoopConfig, env: Environment, key: Array) -> LoopState:
    """An untrained agent, and a replay buffer with `warmup_steps` demonstrated transitions. Arrays
    of `env`, a pytree, are traced. The same key gives bitwise identical results on the same
    machine."""
    key, learner_key, reset_key, warmup_key = jax.random.split(key, 4)
    env_state, observation = env.reset(reset_key)
    chex.assert_shape(observation, (env.num_envs, env.observation_size))

    def zero():
        return jnp.zeros((), jnp.int32)

    state = LoopState(
        learner=agent.init(
            sac, learner_key, env.observation_size, env.action_size, env.privileged_size
        ),
        replay=ring.init(loop.replay_capacity, env.observation_size, env.action_size),
        env_state=env_state,
        observation=jnp.asarray(observation, jnp.float32),
        key=key,
        env_steps=zero(),
        updates=zero(),
    )

    def body(state: LoopState, key: Array) -> tuple[LoopState, None]:
        action = jnp.asarray(env.demonstrate(state.env_state, key), jnp.float32)
        return _play(env, state, action)[0], None

    steps = -(-loop.warmup_steps // env.num_envs)
    return jax.lax.scan(body, state, jax.random.split(warmup_key, steps))[0]


@functools.partial(jit, static_argnames=("sac", "loop"), donate_argnames=("state",))
def run_chunk(
    sac: SacConfig, loop: LoopConfig, env: Environment, state: LoopState
) -> tuple[LoopState, dict[str, Float[Array, ""]]]:
    """`steps_per_chunk` vector steps of every environment, each followed by `updates_per_step`
    updates. The state is donated; its memory is reused for the result. Returns the state after the
    chunk, and means over it: those of `sac.update`; `reward` of a step; `action_mean`,
    `action_std`; `action_spread`, the standard deviation of the mean action over replayed states;
    `q_bias`, what the critics expected more than what came, entropy included, in episodes that were
    terminated (NaN if none was); `episodes`, the number of episodes that ended, and `episode/NAME`,
    the mean of a metric of the environment over them (0 if none ended); `dropped`, transitions with
    numbers that are not finite."""

    def body(state: LoopState, _: None) -> tuple[LoopState, tuple[Any, ...]]:
        key, act_key, sample_key = jax.random.split(state.key, 3)
        action, value, bonus = agent.act_with_value(sac, state.learner, state.observation, act_key)
        state, step = _play(env, state._replace(key=key), action)

        def learn(learner, key):
            return agent.update(sac, learner, ring.sample(state.replay, key, sac.batch))

        keys = jax.random.split(sample_key, loop.updates_per_step)
        learner, learned = jax.lax.scan(learn, state.learner, keys)
        state = state._replace(learner=learner, updates=state.updates + loop.updates_per_step)
        means = {name: jnp.mean(values) for name, values in learned.items()}
        means["reward"] = jnp.mean(jnp.asarray(step.reward, jnp.float32))
        means["action_mean"] = jnp.mean(action)
        means["action_square"] = jnp.mean(action**2)
        ended = step.terminated | step.truncated
        sums = {
            name: jnp.sum(jnp.where(ended, x, 0), dtype=jnp.float32)
            for name, x in step.metrics.items()
        }
        judged = _Judged(
            value, bonus, jnp.asarray(step.reward, jnp.float32), step.terminated, ended
        )
        return state, (means, sums, jnp.sum(ended, dtype=jnp.float32), judged)

    dropped = state.replay.dropped
    state, (means, sums, ended, judged) = jax.lax.scan(
        body, state, None, length=loop.steps_per_chunk
    )
    metrics = {name: jnp.mean(values) for name, values in means.items()}
    variance = metrics.pop("action_square") - metrics["action_mean"] ** 2
    metrics["action_std"] = jnp.sqrt(jnp.maximum(variance, 0))
    seen = ring.sample(state.replay, jax.random.fold_in(state.key, 0), sac.batch).observation
    metrics["action_spread"] = jnp.mean(
        jnp.std(agent.act(sac, state.learner.actor, seen, None), axis=0)
    )
    metrics["q_bias"] = _bias(judged, sac.gamma)
    metrics["dropped"] = jnp.asarray(state.replay.dropped - dropped, jnp.float32)
    metrics["episodes"] = jnp.sum(ended)
    for name, values in sums.items():
        metrics[f"episode/{name}"] = jnp.sum(values) / jnp.maximum(metrics["episodes"], 1)
    return state, metrics


class _Judged(NamedTuple):
    """What the critics said of the actions of a chunk, and what came of them: (steps, envs)
    each."""

    value: Array
    bonus: Array  # for the entropy of the action
    reward: Array
    terminated: Array
    ended: Array


def _bias(judged: _Judged, gamma: float) -> Float[Array, ""]:
    """Mean value less the return that followed, over the actions whose episode was terminated
    within the chunk."""

    def back(
        after: tuple[Array, Array], one: _Judged
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        future, known = after
        found = one.reward + gamma * jnp.where(one.ended, 0, future)
        known = one.terminated | (known & ~one.ended)
        return (found + one.bonus, known), (jnp.where(known, one.value - found, 0), known)

    zero = jnp.zeros_like(judged.reward[0])
    _, (errors, known) = jax.lax.scan(back, (zero, zero > 0), judged, reverse=True)
    return jnp.sum(errors) / jnp.sum(known, dtype=jnp.float32)


@functools.partial(jit, once=True, static_argnames=("sac", "loop"))
def start_agents(sac: SacConfig, loop: LoopConfig, env: Environment, keys: Array) -> LoopState:
    """`start` for an agent a key; they share the environment's scenes, and are the state's first
    axis."""
    return jax.vmap(lambda key: start(sac, loop, env, key))(keys)


@functools.partial(jit, static_argnames=("sac", "loop"), donate_argnames=("state",))
def run_agents(
    sac: SacConfig, loop: LoopConfig, env: Environment, state: LoopState
) -> tuple[LoopState, dict[str, Float[Array, " agents"]]]:
    """`run_chunk` for the agents of `start_agents`; the state is donated, too."""
    return jax.vmap(lambda one: run_chunk(sac, loop, env, one))(state)
