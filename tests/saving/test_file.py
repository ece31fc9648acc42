import json
import shutil
import struct
import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from safetensors.numpy import load_file, save_file
from saved_models import FOLDER, predictions, write_models

from hybridkin import Commands, load_model
from hybridkin.saving._file import VERSION, write
from hybridkin.saving.header import model_header

STORED = sorted(FOLDER.glob("*.safetensors"))
NAMES = [path.stem for path in STORED]
NOT_LEARNING = {"adapted_pose", "chain", "chain_of_all_parts", "elastic_chain", "elm", "elm_cv"}
NOT_LEARNING |= {"pose_output", "rigid", "structural_chain"}  # that have no `partial_fit` of tips
LEARNING = [path for path in STORED if path.stem not in NOT_LEARNING]
# Arrays with an entry for every row of the training, and one that nothing uses.
LENGTHS = {"error_model.residual": ("short", "empty"), "fitted_rows": ("short", "empty")}
LENGTHS |= {"module.tested.rows": ("short",), "module.learned.tested.rows": ("short",)}
LENGTHS |= {"error_model.singular_": ("axis", "short", "empty")}
ONE_OF_EACH = ("chain", "elastic_chain", "rigid", "elm", "drift_and_radius", "parallel_kernel")
ONE_OF_EACH += ("parallel_regression", "serial_pose", "serial_elm", "pose_output")


def said_of(path):
    """Return the inputs and the predictions that were stored beside a model."""
    with np.load(path.parent / "predictions.npz") as stored:
        said = {
            name.split(".")[1]: stored[name]
            for name in stored.files
            if name.split(".")[0] == path.stem
        }
    return said.pop("q"), said


