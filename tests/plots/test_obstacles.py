"""Surfaces of obstacles, and pictures that show them."""

import numpy as np
import pytest
import torch
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from hybridkin import obstacles, plots, robots
from hybridkin._core.rotations import rotation

LOW, HIGH = np.array([-1.0, -1.5, -0.5]), np.array([1.0, 1.0, 2.0])


def turned(seed):

    vector = np.random.default_rng(seed).normal(size=3)
    return rotation(torch.from_numpy(vector))[0]


SCENE = {
    "sphere": obstacles.Sphere([0.1, 0.2, 0.3], 0.2),
    "capsule": obstacles.Capsule([0.1, -0.2, 0.3], [0.4, 0.5, -0.1], 0.05),
    "box": obstacles.Box([0.1, 0.2, 0.9], [0.2, 0.3, 0.5], turned(0)),
    "round box": obstacles.Box([0.1, 0.2, 0.9], [0.2, 0.3, 0.5], turned(1), 0.1),
}
VOLUMES = {
    "sphere": 4.0 / 3.0 * np.pi * 0.2**3,
    "capsule": np.pi * 0.05**2 * (np.sqrt(0.74) + 4.0 / 3.0 * 0.05),
    "box": 0.03,
    "round box": 0.03 + 0.062 + np.pi * 0.01 * 1.0 + 4.0 / 3.0 * np.pi * 1e-3,
}


def volume_in(surface):
    """The volume inside a surface, by the divergence theorem; negative if it is inside out."""
    first, second, third = np.moveaxis(surface.triangles, 1, 0)
    return float((first * np.cross(second, third)).sum()) / 6.0


def edges_of(surface):
    """The directed edges of all triangles, by the places of their ends."""
    points = np.round(surface.triangles, 9) + 0.0
    edges = []
    for k in range(3):
        ends = np.concatenate([points[:, k], points[:, (k + 1) % 3]], axis=1)
        edges += [*map(tuple, ends)]
    return edges


@pytest.mark.parametrize("name", SCENE)
def test_surfaces_are_closed_and_lie_on_the_obstacle(name):
    surface = plots.obstacle_surface(SCENE[name], LOW, HIGH)
    np.testing.assert_allclose(SCENE[name].distance(surface.vertices), 0.0, atol=1e-12)
    edges = edges_of(surface)
    assert len({*edges}) == len(edges)
    assert {*edges} == {(*edge[3:], *edge[:3]) for edge in edges}
    # Chords of 18 degrees lie inside a curved surface.
    assert 0.93 * VOLUMES[name] < volume_in(surface) <= VOLUMES[name] * (1.0 + 1e-12)
    if name == "box":
        assert volume_in(surface) == pytest.approx(VOLUMES[name], rel=1e-12)


@pytest.mark.parametrize("normal", [[0.0, 0.0, 1.0], [0.0, -2.0, 0.0], [1.0, 2.0, -1.5]])
def test_half_spaces_are_cut_at_the_picture(normal):
    wall = obstacles.HalfSpace(normal, 0.1)
    surface = plots.obstacle_surface(wall, LOW, HIGH)
    assert len(surface.faces) > 0
    np.testing.assert_allclose(wall.distance(surface.vertices), 0.0, atol=1e-12)
    assert (surface.vertices >= LOW - 1e-11).all()
    assert (surface.vertices <= HIGH + 1e-11).all()
    # It reaches the sides of the picture: the plane cuts as many points of a grid.
    on_side = np.isclose(surface.vertices, LOW) | np.isclose(surface.vertices, HIGH)
    assert on_side.any(axis=1).all()
    unit = np.array(normal) / np.linalg.norm(normal)
    first, second, third = np.moveaxis(surface.triangles, 1, 0)
    areas = 0.5 * np.cross(second - first, third - first)
    assert (areas @ unit >= 0.0).all()
    # The section of a box has the area of its projection along an axis, over the cosine.
    axis = int(np.abs(unit).argmax())
    grid = np.random.default_rng(0).uniform(LOW, HIGH, (200_000, 3))
    grid[:, axis] = 0.0
    height = (0.1 / np.linalg.norm(normal) - grid @ unit) / unit[axis]
    inside = ((height >= LOW[axis]) & (height <= HIGH[axis])).mean()
    base = np.prod(np.delete(HIGH - LOW, axis))
    assert areas.sum(axis=0) @ unit * abs(unit[axis]) == pytest.approx(inside * base, rel=0.01)


