"""The views of the pictures in docs/view.md, and what a user does there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import hybridkin.app
from hybridkin import ConstantCurvatureChain, HybridForwardModel, datasets, obstacles, robots

FTDCR = Path(__file__).parents[1] / "examples/robots/ftdcr_v4_elastic.toml"


class Scene:
    """A view to open, and what a user does there."""

    def opened(self, port):
        """Return the view, which listens to a port."""
        raise NotImplementedError

    def act(self, view, page, click):
        """Do what the picture shows; `click` clicks on a point of space on the page."""


class Target(Scene):
    """The simulated trunk follows a target that was dragged to the side."""

    def opened(self, port):
        chain = robots.bionic_handling_assistant()
        return hybridkin.app.view(chain, q_min=0.17, q_max=0.33, port=port)

    def act(self, view, page, click):
        view.follow(view.robot.x + np.array([0.3, 0.0, -0.05]))


class Obstacles(Scene):
    """The trunk bends over a pipe to reach a target behind it."""

    def opened(self, port):
        around = [
            obstacles.Capsule([0.2, -0.25, 0.42], [0.2, 0.25, 0.42], 0.03, name="pipe"),
            obstacles.Sphere([0.35, 0.0, 0.75], 0.06, name="lamp"),
            obstacles.HalfSpace([0.0, 0.0, 1.0], -0.02, name="table"),
        ]
        limits = {"q_min": 0.15, "q_max": 0.35}
        chain = robots.bionic_handling_assistant()
        return hybridkin.app.view(chain, **limits, obstacles=around, clearance=0.005, port=port)

    def act(self, view, page, click):
        box = [*view._switched].index("body that keeps clear")
        page.get_by_role("checkbox").nth(box).click()
        view.follow(np.array([0.42, 0.0, 0.53]))


class SlackTendons(Scene):
    """Elastic tendons of a robot, five of them slack and thin."""

    def opened(self, port):
        chain = robots.read_description(FTDCR).chain
        return hybridkin.app.view(chain, q_min=-0.007, q_max=0.007, port=port)

    def act(self, view, page, click):
        view.go_to(np.tile([-0.006, 0.006, 0.003], 3))


class WrongDescription(Scene):
    """Two chambers of every segment are swapped; the page shows where the tip was measured."""

    def opened(self, port):
        data = datasets.load_trunk()
        rows = datasets.paper_split(data, random_state=0)[0][::4]
        self.log = datasets.Log(data.q[rows], data.x[rows])
        swapped = np.radians([0.0, 240.0, 120.0])
        nominal = robots.bionic_handling_assistant()
        radii = nominal.geometry()["radii"].tolist()
        chain = ConstantCurvatureChain(radii, angles=swapped)
        return hybridkin.app.view(chain, self.log, port=port)

    def act(self, view, page, click):
        tips = view._rows.tips
        aside = tips[:, 1] - 0.5 * np.abs(tips[:, 0] - 0.1)
        click(tips[aside.argmin()])


class Recording(Scene):
    """Held-out motions of a recorded robot; the page shows one of their rows."""

    def opened(self, port):
        data = datasets.load_ftdcr()
        robot = robots.read_description(FTDCR)
        names = np.unique(data.groups)
        held_out = np.isin(data.groups, names[::4])
        train = np.flatnonzero(~held_out)[::8]
        model = HybridForwardModel(robot.chain, "quadratic", calibrate=("radii", "base"))
        model.fit(data.q[train], data.x[train])
        model.described(replace(model.description_, robot=robot))
        log = datasets.Log(data.q[held_out], data.x[held_out])
        return hybridkin.app.view(model, log, port=port)

    def act(self, view, page, click):
        tips = view._rows.tips
        click(tips[np.linalg.norm(tips - [0.1, 0.0, 0.12], axis=1).argmin()])


SCENES = {
    "view_target": Target(),
    "view_obstacles": Obstacles(),
    "view_slack_tendons": SlackTendons(),
    "view_wrong_description": WrongDescription(),
    "view_recording": Recording(),
}
