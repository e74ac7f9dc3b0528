"""Padded sizes: the same solve to rounding, one program for all problems of a cell of the grid."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from hypothesis import given, settings
from hypothesis import strategies as st
from support import solve
from test_layout import (
    blocks_by_brute_force,
    blocks_by_layout,
    problem_of,
    rows_of,
    rows_of_problem,
    sum_by_levels,
    sum_by_ranks,
)

from jaxba import (
    Ceres,
    Lenses,
    Loss,
    SolveOptions,
    StepOptions,
    Tolerances,
    build_layout,
    hold,
    prepare,
    random_scene,
    solve_loop,
)
from jaxba.lm.step import state_of
from jaxba.paper.subproblem import sub_problem
from jaxba.problem.options import Refinement
from jaxba.scenes import SceneConfig
from jaxba.structure import covisibility
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.padding import (
    COARSE_OBSERVATIONS,
    MAX_CAMERAS,
    MAX_PAIRS,
    MIN_OBSERVATIONS,
    PAIRS_PER_SLOT,
    POINT_CHUNK,
    POINTS_PER_CHUNK,
    Capacity,
    capacity_of,
    padded_parameters,
)
from jaxba.structure.segment_sums import point_sum
from jaxba.structure.sum_trees import Room, prefix_levels, sum_tree

SMALL = Capacity(cameras=8, points=64, observations=512, pairs=4096)


def windows(count: int, cameras: int = 10) -> list:
    """Neighbouring cameras of a sequence."""
    scene = random_scene(
        SceneConfig(40, 900, 3600, max_depth=4.0, gap_share=0.1, revisit_share=0.0), 0
    )
    return [
        sub_problem(scene, np.arange(first, first + cameras))
        for first in np.linspace(0, 30, count).astype(int)
    ]


def mates(dense: bool) -> tuple:
    """Two problems of one cell that differ in every size."""
    if dense:
        one = support.tiny()
        other = sub_problem(support.tiny(), np.arange(5))
        extra = np.vstack([other.points, np.ones((3, 3))])  # nobody observes these
        other = other.replace(points=extra)
    else:
        fewer = [sub_problem(window, np.arange(9)) for window in windows(31)]
        others = [
            other.replace(cameras=np.vstack([other.cameras, np.ones((2, 9))])) for other in fewer
        ]

        def differ(a, b):
            return a.num_points != b.num_points and a.num_observations != b.num_observations

        one, other = next(
            (a, b)
            for a in windows(31)
            for b in others
            if capacity_of(a) == capacity_of(b) and differ(a, b)
        )
    assert capacity_of(one) == capacity_of(other)
    sizes = [(p.num_cameras, p.num_points, p.num_observations) for p in (one, other)]
    assert all(a != b for a, b in zip(*sizes, strict=True))
    assert all(
        (build_layout(p, capacity=capacity_of(p)).grid is not None) == dense for p in (one, other)
    )
    return one, other


def shapes(tree) -> list:
    """What a compiled program depends on."""
    return [jax.tree.structure(tree), *((x.shape, x.dtype) for x in jax.tree.leaves(tree))]


def stepwise(problem, policy="ceres", options=None, **settings):
    """A solve step by step: the compiled step is shared by policies."""
    return solve(problem, policy, options, callback=lambda record: None, **settings)


BATCHES = st.sampled_from([3, 40, 2048])
"""Chunks of pairs that are multiplied at once; with the last of these small problems have one
batch."""

# The grid


@pytest.mark.parametrize(
    ("count", "room"),
    [
        (1, 8),
        (8, 8),
        (9, 32),
        (33, 48),
        (49, 64),
        (65, 96),
        (97, 128),
    ],
)
def test_cameras_are_rounded_up_to_the_next_size(count, room):
    assert capacity_of(problem_of(np.full(3, 1), count, seed=0)) == Capacity(room, 256, 1024, 6144)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 3000), st.integers(1, 9))
def test_slots_are_doubled_at_most_and_many_rounded_up_by_a_quarter(points, length):
    """Points of equal tracks need as many slots as the next even number of observations, and one
    chunk is empty."""
    problem = problem_of(np.full(points, length), 9, seed=0)
    needed = (length + length % 2) * points + 2
    found = capacity_of(problem).observations
    assert needed <= found
    most = 5 / 4 if found > COARSE_OBSERVATIONS else 2
    assert found < needed * most or found == MIN_OBSERVATIONS


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 40), st.integers(1, 3000), st.integers(0, 50))
def test_a_capacity_holds_its_problem_and_no_more_than_the_next_size(
    seed, cameras, points, duplicates
):
    rng = np.random.default_rng(seed)
    problem = problem_of(
        np.append(1, rng.integers(0, min(cameras, 9) + 1, points)), cameras, seed, duplicates
    )
    found = capacity_of(problem)
    layout = build_layout(problem, grid=False)
    seen = support.by_camera(layout, layout.slot_mask)
    listed = np.sum(seen[layout.pairs.left] & seen[layout.pairs.right])
    order = ObservationOrder.of(problem)
    assert found.holds(order)
    smaller = replace(found, observations=found.observations // 2)
    assert not smaller.holds(order) or found.observations == 1024
    rooms = [int(share * found.observations / POINT_CHUNK) for share in POINTS_PER_CHUNK]
    assert found.points == min(room for room in rooms if room >= problem.num_points)
    least = found.observations * PAIRS_PER_SLOT
    assert listed <= found.pairs
    assert found.pairs < 2 * listed or found.pairs == least
    assert problem.num_cameras <= found.cameras <= max(8, 32 * problem.num_cameras // 9)


# Layouts


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.integers(0, 40), min_size=1, max_size=12),
    st.sampled_from([1, 3, 8, 16]),
    st.integers(0, 10**6),
)
def test_a_tree_with_room_sums_every_target_once_in_one_shape(counts, width, seed):
    counts = np.array(counts)
    rng = np.random.default_rng(seed)
    items = rng.permutation(counts.sum())
    empty = int(counts.sum())
    rows = np.append(rng.integers(-1000, 1000, counts.sum()), 0)
    expected = np.zeros(len(counts), int)
    np.add.at(expected, np.repeat(np.arange(len(counts)), counts), rows[items])
    room = Room(500, 45)
    levels = sum_tree(items, counts, empty, width, room)
    assert np.array_equal(sum_by_levels(rows, levels), expected)
    nothing = sum_tree(np.zeros(0, int), np.zeros(len(counts), int), empty, width, room)
    assert [level.shape for level in levels] == [level.shape for level in nothing]


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.integers(0, 40), min_size=1, max_size=12),
    st.sampled_from([0, 1]),
    st.integers(0, 10**6),
)
def test_ranks_sum_every_target_once(counts, first, seed):
    counts = np.sort(counts)[::-1]
    rng = np.random.default_rng(seed)
    items = rng.permutation(counts.sum())
    empty = int(counts.sum())
    rows = np.append(rng.integers(-1000, 1000, counts.sum()), 0)
    expected = np.zeros(len(counts), int)
    start = np.cumsum(counts) - counts
    rank = np.arange(len(items)) - np.repeat(start, counts)
    np.add.at(
        expected,
        np.repeat(np.arange(len(counts)), counts)[rank >= first],
        rows[items[rank >= first]],
    )
    levels = prefix_levels(items, counts, empty, Room(500, 45), first)
    found = sum_by_ranks(rows, levels)
    assert np.array_equal(found, expected[: len(found)])
    assert not expected[len(found) :].any()


@pytest.mark.parametrize("most", [3, 9, 33])
def test_ranks_of_usual_counts_have_one_shape(most):
    """Counts that fall with the square of the rank; and some that do not, which get longer
    prefixes."""
    usual = [np.sort(np.minimum(most, np.arange(200) // step))[::-1] for step in (40, 50)]

    def shapes_of(counts):
        return [
            level.shape
            for level in prefix_levels(np.arange(counts.sum()), counts, 2000, Room(2000, 33))
        ]

    few = np.zeros(200, int)
    assert shapes_of(usual[0]) == shapes_of(usual[1]) == shapes_of(few)
    few[:60] = 33
    assert [b >= a for (_, a), (_, b) in zip(shapes_of(usual[0]), shapes_of(few), strict=True)] == [
        True
    ] * 7
    assert shapes_of(few) != shapes_of(usual[0])


def test_ranks_without_room_are_refused():
    with pytest.raises(ValueError, match="no room for 5 items, 3 of one target"):
        prefix_levels(np.arange(5), np.array([3, 2]), 5, Room(8, 2))


def test_a_tree_without_room_is_refused():
    with pytest.raises(ValueError, match="no room for 5 items, 3 of one target"):
        sum_tree(np.arange(5), np.array([3, 2]), 5, 2, Room(8, 2))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 8), st.integers(1, 60), st.integers(0, 6), BATCHES)
def test_a_padded_layout_holds_every_observation_once_and_sums_it_right(
    seed, cameras, points, duplicates, batch
):
    rng = np.random.default_rng(seed)
    problem = problem_of(
        np.append(1, rng.integers(0, cameras + 1, points)), cameras, seed, duplicates
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(covisibility, "PAIR_BATCH", batch)
        layout = build_layout(problem, grid=False, capacity=SMALL)
    assert rows_of(layout) == rows_of_problem(problem)
    empty = ~np.asarray(layout.slot_mask)
    assert empty.any()
    assert not np.any(layout.pixels[:, empty])
    assert not np.any(layout.whitening[:, :, empty])
    assert (layout.num_points, layout.num_cameras) == (SMALL.points, SMALL.cameras)
    support.check_sums(layout, rng)
    weights = rng.integers(1, 1 << 20, layout.num_slots).astype(np.float64)
    found = blocks_by_layout(layout, weights)
    assert np.array_equal(
        found[:cameras, :cameras], blocks_by_brute_force(problem, layout, weights)
    )
    assert not found[cameras:].any()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 10**6), st.booleans(), st.sampled_from([3, 2048]))
def test_shapes_follow_from_the_capacity_alone(one, other, grid, batch):
    """Random sub-problems: any cameras, any points. Where the whole may be one dense product, it is
    so for both."""
    made = []
    for seed in (one, other):
        rng = np.random.default_rng(seed)
        cameras = rng.integers(1, 9)
        tracks = np.append(1, np.minimum(cameras, rng.geometric(0.4, rng.integers(1, 60)) - 1))
        if grid:  # every camera sees every point, and there are no cameras to pad
            cameras = 8
            tracks = np.full(rng.integers(1, 42), 8)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(covisibility, "PAIR_BATCH", batch)
            made.append(build_layout(problem_of(tracks, cameras, seed), grid=grid, capacity=SMALL))
    assert shapes(made[0]) == shapes(made[1])
    assert (made[0].grid is not None) == grid


def test_windows_of_a_sequence_share_shapes_wherever_they_share_a_cell():
    seen: dict = {}
    for problem in windows(31):
        capacity = capacity_of(problem)
        layout = build_layout(problem, StepOptions(), capacity)
        start = padded_parameters(problem, capacity)
        state = jax.eval_shape(
            lambda *start, layout=layout: state_of(layout, *start, StepOptions()), *start
        )
        seen.setdefault((capacity, layout.grid is None), []).append(shapes((layout, state)))
    assert all(made == same[0] for same in seen.values() for made in same)
    assert len(seen) <= 6


def test_cameras_that_see_points_many_times_get_deeper_trees_and_not_wrong_sums():
    """Tracks of 40 observations by three cameras, where eight would be the most."""
    base = problem_of(np.full(6, 3), 3, seed=0)
    times = np.tile(np.arange(base.num_observations), 14)[:240]
    problem = base.replace(
        observations=np.random.default_rng(0).normal(size=(240, 2)),
        camera_index=base.camera_index[times],
        point_index=base.point_index[times],
        whitening=base.whitening[times],
    )
    layout = build_layout(problem, capacity=replace(SMALL, pairs=8192))
    column = np.bincount(layout.slot_point[layout.slot_mask], minlength=SMALL.points)
    assert column.max() > SMALL.cameras
    assert np.array_equal(point_sum(layout, jnp.asarray(layout.slot_mask, float)[None])[0], column)
    weights = np.random.default_rng(1).integers(1, 1 << 10, layout.num_slots).astype(np.float64)
    found = blocks_by_layout(layout, weights)
    assert np.array_equal(found[:3, :3], blocks_by_brute_force(problem, layout, weights))


def test_an_empty_slot_that_is_not_a_number_spoils_no_point():
    """As where a trial sends the first point, to which empty slots belong, out of range."""
    layout = build_layout(problem_of(np.full(9, 3), 4, seed=0), capacity=SMALL)
    values = np.where(layout.slot_mask, 1.0, np.nan)[None]
    assert np.array_equal(
        point_sum(layout, jnp.asarray(values))[0], np.append(np.full(9, 3.0), np.zeros(55))
    )


def test_a_problem_larger_than_the_capacity_is_refused():
    # 512 observations, and none of the 512 slots would be empty
    problem = problem_of(np.full(64, 8), 8, seed=0)
    with pytest.raises(ValueError, match="larger than the capacity: 8 cameras, 64 points"):
        build_layout(problem, capacity=SMALL)


@pytest.mark.parametrize("solver", ["implicit", "sparse"])
def test_only_layouts_for_a_factored_system_are_padded(solver):
    with pytest.raises(ValueError, match="only layouts for a factored system"):
        build_layout(support.tiny(), StepOptions(linear_solver=solver), SMALL)


# Solves


def check_same(padded, plain, rtol: float = 1e-9) -> None:
    """The same solve to rounding."""
    assert padded.capacity is not None
    assert plain.capacity is None
    assert (padded.iterations, padded.accepted) == (plain.iterations, plain.accepted)
    assert padded.termination == plain.termination
    np.testing.assert_allclose(padded.initial_cost, plain.initial_cost, rtol=1e-12)
    np.testing.assert_allclose(padded.history.cost, plain.history.cost, rtol=rtol)
    np.testing.assert_allclose(padded.history.damping, plain.history.damping, rtol=1e-6)
    np.testing.assert_allclose(padded.problem.cameras, plain.problem.cameras, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(padded.problem.points, plain.problem.points, rtol=1e-5, atol=1e-6)


SLOW_KINDS = ("tiny", "loss", "embedded", "fixed intrinsics")
KINDS = {
    "tiny": (support.tiny, StepOptions()),
    "dense product": (lambda: support.paper(0), StepOptions()),
    "loss": (support.tiny, StepOptions(loss=Loss("huber", 1.7))),
    "embedded": (
        support.odd,
        StepOptions(refinement=Refinement(points=3, camera_rounds=2, trials=3, pattern_moves=2)),
    ),
    "fixed intrinsics": (support.tiny, StepOptions(intrinsics="fixed")),
}


@pytest.mark.parametrize(
    "kind", [pytest.param(x, marks=pytest.mark.slow if x in SLOW_KINDS else ()) for x in KINDS]
)
def test_a_padded_solve_equals_the_one_of_the_given_sizes(kind):
    make, options = KINDS[kind]
    check_same(stepwise(make(), "ceres", options, pad=True), stepwise(make(), "ceres", options))


@pytest.mark.slow
def test_in_mixed_arithmetic_it_is_the_same_to_float32():
    """The preconditioner is a factorisation in float32, behind which conjugate gradients stop at
    1e-3."""
    padded, plain = (stepwise(support.tiny(), dtype="mixed", pad=pad) for pad in (True, False))
    check_same(padded, plain, rtol=float(np.finfo(np.float32).eps))


@pytest.mark.parametrize("policy", [pytest.param("learned", marks=pytest.mark.slow), "nielsen"])
def test_policies_see_the_true_problem(policy):
    """The learned one observes numbers of cameras, points and observations."""
    problem = windows(1)[0]
    check_same(stepwise(problem, policy, pad=True), stepwise(problem, policy))


@pytest.mark.slow
def test_a_band_is_factored_dense_to_the_same_end():
    scene = random_scene(
        SceneConfig(70, 200, 800, max_depth=4.0, gap_share=0.0, revisit_share=0.0), 0
    )
    padded, plain = (stepwise(scene, max_iterations=4, pad=pad) for pad in (True, False))
    assert build_layout(scene, StepOptions()).pairs.band is not None
    check_same(padded, plain)


def test_what_nobody_observes_comes_back_bit_by_bit_and_the_rest_moves():
    problem = support.odd()
    solution = stepwise(problem, max_iterations=10, pad=True)
    assert solution.capacity is not None
    assert solution.accepted > 0
    lonely = np.setdiff1d(np.arange(problem.num_cameras), problem.camera_index)
    unseen = np.setdiff1d(np.arange(problem.num_points), problem.point_index)
    assert (len(lonely), len(unseen)) == (1, 2)
    assert solution.problem.cameras.shape == problem.cameras.shape
    assert solution.problem.points.shape == problem.points.shape
    assert solution.problem.cameras[lonely].tobytes() == problem.cameras[lonely].tobytes()
    assert solution.problem.points[unseen].tobytes() == problem.points[unseen].tobytes()
    assert (
        (solution.problem.points[problem.point_index] != problem.points[problem.point_index])
        .any(axis=1)
        .all()
    )


# Programs


def compilations(run) -> int:
    """Programs that JAX traced or compiled meanwhile."""
    events = []

    def listen(event, seconds, **_):
        return events.append(event) if "compile" in event else None

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        run()
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    return len(events)


@pytest.mark.xla
@pytest.mark.parametrize(
    ("run", "dense"),
    [(stepwise, False), pytest.param(solve, True, marks=pytest.mark.slow)],
    ids=["pairs", "dense product"],
)
def test_another_problem_of_the_same_cell_compiles_nothing(run, dense):
    """Other numbers of cameras, points and observations, other tracks; some cameras or points
    unobserved."""
    one, other = mates(dense)
    run(one, "ceres", pad=True, max_iterations=3)

    def again(**how):
        return compilations(lambda: run(other, Ceres(initial=0.7), max_iterations=3, **how))

    assert again(pad=True) == 0
    assert again(pad=False) > 0


@pytest.mark.xla
def test_a_program_is_the_same_text_for_every_problem_of_a_cell():
    """So that a persistent cache, which goes by the text, serves the next process too."""
    texts = set()
    for problem in mates(dense=False):
        capacity = capacity_of(problem)
        layout = build_layout(problem, StepOptions(), capacity)
        state = state_of(layout, *padded_parameters(problem, capacity), StepOptions())
        texts.add(
            solve_loop.__wrapped__.lower(
                layout, state, Ceres(), Tolerances(), StepOptions(), 10
            ).as_text()
        )
    assert len(texts) == 1


# What is left as it is


@pytest.mark.parametrize("asked", [{"linear_solver": "implicit"}, {"method": "stba"}])
def test_other_solvers_are_left_as_they_are(asked):
    padded = stepwise(support.tiny(), max_iterations=2, pad=True, **asked)
    plain = stepwise(support.tiny(), max_iterations=2, **asked)
    assert padded.capacity is None
    assert padded.linear_solver == plain.linear_solver
    assert np.array_equal(padded.history.cost, plain.history.cost)


def test_where_there_is_a_choice_padding_takes_the_explicit_solver():
    solution = stepwise(support.tiny(), max_iterations=2, pad=True, linear_solver="auto")
    assert (solution.linear_solver, solution.capacity) == ("explicit", capacity_of(support.tiny()))
    options = StepOptions(linear_solver="implicit")
    assert stepwise(
        support.tiny(), "ceres", options, max_iterations=2, pad=True, linear_solver="auto"
    ).capacity


def test_large_problems_have_no_capacity():
    assert capacity_of(problem_of(np.full(3, 1), MAX_CAMERAS, seed=0)) is not None
    assert capacity_of(problem_of(np.full(3, 1), MAX_CAMERAS + 1, seed=0)) is None
    long = problem_of(np.full(3, 1), 4, seed=0)
    many = 131_072
    at = np.random.default_rng(0).integers(3, size=many)
    crowded = replace(
        long,
        observations=np.zeros((many, 2)),
        camera_index=np.zeros(many, np.int32),
        point_index=at.astype(np.int32),
        whitening=None,
    )
    assert capacity_of(crowded) is None
    tracks = np.full(MAX_PAIRS // 210 + 1, 20)  # 210 pairs each
    assert capacity_of(problem_of(tracks, 20, seed=0)) is None
    assert capacity_of(problem_of(tracks[:-1], 20, seed=0)) is not None


def test_a_large_problem_is_solved_as_it_is():
    """More cameras than are padded, most of them unobserved, so that it is quick all the same."""
    tiny = support.tiny()
    many = tiny.replace(cameras=np.vstack([tiny.cameras, np.ones((MAX_CAMERAS, 9))]))
    padded, plain = (prepare(many, "ceres", SolveOptions(pad=pad)) for pad in (True, False))
    assert padded.capacity is None
    assert padded.state.cost == plain.state.cost


# Lenses and constants


def with_lenses(problem, lenses: int, seed: int):
    """The problem with so many lenses for all of its cameras, some numbers of them held, and some
    poses and points."""
    random = np.random.default_rng(seed)
    lens_of_camera = np.arange(problem.num_cameras) % lenses
    cameras = np.array(problem.cameras)
    cameras[:, 6:] = cameras[lens_of_camera, 6:]
    free = np.ones((lenses, 3), bool)
    free[random.integers(lenses), 2] = False
    shared = problem.replace(cameras=cameras, lenses=Lenses(lens_of_camera, free))
    return hold(shared, poses=[int(random.integers(problem.num_cameras))], points=[0, 3])


@pytest.mark.parametrize("lenses", [1, 3, pytest.param(6, marks=pytest.mark.slow)])
def test_a_padded_solve_with_shared_lenses_and_constants_equals_the_one_of_the_given_sizes(lenses):
    problem = with_lenses(support.tiny(), lenses, seed=lenses)
    check_same(stepwise(problem, max_iterations=5, pad=True), stepwise(problem, max_iterations=5))


def test_what_is_shared_and_constant_changes_no_shape():
    """Other images of a lens, other lenses of less than a quarter of them, other constants and
    other sizes."""
    one, other = mates(dense=False)
    made = []
    for seed, (problem, lenses) in enumerate([(one, 2), (other, 2), (one, 3), (other, 4)]):
        problem = with_lenses(problem, lenses, seed)
        capacity = capacity_of(problem)
        made.append((capacity, shapes(build_layout(problem, capacity=capacity))))
    assert all(each == made[0] for each in made)
