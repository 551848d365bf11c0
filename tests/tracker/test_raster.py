"""The rasterizer against triangles worked by hand and against ray casting."""

import numpy as np
import trimesh

from tracker.raster import project, rasterize, render, shade, vertex_normals

TRIANGLE = np.array([[0, 1, 2]], np.int32)
FACING = np.array(
    [[2, 2, 1], [2, 12, 1], [12, 2, 1]], np.float32
)  # counter-clockwise on a screen with y down
CENTRE = np.array([0.01, -0.02, 0.5])


def _icosphere() -> tuple[np.ndarray, np.ndarray]:
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    return sphere.vertices + CENTRE, sphere.faces.astype(np.int32)


def test_one_triangle_covers_exactly_its_pixels() -> None:
    raster = rasterize(FACING, TRIANGLE, (16, 14))
    y, x = np.mgrid[:14, :16]
    inside = (x >= 2) & (y >= 2) & (x + y <= 14)
    assert raster.triangle.shape == (14, 16)
    np.testing.assert_array_equal(raster.triangle == 0, inside)
    np.testing.assert_allclose(raster.barycentric[inside].sum(1), 1, atol=1e-6)
    np.testing.assert_allclose(
        raster.barycentric[inside] @ FACING, np.c_[x[inside], y[inside], np.ones(inside.sum())], atol=1e-5
    )
    assert np.isinf(raster.depth[~inside]).all()


def test_back_faces_are_culled() -> None:
    assert (rasterize(FACING, TRIANGLE[:, ::-1], (16, 16)).triangle < 0).all()


def test_the_nearer_triangle_wins_whatever_the_order() -> None:
    near, far = FACING - [0, 0, 0.5], FACING
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    for vertices, front in ((np.r_[near, far], 0), (np.r_[far, near], 1)):
        raster = rasterize(vertices, faces, (16, 16))
        assert set(np.unique(raster.triangle)) == {-1, front}
        assert np.isclose(raster.depth[3, 3], 0.5)


def test_weights_are_those_of_the_surface_not_of_the_screen() -> None:
    corners = np.array([[-0.1, -0.1, 0.4], [-0.1, 0.1, 0.5], [0.1, -0.1, 0.9]])
    pixels = np.c_[project(corners, 60.0, (20, 20)), corners[:, 2]]
    raster = rasterize(pixels, TRIANGLE, (40, 40))
    y, x = np.nonzero(raster.triangle == 0)
    points = raster.barycentric[y, x] @ corners
    np.testing.assert_allclose(project(points, 60.0, (20, 20)), np.c_[x, y], atol=1e-4)
    np.testing.assert_allclose(points[:, 2], raster.depth[y, x], rtol=1e-5)


def test_agrees_with_ray_casting() -> None:
    vertices, faces = _icosphere()
    pixels = np.c_[project(vertices, 200.0, (40, 40)), vertices[:, 2]]
    raster = rasterize(pixels, faces, (80, 80))
    rng = np.random.default_rng(0)
    xy = rng.integers(5, 75, (60, 2))
    rays = np.c_[(xy - 40) / 200.0, np.ones(60)]
    # Every ray against every triangle: ray · t = (1 - u - v) a + u b + v c.
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    system = np.stack(np.broadcast_arrays(rays[:, None], (a - b)[None], (a - c)[None]), axis=-1)
    t, u, v = np.moveaxis(
        np.linalg.solve(system, np.broadcast_to(a, system.shape[:3])[..., None])[..., 0], -1, 0
    )
    t[(u < 0) | (v < 0) | (u + v > 1)] = np.inf
    np.testing.assert_allclose(raster.depth[xy[:, 1], xy[:, 0]], t.min(1), rtol=1e-4)
    hit = np.isfinite(t.min(1))
    assert 10 < hit.sum() < 60
    assert (raster.triangle[xy[:, 1], xy[:, 0]] == t.argmin(1))[hit].mean() > 0.95


def test_triangles_behind_the_camera_not_finite_or_far_outside_draw_nothing() -> None:
    for bad in (-1.0, np.nan, np.inf):
        vertices = FACING.copy()
        vertices[1, 2] = bad
        assert (rasterize(vertices, TRIANGLE, (16, 16)).triangle < 0).all() or bad == np.inf
        vertices = FACING.copy()
        vertices[1, 0] = np.nan if bad == -1 else bad
        assert (rasterize(vertices, TRIANGLE, (16, 16)).triangle < 0).all()
    assert (rasterize(FACING + np.float32([1e8, 0, 0]), TRIANGLE, (16, 16)).triangle < 0).all()


def test_normals_of_a_sphere_point_outwards() -> None:
    vertices, faces = _icosphere()
    radial = (vertices - CENTRE) / 0.1
    assert (np.einsum("vi,vi->v", vertex_normals(vertices, faces), radial) > 0.999).all()


def test_shading_keeps_the_background_and_is_bright_towards_the_light() -> None:
    vertices, faces = _icosphere()
    albedo = np.full((len(vertices), 3), 200, np.uint8)
    pixels = np.c_[project(vertices, 200.0, (40, 40)), vertices[:, 2]]
    raster = rasterize(pixels, faces, (80, 80))
    background = np.random.default_rng(1).integers(0, 255, (80, 80, 3)).astype(np.uint8)
    picture = shade(raster, faces, vertices, albedo, background, light=(-1, 0, -1), ambient=0.2)
    empty = raster.triangle < 0
    np.testing.assert_array_equal(picture[empty], background[empty])
    y, x = np.nonzero(~empty)
    row = y == 32
    left, right = picture[y, x][row & (x < 35)].mean(), picture[y, x][row & (x > 55)].mean()
    assert left > right + 40


def test_supersampling_does_not_move_the_picture() -> None:
    vertices, faces = _icosphere()
    albedo = np.full((len(vertices), 3), 255, np.uint8)
    centres = []
    for samples in (1, 4):
        picture = render(vertices, faces, albedo, 200.0, (40.0, 40.0), (80, 80), (0, 0, 0), samples)
        weight = (picture[..., 0] > 60).astype(float)
        y, x = np.mgrid[:80, :80]
        centres.append([(weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()])
    np.testing.assert_allclose(centres[0], centres[1], atol=0.1)


def test_what_the_light_does_not_reach_has_the_skys_share_of_it() -> None:
    vertices, faces = _icosphere()
    albedo = np.full((len(vertices), 3), 200, np.uint8)
    raster = rasterize(np.c_[project(vertices, 200.0, (40, 40)), vertices[:, 2]], faces, (80, 80))
    behind, ahead = (
        shade(raster, faces, vertices, albedo, (0, 0, 0), light=(0, 0, z), ambient=0.25).max()
        for z in (1, -1)
    )
    assert behind == 100  # squares stand for light: half of 200
    assert abs(int(ahead) - 200) <= 1
