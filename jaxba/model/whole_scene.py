"""A scene moved, turned and scaled as a whole to what was measured besides its pixels.

Pixels stay as they are under a similarity of the scene, x -> s R x + t; other residuals do not.
Their cost

    f(s, R, t, b) = 1/2 sum_k sum_rows rho_k(|r_k|^2)

is minimised over the similarity and the blocks b of unknowns that only these residuals have, with
cameras and points as a rigid body, by Levenberg's and Marquardt's method from several attitudes.
Distances, baselines, relative poses, depths and positions are linear in s and t, IMUs in the
velocities besides: at an attitude one step is the closed form.

Source: Strasdat et al. 2010, "Scale drift-aware large scale monocular SLAM", for the exponential of
a similarity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.model.registration import rows_of
from jaxba.model.row_derivatives import values
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import cross_matrices
from jaxba.problem.similarity import Similarity
from jaxba.rotations import rotation_matrix
from jaxba.runtime.compilation import program
from jaxba.runtime.numerics import numerics
from jaxba.structure.residual_slots import ResidualSlots
from jaxba.structure.unknowns import Unknowns

SIMILARITY = 7  # numbers of a similarity: rotation, translation, scale

MOST_ROWS = 1_000  # rows of a residual that are asked, evenly spread among all

# of blocks, up to which these are found; residuals with larger ones are not asked
MOST_NUMBERS = 150

LOOSE = 0.1
"""Standard deviation (radians, extents of the scene, shares of its scale) up to which rows that the
scene is aligned with determine a freedom. A flight whose positions lie on a line within their noise
knows its roll to 0.2."""

# smallest information on a freedom that is not rounding, as a share of the largest
DETERMINED = 1e-13

SINGULAR = 1e-9  # smallest eigenvalue of normal equations with a unit diagonal that counts

BETTER = 0.99  # share of the cost at a smaller turn that a larger one must have to be taken

# most steps, and the relative decrease of the cost after which there are no more
ITERATIONS = 30
ENOUGH = 1e-9

# the first damping, as a share of the diagonal, and by what it changes
DAMPING = 1e-9
FACTOR = 10.0

MOST_SHRUNK = -0.9  # change of the scale in a step, as a share: it stays positive


class Moves(NamedTuple):
    """Some similarities, and values of blocks with each."""

    scale: Float[np.ndarray, " n"]
    rotation: Float[np.ndarray, "n 3 3"]
    translation: Float[np.ndarray, "n 3"]
    blocks: tuple[Float[np.ndarray, "n _ _"], ...]


class Expansion(NamedTuple):
    """For each of some moves the cost of each residual, its gradient and the matrix of normal
    equations, by the seven numbers of a similarity about the middle, in radians and extents, and by
    those of blocks."""

    cost: Float[np.ndarray, "n kinds"]
    gradient: Float[np.ndarray, "n kinds numbers"]
    normal: Float[np.ndarray, "n kinds numbers numbers"]


@dataclass(frozen=True)
class WholeScene:
    """Residuals of a problem near the origin as functions of a similarity of its scene."""

    kinds: tuple[ResidualSlots, ...]
    unknowns: Unknowns
    cameras: Float[np.ndarray, "parameters cameras"]
    points: Float[np.ndarray, "3 points"]
    # the row of each block that each camera has; negative for none
    groups: tuple[Int[np.ndarray, " cameras"], ...]
    blocks: tuple[Float[np.ndarray, "_ _"], ...]
    shares: tuple[float, ...]  # rows of each residual over those that are asked
    middle: Float[np.ndarray, "3"]
    extent: float

    @classmethod
    def of(
        cls, problem: BundleProblem, middle: Float[np.ndarray, "3"], extent: float
    ) -> WholeScene:
        """Those of a problem near the origin with a middle and an extent."""
        blocks = tuple(np.asarray(block, np.float64) for block in problem.residuals.blocks)
        asked = sum(block.size for block in blocks) <= MOST_NUMBERS
        with numerics(np.float64):
            kinds, unknowns, parameters, groups = jax.device_get(rows_of(problem))
        kinds = [kind for kind in kinds if asked or not any(end for _, end in kind.places)]
        return cls(
            kinds=tuple(map(_some, kinds)),
            unknowns=unknowns,
            cameras=parameters[0],
            points=parameters[1],
            groups=groups if asked else (),
            blocks=blocks if asked else (),
            shares=tuple(max(1.0, len(kind.rows) / MOST_ROWS) for kind in kinds),
            middle=middle,
            extent=extent,
        )

    # spinning threads of BLAS made small eigenvalue problems 200 times slower on a busy machine
    @numerics(np.float64)
    def minimised(
        self, directions: Float[np.ndarray, "7 free"]
    ) -> tuple[Similarity, tuple[Float[np.ndarray, "_ _"], ...], float]:
        """The similarity in the span of some directions with the least cost, the blocks with it,
        and its cost as a share of the cost without it. Where nothing is determined it is the
        identity, and blocks alone are found."""
        free = _moves_freely(directions)
        start = self._started(free)
        begun = self._expanded(start)
        directions = self._determined(begun, directions)
        first = float(begun.cost[0].sum())
        if not (directions.shape[1] or self.blocks) or not np.isfinite(first):
            return Similarity(1.0, np.eye(3), np.zeros(3)), self.blocks, 1.0
        if not directions.shape[1]:
            start, begun = jax.tree.map(_first, (start, begun))
        moves, costs = self._descended(start, begun, directions, free)
        best = 0
        for k in range(1, len(costs)):
            best = k if costs[k] < BETTER * costs[best] else best
        by = Similarity(float(moves.scale[best]), moves.rotation[best], moves.translation[best])
        return by, tuple(block[best] for block in moves.blocks), float(costs[best]) / first

    def _started(self, free: bool) -> Moves:
        """The identity, and where the scene moves freely the other 23 rotations of a cube about its
        middle."""
        from scipy.spatial.transform import Rotation  # imported late, as in geometry.py

        turns = Rotation.create_group("O").as_matrix()
        turns = turns[np.argsort(-np.trace(turns, axis1=1, axis2=2), kind="stable")]
        turns = turns if free else turns[:1]
        count = len(turns)
        blocks = tuple(np.broadcast_to(block, (count, *block.shape)) for block in self.blocks)
        return Moves(np.ones(count), turns, self.middle - turns @ self.middle, blocks)

    def _determined(
        self, begun: Expansion, directions: Float[np.ndarray, "7 free"]
    ) -> Float[np.ndarray, "7 some"]:
        """Those directions that rows determine, whatever blocks are, but rows that the scene is
        aligned with do not."""
        aligned = np.array([kind.rows.aligned for kind in self.kinds])
        known = _about_similarity(begun.normal[0, aligned].sum(axis=0))
        information, vectors = np.linalg.eigh(directions.T @ known @ directions)
        directions = directions @ vectors[:, information < LOOSE**-2]
        normal = begun.normal.sum(axis=(0, 1))
        information, vectors = np.linalg.eigh(directions.T @ _about_similarity(normal) @ directions)
        directions = directions @ vectors
        whole = np.einsum("ij,ik,kj->j", directions, normal[:SIMILARITY, :SIMILARITY], directions)
        least = np.maximum(SINGULAR * whole, DETERMINED * whole.max(initial=0.0))
        return directions[:, information > least]

    def _descended(
        self, moves: Moves, now: Expansion, directions: Float[np.ndarray, "7 free"], free: bool
    ) -> tuple[Moves, Float[np.ndarray, " n"]]:
        """Moves at minima, and their costs.

        Args:
            moves: where to begin.
            now: their expansion.
            directions: along which the scene may move, by the numbers of a similarity.
            free: whether nothing holds the scene, but perhaps its scale."""
        numbers = now.normal.shape[-1]
        count = directions.shape[1]
        basis = np.zeros((numbers, count + numbers - SIMILARITY))
        basis[:SIMILARITY, :count] = directions
        basis[SIMILARITY:, count:] = np.eye(numbers - SIMILARITY)
        damping = np.full(len(now.cost), DAMPING)
        costs = now.cost.sum(axis=1)
        for _ in range(ITERATIONS):
            normal = basis.T @ now.normal.sum(axis=1) @ basis
            gradient = now.gradient.sum(axis=1) @ basis
            steps = -_solved(normal, gradient, damping) @ basis.T
            tried = self._stepped(moves, steps, free)
            there = self._expanded(tried)
            after = np.nan_to_num(there.cost.sum(axis=1), nan=np.inf, posinf=np.inf)
            better = after < costs
            decrease = np.where(better, costs - after, 0.0)
            moves = _picked(tried, moves, better)
            now = _picked(there, now, better)
            damping = np.where(better, damping / FACTOR, np.maximum(damping, DAMPING) * FACTOR**2)
            ended = better & (decrease <= ENOUGH * costs)
            costs = np.where(better, after, costs)
            if (ended | (damping > 1 / DAMPING)).all():
                break
        return moves, costs

    def _stepped(self, moves: Moves, steps: Float[np.ndarray, "n numbers"], free: bool) -> Moves:
        """Moves after steps of the scene before it is moved. Where the scene is not `free` they are
        along paths of the group of similarities, so that what directions leave at its place stays
        there."""
        from scipy.spatial.transform import Rotation

        steps = steps * np.minimum(1.0, MOST_SHRUNK / np.minimum(steps[:, 6], MOST_SHRUNK))[:, None]
        growth = 1 + steps[:, 6]
        turn = Rotation.from_rotvec(steps[:, :3]).as_matrix()
        shift = self.extent * steps[:, 3:6]
        if not free:
            turn, shift = _along_path(steps[:, :3], growth, shift)
        linear = growth[:, None, None] * turn
        shift = self.middle + shift - linear @ self.middle
        shift = (
            moves.scale[:, None] * np.einsum("nij,nj->ni", moves.rotation, shift)
            + moves.translation
        )
        blocks = []
        start = SIMILARITY
        for block in moves.blocks:
            numbers = block[0].size
            blocks.append(block + steps[:, start : start + numbers].reshape(block.shape))
            start += numbers
        return Moves(moves.scale * growth, moves.rotation @ turn, shift, tuple(blocks))

    def _expanded(self, moves: Moves) -> Expansion:
        given = (
            self.kinds,
            self.unknowns,
            self.cameras,
            self.points,
            self.groups,
            moves,
            self.middle,
            self.extent,
        )
        with numerics(np.float64):
            cost, gradient, normal = jax.device_get(program(_expansions, level="quick")(*given))
        shares = np.array(self.shares)
        return Expansion(cost * shares, gradient * shares[:, None], normal * shares[:, None, None])


def _first(numbers: np.ndarray) -> np.ndarray:
    """The numbers of the first of some moves."""
    return numbers[:1]


def _picked(mine: Any, others: Any, chosen: Bool[np.ndarray, " n"]) -> Any:
    """Arrays with entries of some where they are chosen, and those of others elsewhere."""

    def pick(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.where(chosen.reshape(-1, *[1] * (one.ndim - 1)), one, other)

    return jax.tree.map(pick, mine, others)


def _moves_freely(directions: Float[np.ndarray, "7 free"]) -> bool:
    """Whether directions have all rotations and translations among them."""
    return bool(np.linalg.matrix_rank(directions[: SIMILARITY - 1], tol=SINGULAR) == SIMILARITY - 1)


def _along_path(
    turn: Float[np.ndarray, "n 3"], growth: Float[np.ndarray, " n"], shift: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
    """Rotations and translations of exponentials of similarities that grow the scene by `growth`.
    Source: Strasdat et al. 2010, eq. 16; without a rotation the translation is `shift`."""
    from scipy.linalg import expm  # imported late, as in geometry.py

    change = growth - 1
    small = np.abs(change) < 1e-12
    along = np.where(small, 1.0, np.log(growth) / np.where(small, 1.0, change))
    generator = np.zeros((len(turn), 4, 4))
    generator[:, :3, :3] = cross_matrices(turn) + change[:, None, None] * np.eye(3)
    generator[:, :3, 3] = shift
    matrices = expm(along[:, None, None] * generator)
    return matrices[:, :3, :3] / growth[:, None, None], matrices[:, :3, 3]


def _solved(
    normal: Float[np.ndarray, "n k k"],
    right: Float[np.ndarray, "n k"],
    damping: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n k"]:
    """Solutions of normal equations whose diagonals are damped by shares of themselves; zero where
    not determined."""
    roots = np.sqrt(np.einsum("nkk->nk", normal))
    inverse = np.divide(1.0, roots, out=np.zeros_like(roots), where=roots > 0)
    values, vectors = np.linalg.eigh(inverse[:, :, None] * normal * inverse[:, None, :])
    along = np.einsum("nji,nj->ni", vectors, inverse * right)
    kept = values > SINGULAR * values.max(axis=1, keepdims=True)
    along = np.where(kept, along / np.where(kept, values + damping[:, None], 1.0), 0.0)
    return inverse * np.einsum("nij,nj->ni", vectors, along)


def _some(kind: ResidualSlots) -> ResidualSlots:
    """Some of the rows of a residual, evenly spread."""
    count = len(kind.rows)
    kept = np.unique(np.linspace(0, count - 1, min(count, MOST_ROWS)).astype(int))
    return replace(
        kind,
        rows=kind.rows.of(kept),
        cameras=tuple(cameras[kept] for cameras in kind.cameras),
        points=tuple(points[kept] for points in kind.points),
        slots=kind.slots[:, :, kept],
    )


def _about_similarity(normal: Float[np.ndarray, "numbers numbers"]) -> Float[np.ndarray, "7 7"]:
    """The information on a similarity alone, with the numbers of blocks eliminated."""
    first = slice(SIMILARITY)
    last = slice(SIMILARITY, None)
    roots = np.sqrt(np.diagonal(normal)[last])
    inverse = np.divide(1.0, roots, out=np.zeros_like(roots), where=roots > 0)
    scaled = inverse[:, None] * normal[last, last] * inverse
    mixed = normal[first, last] * inverse
    return (
        normal[first, first]
        - mixed @ np.linalg.pinv(scaled, rcond=SINGULAR, hermitian=True) @ mixed.T
    )


def _expansions(
    kinds: tuple[ResidualSlots, ...],
    unknowns: Unknowns,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    groups: tuple[Array, ...],
    moves: Moves,
    middle: Float[Array, "3"],
    extent: Array,
) -> tuple[Array, Array, Array]:
    """The numbers of an `Expansion`. Arguments are those of `WholeScene`."""
    zero = jnp.zeros(SIMILARITY + sum(block[0].size for block in moves.blocks))

    def at_move(move: Moves) -> tuple[Array, Array, Array]:
        def residuals(change: Array) -> list[Array]:
            turn = rotation_matrix(change[:3, None])[:, :, 0]
            grown = (1 + change[6]) * move.scale
            rotation = move.rotation @ turn
            shift = middle + extent * change[3:6] - (1 + change[6]) * turn @ middle
            shift = move.scale * move.rotation @ shift + move.translation
            state = cameras
            if groups:
                numbers = sum(block.shape[1] for block in move.blocks)
                parts = [cameras[: len(cameras) - numbers]]
                start = SIMILARITY
                for block, group in zip(move.blocks, groups, strict=True):
                    changed = block + change[start : start + block.size].reshape(block.shape)
                    parts.append(jnp.where(group >= 0, changed[jnp.maximum(group, 0)].T, 0.0))
                    start += block.size
                state = jnp.concatenate(parts)
            of_kinds = []
            for kind in kinds:
                rows = kind.rows
                seen = jnp.asarray(rows.scale) * jnp.asarray(rows.rotation)
                frame = replace(
                    rows,
                    scale=rows.scale * grown,
                    rotation=jnp.asarray(rows.rotation) @ rotation,
                    translation=seen @ shift + jnp.asarray(rows.translation),
                )
                of_kinds.append(values(replace(kind, rows=frame), unknowns, state, points))
            return of_kinds

        costs = []
        gradients = []
        normals = []
        for kind, at, by in zip(kinds, residuals(zero), jax.jacfwd(residuals)(zero), strict=True):
            squared = jnp.sum(at * at, axis=0)
            cost, slope = (
                (squared, jnp.ones_like(squared))
                if kind.rows.loss.trivial
                else kind.rows.loss(squared)
            )
            costs.append(0.5 * jnp.sum(cost))
            gradients.append(jnp.einsum("r,kr,krn->n", slope, at, by))
            normals.append(jnp.einsum("r,krm,krn->mn", slope, by, by))
        return jnp.stack(costs), jnp.stack(gradients), jnp.stack(normals)

    return jax.vmap(at_move)(moves)
