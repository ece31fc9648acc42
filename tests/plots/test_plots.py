import base64
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from PIL import Image

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ForceTendonChain,
    HybridForwardModel,
    InverseKinematics,
    datasets,
    plots,
    robots,
    trajectories,
)
from hybridkin.plots.models import body_of

SPACE = {"projection": "3d"}
SHIFT = np.array([0.0, 0.01, -0.02])
BENT = np.array([0.25, 0.3, 0.27, 0.25, 0.21, 0.3, 0.2, 0.25, 0.22])


@pytest.fixture(autouse=True)
def no_figure_left_open():
    plt.close("all")  # of other tests
    yield
    left = plt.get_fignums()
    plt.close("all")
    assert not left


@pytest.fixture
def x():
    return np.random.default_rng(0).normal(0.0, 0.2, (50, 3))


@pytest.fixture(scope="module")
def data():
    return datasets.load_trunk()


@pytest.fixture(scope="module")
def hybrid(data):
    return HybridForwardModel(robots.bionic_handling_assistant(), "linear").fit(data.q, data.x)


@pytest.fixture(scope="module")
def track():
    path = trajectories.figure_eight([0.0, 0.0, 0.72], (0.2, 0.1), duration=2.0, dt=0.05)
    ik = InverseKinematics(robots.bionic_handling_assistant(), q_min=0.1, q_max=0.4, dt=0.05)
    return ik.track(path.x, path.t, plant=lambda q: ik.step(q, path.x[0]).x + SHIFT)


def drawn(figure, tmp_path):
    figure.savefig(tmp_path / "figure.png")
    return (tmp_path / "figure.png").stat().st_size > 2000


def path_lengths(points):
    return np.linalg.norm(np.diff(points, axis=-2), axis=-1).sum(axis=-1)


# Errors


def test_error_histogram_counts_every_row_in_the_unit_shown(x, tmp_path):
    shift = [0.03, 0.0, 0.04]
    display = plots.ErrorHistogramDisplay.from_predictions(x, {"a": x + shift, "b": x})
    np.testing.assert_allclose(display.errors["a"], 0.05)
    figure, ax = plots.new_figure(4, 3)
    assert display.plot(ax, unit="mm") is display
    assert (display.ax_, display.figure_) == (ax, figure)
    assert ax.get_xlabel() == "tip error [mm]"
    assert ax.get_xlim() == pytest.approx((0.0, 50.0))
    # Outlines of "a" then "b": all of "b" lies in the first bin, all of "a" in the last.
    outlines = [patch.get_xy() for patch in ax.patches]
    assert [outline[:, 1].max() for outline in outlines] == [50] * 4
    assert outlines[0][outlines[0][:, 1] == 50, 0].min() == pytest.approx(48.75)
    assert "a: mean 50.00, max 50.0 mm" in [t.get_text() for t in ax.get_legend().get_texts()]
    assert drawn(figure, tmp_path)


def test_tendons_on_stages_are_drawn_as_long_as_they_are():
    lengths = [None, None, 0.1, 0.12]
    chain = ConstantCurvatureChain(
        [0.01] * 4,
        n_actuators=[1, 1, 2, 3],
        lengths=lengths,
        routing="base",
        offsets=[0.1, 0.05, 0.0, 0.0],
        stage="rotation",
    )
    q = np.array([[2.0, 0.2, -0.006, 0.006, 0.01, -0.005, -0.005]])
    actuators = body_of(chain, q, 400)["actuators"]
    drawn = [np.linalg.norm(np.diff(path[0], axis=0), axis=1).sum() for path in actuators]
    straight = np.repeat([0.0, 0.0, 0.1, 0.22], chain.actuators_per_segment)
    np.testing.assert_allclose(drawn[2:], (straight + q[0])[2:], rtol=1e-5)


