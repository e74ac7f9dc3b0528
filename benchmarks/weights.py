"""What a learned noise model of key-points is worth: weights of observations beside equal weights,
on solved cameras.

    python -m benchmarks.weights scenes
    jaxba-kitti SEQUENCE --keyframes all --out kitti00.txt.bz2
    python -m benchmarks.weights kitti --path kitti00.txt.bz2 --folder SEQUENCE --poses POSES

The model is linear, log sigma = b + features . w, and solves have Cauchy's loss of residuals over
sigma. *residuals* is the most likely model of the residuals of the twin's solves; *solve* is
trained through `jaxba.differentiable_solve` so that the logarithm of the error of aligned centres
falls, from equal weights; *both* from *residuals*. The twin: equal weights and the best robust loss
on the training half. Ratios are paired. On a sequence, problems are windows with disjoint shares of
the tracks, since with all of them the true poses' own error is the larger one; the centres that the
other tracks give are a second truth, which shares no noise of key-points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from scipy.optimize import minimize
from scipy.spatial import KDTree

import jaxba
from jaxba.game.statistics import geometric_mean, paired_ratio
from jaxba.io import read_problem
from jaxba.io.frames import poses_of, read_poses, read_sidecar
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.similarity import umeyama
from jaxba.rotations import rotation_matrix

SCALES = {
    "cauchy": (0.1, 0.2, 0.5, 1.0, 2.0),
    "huber": (0.2,),
    "tukey": (0.7, 1.5, 3.0),
    "squared": (1.0,),
}
"""Candidates for the twin's loss, pixels."""
FACTORS = (1.0, 1.5, 2.5)
"""Candidates for the scale of Cauchy's loss over the sigma of the residuals."""
TRAIN = range(20, 120, 20)
TEST = range(120, 200, 20)
WIDTH = 20
SHARE = 8
PARTS = 2
"""First frames of windows, their length, into how many parts tracks are divided, and how many of
these train. True poses of the first frames of sequence 00 are wrong by decimetres."""
STRICT = jaxba.Tolerances(ftol=1e-12, gtol=0.0, xtol=1e-12)
TIGHT = jaxba.SolveOptions(
    loss=jaxba.Loss("cauchy"), tolerances=STRICT, max_iterations=200, intrinsics="fixed"
)
SOLVE = replace(TIGHT, tolerances=jaxba.Tolerances(ftol=1e-9))


@dataclass
class Case:
    """A problem, at the solution of its twin once `choose_twin` ran; features of observations; true
    centres."""

    problem: BundleProblem
    features: np.ndarray
    truth: np.ndarray
    others: np.ndarray | None = None


def whitened(case: Case, model: np.ndarray) -> BundleProblem:
    """The problem with the weights of a model."""
    sigma = np.exp(model[0] + case.features @ model[1:])
    return case.problem.replace(whitening=np.eye(2) / sigma[:, None, None])


def error(cameras: np.ndarray, truth: np.ndarray) -> float:
    """Root mean squared distance of centres after the alignment with the truth."""
    found = geometry.camera_centers(cameras)
    return float(np.sqrt(((umeyama(found, truth).points(found) - truth) ** 2).sum(axis=1).mean()))


def ends(cases: list[Case], model: np.ndarray, loss: str = "cauchy") -> np.ndarray:
    """Errors of the solves with a model, by the truth and by the other tracks, shape (2, cases)."""
    options = replace(SOLVE, loss=jaxba.Loss(loss))
    found = []
    for case in cases:
        cameras = np.asarray(jaxba.solve(whitened(case, model), options=options).problem.cameras)
        found.append(
            [
                error(cameras, case.truth),
                error(cameras, case.truth if case.others is None else case.others),
            ]
        )
    return np.array(found).T


def equal(case: Case, scale: float) -> np.ndarray:
    """The model of equal weights."""
    return np.append(np.log(scale), np.zeros(case.features.shape[1]))


def choose_twin(train: list[Case], every: list[Case]) -> tuple[tuple[str, float], np.ndarray]:
    """The loss and scale with the least error on the training half, and the best equal weights
    under Cauchy's loss. The twin's solutions are then the starts of all solves."""
    pairs = [(loss, scale) for loss, scales in SCALES.items() for scale in scales]
    tried = {
        pair: geometric_mean(ends(train, equal(train[0], pair[1]), pair[0])[0]) for pair in pairs
    }
    print("equal weights:", tried, flush=True)
    loss, scale = min(tried, key=lambda pair: tried[pair])
    for case in every:
        start = whitened(case, equal(case, scale))
        case.problem = jaxba.solve(start, options=replace(SOLVE, loss=jaxba.Loss(loss))).problem
    return (loss, scale), equal(
        train[0], min(SCALES["cauchy"], key=lambda scale: tried["cauchy", scale])
    )


