"""Trained policies: their files, the network without flax, their names, and that a solve cannot
suffer from them."""

from __future__ import annotations

import functools
import itertools
import json
from dataclasses import asdict, replace
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import save_file
from support import same_bits, solve

import jaxba
from jaxba import SolveOptions, StepOptions, make_policy, random_scene, scene_like, solve_loop
from jaxba.damping import registry
from jaxba.damping.agent_config import AgentConfig, embedded
from jaxba.damping.features import observation_size
from jaxba.damping.learned import Layer, LearnedPolicy, learned_from
from jaxba.damping.policy_file import FORMAT, LARGEST_FILE, load_policy, save_policy
from jaxba.problem.options import Coordinates, Refinement
from jaxba.solver.names import SolverName, parse_solver
from jaxba.training import sac
from jaxba.training.config import load
from jaxba.typing import InputError

AGENT = AgentConfig(history=2, low=-10.0, high=2.0, first_low=-10.0, descent=50.0)


def random_policy(
    seed: int, agent: AgentConfig = AGENT, width: int = 16, spread: float = 1.0
) -> LearnedPolicy:
    """Two hidden layers of noise; its actions are anything in (-1, 1)."""
    rng = np.random.default_rng(seed)
    sizes = [observation_size(agent), width, width, 2]
    layers = [
        Layer(
            (spread * rng.normal(size=(a, b)) * np.sqrt(2 / a)).astype(np.float32),
            rng.normal(size=b).astype(np.float32) * np.float32(0.3),
        )
        for a, b in itertools.pairwise(sizes)
    ]
    return LearnedPolicy(tuple(layers), agent)


# Files


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 99), st.sampled_from(["scale-free", "paper", "duration"]), st.integers(1, 20))
def test_a_policy_comes_back_from_its_file_bit_by_bit(tmp_path_factory, seed, observation, history):
    path = tmp_path_factory.mktemp("policy") / "some.safetensors"
    policy = random_policy(
        seed,
        AgentConfig(
            observation=observation, history=history, guard="off", refinement=Refinement(trials=2)
        ),
    )
    save_policy(path, policy, {"seed": str(seed)})
    found = load_policy(path)
    assert found.config == policy.config
    assert same_bits(found.layers, policy.layers)
    assert list(path.parent.iterdir()) == [path]  # nothing else is left behind


def test_equal_policies_are_equal_files(tmp_path):
    facts = {name: name.upper() for name in "abcdefgh"}
    for count in range(4):
        save_policy(tmp_path / f"{count}.safetensors", random_policy(3), facts)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1


def test_a_path_is_the_name_of_a_policy(tmp_path):
    path = tmp_path / "mine.safetensors"
    save_policy(path, random_policy(3))
    policy = make_policy(str(path))
    assert isinstance(policy, LearnedPolicy)
    chex.assert_trees_all_equal(policy.layers, random_policy(3).layers, strict=True)


def _tensors(policy: LearnedPolicy) -> dict[str, np.ndarray]:
    return {
        f"layer{k}.{name}": x
        for k, layer in enumerate(policy.layers)
        for name, x in layer._asdict().items()
    }


def _facts(**changes: str) -> dict[str, str]:
    return {"format": FORMAT, "agent": json.dumps(asdict(AGENT)), **changes}


def _agent(**changes) -> dict[str, str]:
    return _facts(agent=json.dumps({**asdict(AGENT), **changes}))


def _changed(name: str, change) -> dict[str, np.ndarray]:
    tensors = _tensors(random_policy(0))
    tensors[name] = np.ascontiguousarray(change(np.array(tensors[name])))
    return tensors


def _with_nan(x: np.ndarray) -> np.ndarray:
    x.flat[3] = np.nan
    return x


def _without(name: str) -> dict[str, np.ndarray]:
    tensors = _tensors(random_policy(0))
    del tensors[name]
    return tensors


