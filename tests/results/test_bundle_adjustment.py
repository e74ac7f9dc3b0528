"""`bundle_adjustment` and its siblings in the place of pycolmap's.

The truth is pycolmap itself, or the same views from a start at the true points.
"""

from __future__ import annotations

import copy
import itertools
from types import SimpleNamespace

import numpy as np
import pytest

import jaxba
from jaxba.results.bundle_adjustment import solve_options

pycolmap = pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")

pytestmark = pytest.mark.extra

IMAGES = 6
POINTS = 60
DISPLACED = 5  # points
TYPES = pycolmap.BundleAdjustmentTerminationType


def scene(seed: int = 1):
    """A scene of one lens with noise, and the true one with the same pixels."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = options.num_cameras_per_rig = 1
    options.num_frames_per_rig = IMAGES
    options.num_points3D = POINTS
    found = pycolmap.synthesize_dataset(options)
    true = {point: np.array(value.xyz) for point, value in found.points3D.items()}
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.5
    noise.rig_from_world_rotation_stddev = 0.5
    noise.rig_from_world_translation_stddev = 0.02
    pycolmap.synthesize_noise(noise, found)
    return found, true


@pytest.fixture(scope="module")
def start():
    return scene()[0]


def configuration(model, images=None, gauge="TWO_CAMS_FROM_WORLD"):
    config = pycolmap.BundleAdjustmentConfig()
    for image in sorted(model.reg_image_ids()) if images is None else images:
        config.add_image(image)
    config.fix_gauge(getattr(pycolmap.BundleAdjustmentGauge, gauge))
    return config


def quiet(**solver):
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    for name, value in solver.items():
        setattr(options.ceres.solver_options, name, value)
    return options


def numbers(model):
    """Everything that a bundle adjustment may change."""
    poses = [image.cam_from_world().matrix().tolist() for _, image in sorted(model.images.items())]
    points = [(point, value.xyz.tolist()) for point, value in sorted(model.points3D.items())]
    views = [value.track.length() for _, value in sorted(model.points3D.items())]
    return poses, points, views, [camera.params.tolist() for camera in model.cameras.values()]


def cost(model):
    """Over all views, infinite with one of a point behind its image."""
    total = 0.0
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.images[element.image_id]
            pixel = image.project_point(point.xyz)
            if pixel is None:
                return np.inf
            difference = pixel - image.points2D[element.point2D_idx].xy
            total += 0.5 * float(difference @ difference)
    return total


def displaced(seed):
    """A scene with points far away in random directions, and the true points."""
    model, true = scene(seed)
    rng = np.random.default_rng(seed)
    for point in rng.choice(sorted(true), DISPLACED, replace=False).tolist():
        away = rng.normal(size=3)
        model.point3D(point).xyz = true[point] + 20 * away / np.linalg.norm(away)
    return model, true


@pytest.mark.filterwarnings("ignore:the reconstruction. deleted:jaxba.ProblemWarning")
def test_displaced_points_come_back_and_views_behind_are_deleted_as_by_colmap():
    ours, true = displaced(1)
    theirs = copy.deepcopy(ours)
    right = copy.deepcopy(ours)
    pycolmap.ObservationManager(right).filter_observations_with_negative_depth()
    assert right.compute_num_observations() < ours.compute_num_observations()
    for point in right.points3D:
        right.point3D(point).xyz = true[point]
    jaxba.bundle_adjustment(right, quiet())
    solution = jaxba.bundle_adjustment(ours, quiet())
    pycolmap.bundle_adjustment(theirs, quiet())
    assert numbers(ours)[2] == numbers(theirs)[2] == numbers(right)[2]
    assert solution.initial_cost > 1e6
    assert cost(ours) == pytest.approx(cost(right), rel=1e-5)
    assert cost(ours) <= cost(theirs) * (1 + 1e-5)


def test_what_is_deleted_is_said():
    model, _ = displaced(1)
    before = model.compute_num_observations()
    with pytest.warns(jaxba.ProblemWarning, match=r"deleted \d+ views of points behind") as notes:
        jaxba.bundle_adjustment(model, quiet(max_num_iterations=1))
    assert f"deleted {before - model.compute_num_observations()} views" in str(notes[0].message)


def test_a_point_that_is_seen_impossibly_far_from_its_pixels_comes_back(start):
    model = copy.deepcopy(start)
    image = model.images[1]
    # in front of it, far to the side
    near = image.cam_from_world().inverse() * np.array([0.02, 0.0, 0.005])
    model.point3D(3).xyz = near
    in_front = [(other.cam_from_world() * near)[2] > 0 for other in model.images.values()]
    assert all(in_front)
    right = copy.deepcopy(start)
    jaxba.bundle_adjustment(right, quiet())
    solution = jaxba.bundle_adjustment(model, quiet())
    assert solution.initial_cost > 1e5
    assert cost(model) == pytest.approx(cost(right), rel=1e-6)


def test_with_a_config_views_behind_stay_and_count_for_nothing(start):
    model = copy.deepcopy(start)
    image = model.images[1]
    model.point3D(3).xyz = image.cam_from_world().inverse() * np.array([0.0, 0.0, -3.0])
    views = numbers(model)[2]
    solution = jaxba.bundle_adjustment(model, quiet(), configuration(model))
    assert numbers(model)[2] == views
    assert 2 * IMAGES * POINTS - 2 * IMAGES <= solution.num_residuals < 2 * IMAGES * POINTS
    assert solution.final_cost < IMAGES * POINTS


def nothing(kind, model):
    """A reconstruction and a config that see nothing."""
    config = configuration(model)
    if kind == "no points":
        for point in list(model.points3D):
            model.delete_point3D(point)
    if kind == "behind":
        config = None
        for point in model.points3D:
            model.point3D(point).xyz = model.point3D(point).xyz + np.array([0.0, 0.0, 1e4])
        for frame in model.frames.values():
            frame.rig_from_world = pycolmap.Rigid3d()
        for point in model.points3D:
            model.point3D(point).xyz = -np.abs(model.point3D(point).xyz)
    if kind == "empty config":
        config = pycolmap.BundleAdjustmentConfig()
    return config


@pytest.mark.parametrize("kind", ["no points", "behind", "empty config", "no images"])
def test_where_nothing_is_seen_a_summary_says_failure_and_nothing_changes(start, kind):
    model = pycolmap.Reconstruction() if kind == "no images" else copy.deepcopy(start)
    config = None if kind == "no images" else nothing(kind, model)
    before = numbers(model)
    summary = jaxba.bundle_adjustment(model, quiet(), config)
    assert summary.termination_type == TYPES.FAILURE
    assert not summary.is_solution_usable()
    assert summary.num_residuals == summary.num_residuals_reduced == summary.num_parameters == 0
    assert "FAILURE" in summary.brief_report()
    assert "nothing is observed" in summary.full_report()
    assert numbers(model) == before


@pytest.mark.parametrize("points", [1, 2])
def test_a_gauge_that_too_few_points_cannot_hold_is_left_out_as_by_colmap(start, points):
    model = copy.deepcopy(start)
    for point in sorted(model.points3D)[points:]:
        model.delete_point3D(point)
    config = configuration(model, sorted(model.reg_image_ids())[:2], "THREE_POINTS")
    assert jaxba.bundle_adjustment(model, quiet(), config).is_solution_usable()


def test_a_summary_speaks_as_pycolmaps(start):
    theirs = copy.deepcopy(start)
    ours = copy.deepcopy(start)
    config = configuration(start)
    expected = pycolmap.create_default_bundle_adjuster(quiet(), config, theirs).solve()
    summary = jaxba.create_default_bundle_adjuster(quiet(), config, ours).solve()
    assert summary.termination_type == expected.termination_type == TYPES.CONVERGENCE
    assert summary.is_solution_usable()
    assert expected.is_solution_usable()
    assert summary.num_residuals == summary.num_residuals_reduced == expected.num_residuals
    assert summary.brief_report().startswith(
        f"jaxba report: Iterations: {summary.iterations}, Initial cost: "
    )
    assert cost(ours) == pytest.approx(cost(theirs), rel=1e-6)
    assert isinstance(summary, jaxba.Solution)


def test_a_dictionary_means_what_pycolmap_makes_of_it(start):
    values = {"refine_focal_length": False, "ceres": {"solver_options": {"max_num_iterations": 2}}}
    ours = copy.deepcopy(start)
    same = copy.deepcopy(start)
    summary = jaxba.bundle_adjustment(ours, values)
    jaxba.bundle_adjustment(same, pycolmap.BundleAdjustmentOptions(values))
    assert numbers(ours) == numbers(same)
    assert ours.cameras[1].focal_length == start.cameras[1].focal_length
    assert summary.iterations == 2
    assert summary.termination_type == TYPES.NO_CONVERGENCE
    assert summary.is_solution_usable()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"refine_focal": False}, "pycolmap .* has no option refine_focal$"),
        ({"ceres": {"eta": 1}}, r"has no option ceres\.eta$"),
        ({"refine_focal_length": "no"}, "could not assign refine_focal_length$"),
        (
            "fast",
            "options must be a pycolmap.BundleAdjustmentOptions or a dictionary of its values, not "
            "'fast'",
        ),
    ],
)
def test_options_that_pycolmap_does_not_have_are_refused_in_one_line(start, options, said):
    model = copy.deepcopy(start)
    with pytest.raises(ValueError, match=said) as error:
        jaxba.bundle_adjustment(model, options)
    assert "\n" not in str(error.value)
    assert numbers(model) == numbers(start)


def test_a_token_stops_the_solve_in_the_third_place_and_by_name(start):
    token = pycolmap.CancellationToken()
    assert jaxba.bundle_adjustment(copy.deepcopy(start), quiet(), token).converged
    assert jaxba.bundle_adjustment(copy.deepcopy(start), quiet(), cancellation_token=None).converged
    token.cancel()
    stopped = jaxba.bundle_adjustment(copy.deepcopy(start), quiet(), cancellation_token=token)
    assert stopped.iterations == 1
    assert stopped.termination_type == TYPES.NO_CONVERGENCE
    with pytest.raises(
        ValueError, match=r"config must be a pycolmap\.BundleAdjustmentConfig, not 'all'"
    ):
        jaxba.bundle_adjustment(copy.deepcopy(start), quiet(), "all")


def test_the_limits_of_colmaps_mapper_count(start):
    local = pycolmap.IncrementalPipelineOptions().get_local_bundle_adjustment()
    chosen = solve_options(local)
    assert chosen.tolerances.gtol == local.ceres.solver_options.gradient_tolerance == 10.0
    assert chosen.max_iterations == local.ceres.solver_options.max_num_iterations == 25
    summary = jaxba.bundle_adjustment(copy.deepcopy(start), quiet(gradient_tolerance=1e9))
    assert summary.termination == jaxba.Termination.GRADIENT
    assert summary.iterations == 1


def test_a_time_limit_ends_the_solve(start, monkeypatch):
    seconds = itertools.count()  # one passes whenever somebody looks
    monkeypatch.setattr("jaxba.solver.time_limit.clock", lambda: float(next(seconds)))
    model = copy.deepcopy(start)
    summary = jaxba.bundle_adjustment(model, quiet(max_solver_time_in_seconds=4.5))
    assert summary.termination == jaxba.Termination.TIME_LIMIT
    assert summary.termination_type == TYPES.NO_CONVERGENCE
    assert summary.is_solution_usable()
    assert summary.iterations > 0
    assert cost(model) < cost(start)


def test_a_time_limit_below_the_set_up_leaves_the_start_as_in_colmap(start):
    ours = copy.deepcopy(start)
    theirs = copy.deepcopy(start)
    options = quiet(max_solver_time_in_seconds=1e-6)
    with pytest.warns(
        jaxba.ProblemWarning, match="the time limit was over before the first iteration"
    ):
        summary = jaxba.create_default_bundle_adjuster(options, configuration(ours), ours).solve()
    expected = pycolmap.create_default_bundle_adjuster(
        options, configuration(theirs), theirs
    ).solve()
    assert summary.iterations == 0
    assert summary.termination_type == expected.termination_type == TYPES.NO_CONVERGENCE
    assert cost(ours) == pytest.approx(cost(theirs), rel=1e-12)


def test_what_is_ignored_and_would_change_the_end_is_named(start):
    options = quiet(min_trust_region_radius=1e-3, eta=0.3, num_threads=2)
    named = r"ignored ceres\.solver_options\.min_trust_region_radius, so"
    with pytest.warns(jaxba.ProblemWarning, match=named) as notes:
        jaxba.bundle_adjustment(copy.deepcopy(start), options)
    assert len(notes) == 1
    options = pycolmap.BundleAdjustmentOptions(backend="CASPAR")
    options.caspar.solver_iter_max = 3
    with pytest.warns(jaxba.ProblemWarning, match=r"ignored caspar\.solver_iter_max, so"):
        jaxba.bundle_adjustment(copy.deepcopy(start), options)


@pytest.mark.parametrize("gauge", ["THREE_POINTS", "TWO_CAMS_FROM_WORLD"])
def test_a_local_adjustment_gives_no_warning(start, gauge):
    model = copy.deepcopy(start)
    config = configuration(model, sorted(model.reg_image_ids())[:3], gauge)
    assert jaxba.bundle_adjustment(model, quiet(), config).converged  # warnings are errors in tests


@pytest.mark.filterwarnings("ignore:the reconstruction. 1 point left out:jaxba.ProblemWarning")
@pytest.mark.parametrize("loss", ["TRIVIAL", "CAUCHY"])
def test_pose_priors_end_where_pycolmaps_do(start, loss):
    rng = np.random.default_rng(0)
    priors = []
    for number, image in sorted(start.images.items()):
        position = 3 * image.projection_center() + [10, 20, 30] + rng.normal(size=3) * 0.05
        priors.append(
            pycolmap.PosePrior(
                corr_data_id=image.data_id,
                position=position + (2.0 if number == 2 else 0.0),
                position_covariance=np.diag([0.05, 0.05, 0.1]) ** 2,
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
        )
    priors[3].position_covariance = np.full((3, 3), np.nan)
    prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
    prior_options.ceres.prior_position_loss_function_type = getattr(pycolmap.LossFunctionType, loss)
    options = quiet(function_tolerance=1e-14, gradient_tolerance=1e-12, parameter_tolerance=1e-14)
    config = pycolmap.BundleAdjustmentConfig()
    for image in start.images:
        config.add_image(image)
    ours = copy.deepcopy(start)
    theirs = copy.deepcopy(start)
    ours.add_point3D(np.ones(3), pycolmap.Track())  # seen by nothing: it moves with the rest
    arguments = options, prior_options, config, priors
    pycolmap.create_pose_prior_bundle_adjuster(*arguments, theirs).solve()
    assert jaxba.create_pose_prior_bundle_adjuster(*arguments, ours).solve().converged
    for number, image in theirs.images.items():
        np.testing.assert_allclose(
            ours.images[number].projection_center(), image.projection_center(), atol=1e-6
        )
    assert np.linalg.norm(ours.points3D[max(ours.points3D)].xyz - [10, 20, 30]) < 6


def test_priors_that_say_nothing_are_refused(start):
    config = configuration(start)
    for priors, said in (
        ([], "no image of the config has a position"),
        ([degrees(start)], "image 1 is in degrees"),
    ):
        adjuster = jaxba.create_pose_prior_bundle_adjuster(
            quiet(),
            pycolmap.PosePriorBundleAdjustmentOptions(),
            config,
            priors,
            copy.deepcopy(start),
        )
        with pytest.raises(ValueError, match=f"^pose_priors: .*{said}"):
            adjuster.solve()


def degrees(model):
    return pycolmap.PosePrior(
        corr_data_id=model.images[1].data_id,
        position=[47.0, 8.0, 400.0],
        coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84,
    )


def test_a_pycolmap_without_rigs_is_refused_before_anything_changes(start):
    class Older:
        """A reconstruction of pycolmap 3.10."""

        def write_binary(self, folder):
            raise AssertionError("read although it cannot be written back")

    broken = SimpleNamespace(refine_focal_length=True)  # options whose other values cannot be read
    for options in (None, broken):
        with pytest.raises(ValueError, match=r"^this needs pycolmap 3\.12 or newer"):
            jaxba.bundle_adjustment(Older(), options)
    with pytest.raises(ValueError, match=r"^this needs pycolmap 3\.12 or newer"):
        jaxba.from_pycolmap(Older())
