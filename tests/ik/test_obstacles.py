"""Distances to obstacles: closed forms, and what holds for all of them."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import obstacles
from hybridkin._core.rotations import rotation
from hybridkin.ik.obstacles import as_numbers, distances

TURN = rotation(torch.tensor([0.3, -0.7, 0.5], dtype=torch.float64))[0]
BOX = obstacles.Box([1.0, 2.0, 3.0], [0.2, 0.4, 1.0], TURN)
ALL = {
    "sphere": obstacles.Sphere([0.1, -0.2, 0.5], 0.3),
    "half-space": obstacles.HalfSpace([1.0, 2.0, -2.0], 0.6),
    "capsule": obstacles.Capsule([0.0, -1.0, 0.5], [0.3, 1.0, 0.2], 0.1),
    "box": BOX,
    "round box": obstacles.Box([1.0, 2.0, 3.0], [0.2, 0.4, 1.0], TURN, radius=0.1),
}


def points(n=2000, size=2.0, seed=0):
    return size * torch.randn(n, 3, dtype=torch.float64, generator=torch.manual_seed(seed))


def test_a_sphere_a_plane_a_rod():
    x = points()
    ball = (x - ALL["sphere"].center).norm(dim=-1) - 0.3
    assert_close(ALL["sphere"].distance(x), ball, rtol=0.0, atol=1e-15)
    plane = (x @ torch.tensor([1.0, 2.0, -2.0], dtype=torch.float64) - 0.6) / 3.0
    assert_close(ALL["half-space"].distance(x), plane, rtol=0.0, atol=1e-14)
    start = torch.tensor([0.0, -1.0, 0.5], dtype=torch.float64)
    way = torch.tensor([0.3, 2.0, -0.3], dtype=torch.float64)
    share = (((x - start) @ way) / way.square().sum()).clamp(0.0, 1.0)
    rod = (x - start - share[:, None] * way).norm(dim=-1) - 0.1
    assert_close(ALL["capsule"].distance(x), rod, rtol=0.0, atol=1e-14)


def test_a_box_on_its_faces_edges_corners_and_inside():
    box = obstacles.Box([0.0, 0.0, 0.0], [0.2, 0.4, 1.0])
    places = [[0.3, 0.0, 0.1], [0.4, 0.6, 0.0], [0.4, 0.6, 1.7], [0.05, 0.0, 0.0], [0.0, 0.19, 0.4]]
    expected = [0.2, 0.5, 1.3, -0.05, -0.01]
    assert_close(box.distance(places), torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("name", ALL)
def test_the_direction_is_the_gradient_and_the_surface_is_where_it_leads(name):
    scene = as_numbers([ALL[name]])
    x = points().requires_grad_(True)
    distance, normal = distances(x, scene)
    (slope,) = torch.autograd.grad(distance.sum(), x)
    assert_close(normal[:, 0], slope, rtol=0.0, atol=1e-12)
    on_surface = x - distance * normal[:, 0]
    outside = distance[:, 0] > 0.0
    assert_close(
        distances(on_surface[outside], scene)[0],
        torch.zeros(int(outside.sum()), 1, dtype=torch.float64),
        rtol=0.0,
        atol=1e-12,
    )
    assert outside.any()


@pytest.mark.parametrize("name", ALL)
def test_it_is_convex_and_a_ball_of_this_size_is_free(name):
    """Distances change by at most the way, and a half-space of the surface holds the obstacle."""
    scene = as_numbers([ALL[name]])
    one = points(seed=1)
    other = points(seed=2)
    here, normal = distances(one, scene)
    there, _ = distances(other, scene)
    way = (one - other).norm(dim=-1)
    assert ((here - there).abs()[:, 0] <= way + 1e-12).all()
    inside = there[:, 0] <= 0.0
    along = (normal[:, 0] * (other - one)).sum(-1)
    outside = here[:, 0] > 0.0
    kept = along <= -here[:, 0] + 1e-12
    assert kept[inside & outside].all()


def test_a_motion_of_the_frame_changes_no_distance():
    motion = rotation(torch.tensor([0.4, 0.1, -1.0], dtype=torch.float64))[0]
    shift = torch.tensor([0.3, -0.1, 0.2], dtype=torch.float64)
    turned = obstacles.Box(motion @ BOX.center + shift, [0.2, 0.4, 1.0], motion @ TURN)
    x = points()
    assert_close(turned.distance(x @ motion.mT + shift), BOX.distance(x), rtol=0.0, atol=1e-12)


def test_moved_keeps_the_shape():
    there = BOX.moved([0.0, 0.0, 0.0])
    x = points()
    assert_close(there.distance(x - BOX.center), BOX.distance(x))


def test_the_centre_of_a_ball_has_a_way_out():
    distance, normal = distances(torch.zeros(1, 3), as_numbers([obstacles.Sphere([0, 0, 0], 0.2)]))
    assert float(distance) == pytest.approx(-0.2)
    assert float(normal.norm()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("radius", lambda: obstacles.Sphere([0.0, 0.0, 0.0], -1.0)),
        ("radius", lambda: obstacles.Sphere([0.0, 0.0, 0.0], math.nan)),
        ("radius", lambda: obstacles.Capsule([0.0] * 3, [1.0] * 3, 0.0)),
        ("center", lambda: obstacles.Sphere([0.0, 0.0], 1.0)),
        ("center", lambda: obstacles.Sphere([0.0, 0.0, math.inf], 1.0)),
        ("end", lambda: obstacles.Capsule([0.0] * 3, [math.nan] * 3, 0.1)),
        ("normal", lambda: obstacles.HalfSpace([0.0, 0.0, 0.0], 1.0)),
        ("offset", lambda: obstacles.HalfSpace([0.0, 0.0, 1.0], math.inf)),
        ("size", lambda: obstacles.Box([0.0] * 3, [1.0, 0.0, 1.0])),
        ("rotation", lambda: obstacles.Box([0.0] * 3, [1.0] * 3, -np.eye(3))),
        ("points", lambda: BOX.distance([0.0, 1.0])),
    ],
)
def test_what_is_no_obstacle_is_refused_by_name(name, call):
    with pytest.raises(ValueError, match=f"`{name}`"):
        call()
