"""Geometry against OpenCV, SciPy and itself; what fixed cameras see, against what can be reckoned by hand."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from freshfield import geometry
from freshfield.coverage import MOST_OBLIQUE_DEG, PLAN, plan_svg, reckon
from freshfield.geometry import Pinhole, Pose, look_at, quaternion_normalize, quaternion_to_matrix, se3_inverse, so3_log
from tests.support import refused

finite = st.floats(-1e3, 1e3, allow_subnormal=True)
vectors = st.tuples(finite, finite, finite)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: max(map(abs, q)) > 1e-3)


def scipy(q) -> Rotation:
    return Rotation.from_quat([q[1], q[2], q[3], q[0]])


@given(quaternions)
def test_quaternions_and_matrices_agree_with_scipy(q):
    m = quaternion_to_matrix(q)
    np.testing.assert_allclose(m, scipy(q).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(m @ m.T, np.eye(3), atol=1e-12)
    # Up to sign: a half turn has w = 0, where both are normal.
    assert abs(geometry.matrix_to_quaternion(m) @ quaternion_normalize(q)) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(quaternion_to_matrix(geometry.matrix_to_quaternion(m)), m, atol=1e-12)


@given(quaternions, quaternions)
def test_products_compose_rotations(a, b):
    product, whole = quaternion_to_matrix(geometry.quaternion_multiply(a, b)), scipy(a) * scipy(b)
    np.testing.assert_allclose(product, whole.as_matrix(), atol=1e-9)


def test_normalising_survives_any_scale_and_refuses_what_has_no_direction():
    for scale in (1e-300, 1e-30, 1.0, 1e30, 1e300):
        np.testing.assert_allclose(quaternion_normalize([0.0, 3.0 * scale, -4.0 * scale, 0.0]), [0, 0.6, -0.8, 0])
    np.testing.assert_allclose(np.linalg.norm(quaternion_normalize([0.0, 5e-324, -5e-324, 0.0])), 1.0, rtol=1e-12)
    for none in ([0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1]):
        refused(geometry.GeometryError, "", quaternion_normalize, none)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, -2, 3]])
@pytest.mark.parametrize("angle", [0, 1e-12, 1e-5, 1e-4, 0.1, 3.0, np.pi - 1e-9, np.pi - 1e-5, np.pi])
def test_half_turns_and_tiny_turns(axis, angle):
    w = np.array(axis) / np.linalg.norm(axis) * angle
    m = geometry.so3_exp(w)
    np.testing.assert_allclose(m, Rotation.from_rotvec(w).as_matrix(), atol=1e-9)
    back = so3_log(m)
    # At pi both signs are right.
    assert min(np.abs(back - w).max(), np.abs(back + w).max() if angle > 3.14 else np.inf) < 1e-7
    np.testing.assert_allclose(geometry.so3_exp(back), m, atol=1e-9)


@given(quaternions, quaternions, st.floats(0, 1))
def test_slerp_goes_the_shorter_way_at_constant_speed(a, b, fraction):
    start, end = quaternion_to_matrix(a), quaternion_to_matrix(b)
    whole = np.linalg.norm(so3_log(start.T @ end))
    middle = quaternion_to_matrix(geometry.slerp(a, b, fraction))
    assert np.linalg.norm(so3_log(start.T @ middle)) == pytest.approx(fraction * whole, abs=1e-6)
    np.testing.assert_allclose(quaternion_to_matrix(geometry.slerp(a, b, 1)), end, atol=1e-9)
    between = Pose(tuple(a), (0.0, 0.0, 1.0)).interpolate(Pose(tuple(b), (2.0, 4.0, 1.0)), fraction)
    assert between.translation_m == pytest.approx((2 * fraction, 4 * fraction, 1.0))
    np.testing.assert_allclose(between.matrix()[:3, :3], middle, atol=1e-9)


def test_matrices_that_are_no_pose_are_refused():
    for spoil in (
        lambda m: m * [[-1], [1], [1], [1]],  # mirrored
        lambda m: m * 1.01,  # scaled
        lambda m: m + np.triu(np.full((4, 4), 0.01)),  # sheared
        lambda m: np.where(np.eye(4) > 0, np.nan, m),
        lambda m: m[:2],
        lambda m: m * [[1], [1], [1], [2]],
    ):
        refused(geometry.GeometryError, "", Pose.from_matrix, spoil(look_at([1, 2, 3], [0, 0, 0])))


@given(vectors, vectors)
def test_look_at_looks_at(eye, target):
    if np.linalg.norm(np.subtract(eye, target)) < 1e-6:
        return
    m = look_at(eye, target)
    Pose.from_matrix(m)  # rigid and right-handed
    local = se3_inverse(m) @ np.append(target, 1.0)
    distance = np.linalg.norm(np.subtract(eye, target))
    np.testing.assert_allclose(local[:3], [0, 0, distance], atol=1e-6 * max(1, distance, *map(abs, eye)))
    assert m[2, 1] <= 1e-9  # image-down never points up
    Pose.from_matrix(look_at(eye, np.subtract(eye, (0, 0, 1))))  # straight down
    refused(geometry.GeometryError, "", look_at, eye, eye)


def test_a_lens_that_folds_back_does_not_see_what_is_aside():
    lens, places = Pinhole(96, 72, 105.0, 105.0, 48.0, 36.0, (-0.3, 0.0, 0.0, 0.0)), [(-1.6, 0.0, 1.0), (0.2, 0.0, 1.0)]
    _, at, inside = geometry.seen_from(lens, np.eye(4), places)
    assert geometry.invertible(lens) and (at > 0).all() and inside.tolist() == [False, True]


def test_rays_converge_where_least_squares_says():
    rng = np.random.default_rng(0)
    origins = rng.standard_normal((5, 3)) * 4.0
    ways = np.array([1.0, 2.0, 3.0]) + 0.1 * rng.standard_normal((5, 3)) - origins
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    across = np.eye(3) - ways[:, :, None] * ways[:, None, :]
    wanted = np.linalg.lstsq(across.reshape(-1, 3), (across @ origins[..., None]).ravel(), rcond=None)[0]
    assert geometry.converging_point(origins, ways) == pytest.approx(wanted)
    assert geometry.converging_point(origins, -ways) is None, "they run apart"
    assert geometry.converging_point(origins, np.tile(ways[0], (5, 1))) is None, "they are parallel"


lenses = st.builds(
    Pinhole,
    width=st.integers(16, 640),
    height=st.integers(16, 480),
    fx=st.floats(200, 600),
    fy=st.floats(200, 600),
    cx=st.floats(100, 400),
    cy=st.floats(100, 300),
    distortion=st.tuples(
        st.floats(-0.05, 0.1), st.floats(-0.02, 0.05), st.floats(-0.002, 0.002), st.floats(-0.002, 0.002)
    ),
)


@given(lenses, st.integers(0, 2**32))
def test_projection_agrees_with_opencv(camera, seed):
    """OpenCV counts pixel centers as whole numbers, we the image's corner as zero: half a pixel apart."""
    points = np.random.default_rng(seed).uniform([-1, -1, 2], [1, 1, 5], (20, 3))
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), *camera.opencv())
    np.testing.assert_allclose(camera.project(points), theirs[:, 0] + 0.5, atol=1e-6)
    read = Pinhole.from_opencv(camera.width, camera.height, *camera.opencv())
    np.testing.assert_allclose(read.project(points), camera.project(points), atol=1e-6)


