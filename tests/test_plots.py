import numpy as np
import pytest
from matplotlib.figure import Figure

from hybridkin import plots


@pytest.fixture
def x():
    return np.random.default_rng(0).normal(0.0, 0.2, (50, 3))


def drawn(figure, tmp_path):
    figure.savefig(tmp_path / "figure.png")
    return (tmp_path / "figure.png").stat().st_size > 2000


def test_error_histogram_counts_every_row_in_the_unit_shown(x, tmp_path):
    shift = [0.03, 0.0, 0.04]
    display = plots.ErrorHistogramDisplay.from_predictions(x, {"a": x + shift, "b": x})
    np.testing.assert_allclose(display.errors["a"], 0.05)
    figure, ax = plots.new_figure(4, 3)
    assert display.plot(ax, unit="mm", bins=10) is display
    assert ax.get_xlabel() == "tip error [mm]"
    assert "a: mean 50.00, max 50.0 mm" in [t.get_text() for t in ax.get_legend().get_texts()]
    assert drawn(figure, tmp_path)


def test_boxes_and_bars_name_every_model(tmp_path):
    figure, axes = plots.new_figure(6, 3, 1, 2)
    plots.ErrorBoxDisplay({"a": [0.01, 0.02], "b": [0.03, 0.05]}).plot(axes[0])
    plots.BarDisplay(["a", "b"], [1.0, 2.0], [0.5, 3.0]).plot(axes[1], label="error [cm]")
    for ax in axes:
        assert {t.get_text() for t in ax.get_yticklabels()} == {"a", "b"}
    assert drawn(figure, tmp_path)


def test_tracking_draws_target_and_tracks(x, tmp_path):
    figure, axes = plots.new_figure(6, 3, 1, 2)
    display = plots.TrackingDisplay(x, {"one": x + 0.01, "two": x})
    display.plot(axes[0], plane="xz")
    display.plot_time(axes[1])
    np.testing.assert_allclose(axes[0].lines[0].get_xydata(), 100 * (x + 0.01)[:, [0, 2]])
    np.testing.assert_allclose(axes[0].lines[2].get_xydata(), 100 * x[:, [0, 2]])
    assert len(axes[1].lines) == 9
    assert drawn(figure, tmp_path)


def test_actuators_share_out_over_segments(tmp_path):
    figure, axes = plots.new_figure(4, 4, 2, 1)
    q = np.arange(21.0).reshape(3, 7)
    plots.ActuatorDisplay({"a": q}, (3, 4)).plot(axes, unit="m")
    assert [len(ax.lines) for ax in axes] == [3, 4]
    np.testing.assert_allclose(axes[1].lines[0].get_ydata(), q[:, 3])
    assert drawn(figure, tmp_path)


def test_space(x, tmp_path):
    figure, axes = plots.new_figure(8, 4, 1, 2, subplot_kw={"projection": "3d"})
    plots.WorkspaceDisplay(x, x + 0.01, backbone=x[:5], row=3).plot(axes[0])
    plots.BackboneDisplay(x[:10]).plot(axes[1], unit="mm")
    assert axes[1].get_zlabel() == "z [mm]"
    assert drawn(figure, tmp_path)


def test_own_axes_when_none_are_given(x):
    display = plots.ErrorHistogramDisplay({"a": [0.01, 0.02]}).plot()
    assert isinstance(display.ax_.figure, Figure)
    plots.plt.close(display.ax_.figure)
