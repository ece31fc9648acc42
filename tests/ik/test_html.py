import numpy as np

from hybridkin import ConstantCurvatureChain, InverseKinematics
from hybridkin.ik.results import Track

CHAIN = ConstantCurvatureChain([0.1, 0.093])


def track(**changed):
    t = np.linspace(0.0, 1.0, 5)
    q = np.stack([t, -t], axis=1)
    error = np.array([0.001, 0.002, 0.003, np.nan, np.inf])
    margin = np.full(5, np.inf)
    parts = {
        "t": t,
        "q": q,
        "effective": q,
        "x": np.zeros((5, 3)),
        "x_measured": None,
        "target": np.zeros((5, 3)),
    }
    parts |= {"error": error, "status": np.array([0, 0, 1, 6, 6]), "sigma_min": np.ones(5)}
    parts["clearance"] = np.full(5, np.inf)
    return Track(**{**parts, "limit_margin": margin, **changed})


def test_all_settings_and_the_model():
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=[0.3, 0.4] * 3, dt=0.05)
    html = ik._repr_html_()
    assert "q_max</th><td>0.3 to 0.4</td>" in html
    assert "dt</th><td>0.05</td>" in html
    assert "damping</th><td>&#x27;adaptive&#x27;</td>" in html
    assert "<summary>model: ConstantCurvatureChain</summary>" in html
    assert "radii [m]</th><td>0.1, 0.093</td>" in html
    assert (
        repr(ik)
        == "InverseKinematics(ConstantCurvatureChain, q_min=0.1, q_max=0.3 to 0.4, dt=0.05)"
    )


def test_outcome_errors_and_commands_of_a_track():
    html = track()._repr_html_()
    assert "5 targets: 2 CONVERGED, 1 AT_LIMITS, 2 INVALID_INPUT" in html
    assert "distance from path to tip of the model</th><td>error mean 0.002 m, max 0.003 m" in html
    assert "q[1]</th><td>-1</td><td>0</td>" in html
    measured = track(x_measured=np.zeros((5, 3)), error=np.full(5, np.nan))._repr_html_()
    assert "distance from path to measured tip</th><td>no error known</td>" in measured