@given(lenses, st.integers(0, 2**32))
def test_rays_undo_projection(camera, seed):
    points = np.random.default_rng(seed).uniform([-0.8, -0.8, 1.6], [0.8, 0.8, 4], (20, 3))
    rays = camera.rays(camera.project(points))
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=1, keepdims=True), atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    wide = Pinhole(640, 480, 400, 400, 320, 240, (-0.22, 0.03, 1e-3, -1e-3))  # nearly folds at its corners
    np.testing.assert_allclose(wide.project(wide.rays([[0, 0], [640, 480]])), [[0, 0], [640, 480]], atol=1e-6)
    folds = Pinhole(
        64, 48, 58.772257, 58.772257, 30.759072, 22.351561, (-0.23285114, -0.07019271, 1.09234e-3, 4.09036e-4)
    )
    assert geometry.invertible(folds)
    assert np.abs(folds.project(folds.rays([[64, 48]])) - [[64, 48]]).max() < 1, "on the fold"


@given(st.integers(8, 200), st.integers(8, 200), st.floats(20, 120), st.sampled_from([0.25, 0.5, 1 / 3, 2.0]))
def test_scaling_leaves_directions_where_they_were(width, height, fov, factor):
    """The corners of the image look the same way at any size."""
    camera = Pinhole.from_fov(width, height, fov)
    small = camera.scaled(factor)
    corners = np.array([[0, 0], [1, 1], [0.25, 0.75]])
    np.testing.assert_allclose(
        small.rays(corners * [small.width, small.height]), camera.rays(corners * [width, height]), atol=1e-12
    )


