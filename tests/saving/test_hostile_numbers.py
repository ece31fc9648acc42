"""Files with other numbers and a right checksum: refused, or the core and torch agree on them."""

import copy

import numpy as np
import pytest
import torch
from renumbered import judged, renumbered
from safetensors.numpy import load_file
from saved_models import FOLDER

from hybridkin import ElasticTendonChain, ForceTendonChain, load_model, native, save_model
from hybridkin.saving import _prediction
from hybridkin.saving._file import write
from hybridkin.saving.header import model_header

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
NAMES = sorted(path.stem for path in FOLDER.glob("*.safetensors"))
BODY = ForceTendonChain([0.01], [0.3], 0.02, 200.0, weight=1.0, taper=0.5)


def rewritten(source, path, arrays=None, **entries):
    """Write a file with other arrays or entries of the header, and a right checksum."""
    content = {**load_file(source), **(arrays or {})}
    write(path, {**model_header(source), **entries}, content)
    return path


@pytest.mark.parametrize("name", BODY.layout.arrays)
@pytest.mark.parametrize("value", [1e60, -1e60])
def test_huge_numbers_of_a_body_are_refused(tmp_path, name, value):
    save_model(BODY, tmp_path / "model")
    arrays = load_file(tmp_path / "model")
    huge = {name: np.full_like(arrays[name], value)}
    path = rewritten(tmp_path / "model", tmp_path / "huge", huge)
    with pytest.raises(ValueError, match=r"huge is damaged"):
        load_model(path)


def test_the_message_names_the_file_and_both_predictions(tmp_path):
    save_model(BODY, tmp_path / "model")
    path = rewritten(tmp_path / "model", tmp_path / "longer", {"lengths": np.full(1, 0.31)})
    message = r"longer is damaged: at q = .* predicts \[\[.*0\.\d.*, but the file says \[\[.*0\.\d"
    with pytest.raises(ValueError, match=message):
        load_model(path)
    header = model_header(tmp_path / "model")
    assert len(header["prediction"]["x"]) == 2
    for wrong in (3, {}, {"q": [[0.0]]}, {**header["prediction"], "x": [[1.0, None, 0.0]] * 2}):
        with pytest.raises(ValueError, match=r"is damaged: .*prediction|is damaged: `"):
            load_model(rewritten(tmp_path / "model", path, prediction=wrong))


def test_files_without_a_prediction_are_read(tmp_path):
    """Earlier versions wrote none; what they predict must be finite."""
    save_model(BODY, tmp_path / "model")
    header = model_header(tmp_path / "model")
    del header["prediction"]
    arrays = load_file(tmp_path / "model")
    write(tmp_path / "earlier", header, arrays)
    twin, q = load_model(tmp_path / "earlier"), torch.full((2, 3), 0.3).double()
    assert torch.equal(twin(q), BODY(q))
    write(tmp_path / "earlier", header, {**arrays, "radii": np.full(1, 1e60)})
    with pytest.raises(ValueError, match="earlier is damaged: `radii`"):
        load_model(tmp_path / "earlier")


def test_hysteresis_must_be_whole(tmp_path):
    source = FOLDER / "creep.safetensors"
    header, arrays = model_header(source), load_file(source)
    for name in ("creep_gains", "creep_times", "play_width"):
        fewer = {key: value for key, value in header["arrays"].items() if key != name}
        write(tmp_path / "part", {**header, "arrays": fewer}, arrays)
        if name == "play_width":  # creep alone is an operator too
            assert load_model(tmp_path / "part").hysteresis_.kind == "creep"
            continue
        with pytest.raises(ValueError, match=f"part is damaged: .*{name}"):
            load_model(tmp_path / "part")


@pytest.mark.parametrize("kind", ["serial_quadratic", "blend", "serial_pose"])
@pytest.mark.parametrize("factor", [1.05, -1.0])
def test_weights_must_be_those_of_a_blend(tmp_path, kind, factor):
    source = FOLDER / f"{kind}.safetensors"
    weights = (
        factor * load_file(source)["module.weights"] / load_file(source)["module.weights"].sum()
    )
    path = rewritten(source, tmp_path / "model", {"module.weights": weights})
    with pytest.raises(ValueError, match="model is damaged: `weights` must be zero or more"):
        load_model(path)


def test_planes_of_bending_must_be_those_of_the_angles(tmp_path):
    source = FOLDER / "chain.safetensors"
    settings = {**model_header(source)["settings"], "bends": [1, 2]}
    with pytest.raises(ValueError, match="model is damaged: `bends`"):
        load_model(rewritten(source, tmp_path / "model", settings=settings))


def test_a_model_that_predicts_nothing_finite_is_not_saved(tmp_path):
    body = copy.deepcopy(BODY)
    body.lengths.fill_(torch.nan)
    with pytest.raises(ValueError, match="`model` must predict finite numbers"):
        save_model(body, tmp_path / "model")
    assert [*tmp_path.iterdir()] == []


def test_a_row_without_a_shape_is_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(_prediction, "_OUTSIDE", 1e3)  # compressed there
    body = ElasticTendonChain([0.01], [0.1], axial_stiffness=1e-3)
    save_model(body, tmp_path / "model")
    assert len(model_header(tmp_path / "model")["prediction"]["q"]) == 1
    monkeypatch.undo()
    q = torch.tensor([[0.001, -0.002, 0.0]], dtype=torch.float64)
    assert torch.equal(load_model(tmp_path / "model")(q), body(q))


@pytest.mark.needs_core
def test_a_core_that_disagrees_is_noticed(tmp_path, monkeypatch):
    save_model(load_model(FOLDER / "chain.safetensors"), tmp_path / "model")
    evaluate = native.library.Program.evaluate

    def wrong(self, *arguments):
        x, *others = evaluate(self, *arguments)
        return (x + 1e-4, *others)

    monkeypatch.setattr(native.library.Program, "evaluate", wrong)
    with pytest.raises(ValueError, match=r"is damaged: .* but the compiled core"):
        load_model(tmp_path / "model")


@pytest.mark.slow
@pytest.mark.parametrize("kind", NAMES)
def test_other_numbers_with_a_right_checksum(tmp_path, kind):
    for k in range(6):
        said = judged(*renumbered(kind, k, tmp_path / "model"))
        assert said in ("refused", "read"), f"{kind} {k}: {said}"