GOOD = _tensors(random_policy(0))
BAD = {
    "no format": (GOOD, None, "no policy of jaxba"),
    "other format": (GOOD, _facts(format="pt"), "no policy of jaxba"),
    "later version": (GOOD, _facts(format="jaxba-policy-2"), "jaxba-policy-2"),
    "no agent": (GOOD, {"format": FORMAT}, "agent"),
    "no json": (GOOD, _facts(agent="{"), "cannot be used"),
    "json, but no settings": (GOOD, _facts(agent="[1, 2]"), "cannot be used"),
    "unknown setting": (GOOD, _agent(colour="red"), "colour"),
    "unknown observation": (GOOD, _agent(observation="everything"), "observation"),
    "wrong type": (GOOD, _agent(history="5"), "history"),
    "not a number": (GOOD, _agent(escalate=float("nan")), "escalate"),
    "another observation": (GOOD, _agent(observation="paper"), r"layer 0.*\(31, 16\).*paper"),
    "another history": (GOOD, _agent(history=7), "layer 0"),
    "layers that do not fit": (_changed("layer1.kernel", lambda x: x[:-1]), _facts(), "layer 1"),
    "a bias that does not fit": (_changed("layer0.bias", lambda x: x[:-1]), _facts(), "layer 0"),
    "a flat kernel": (_changed("layer0.kernel", np.ravel), _facts(), "layer 0"),
    "three outputs": (
        {
            **_changed("layer2.bias", lambda x: np.ones(3, np.float32)),
            "layer2.kernel": np.ones((16, 3), np.float32),
        },
        _facts(),
        "2 numbers, not 3",
    ),
    "a weight that is not a number": (
        _changed("layer1.kernel", _with_nan),
        _facts(),
        "layer 1.*finite",
    ),
    "an infinite bias": (
        _changed("layer2.bias", lambda x: x + np.inf),
        _facts(),
        "layer 2.*finite",
    ),
    "whole numbers": (_changed("layer1.kernel", lambda x: x.astype(np.int32)), _facts(), "layer 1"),
    "no bias": (_without("layer1.bias"), _facts(), "layer1.bias"),
    "no tensors": ({}, _facts(), "."),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.usefixtures("unchecked")
def test_a_file_that_is_no_policy_is_refused_in_one_line(tmp_path, case):
    tensors, facts, words = BAD[case]
    path = tmp_path / "bad.safetensors"
    save_file(tensors, path, facts)
    _refused(path, words)


def _refused(path: Path, words: str) -> None:
    for read in (load_policy, lambda path: make_policy(str(path))):
        with pytest.raises(InputError, match=words) as caught:
            read(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_path_that_is_no_file_is_refused_in_one_line(tmp_path):
    _refused(tmp_path / "missing.safetensors", "[Nn]o such file")
    _refused(tmp_path / "missing" / "either.safetensors", "[Nn]o such file")
    folder = tmp_path / "folder.safetensors"
    folder.mkdir()
    _refused(folder, "directory")


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"\x00" * 7, b"\xff" * 64, b"PK\x03\x04" + b"\x00" * 100]
)
def test_a_file_of_another_kind_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "other.safetensors"
    path.write_bytes(content)
    _refused(path, "not a safetensors file")


def test_a_file_cut_short_is_refused_in_one_line(tmp_path):
    path = tmp_path / "some.safetensors"
    save_policy(path, random_policy(0))
    whole = path.read_bytes()
    for share in (0.01, 0.5, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        _refused(path, "not a safetensors file")


def test_a_large_file_is_refused_in_one_line(tmp_path):
    path = tmp_path / "large.safetensors"
    path.write_bytes(bytes(LARGEST_FILE + 1))
    _refused(path, "larger")


def test_a_policy_that_could_not_be_read_again_is_not_written(tmp_path):
    with pytest.raises(InputError, match="more than the 1048576 of a policy file"):
        save_policy(tmp_path / "large.safetensors", random_policy(0, width=512))
    assert not list(tmp_path.iterdir())


def test_every_shipped_policy_can_be_used_and_is_small():
    folder = Path(jaxba.__file__).parent / "policies"
    shipped = sorted(folder.glob("*.safetensors"))
    assert registry.SHIPPED in shipped
    for path in shipped:
        assert path.stat().st_size <= LARGEST_FILE
        assert load_policy(path).config.guard == "hand-over"


# The network


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_its_action_is_that_of_the_trained_actor(layers):
    config = sac.SacConfig(width=24, layers=layers)
    size = observation_size(AGENT)
    actor = sac.init(config, jax.random.key(1), size, 1).actor
    actor = jax.tree.map(
        lambda x, k: x + 0.3 * jax.random.normal(k, x.shape, x.dtype), actor, _keys(actor)
    )
    policy = learned_from(AGENT, actor)
    observations = jax.random.uniform(jax.random.key(2), (40, size), jnp.float32, -2, 2)
    expected = np.asarray(sac.act(config, actor, observations, None))
    found = np.asarray(jax.vmap(policy.act)(observations))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert np.ptp(expected) > 0.1
    by_hand = np.asarray(observations, np.float64)
    for k, layer in enumerate(policy.layers):
        by_hand = by_hand @ np.asarray(layer.kernel, np.float64) + np.asarray(
            layer.bias, np.float64
        )
        by_hand = by_hand if k == layers else np.maximum(by_hand, 0)
    np.testing.assert_allclose(found, np.tanh(by_hand[:, :1]), rtol=1e-4, atol=1e-5)


def _keys(tree):
    leaves, shape = jax.tree.flatten(tree)
    return jax.tree.unflatten(shape, list(jax.random.split(jax.random.key(0), len(leaves))))


# Names


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """A policy with embedded iterations in the place of the shipped one, whose own file is not
    looked at."""
    file = tmp_path / "shipped.safetensors"
    save_policy(file, random_policy(0, replace(AGENT, refinement=Refinement(2, trials=3))))
    monkeypatch.setattr(registry, "SHIPPED", file)
    return file


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("learned", SolverName("learned", None)),
        ("learned+refine0", SolverName("learned", 0)),
        ("learned+refine3", SolverName("learned", 3)),
        ("learned@float32", SolverName("learned", None, "float32")),
        ("learned+refine3@mixed", SolverName("learned", 3, "mixed")),
        ("ceres+embedded", SolverName("ceres", None)),
        ("classic:0.03+embedded@float32", SolverName("classic:0.03", None, "float32")),
    ],
)
@pytest.mark.usefixtures("shipped")
def test_names_of_learned_policies_read_back_as_themselves(text, name):
    assert parse_solver(text) == name
    assert str(name) == text
    assert parse_solver(str(name)) == name
    assert parse_solver(f"lm+{text}") == name