def by_residuals(train: list[Case]) -> np.ndarray:
    """The most likely model of the residuals, and of FACTORS the scale of the loss with the least
    error."""
    features = np.concatenate([case.features for case in train])
    seen = [np.bincount(case.problem.point_index)[case.problem.point_index] for case in train]
    # of the two numbers a track of n has 2 n - 3 degrees of freedom
    lost = 1 - 1.5 / np.concatenate(seen)
    plain = [geometry.residuals(case.problem.replace(whitening=None)) for case in train]
    squares = (np.concatenate(plain) ** 2).sum(axis=1) / np.maximum(lost, 0.25)

    def likelihood(model: np.ndarray) -> tuple[float, np.ndarray]:
        log_sigma = model[0] + features @ model[1:]
        # Student's distribution with two degrees of freedom
        share = squares * np.exp(-2 * log_sigma) / 2
        slope = 2 - 4 * share / (1 + share)
        value = 2 * log_sigma + 2 * np.log1p(share)
        return value.mean(), np.append(slope.mean(), slope @ features / len(slope))

    found = minimize(likelihood, np.zeros(1 + features.shape[1]), jac=True).x
    scaled = [np.append(found[0] + np.log(factor), found[1:]) for factor in FACTORS]
    return min(scaled, key=lambda model: geometric_mean(ends(train, model)[0]))


def gradient(case: Case, model: np.ndarray) -> np.ndarray:
    """Of the logarithm of the error by the model, through the solve."""
    problem = whitened(case, model)
    find = jaxba.differentiable_solve(problem, options=TIGHT)
    (cameras, points), pull = jax.vjp(find, jax.tree.map(jnp.asarray, jaxba.inputs_of(problem)))
    # the best: its derivative is zero
    here = umeyama(geometry.camera_centers(np.asarray(cameras)), case.truth)

    def misfit(cameras: jax.Array) -> jax.Array:
        turn = jnp.moveaxis(rotation_matrix(cameras[:, :3].T), 2, 0)
        centers = -jnp.einsum("cji,cj->ci", turn, cameras[:, 3:6])
        return (
            jnp.log(
                jnp.sum(
                    (here.scale * centers @ here.rotation.T + here.translation - case.truth) ** 2
                )
            )
            / 2
        )

    (slope,) = pull((jax.grad(misfit)(cameras), jnp.zeros_like(points)))
    sigma = np.exp(model[0] + case.features @ model[1:])
    by_sigma = -np.trace(np.asarray(slope.whitening), axis1=1, axis2=2) / sigma
    return np.append(by_sigma.sum(), by_sigma @ case.features)


def through_solve(
    cases: list[Case], start: np.ndarray, steps: int, draw=lambda case: case
) -> np.ndarray:
    """Adam on the mean of `gradient`; `draw` makes the problem of a step from a case."""
    # a number can move by 1, however many steps there are
    rule = optax.adam(optax.cosine_decay_schedule(2 / steps, steps))
    model = jnp.asarray(start)
    state = rule.init(model)
    for _ in range(steps):
        slope = np.mean([gradient(draw(case), np.asarray(model)) for case in cases], axis=0)
        update, state = rule.update(jnp.asarray(slope), state)
        model = optax.apply_updates(model, update)
    return np.asarray(model)


def report(test: list[Case], base: np.ndarray, name: str, model: np.ndarray) -> None:
    """Prints the ratios of the model's errors to the twin's, by the truth and by other tracks, and
    the model."""
    known = [case.others is not None for case in test]
    found = ends(test, model, "squared" if name == "equal" else "cauchy")
    pairs = [(found[0], base[0]), (found[1, known], base[1, known])][: 1 + any(known)]
    cells = ["{:.3f} [{:.3f}, {:.3f}]".format(*paired_ratio(*pair)) for pair in pairs]
    print(name, *cells, np.round(model, 2), flush=True)


def scenes(steps: int = 40) -> None:
    """Random scenes whose noise depends on two of three features; `known noise` has the true
    numbers."""
    known = np.array([np.log(0.4), 0.7, -0.4, 0.0])
    rng = np.random.default_rng(0)

    def draw(truth: BundleProblem) -> Case:
        features = rng.normal(size=(truth.num_observations, 3))
        noise = np.exp(known[0] + features @ known[1:])[:, None] * rng.normal(
            size=(len(features), 2)
        )
        problem = truth.replace(observations=geometry.project(truth) + noise)
        return Case(problem, features, geometry.camera_centers(truth.cameras))

    config = jaxba.SceneConfig(
        cameras=8, points=80, mean_track=5.0, trajectory="orbit", min_depth=4.0, max_depth=16.0
    )
    truths = [jaxba.random_scene_with_truth(config, seed)[1] for seed in range(40)]
    train, test = [[draw(one) for one in part] for part in (truths[:16], truths[16:])]
    twin, start = choose_twin(train, train + test)
    base = ends(test, equal(test[0], twin[1]), twin[0])
    report(test, base, "equal", equal(test[0], 1.0))
    # five sigma: hardly robust
    report(test, base, "known noise", known + np.log(5.0) * np.eye(4)[0])
    report(test, base, "residuals", by_residuals(train))
    report(test, base, "solve", through_solve(train[:1], start, steps, lambda _: draw(truths[0])))


