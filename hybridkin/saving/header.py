"""The header of a saved model."""

from __future__ import annotations

from pathlib import Path

from hybridkin.saving._file import Header, model_path, read


def model_header(path: str | Path) -> Header:
    """Return the header of a saved model without loading the model.

    Parameters
    ----------
    path : str or Path
        File that `save_model` wrote, or the folder of a fit.

    Returns
    -------
    dict
        JSON values: ``created`` (date); ``versions`` of the packages that wrote it; ``units`` of q
        and x; ``training`` (``rows``, errors [m], for error_model="auto" all candidates, and the
        notes given to `save_model`); for a hybrid, ``domain`` (``q_low`` and ``q_high`` of the
        training rows, and the ``guard``); ``prediction`` (``x`` and domain ``distance`` at two rows
        ``q``, which `load_model` compares). The model itself: ``kind``, ``settings``, names of
        ``arrays``, and ``parts``, each with these four entries.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not a saved model, is damaged, or has another format version.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from hybridkin import robots, save_model
    >>> from hybridkin.saving.header import model_header
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "trunk.safetensors"
    >>> save_model(robots.bionic_handling_assistant(), path)
    >>> model_header(path)["units"]
    {'q': 'm', 'x': 'm'}
    """
    return read(model_path(path))[0]