def refused_or_the_same(path, q, said):
    """Return whether a file is refused; else it must predict what it always did."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = load_model(path)
            found = predictions(model, q)
    except ValueError:
        return True
    for name in said:
        assert_allclose(found[name], said[name], rtol=0, atol=1e-12)
    return False


@pytest.mark.parametrize("path", STORED, ids=NAMES)
def test_stored_files_predict_what_they_did(path):
    q, said = said_of(path)
    model = load_model(path)
    found = predictions(model, q)
    assert {*found} == {*said}
    # One chain keeps its geometry in single precision, and every machine rounds that its own way.
    tol = 1e-6 if path.stem == "chain_of_all_parts" else 1e-12
    for name in said:
        assert_allclose(found[name], said[name], rtol=tol, atol=tol)


@pytest.mark.parametrize("path", LEARNING, ids=lambda path: path.stem)
def test_stored_hybrids_learn_on(path):
    q, said = said_of(path)
    model = load_model(path)
    wanted = said["x"] + 0.02
    before = np.abs(model.predict(q[:1]) - wanted[:1]).max()
    rows = Commands(np.repeat(q[:1], 30, 0), time=np.arange(30.0))
    model.partial_fit(rows, np.repeat(wanted[:1], 30, 0))
    assert np.abs(model.predict(q[:1]) - wanted[:1]).max() < 0.3 * before


@pytest.mark.slow
def test_there_is_a_file_of_every_kind_and_writing_keeps_it(tmp_path, fitted):
    names = {path.stem for path in FOLDER.glob("*.safetensors")}
    assert names == {*fitted}
    assert sum(path.stat().st_size for path in FOLDER.rglob("*.*")) < 400_000
    shutil.copytree(FOLDER, tmp_path / "models")
    (tmp_path / "models" / "elm.safetensors").unlink()
    write_models(tmp_path / "models", fitted)
    for path in FOLDER.glob("*.safetensors"):
        if path.stem != "elm":
            assert (tmp_path / "models" / path.name).read_bytes() == path.read_bytes()
    q, said = said_of(FOLDER / "elm.safetensors")
    assert not refused_or_the_same(tmp_path / "models" / "elm.safetensors", q, said)
    assert_array_equal(said_of(tmp_path / "models" / "rigid.safetensors")[0][0], [-1, -0.75, -0.5])


def test_cut_and_stretched_files(tmp_path):
    whole, path = (FOLDER / "drift_and_radius.safetensors").read_bytes(), tmp_path / "model"
    for end in [*range(0, 40, 3), *range(40, len(whole), 97), len(whole) - 1]:
        path.write_bytes(whole[:end])
        with pytest.raises(ValueError, match="is not a model"):
            load_model(path)
    path.write_bytes(whole + b"more")
    with pytest.raises(ValueError, match="is not a model"):
        load_model(path)


@pytest.mark.parametrize(
    "head",
    [
        b"\xff" * 8,
        struct.pack("<Q", 2**62) + b"{}",
        struct.pack("<Q", 99_000_000) + b"{}",
        b'{"a":{"dtype":"F64","shape":[1000000000000],"data_offsets":[0,8000000000000]}}',
        b'{"a":{"dtype":"F64","shape":[4611686018427387904,4],"data_offsets":[0,0]}}',
        b'{"a":{"dtype":"F64","shape":[1],"data_offsets":[8,0]}}',
        b'{"../../a":{"dtype":"F64","shape":[1],"data_offsets":[-8,0]}}',
        b'{"a":{"dtype":"OBJ","shape":[1],"data_offsets":[0,8]}}',
    ],
)
def test_sizes_that_are_not_there(tmp_path, head):
    path = tmp_path / "model"
    long = head if head[:1] != b"{" else struct.pack("<Q", len(head)) + head
    path.write_bytes(long + bytes(8))
    with pytest.raises(ValueError, match="is not a model"):
        load_model(path)


@pytest.mark.parametrize(
    ("kind", "name", "value", "message"),
    [
        ("elastic_chain", "tendon_zeros", 1e300, "must be less than 1e.75"),
        (
            "rigid_hybrid",
            "drift_scale",
            0.0,
            "(the arrays do not give finite numbers|must be positive)",
        ),
        ("parallel_linear", "module.corrections.0.guard.model.factor", 0.0, "finite numbers"),
    ],
)
def test_numbers_that_predict_nothing_finite(tmp_path, kind, name, value, message):
    source, path = FOLDER / f"{kind}.safetensors", tmp_path / "model"
    header, arrays = model_header(source), load_file(source)
    write(path, header, {**arrays, name: np.full_like(arrays[name], value)})
    with pytest.raises(ValueError, match=f"is damaged: .*{message}"):
        load_model(path)


def test_rule_for_files_of_other_versions(tmp_path):
    source, path = FOLDER / "serial_elm.safetensors", tmp_path / "model"
    header, arrays = model_header(source), load_file(source)
    q, said = said_of(source)
    later = {"versions": {"hybridkin": "7.1.0"}}
    write(
        path,
        {**header, **later, "colour": "red", "settings": {**header["settings"], "a": 1}},
        arrays,
    )
    assert not refused_or_the_same(path, q, said)
    for version in (1, VERSION - 1, VERSION + 1):
        message = rf"format version {version}, .* version {VERSION}; .*7\.1\.0"
        write(path, {**header, **later, "version": version}, arrays)
        with pytest.raises(ValueError, match=message):
            load_model(path)
        with pytest.raises(ValueError, match=message):
            model_header(path)
    for version in (True, 2.0, "2", 0, -1, None):
        write(path, {**header, "version": version}, arrays)
        with pytest.raises(ValueError, match="version"):
            load_model(path)


def test_a_file_without_its_checksum_is_refused(tmp_path):
    source, path = FOLDER / "chain.safetensors", tmp_path / "model"
    header = {"hybridkin": json.dumps(model_header(source))}
    for metadata in (header, {**header, "sha256": "0" * 64}, {**header, "sha256": ""}):
        save_file(load_file(source), path, metadata=metadata)
        with pytest.raises(ValueError, match="checksum"):
            load_model(path)
