"""Numbers and names of users in files and on pages, for tools that build on hybridkin.

Units of logs; texts of users by the grammar of the file that shows them, so that nobody writes code
by a name; values as JSON expresses them; and files that are written completely or not at all.
"""

from typing import TYPE_CHECKING

from hybridkin._core.first_use import on_first_use

if TYPE_CHECKING:
    from hybridkin._core.directions import in_terms
    from hybridkin._core.files import check_outputs, write_file, write_files
    from hybridkin._core.named_rows import named_places
    from hybridkin._core.stored import plain
    from hybridkin._core.texts import (
        csv_table,
        markdown,
        markdown_block,
        markdown_cell,
        toml_value,
        visible,
        visible_lines,
    )
    from hybridkin._core.units import (
        FRAMES,
        METRES,
        SECONDS,
        UNITS,
        LogUnit,
        duration_in_words,
        rough_unit,
    )

__all__ = [
    "FRAMES",
    "METRES",
    "SECONDS",
    "UNITS",
    "LogUnit",
    "check_outputs",
    "csv_table",
    "duration_in_words",
    "in_terms",
    "markdown",
    "markdown_block",
    "markdown_cell",
    "named_places",
    "plain",
    "rough_unit",
    "toml_value",
    "visible",
    "visible_lines",
    "write_file",
    "write_files",
]

# Units and texts come without torch.
_NAMES_OF = {
    "directions": ("in_terms",),
    "files": ("check_outputs", "write_file", "write_files"),
    "named_rows": ("named_places",),
    "stored": ("plain",),
    "texts": (
        "csv_table",
        "markdown",
        "markdown_block",
        "markdown_cell",
        "toml_value",
        "visible",
        "visible_lines",
    ),
    "units": (
        "FRAMES",
        "METRES",
        "SECONDS",
        "UNITS",
        "LogUnit",
        "duration_in_words",
        "rough_unit",
    ),
}
__getattr__ = on_first_use("hybridkin._core", _NAMES_OF)