def features_of(
    problem: BundleProblem, frames: tuple[int, ...], folder: str
) -> dict[str, np.ndarray]:
    """What a front end knows of every observation; SIFT runs once more, since a BAL file holds
    pixels alone."""
    from jaxba.kitti.features import SIFT_CONTRAST
    from jaxba.kitti.images import image_reader
    from jaxba.kitti.opencv import cv2
    from jaxba.kitti.sequence import read_sequence

    sequence = read_sequence(folder)
    numbers = np.zeros((problem.num_observations, 3))
    read = image_reader(sequence)
    center = [sequence.calibration.cx, sequence.calibration.cy]
    pixels = np.asarray(problem.observations) * [1, -1]
    for camera, frame in enumerate(frames):
        image = read(sequence.numbers.index(frame))
        rows = np.flatnonzero(problem.camera_index == camera)
        found = cv2.SIFT.create(nfeatures=0, contrastThreshold=SIFT_CONTRAST).detect(image, None)
        far, at = (
            np.asarray(x) for x in KDTree([key.pt for key in found]).query(pixels[rows] + center)
        )
        assert far.max() < 0.01, "the problem is not of these images"
        corner = cv2.cornerMinEigenVal(image, 7)
        keys = [found[one] for one in at]
        x, y = np.minimum(
            np.rint([key.pt for key in keys]).astype(int), np.array(corner.shape)[::-1] - 1
        ).T
        numbers[rows] = np.stack(
            [[key.size for key in keys], [key.response for key in keys], corner[y, x]], axis=1
        )
    size, response, contrast = np.log(numbers + np.array([0, 0, 1e-6])).T
    point = np.asarray(problem.point_index)
    camera = np.asarray(problem.camera_index)
    order = np.lexsort((camera, point))
    inverse = np.argsort(order)
    starts = np.searchsorted(point[order], np.arange(problem.num_points))
    length = np.bincount(point)[point]
    age = inverse - starts[point]

    def own(x):
        return np.abs(x - (np.bincount(point, x) / np.bincount(point))[point])

    step = np.linalg.norm(np.diff(pixels[order], axis=0, prepend=pixels[order][:1]), axis=1)
    step[starts] = step[starts + 1]
    found = {
        "size": size,
        "response": response,
        "contrast": contrast,
        "length": np.log(length),
        "age": np.log1p(age),
    }
    found |= {
        "size beside track": np.minimum(own(size), 1),
        "response beside track": np.minimum(own(response), 2),
    }
    return found | {
        "motion": np.log1p(step[inverse]),
        "radius": np.hypot(*pixels.T) / 600,
        "y": pixels[:, 1] / 600,
    }


def kitti(path: str, folder: str, poses: str, steps: int = 12) -> None:
    """Windows of a sequence: training on the first frames, ratios on the last."""
    problem = read_problem(path)
    side = read_sidecar(path)
    frames = np.asarray(side.frames)
    truth = poses_of(read_poses(poses), side.frames, side.calibration)[:, :, 3]
    kept = Path(f"{path}.features.npz")
    if not kept.exists():
        np.savez(kept, allow_pickle=False, **features_of(problem, side.frames, folder))
    columns = dict(np.load(kept))
    table = np.stack([*columns.values()], axis=1)
    number = frames[problem.camera_index]
    learned = table[(number >= TRAIN.start) & (number < TRAIN.stop)]
    table = (table - learned.mean(axis=0)) / learned.std(axis=0)
    part_of = np.random.default_rng(0).integers(SHARE, size=problem.num_points)

    def window(first: int, parts: range) -> Case:
        cameras = np.flatnonzero((frames >= first) & (frames < first + WIDTH))
        rows = np.isin(problem.camera_index, cameras) & np.isin(part_of[problem.point_index], parts)
        rows &= (
            np.bincount(problem.point_index[rows], minlength=problem.num_points)[
                problem.point_index
            ]
            >= 2
        )
        own = problem.subset(rows, cameras, np.unique(problem.point_index[rows]))
        return Case(own, table[rows], truth[cameras])

    def cut(starts, count):
        return [window(first, range(k, k + 1)) for first in starts for k in range(count)]

    train = cut(TRAIN, PARTS)
    test = cut(TEST, SHARE)
    twin, start = choose_twin(train, train + test)
    half = SHARE // 2
    for at, first in enumerate(TEST):
        rest = window(first, range(half, SHARE))
        found = jaxba.solve(
            whitened(rest, equal(rest, twin[1])), options=replace(SOLVE, loss=jaxba.Loss(twin[0]))
        )
        for case in test[at * SHARE : at * SHARE + half]:
            case.others = geometry.camera_centers(np.asarray(found.problem.cameras))
    base = ends(test, equal(test[0], twin[1]), twin[0])
    residuals = by_residuals(train)
    print(
        f"{len(test)} held-out problems; twin", twin, geometric_mean(base[0]), *columns, flush=True
    )
    report(test, base, "equal", equal(test[0], 1.0))
    report(test, base, "residuals", residuals)
    report(test, base, "solve", through_solve(train[::PARTS], start, steps))
    report(test, base, "both", through_solve(train[::PARTS], residuals, steps))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    tyro.extras.subcommand_cli_from_dict({"scenes": scenes, "kitti": kitti})
