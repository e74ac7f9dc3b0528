"""Runs the solves and trainings of tables and figures, keeps results on disk, and makes rows of
them."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias, cast

import jax
import numpy as np

from jaxba.bench import profile
from jaxba.bench.run import RunSettings, record_of, run_solver
from jaxba.bench.sources import Source
from jaxba.damping import DampingPolicy, load_policy
from jaxba.game.rollout import play
from jaxba.game.scene_bank import Bank, reach
from jaxba.paper import agents, results, zero_net
from jaxba.paper.agents import Agent
from jaxba.paper.config import PaperConfig
from jaxba.paper.results import NEAR, SCHEDULE, Play, Row, Store
from jaxba.peers import require
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import LinearSolverChoice
from jaxba.runtime import process
from jaxba.solver.drivers import IterationRecord
from jaxba.solver.names import SolverName, parse_solver
from jaxba.solver.options import SolveOptions
from jaxba.solver.record import Record
from jaxba.solver.solve import solve
from jaxba.typing import InputError

LIMIT = profile.ITERATION_LIMIT

# agents trained on other real problems, and untrained twins
ELSEWHERE = "-elsewhere"
CONSTANT = "-constant"
TEST = "test"  # name of the scenes of the tables in records
SMALL = "small"  # family of the small random scenes

Built: TypeAlias = tuple[DampingPolicy, SolveOptions]


@dataclass(frozen=True)
class Method:
    """The solver of a table row: a policy, perhaps with several training runs, and the options of
    the step.

    `build` gets the number of a training run, and a real problem (None: the scenes of the tables);
    it returns None if there is no policy for it. Rules ignore both. It may train it, so it is
    called only if something has to be run. A policy has collapsed if it does the same in every
    state in the end."""

    name: str  # in records
    build: Callable[[int, Source | None], Built | None]  # policy and options of a training run
    seeds: int = 0  # number of training runs; 0 for a rule
    peer: SolverName | None = None  # another library that solves real problems, in place of `build`
    # whether most policies do so
    collapsed: Callable[[Sequence[Source | None]], bool] = lambda _: False

    @property
    def numbers(self) -> range:
        """Numbers of the training runs; only 0 for a rule."""
        return range(max(1, self.seeds))

    def label(self, seed: int) -> str:
        """Name of the solver in records of solves."""
        return f"{self.name}#{seed}" if self.seeds else self.name


def method_named(name: str) -> Method:
    """The method with a solver name of `jaxba-bench`, which `/LINEAR_SOLVER` may follow."""
    solver, slash, linear = name.partition("/")
    parsed = parse_solver(solver)

    def build(*_: Any) -> Built:
        policy, options = parsed.build()
        return policy, replace(
            options, linear_solver=cast(LinearSolverChoice, linear if slash else "auto")
        )

    return Method(name, build, 0, parsed if parsed.peer else None)


class Runner:
    """A reproduction run in a folder. Nothing is run whose result is in the folder."""

    def __init__(
        self, config: PaperConfig, folder: Path, report: Callable[[str], None] = lambda _: None
    ) -> None:
        """Reads the results that the folder, which must exist, has. `report` is called with a line
        of text when something starts. Raises ProblemError: a file of results is damaged."""
        self.config = config
        self.folder = folder
        self.report = report
        self.store = Store(folder)
        self.done = 0  # solves, plays and trainings of this process
        self._read: tuple[Source, BundleProblem] | None = None

    def agent(
        self,
        kind: Agent,
        linear: LinearSolverChoice = "auto",
        method: str = "lm",
        *,
        twin: bool = False,
    ) -> Method:
        """The method with an agent, which is trained on synthetic scenes when it is first built; or
        its twin without learning, the best constant action on its training scenes."""
        if method != "lm":
            kind = replace(
                kind, name=f"{method}+{kind.name}", overrides=(*kind.overrides, f"method={method}")
            )
        return self._method(kind.name, lambda _: kind, method, linear=linear, twin=twin)

    def elsewhere(self, kind: Agent, method: str = "lm", *, twin: bool = False) -> Method:
        """The same with agents trained on windows of other real problems."""

        def find(source):
            return source and agents.trained_elsewhere(self.config, source, kind, method)

        name = f"{kind.name}{ELSEWHERE}"
        return self._method(name if method == "lm" else f"{method}+{name}", find, method, twin=twin)

    def _method(
        self,
        name: str,
        find: Callable[[Source | None], Agent | None],
        method: str,
        linear: LinearSolverChoice = "auto",
        *,
        twin: bool,
    ) -> Method:
        def build(seed: int, source: Source | None) -> Built | None:
            agent = find(source)
            where = (self.folder, self.report)
            if agent is None:
                return None
            if twin:
                path = agents.best_constant(self.config, agent, *where)
            else:
                self.done += agents.train(self.config, agent, *where)
                path = agents.own_folder(agent, self.folder) / agents.POLICY.format(seed + 1)
            return load_policy(path), SolveOptions(method=method, linear_solver=linear)

        def collapsed(of: Sequence[Source | None]) -> bool:
            named = {agent.name: agent for source in of if (agent := find(source))}
            found = [
                one
                for agent in named.values()
                for one in agents.collapsed(self.config, agent, self.folder)
            ]
            return not twin and 2 * sum(found) > len(found)

        name += CONSTANT * twin + f"/{linear}" * (linear != "auto")
        seeds = 0 if twin else self.config.agents.seeds
        return Method(name, build, seeds, collapsed=collapsed)

    def zero_net(self) -> Method:
        """The method with the Zero-net, with as many training runs as an agent."""
        return Method("zero-net", self._zero_net, self.config.agents.seeds)

    def _zero_net(self, seed: int, _: Any) -> Built:
        settings = agents.train_config(self.config, agents.OURS)
        agent = settings.game.agent
        path = self.folder / "agents" / f"zero-net-{seed}.npz"
        if path.is_file():
            net = zero_net.restore(path, self.config.zero_net, agent)
        else:
            self.report(f"zero-net {seed + 1}: training")
            train_on = agents.scenes(self.config, self.folder, self.report)[0]
            game = agents.game(self.config, agents.OURS, settings, train_on)
            key = jax.random.fold_in(jax.random.key(self.config.seed), 2000 + seed)
            net, _ = zero_net.train(self.config.zero_net, game, agent, key)
            path.parent.mkdir(parents=True, exist_ok=True)
            zero_net.save(path, net)
            self.done += 1
        return net, SolveOptions()

    @functools.cached_property
    def test_scenes(self) -> Bank:
        """The scenes of the tables, generated when first needed."""
        return agents.scenes(self.config, self.folder, self.report)[1]

    def play(self, method: Method) -> None:
        """Solves the scenes of the tables with a method, unless the folder has the result."""
        for seed in method.numbers:
            if self.store.play(TEST, method.name, seed):
                continue
            process.release_programs()
            policy, options = cast(Built, method.build(seed, None))
            settings = agents.train_config(self.config, agents.OURS)
            options = replace(options, intrinsics=settings.bank.intrinsics).step_options(policy)
            bank = self.test_scenes
            self.report(f"{method.label(seed)} on {len(bank.initial_cost)} scenes")
            started = time.perf_counter()
            found = play(settings.bank.kind, bank, policy, options, LIMIT)
            best = np.asarray(bank.best_cost)
            first = [
                row[: min(SCHEDULE, count)]
                for row, count in zip(found.dampings, found.iterations, strict=True)
            ]
            self.store.add_play(
                Play(
                    scenes=TEST,
                    method=method.name,
                    seed=seed,
                    iterations=tuple(int(x) for x in found.iterations),
                    converged=tuple(bool(x) for x in found.converged),
                    near=tuple(float(x) for x in reach(found.costs, best, NEAR)),
                    end=tuple(float(x) for x in found.costs[:, -1] / best - 1),
                    first=tuple(tuple(float(x) for x in row) for row in first),
                    seconds=time.perf_counter() - started,
                )
            )
            self.done += 1

    def solve(
        self,
        sources: Iterable[Source],
        methods: Sequence[Method],
        limit: int = LIMIT,
        repeats: int = 0,
    ) -> None:
        """Solves problems with methods, except for those whose results the folder has. A problem
        that cannot be read is reported and skipped. `limit` of linear solves and `repeats` are the
        configuration's if 0."""
        for source in sources:
            for method in methods:
                for seed in method.numbers:
                    for repeat in range(repeats or self.config.real.repeats):
                        if self.store.solve(source.name, method.label(seed), repeat) is None:
                            try:
                                self._solve(source, method, seed, repeat, limit)
                            except InputError as error:
                                self.report(f"{source.name} by {method.name}: left out: {error}")

    def _solve(self, source: Source, method: Method, seed: int, repeat: int, limit: int) -> None:
        if method.peer:
            require(method.peer)
        built = None if method.peer else method.build(seed, source)
        if built is None and not method.peer:
            return
        if self._read is None or self._read[0] != source:
            self._read = source, source.read()
        problem = self._read[1]
        self.report(f"{source.name} by {method.label(seed)}")
        if built is None:
            assert method.peer
            record = run_solver(
                problem, source, method.peer, repeat, RunSettings(max_iterations=limit)
            )
        else:
            policy, options = built
            options = replace(options, max_iterations=limit, compilation="full")
            # poses and points are unknown, as in the paper
            if source.family in (self.config.real.kitti.name, SMALL):
                options = replace(options, intrinsics="fixed")
            if source.family == SMALL:
                options = replace(options, linear_solver="explicit")
            steps: list[IterationRecord] = []
            solution = solve(problem, policy, options, callback=lambda step: steps.append(step))
            known: Any = {
                "name": source.name,
                "family": source.family,
                "solver": SolverName("ceres"),
            }
            record = record_of(solution, steps, repeat=repeat, **known)
        self.store.add_solve(replace(record, solver=method.label(seed)))
        self.done += 1

    def row_on_scenes(self, method: Method) -> Row:
        """The row of a method on the scenes of the tables, from the results so far."""
        plays = [self.store.play(TEST, method.name, seed) for seed in method.numbers]
        found = {p.seed: results.of_play(p) for p in plays if p is not None}
        return self._row(method, found, [None])

    def row_on(self, sources: Iterable[Source], method: Method) -> Row:
        """The row of a method on real problems, from the results so far."""
        sources = list(sources)
        names = [source.name for source in sources]
        best = profile.best_cost(self.store.solves)
        found = {}
        for seed in method.numbers:
            records = self.store.solves_of(names, [method.label(seed)])
            if records:
                found[seed] = results.of_records(records, best)
        return self._row(method, found, sources)

    def _row(
        self, method: Method, found: dict[int, list[results.Outcome]], of: Sequence[Source | None]
    ) -> Row:
        row = results.row_of(method.name, found, method.seeds > 0)
        return row._replace(collapsed=bool(found) and method.collapsed(of))

    def records_on(
        self, sources: Iterable[Source], methods: Iterable[Method], seed: int = 0
    ) -> list[Record]:
        """Records of solves with one training run of each method, with `Method.name` as the
        solver."""
        labels = {method.label(seed): method.name for method in methods}
        found = self.store.solves_of([source.name for source in sources], list(labels))
        return [replace(record, solver=labels[record.solver]) for record in found]

    def first_dampings(self, method: Method) -> list[tuple[float, ...]]:
        """First lambdas on every scene of the tables, of the method's first training run."""
        known = self.store.play(TEST, method.name, 0)
        return [] if known is None else list(known.first)
