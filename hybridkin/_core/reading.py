"""How a log is read: one value, whose fields are the keywords of the functions that read."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields
from typing import Any, Concatenate, ParamSpec, TypeVar

from numpy.typing import ArrayLike

from hybridkin._core.text_rows import TextForm

Fields = ParamSpec("Fields")
Source = TypeVar("Source")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Reading:
    """The columns of a log, their units and form, and what is done with invalid rows.

    Attributes
    ----------
    q, x, groups, runs, time, time_unit, rate, q_unit, x_unit, q_sign
        As for `datasets.load_log`.
    delimiter, header_line, decimal, missing, unwrap, drop_invalid
        As for `datasets.load_log`.
    """

    q: Sequence[str]
    x: Sequence[str]
    groups: str | None = None
    _: KW_ONLY
    runs: str | None = None
    time: str | None = None
    time_unit: str = "s"
    rate: float | None = None
    q_unit: str = "m"
    x_unit: str = "m"
    q_sign: ArrayLike = 1
    delimiter: str | None = None
    header_line: int | None = None
    decimal: str = "."
    missing: ArrayLike = ()
    unwrap: bool | float | Mapping[str, float] = False
    drop_invalid: bool = False

    @property
    def text_form(self) -> TextForm:
        """How numbers and columns are written in a text file."""
        return TextForm(self.delimiter, self.header_line, self.decimal)

    @property
    def keywords(self) -> dict[str, Any]:
        """The fields by name, as keywords of a function that reads."""
        return {field.name: vars(self)[field.name] for field in fields(Reading)}


def with_fields_of(
    value: Callable[Fields, Reading],
) -> Callable[[Callable[[Source, Reading], Result]], Callable[Concatenate[Source, Fields], Result]]:
    """Return a decorator: a function of a source and a value gets its fields as arguments."""
    of_value = inspect.signature(value)
    made: Callable[..., Reading] = value

    def decorator(
        function: Callable[[Source, Reading], Result],
    ) -> Callable[Concatenate[Source, Fields], Result]:
        source, _ = inspect.signature(function).parameters.values()
        signature = of_value.replace(
            parameters=[source, *of_value.parameters.values()],
            return_annotation=inspect.signature(function).return_annotation,
        )

        @functools.wraps(function)
        def with_fields(*args: Any, **keywords: Any) -> Result:
            try:
                arguments = signature.bind(*args, **keywords).arguments
            except TypeError as error:
                raise TypeError(f"{function.__name__}() {error}") from None
            first = arguments.pop(source.name)
            return function(first, made(**arguments))

        described: Any = with_fields
        described.__signature__ = signature
        return with_fields

    return decorator
