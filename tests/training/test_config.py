"""Configurations of training: presets, files, overrides, and what is refused and how."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from jaxba import settings
from jaxba.damping.agent_config import AgentConfig
from jaxba.game.random_scenes import SceneClass
from jaxba.problem.options import Refinement, StepOptions
from jaxba.settings import configurations
from jaxba.training.config import SettingsError, TrainConfig, load
from jaxba.training.sac import SacConfig


def written(folder: Path, text: str) -> str:
    path = folder / "some.yaml"
    path.write_text(text)
    return str(path)


def refused(*overrides: str, name: str = "default") -> str:
    with pytest.raises(SettingsError) as error:
        load(name, overrides)
    assert "\n" not in str(error.value)
    return str(error.value)


# Presets


def test_the_presets_are_those_that_the_documentation_names():
    assert set(configurations.names("train")) == {"default", "fast", "paper", "paper-tuned"}


@pytest.mark.parametrize("name", configurations.names("train"))
def test_what_is_written_reads_as_the_same_configuration(name, tmp_path):
    found = load(name)
    assert load(written(tmp_path, settings.to_yaml(found))) == found
    assert hash(found) == hash(load(name))


def test_the_default_is_for_lambda_alone_on_plain_steps():
    config = load("default")
    assert config.game.agent.step_options(config.step_options) == StepOptions()


def test_a_file_may_extend_a_preset_and_overrides_win_over_both(tmp_path):
    path = written(
        tmp_path, "extends: default\nseed: 3\ngame: {agent: {refinement: {trials: 2}}}\n"
    )
    found = load(path, ["seed=4"])
    assert found == load("default", ["seed=4", "game.agent.refinement.trials=2"])


def test_the_preset_of_the_paper_is_the_papers_setting():
    found = load("paper")
    assert found.sac == SacConfig(
        variant="value",
        width=256,
        actor_layers=3,
        layer_norm=False,
        tau=1.0,
        target_every=5,
        initial_temperature=1.0,
        learn_temperature=False,
        log_std_min=-20.0,
        privileged=False,
    )
    assert found.bank.kind == SceneClass(10, 10, "paper")
    agent = found.game.agent
    assert (agent.observation, agent.guard, agent.refinement) == ("paper", "off", Refinement())
    assert (agent.low, agent.high, agent.history) == (-10.0, 2.0, 5)
    assert agent.step_options(StepOptions()) == StepOptions()  # plain LM steps
    assert found.step_options.linear_solver == "cg"
    assert found.step_options.truncated.forcing == 0  # no policy takes its steps for inexact ones
    assert (found.game.reward, found.game.bonus, found.loop.warmup_steps) == ("constant", 10.0, 500)
    assert found.game.max_iterations == 100


def test_the_tuned_preset_has_the_papers_game_state_and_networks():
    paper = load("paper")
    tuned = load("paper-tuned")
    assert tuned.bank == paper.bank
    assert tuned.step_options == load("paper", ["linear_solver=explicit"]).step_options
    assert tuned.game == dataclasses.replace(paper.game, scale=tuned.game.scale)
    shape = ("variant", "width", "layers", "actor_layers", "layer_norm", "privileged", "gamma")
    assert all(getattr(tuned.sac, name) == getattr(paper.sac, name) for name in shape)
    assert tuned.sac.learn_temperature


def test_an_empty_file_is_the_defaults_of_the_classes(tmp_path):
    assert load(written(tmp_path, "# nothing\n")) == TrainConfig()


# Overrides


def test_overrides_win_over_the_file_and_reach_every_level():
    found = load(
        "default", ["seed=7", "sac.width=128", "game.agent.history=3", "sac.learning_rate=3e-4"]
    )
    assert (found.seed, found.sac.width, found.game.agent.history) == (7, 128, 3)
    assert found.sac.learning_rate == 3e-4
    assert found.sac == dataclasses.replace(load("default").sac, width=128, learning_rate=3e-4)


def test_overrides_are_yaml():
    found = load(
        "default",
        [
            "bank.kind={cameras: 8, points: 30, family: wide}",
            "bank.scenes=10",
            "sac.target_entropy=null",
            "sac.learn_temperature=false",
            "sac.gamma=1",
        ],
    )
    assert found.bank.kind == SceneClass(8, 30)
    assert (found.bank.scenes, found.sac.target_entropy, found.sac.learn_temperature) == (
        10,
        None,
        False,
    )
    assert isinstance(found.sac.gamma, float)


def test_the_word_off_is_a_guard_and_no_truth_value(tmp_path):
    assert load("default", ["game.agent.guard=off"]).game.agent.guard == "off"
    assert load(written(tmp_path, "game: {agent: {guard: off}}")).game.agent == AgentConfig(
        guard="off"
    )


# What is refused


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sac.lerning_rate=1", "unknown key sac.lerning_rate; did you mean learning_rate"),
        ("zzz=1", "unknown key zzz; known: seed, seeds"),
        ("lop.updates_per_step=1", "did you mean loop"),
        ("seed.deep=1", "seed has no parts"),
        ("bank.kind={camras: 6}", "unknown key bank.kind.camras; did you mean cameras"),
        ("sac=3", "sac must be a mapping, is 3"),
        ("sac.width=1.5", "sac.width must be a whole number, is 1.5"),
        ("sac.width=true", "sac.width must be a whole number, is True"),
        ("sac.gamma=true", "sac.gamma must be a number, is True"),
        ("sac.gamma=.inf", "sac.gamma must be a number, is inf"),
        ("sac.gamma=much", "sac.gamma must be a number, is 'much'"),
        ("sac.layer_norm=1", "sac.layer_norm must be true or false, is 1"),
        ("method=64", "method must be one of lm, stba, deeplm, is 64"),
        ("envs=[64]", "envs must be a whole number, is [64]"),
        ("bank.problems=a", "bank.problems must be a list, is 'a'"),
        ("bank.problems=[1]", "bank.problems[0] must be text, is 1"),
        (
            "game.reward=fun",
            "game.reward must be one of constant, clock, reduction, reversed, is 'fun'",
        ),
        ("sac.width=[", "not YAML"),
        ("sac.width", "must be key=value"),
        ("chunks=0", "chunks must be at least 1, is 0"),
        ("seed=-1", "seed must lie in"),
        ("envs=0", "envs must be at least 1"),
        ("envs=10000000", "loop.replay_capacity must be at least the 10000000 environments"),
        ("loop.replay_capacity=0", "loop: replay_capacity must be at least 1"),
        ("game.agent.history=30", "game.agent: history must be 1 to 20"),
        ("loop.replay_capacity=3000000000", "loop: replay_capacity must be at most 2147483647"),
        (
            "sac.width=512",
            "sac.width 512 with sac.layers 2 makes a policy of 1181704 bytes, more than the "
            "1032192",
        ),
        ("game.agent.first_low=5", "game.agent: first_low must be at most high, 2.0, is 5"),
        ("sac.width=0", "sac.width must be at least 1"),
        ("sac.gamma=1.5", "sac.gamma must lie in (0, 1]"),
        ("sac.learning_rate=0", "sac.learning_rate must be positive"),
        ("sac.log_std_min=1", "sac.log_std_min must be negative"),
        ("bank.refine_points=-1", "bank: refine_points must be at least 0, is -1"),
        ("game.tolerance=100", "game: tolerance must be below 1, is 100"),
        ("game.bonus=-5", "game: bonus must not be negative, is -5"),
    ],
)
def test_impossible_settings_are_one_line_that_names_the_key(override, message):
    assert message in refused(override)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1\n- 2\n", "must be a mapping of settings to their values"),
        ("seed: 1\nsac: [\n", "line 3: not YAML"),
        ("seed: 1\nsac:\n  with: 3\n", "unknown key sac.with; did you mean width"),
    ],
)
def test_a_bad_file_is_named(text, message, tmp_path):
    path = written(tmp_path, text)
    found = refused(name=path)
    assert found.startswith(path)
    assert message in found


def test_files_that_are_not_there_or_no_text(tmp_path):
    known = ", ".join(configurations.names("train"))
    assert (
        refused(name="fastest")
        == f"no configuration 'fastest'; known: {known}, or the path of a file"
    )
    assert "No such file" in refused(name=str(tmp_path / "none.yaml"))
    assert "directory" in refused(name=f"{tmp_path}/").lower()
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    assert "not text" in refused(name=str(tmp_path / "binary.yaml"))


def test_differences_name_the_fields():
    one = load("default")
    other = load("default", ["seed=5", "game.agent.history=3"])
    assert settings.differences(one, one) == []
    assert settings.differences(one, other) == ["seed", "game.agent.history"]
