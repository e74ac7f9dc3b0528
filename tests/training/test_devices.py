"""Training on several devices is that on one, to rounding, and goes on on any other number of them."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest
import toys
from tiny_game import KIND, RULES

from jaxba.game.env import make_game
from jaxba.game.random_scenes import make_scenes
from jaxba.game.scene_bank import Bank, info_of, initial_costs
from jaxba.training import checkpoint, driver, log
from jaxba.training.config import TrainConfig
from jaxba.training.driver import Hooks, Outcome, TrainError, prepare_folder
from jaxba.training.placement import Placement
from jaxba.training.sac import SacConfig
from jaxba.training.train_loop import LoopConfig, LoopState, run_agents, start_agents, state_shares

DEVICES = 2
ENVS = 4
CONFIG = TrainConfig(
    chunks=2,
    evaluate_every=9,
    checkpoint_every=1,
    envs=(ENVS,),
    sac=SacConfig(width=8, batch=16),
    loop=LoopConfig(replay_capacity=300, warmup_steps=16, steps_per_chunk=4),
)
CLOCKS = ("wall_s", "chunk_s", "steps_per_s", "updates_per_s", "cpu_per_wall", "evaluate_s")


@functools.cache
def game():
    """On scenes that nobody has solved: a third of the cost counts as success."""
    scenes = make_scenes(KIND, jax.random.key(5), 16)
    initial = initial_costs(KIND, scenes)
    bank = Bank(scenes, initial, initial / 3, info_of(KIND, scenes, initial, 4), jax.numpy.full(16, 4.0))
    return make_game(RULES, [KIND], [bank], [ENVS])


def run(folder: Path, devices: int, config: TrainConfig = CONFIG, env=None, resume: bool = False, **hooks) -> Outcome:
    score = lambda actor: {"training/score": float(np.sum(actor["params"]["MLP_0"]["Dense_2"]["bias"]))}
    prepare_folder(folder, config, resume)
    return driver.train(config, env or game(), score, folder, Hooks(**hooks), jax.devices()[:devices])


def arrays(outcome: Outcome) -> dict[str, np.ndarray]:
    return checkpoint.pack(outcome.state)


def curve(folder: Path) -> list[dict]:
    return [{k: v for k, v in row.items() if k not in CLOCKS and v is not None} for row in log.read(folder)]


def close(one: LoopState, other: LoopState) -> None:
    first, second = checkpoint.pack(one), checkpoint.pack(other)
    assert list(first) == list(second)
    for name, x in first.items():
        np.testing.assert_allclose(second[name], x, rtol=2e-3, atol=1e-5, err_msg=name)


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> tuple[Path, Outcome]:
    folder = tmp_path_factory.mktemp("devices") / "one"
    return folder, run(folder, 1)


@pytest.mark.slow
def test_environments_on_two_devices_are_those_on_one(alone, tmp_path):
    outcome = run(tmp_path / "two", DEVICES)
    close(outcome.state, alone[1].state)
    for row, expected in zip(curve(tmp_path / "two"), curve(alone[0]), strict=True):
        assert row == pytest.approx(expected, rel=1e-3, abs=1e-5)
    episodes = outcome.state.env_state.episodes[0].state.cost
    assert [x.data.shape for x in episodes.addressable_shards] == [(1, ENVS // 2)] * 2


@pytest.mark.slow
def test_a_run_goes_on_on_another_number_of_devices_and_back(alone, tmp_path):
    folder, stop = tmp_path / "run", lambda: True
    assert not run(folder, DEVICES, stop=stop).finished
    before, _ = checkpoint.restore(folder / driver.CHECKPOINTS, 1)
    close(run(folder, 1, resume=True).state, alone[1].state)
    longer = run(folder, DEVICES, dataclasses.replace(CONFIG, chunks=3), resume=True)
    assert arrays(longer)["env_steps"] == 16 + 3 * CONFIG.loop.steps_per_chunk * ENVS
    # the same checkpoint on as many devices as before: bit for bit
    again = tmp_path / "again"
    assert not run(again, DEVICES, stop=stop).finished
    after, _ = checkpoint.restore(again / driver.CHECKPOINTS, 1)
    assert {name: x.tobytes() for name, x in before.items()} == {name: x.tobytes() for name, x in after.items()}
    one, two = run(again, DEVICES, resume=True), run(tmp_path / "straight", DEVICES)
    assert {name: x.tobytes() for name, x in arrays(one).items()} == {
        name: x.tobytes() for name, x in arrays(two).items()
    }


@pytest.mark.slow
def test_agents_on_devices_of_their_own_are_those_on_one_and_need_not_talk():
    config = dataclasses.replace(CONFIG, seeds=4)
    placement = Placement(jax.devices()[:DEVICES])
    arguments = config.sac, config.loop, placement.divide(config, toys.SEEN)
    fresh = start_agents(*arguments, jax.random.split(jax.random.key(0), 4))
    spread = placement.spread(fresh, state_shares(toys.SEEN))
    assert collectives(*arguments, spread, placement.mesh) == {}
    two, curves = run_agents(*arguments, spread, placement.mesh)
    one, expected = run_agents(*arguments, fresh)
    close(two, one)
    for name, values in curves.items():
        np.testing.assert_allclose(values, expected[name], rtol=1e-3, atol=1e-5, err_msg=name)
    assert [x.data.shape[0] for x in two.replay.rows.addressable_shards] == [2, 2]


@pytest.mark.slow
def test_devices_that_share_environments_talk_once_in_a_step_and_twice_in_an_update():
    placement = Placement(jax.devices()[:DEVICES])
    arguments = CONFIG.sac, CONFIG.loop, placement.divide(CONFIG, game())
    keys = jax.random.split(jax.random.key(0), 1)
    state = jax.eval_shape(lambda: start_agents(*arguments, keys, placement.mesh))
    assert collectives(*arguments, state, placement.mesh) == {"all_gather": 1, "all_reduce": 2}


def collectives(*arguments) -> dict[str, int]:
    """How often each stands in the program of a chunk, whose steps and updates are bodies of loops."""
    kinds = "all_gather|all_reduce|all_to_all|collective_permute|collective_broadcast|reduce_scatter"
    return dict(Counter(re.findall(rf"stablehlo\.({kinds})\b", run_agents.lower(*arguments).as_text())))


def test_what_cannot_be_divided_is_one_line(tmp_path):
    for change, message in (({"envs": (5,)}, "envs"), ({"sac": SacConfig(batch=17)}, "sac.batch")):
        with pytest.raises(TrainError, match=f"{message} must be a multiple of the 2 devices"):
            run(tmp_path / message, DEVICES, dataclasses.replace(CONFIG, **change))