def test_what_lies_beyond_a_picture_has_no_faces():
    floor = obstacles.HalfSpace([0.0, 0.0, 1.0], -3.0)
    surface = plots.obstacle_surface(floor, LOW, HIGH)
    assert surface.faces.shape == (0, 3)
    assert surface.vertices.shape == (0, 3)


# Pictures


CHAIN = robots.bionic_handling_assistant()
Q = np.array([0.25, 0.3, 0.3, 0.25, 0.25, 0.3, 0.2, 0.25, 0.25])
SPACE = {"projection": "3d"}
AROUND = [
    obstacles.Sphere([0.9, 0.2, 0.6], 0.1, name="ball $x$"),
    obstacles.HalfSpace([0.0, 0.0, 1.0], 0.0),
]


@pytest.fixture
def drawn(monkeypatch):
    """The triangles (F, 3, 3) of every obstacle that is drawn, in the unit of the axes."""
    surfaces = []

    def noted(triangles, **look):
        surfaces.append(triangles)
        return Poly3DCollection(triangles, **look)

    monkeypatch.setattr("hybridkin.plots._scene.Poly3DCollection", noted)
    return surfaces


def test_bodies_are_drawn_among_obstacles(drawn):
    figure, ax = plots.new_figure(4, 4, subplot_kw=SPACE)
    plots.BackboneDisplay.from_estimator(CHAIN, Q, obstacles=AROUND).plot(ax, unit="mm")
    ball, floor = drawn
    far = np.linalg.norm(ball - [900.0, 200.0, 600.0], axis=-1)
    np.testing.assert_allclose(far, 100.0)
    np.testing.assert_allclose(floor[..., 2], 0.0, atol=1e-9)
    assert ax.get_xlim()[1] >= 1000.0
    assert "ball \\$x\\$" in [text.get_text() for text in ax.texts]
    figure.draw_without_rendering()


def film_among(scene):
    path = np.linspace(Q, Q + 0.02, 3)
    return plots.TrackAnimation.from_estimator(CHAIN, path, obstacles=scene)


def test_films_show_obstacles_within_their_limits(drawn):
    film = film_among(AROUND)
    low, high = film.limits()
    assert high[0] > 1.0
    plain_low, _ = film_among([]).limits()
    assert low[2] == pytest.approx(plain_low[2], abs=0.02)  # a floor has no end to show
    figure, ax = plots.new_figure(4, 4, subplot_kw=SPACE)
    film.plot(ax, unit="cm")
    ball, floor = drawn
    assert ball[..., 0].max() == pytest.approx(100.0, abs=2.0)
    np.testing.assert_allclose(floor[..., :2].max(axis=(0, 1)), 100.0 * high[:2], rtol=0.05)
    figure.draw_without_rendering()


def test_pages_hold_the_obstacles(tmp_path, monkeypatch):
    viser = pytest.importorskip("viser")
    meshes = {}
    add = viser.SceneApi.add_mesh_simple

    def noted(self, name, vertices, faces, **options):
        meshes[name] = (vertices, faces)
        return add(self, name, vertices, faces, **options)

    monkeypatch.setattr(viser.SceneApi, "add_mesh_simple", noted)
    film = film_among(AROUND)
    film.save(tmp_path / "a.html")
    low, high = film.limits()
    vertices, faces = meshes["/obstacle 1 ball $x$"]
    longest = np.max(high - low)
    np.testing.assert_allclose(AROUND[0].distance(longest * vertices), 0.0, atol=1e-9)
    assert faces.max() < len(vertices)
    assert set(meshes) == {"/obstacle 1 ball $x$", "/obstacle 2"}


@pytest.mark.parametrize("scene", [AROUND[0], "ball", [np.zeros(3)], 3.0])
def test_other_things_are_no_obstacles(scene):
    with pytest.raises(TypeError, match=r"`obstacles.* must be a"):
        plots.BackboneDisplay(np.zeros((2, 3)), obstacles=scene)
