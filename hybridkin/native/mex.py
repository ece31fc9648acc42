"""A model or a controller as one C file for MATLAB and Octave (MEX), with its help."""

from __future__ import annotations

import textwrap
from functools import partial
from pathlib import Path

from hybridkin._core.files import check_outputs, write_files
from hybridkin._core.texts import matlab_comment
from hybridkin.native.export import ABOUT_Q, c_project, filled, keeps_clear

_GIVE_BLOCKED = """    const double blocked = state.blocked;
    give(n_out, out, 5, 1, 1, &blocked);
"""


def export_mex(
    model: object,
    folder: str | Path,
    *,
    name: str = "model",
    about_q: str = ABOUT_Q,
    force: bool = False,
) -> list[Path]:
    """Write a model or inverse kinematics for MATLAB and Octave, and return the files.

    Compile the C file there: ``mex trunk.c``, or ``mkoctfile --mex trunk.c`` for Octave.
    ``help trunk`` shows the calls: ``[x, J] = trunk(q)``, and of inverse kinematics
    ``state = trunk('reset', q)`` and ``[q, state] = trunk('step', state, target)``.

    Parameters
    ----------
    model : ForwardModel, fitted HybridForwardModel or ELMRegressor, or InverseKinematics
        As for `export_c`.
    folder : str or Path
        Output folder. Files of an earlier export are replaced, other files are not.
    name : str, default="model"
        Name of the function.
    about_q : str
        Unit and sign of q in sentences, for the help.
    force : bool, default=False
        Replace files that hybridkin did not write.

    Returns
    -------
    list of Path
        The C file and the file with the help.

    Raises
    ------
    NoKernel
        If a part of the model cannot be written in C.
    FileExistsError
        If the folder has a file with one of these names that hybridkin did not write.

    Examples
    --------
    >>> import tempfile
    >>> from hybridkin import native, robots
    >>> chain = robots.bionic_handling_assistant()
    >>> [path.name for path in native.export_mex(chain, tempfile.mkdtemp(), name="trunk")]
    ['trunk.c', 'trunk.m']
    """
    project = c_project(model, name=name, about_q=about_q)
    paths = [Path(folder) / f"{name}{suffix}" for suffix in (".c", ".m")]
    check_outputs(paths, "export", force=force)
    entries = dict(project.entries)
    entries["TITLE"] = matlab_comment(project.title)
    about_lines = textwrap.wrap(matlab_comment(about_q), 92)
    entries["ABOUT_Q_HELP"] = "\n%   ".join(about_lines)
    parts = {
        "STEP_MEX": "mex_step.c",
        "STEP_CALL": "mex_call.c",
        "STEP_HELP": "mex_step.m",
    }
    clear = {
        "CLEAR_MEX": "mex_clear.c",
        "CLEAR_CALL": "mex_clear_call.c",
        "CLEAR_HELP": "mex_clear.m",
    }
    has_obstacles = project.controller is not None and keeps_clear(project.plan)
    entries["GIVE_BLOCKED"] = _GIVE_BLOCKED * has_obstacles
    for key, template in clear.items():
        entries[key] = filled(template, entries) if has_obstacles else ""
    for key, template in parts.items():
        entries[key] = "" if project.controller is None else filled(template, entries)
    header = project.texts[f"{name}.h"]
    include = f'#include "{name}.h"\n'
    entries["MODEL_C"] = project.texts[f"{name}.c"].replace(include, header)
    texts = {
        f"{name}.c": filled("mex.c", entries),
        f"{name}.m": filled("mex.m", entries),
    }
    write_files(
        folder,
        {file: partial(Path.write_text, data=text) for file, text in texts.items()},
    )
    return paths