@pytest.mark.usefixtures("shipped")
def test_embedded_is_what_a_learned_policy_has_anyway():
    assert parse_solver("learned+embedded") == SolverName("learned", None)


@pytest.mark.parametrize("folder", [".", "with space", "x+y", "v@1", "lm+"])
def test_the_path_of_a_policy_is_a_name(tmp_path, folder):
    path = tmp_path / folder / "mine.safetensors"
    path.parent.mkdir(exist_ok=True)
    save_policy(path, random_policy(5))
    for ending, refine in (("", None), ("+refine0", 0), ("+refine4", 4)):
        name = parse_solver(f"{path}{ending}")
        assert name == SolverName(str(path), refine)
        assert parse_solver(str(name)) == name
        chex.assert_trees_all_equal(name.build()[0].layers, random_policy(5).layers, strict=True)
    assert parse_solver(f"{path}@float32").dtype == "float32"


def test_a_name_says_with_which_embedded_iterations_a_step_is_made(shipped):
    policy, options = parse_solver("learned").build()
    chex.assert_trees_all_equal(policy.layers, load_policy(shipped).layers, strict=True)
    coordinates = Coordinates()
    assert options == SolveOptions(refinement=Refinement(2, trials=3), coordinates=coordinates)
    policy, options = parse_solver("learned+refine0").build()
    chex.assert_trees_all_equal(policy.layers, load_policy(shipped).layers, strict=True)
    assert options == SolveOptions(refinement=Refinement(), coordinates=coordinates)
    assert parse_solver("learned+refine3").build()[1] == replace(
        options, refinement=Refinement(points=3)
    )
    options = parse_solver("ceres+refine3").build()[1]
    assert options == SolveOptions(refinement=Refinement(points=3), coordinates=Coordinates())
    policy, options = parse_solver("ceres+embedded").build()
    assert options.step_options(policy) == embedded().step_options(StepOptions())


def test_the_shipped_policy_is_wired_as_the_preset_of_its_files_name():
    assert load_policy(registry.SHIPPED).config == load(registry.SHIPPED.stem).game.agent


def test_the_shipped_policy_chooses_lambda_alone():
    policy, options = parse_solver("learned").build()
    assert options.step_options(policy) == StepOptions()


# Solves


@functools.cache
def scene(seed: int):
    """Scenes of one shape: one program for all."""
    return random_scene(scene_like("paper"), seed)


@pytest.mark.slow
def test_another_policy_of_the_same_shape_compiles_nothing():
    solve(scene(0), random_policy(1), max_iterations=40)
    programs = solve_loop.__wrapped__._cache_size()
    first = solve(scene(0), random_policy(1), max_iterations=40)
    second = solve(scene(0), random_policy(2), max_iterations=40)
    assert solve_loop.__wrapped__._cache_size() == programs
    assert not np.array_equal(first.history.damping[:1], second.history.damping[:1])


@pytest.mark.slow
def test_the_first_lambda_of_a_solve_is_the_network_s():
    policy = random_policy(1)
    flat = LearnedPolicy(
        (
            *policy.layers[:-1],
            Layer(0 * policy.layers[-1].kernel, np.float32([np.arctanh(0.5), 0])),
        ),
        AGENT,
    )
    found = solve(scene(0), flat, max_iterations=40)
    np.testing.assert_allclose(
        np.log10(found.history.damping[0]), AGENT.low + 0.75 * (AGENT.high - AGENT.low), rtol=1e-5
    )


@pytest.mark.parametrize("seed", range(6))
def test_no_policy_makes_a_solve_worse_than_its_start(seed):
    for policy in (random_policy(seed), random_policy(seed, spread=5.0)):
        found = solve(scene(seed), policy, max_iterations=40)
        assert found.final_cost <= found.initial_cost
        assert (np.diff(np.concatenate([[found.initial_cost], found.history.cost])) <= 0).all()
