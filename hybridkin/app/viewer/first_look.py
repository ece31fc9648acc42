"""The first look at a robot, whatever the shape of the page is."""

from __future__ import annotations

from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridkin.plots.page_server import Camera, fitted_camera

_EYE = (0.9, -1.1, 0.4)  # where the eye stands, from the robot
_SAME = 1e-3  # places of the eye that are the same, relative to its distance
_NARROWEST = 0.1  # width over height


def first_camera(points: NDArray, aspect: float = 1.0) -> Camera:
    """Return the camera that sees points (N, 3) [m] on a page of an aspect."""
    return fitted_camera(points, _EYE, aspect)


class FirstLook:
    """The camera of one page: it shows all points until its user moves it.

    Parameters
    ----------
    client : viser client
        The page.
    points : ndarray of shape (N, 3)
        What it shows [m].
    """

    def __init__(self, client: Any, points: NDArray) -> None:
        self._client = client
        self._points = points
        self._aspect = 0.0
        self._cameras = [first_camera(points)]
        self._lock = Lock()

    def fit(self, camera: Any) -> None:
        """Show all points if the page has another shape, and its camera was not moved by hand."""
        aspect = max(camera.image_width / max(camera.image_height, 1), _NARROWEST)
        with self._lock:
            is_new = abs(aspect - self._aspect) > _SAME * aspect
            is_first = len(self._cameras) == 1
            if not is_new or not (is_first or self._is_ours(camera.position)):
                return
            self._aspect = aspect
            fitted = first_camera(self._points, aspect)
            self._cameras.append(fitted)
            with self._client.atomic():
                fitted.aim(camera)

    def _is_ours(self, position: NDArray) -> bool:
        for camera in self._cameras:
            if np.linalg.norm(position - camera.position) < _SAME * camera.distance:
                return True
        return False