def test_tendons_of_a_heavy_body_are_drawn_as_long_as_they_are():
    chain = ForceTendonChain([0.02, 0.015], [0.2, 0.15], [0.05, 0.02], [90.0, 60.0], weight=1.5)
    q = np.array([[0.9, 0.1, 0.0, 0.3, 0.0, 0.2]])
    actuators = body_of(chain, q, 300)["actuators"]
    drawn = [np.linalg.norm(np.diff(path[0], axis=0), axis=1).sum() for path in actuators]
    with torch.no_grad():
        arcs = chain._arcs_of_rows(torch.from_numpy(q))[:, 0]
        lengths = chain._statics().readings @ arcs
    np.testing.assert_allclose(drawn, lengths, rtol=1e-5)


# Space


def turned():
    base = np.eye(4)
    base[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    base[:3, 3] = [0.3, -0.2, 0.1]
    return base


def test_chambers_drawn_are_as_long_as_commanded():
    chain = ConstantCurvatureChain([0.1, 0.09, 0.08], offsets=[0.01, 0.0, 0.05], base=turned())
    display = plots.BackboneDisplay.from_estimator(chain, BENT, n_points=400)
    assert len(display.actuators) == 9
    assert display.segments == (0, 0, 0, 1, 1, 1, 2, 2, 2)
    lengths = [path_lengths(path)[0] for path in display.actuators]
    np.testing.assert_allclose(lengths, BENT, rtol=1e-5)


def test_disks_and_frames_stand_on_the_backbone():
    chain = ElasticTendonChain([0.01, 0.008], [0.1, 0.08], offsets=[0.0, 0.02], base=turned())
    q = np.array([[-0.004, 0.002, 0.002, 0.003, -0.006, 0.003]])
    display = plots.BackboneDisplay.from_estimator(chain, q)
    poses = chain.poses(torch.from_numpy(q)).numpy()
    np.testing.assert_allclose(display.frames, poses)
    np.testing.assert_allclose(display.points[:, -1], poses[:, -1, :3, 3])
    centres = poses[:, :, :3, 3].copy()
    centres[:, 2] -= 0.02 * poses[:, 2, :3, 2]  # before the tool
    rims = display.disks - centres[:, :, None]
    normals = poses[:, :, :3, 2]
    assert np.abs(np.einsum("kdci,kdi->kdc", rims, normals)).max() < 1e-12
    radii = np.linalg.norm(rims, axis=-1)
    assert (radii.min(axis=-1) > [0.01, 0.01, 0.008]).all()
    first = display.actuators[0][0]  # at angle 0: on the x-axes of base and first segment's end
    np.testing.assert_allclose(first[0], poses[0, 0, :3, 3] + 0.01 * poses[0, 0, :3, 0])
    np.testing.assert_allclose(first[-1], poses[0, 1, :3, 3] + 0.01 * poses[0, 1, :3, 0])


@pytest.mark.slow
def test_a_fitted_hybrid_shows_its_correction(hybrid, data, tmp_path):
    display = plots.BackboneDisplay.from_estimator(hybrid, data.q[3])
    np.testing.assert_allclose(display.predicted[0], hybrid.predict(data.q[3:4])[0])
    np.testing.assert_allclose(display.tips[0], hybrid.predict_mechanical(data.q[3:4])[0])
    figure, ax = plots.new_figure(4, 4, subplot_kw=SPACE)
    display.plot(ax, unit="mm")
    shown = {line.get_label(): np.array(line.get_data_3d()).T for line in ax.lines}
    ends = [display.tips[0], display.predicted[0]]
    np.testing.assert_allclose(shown["learned correction"], 1e3 * np.stack(ends))
    backbone = hybrid.mechanical_model_.backbone(torch.from_numpy(data.q[3]), 12)
    np.testing.assert_allclose(shown["backbone"], 1e3 * backbone)
    assert len([name for name in shown if name.startswith("actuators of segment")]) == 3
    assert drawn(figure, tmp_path)


# Tracks


# Films and pages


@pytest.fixture(scope="module")
def film(track):
    return plots.TrackAnimation.from_estimator(
        robots.bionic_handling_assistant(),
        track.q,
        target=track.target,
        t=track.t,
        x=track.x_measured,
        n_frames=5,
    )


def test_a_frame_shows_body_tip_and_target(track, film):
    figure, ax = plots.new_figure(4, 4, subplot_kw=SPACE)
    film.plot(ax, unit="mm", frame=2)
    shown = {line.get_label(): np.array(line.get_data_3d()).T for line in ax.lines}
    np.testing.assert_allclose(shown["tip (measured)"], 1e3 * track.x_measured[[20]])
    np.testing.assert_allclose(shown["target"], 1e3 * track.target)
    backbone = robots.bionic_handling_assistant().backbone(torch.from_numpy(track.q[20]), 12)
    np.testing.assert_allclose(shown["backbone"], 1e3 * backbone)
    ends = np.stack([track.target[20], track.x_measured[20]])
    np.testing.assert_allclose(shown["tip error"], 1e3 * ends)
    assert ax.get_title() == f"t = 1.00 s, error {1e3 * track.error[20]:.2f} mm"
    figure.draw_without_rendering()


def test_a_film_without_its_program_names_the_way_out(film, tmp_path, monkeypatch):
    monkeypatch.setattr("matplotlib.animation.writers.is_available", lambda name: False)
    with pytest.raises(RuntimeError, match=r"`path` \(--out\) ends in .mp4.*save as .gif or .html"):
        film.save(tmp_path / "a.mp4")


@pytest.mark.slow
def test_gif_has_every_frame_and_reports_progress(film, tmp_path):
    calls = []
    path = film.save(
        tmp_path / "a.gif", dpi=50, speed=2.0, progress=lambda *call: calls.append(call)
    )
    assert calls == [(k, 5) for k in range(1, 6)]
    with Image.open(path) as image:
        assert (image.n_frames, image.size) == (5, (450, 225))
        assert image.info["duration"] == 250  # [ms], at twice the speed
        first = np.array(image.convert("RGB"), dtype=int)
        image.seek(2)
        assert np.abs(np.array(image.convert("RGB"), dtype=int) - first).max() > 100


def frames_of(path):
    """Return what each frame of a page moves: points (P, 3) by name, and the caption."""
    pytest.importorskip("viser")
    import msgspec
    import zstandard

    html = path.read_text(encoding="utf-8")
    packed = base64.b64decode(re.search('__VISER_EMBED_DATA__="(.+?)"', html)[1])
    data = zstandard.ZstdDecompressor().decompress(packed[8:], int.from_bytes(packed[:8], "little"))
    end = 8 + int.from_bytes(data[:8], "little")
    record = msgspec.msgpack.decode(data[8:end])
    buffers = []
    for size in record["binaryBufferLengths"]:
        end += -end % 8
        buffers.append(
            np.frombuffer(data[end : end + size], np.float32) if size % 12 == 0 else None
        )
        end += size
    frames = {}
    for time, message in record["messages"]:
        if message["type"] == "SceneNodeUpdateMessage":
            updates = message["updates"]
            frame = frames.setdefault(time, {})
            if "points" in updates:
                frame[message["name"]] = buffers[updates["points"]["__binary_index"]].reshape(-1, 3)
            if "text" in updates:
                frame["caption"] = updates["text"]
    return [*frames.values()]


def test_page_holds_every_frame_and_needs_no_network(film, track, tmp_path):
    path = film.save(tmp_path / "a.html", unit="mm")
    frames = frames_of(path)
    html = path.read_text(encoding="utf-8")
    assert len(html) < 2e6
    tags = re.findall(r"<(?:script|link|img|iframe)\b[^>]*>", html)
    assert not [tag for tag in tags if re.search("(src|href)=.?(?!data:)[a-z./]", tag)]
    assert [frame["caption"] for frame in frames] == [film.caption(k, "mm") for k in range(5)]
    (low, high) = film.limits()
    longest = np.max(high - low)
    backbone = frames[2]["/backbone"].reshape(-1, 2, 3)
    expected = robots.bionic_handling_assistant().backbone(torch.from_numpy(track.q[20]), 12)
    np.testing.assert_allclose(longest * backbone[:, 1], expected[1:], atol=1e-6)
    tip = longest * frames[2]["/tip (measured)/marks"]
    np.testing.assert_allclose(tip[0], track.x_measured[20], atol=1e-6)


# All of them


def displays(x, track, film):
    """Return functions that draw in a unit, whether in space, and which axes have the unit."""
    errors = {"a": np.linalg.norm(x, axis=1), "b": 0.3 * np.abs(x[:, 0])}
    tracks = plots.TrackingDisplay.from_tracks({"a": track})
    chambers = plots.ActuatorDisplay.from_tracks({"a": track}, (3, 3, 3))
    body = plots.BackboneDisplay.from_estimator(robots.bionic_handling_assistant(), BENT)
    expected = {"robot": np.full(len(track.t), 0.01)}
    return {
        "histogram": (plots.ErrorHistogramDisplay(errors).plot, False, "x"),
        "boxes": (plots.ErrorBoxDisplay(errors).plot, False, "x"),
        "workspace": (plots.WorkspaceDisplay(x, 1.1 * x).plot, True, "xyz"),
        "body": (body.plot, True, "xyz"),
        "film": (film.plot, True, "xyz"),
        "path": (tracks.plot, False, "xy"),
        "time": (tracks.plot_time, False, "y"),
        "error": (lambda ax, unit: tracks.plot_error(ax, unit=unit, expected=expected), False, "y"),
        "commands": (
            lambda ax, unit: chambers.plot([ax, *ax.figure.axes[1:]], unit=unit),
            False,
            "y",
        ),
    }


def drawn_range(ax, in_space):
    """Return the range of what is drawn on each axis (2, 2) or (3, 2)."""
    if in_space:
        return np.vstack(
            [ax.xy_dataLim.intervalx, ax.xy_dataLim.intervaly, ax.zz_dataLim.intervalx]
        )
    return np.vstack([ax.dataLim.intervalx, ax.dataLim.intervaly])


@pytest.mark.slow
def test_every_figure_has_its_axes_in_the_unit_they_name(x, track, film):
    for name, (draw, in_space, axes) in displays(x, track, film).items():
        ranges = {}
        for unit in ("m", "cm", "mm"):
            _, grid = plots.new_figure(4, 4, 3, 1, subplot_kw=SPACE if in_space else None)
            draw(grid[0], unit=unit)
            ranges[unit] = drawn_range(grid[0], in_space)
            for axis in axes:
                label = getattr(grid[0], f"get_{axis}label")()
                assert label.endswith(f"[{unit}]"), name
        for k, axis in enumerate("xyz"[: len(ranges["m"])]):
            for unit, scale in (("cm", 100.0), ("mm", 1000.0)):
                factor = scale if axis in axes else 1.0
                np.testing.assert_allclose(
                    ranges[unit][k], factor * ranges["m"][k], rtol=1e-9, err_msg=f"{name}, {axis}"
                )


def test_commands_are_drawn_in_the_unit_and_signs_of_a_log():
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 6))
    per_unit = np.radians([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    display = plots.ActuatorDisplay({"a": q}, (3, 3), limits=np.stack([q.min(0), q.max(0)]))
    _, axes = plots.new_figure(4, 4, 2, 1)
    display.plot(axes, unit="deg", per_unit=per_unit)
    shown = [line.get_ydata() for ax in axes for line in ax.lines]
    np.testing.assert_allclose(np.transpose(shown), q / per_unit)
    for k, ax in enumerate(axes):
        ends = np.unique([path.vertices[:, 1] for path in ax.collections[0].get_paths()])
        columns = (q / per_unit)[:, 3 * k : 3 * k + 3]
        np.testing.assert_allclose(ends, np.sort([*columns.min(0), *columns.max(0)]))
        assert ax.get_ylabel() == f"segment {k + 1} [deg]"