def test_a_lens_from_its_field_of_view():
    camera = Pinhole.from_fov(100, 50, 90)
    assert camera.fx == pytest.approx(50) and (camera.cx, camera.cy) == (50, 25)
    assert np.isnan(camera.project([[0, 0, -1.0], [0, 0, 0.0]])).all(), "behind the camera there is no pixel"


LENS = Pinhole.from_fov(100, 100, 70.0)
# Share of the directions of the sphere within an angle of one of them.
FACING = (1.0 - np.cos(np.deg2rad(MOST_OBLIQUE_DEG))) / 2.0


def camera(azimuth_deg, distance=3.0, height=0.0, lens=LENS):
    a = np.deg2rad(azimuth_deg)
    return lens, look_at((distance * np.sin(a), -distance * np.cos(a), height), (0.0, 0.0, 0.0))


def test_one_camera_sees_what_faces_it():
    found = reckon([camera(0)])
    assert found.seen_by[1] == pytest.approx(FACING, abs=0.02)
    assert found.parallax_deg is None
    assert (found.plan[PLAN // 2, PLAN // 2], found.plan.max(), found.plan.min()) == (1, 1, 0)
    # One more helps most from behind, where it sees as much again.
    assert found.further_pose[:3, 3] @ [0, -1, 0] < -2.0
    assert found.further_seen_by[0] == pytest.approx(1 - 2 * FACING, abs=0.03)


def test_a_further_camera_counts_what_it_shows_first_and_half_again_what_two_then_see():
    def worth(shares):
        return 1 - shares[0] + 0.5 * sum(shares[2:])

    for azimuths in ([0, 40], [0, 90, 200]):
        rig = [camera(azimuth) for azimuth in azimuths]
        found = reckon(rig)
        assert found.further_seen_by == reckon([*rig, (LENS, found.further_pose)]).seen_by
        others = [worth(reckon([*rig, camera(azimuth)]).seen_by) for azimuth in range(0, 360, 15)]
        assert worth(found.further_seen_by) > max(others) - 0.01 and worth(found.further_seen_by) > min(others) + 0.1


@pytest.mark.stability
@pytest.mark.parametrize(
    "poses",
    [
        [np.eye(4)],
        [look_at((0, 0, 3.0), (0, 0, 0), (0, 1, 0))] * 2,  # straight down
        [look_at((0, 0, 0), (1, 0, 0)), look_at((0, 0, 0), (-1, 0, 0))],  # away from each other
        [np.eye(4), np.block([[np.eye(3), np.full((3, 1), 1e6)], [np.array([[0, 0, 0, 1.0]])]])],
    ],
)
def test_odd_rigs_give_finite_numbers(poses):
    found = reckon([(LENS, np.asarray(pose, np.float64)) for pose in poses])
    assert sum(found.seen_by) == pytest.approx(1.0) and np.isfinite(found.further_pose).all()
    assert "nan" not in plan_svg({str(k): (LENS, p) for k, p in enumerate(poses)}, found) and "nan" not in found.words
    refused(ValueError, "no camera", reckon, [])
