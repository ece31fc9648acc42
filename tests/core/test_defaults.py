"""What a docstring calls the default of an argument is its default."""

import ast
import inspect
import re
from pathlib import Path

import pytest

import hybridkin

ROOT = Path(hybridkin.__file__).parent
LINE = re.compile(r"^\s*(\w+(?:, \w+)*) : [^\n]*default=([^\n]+)$", re.MULTILINE)


def documented(path):
    """Yield where, name, the documented default and the one in the code."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            continue
        text, function = inspect.cleandoc(ast.get_docstring(node) or ""), node
        if isinstance(node, ast.ClassDef):
            makers = [a for a in node.body if getattr(a, "name", "") == "__init__"]
            function = makers[0] if makers else None
        if function is None:
            continue
        a = function.args
        places = [*a.posonlyargs, *a.args]
        last = places[len(places) - len(a.defaults) :]
        found = {p.arg: d for p, d in zip(last, a.defaults, strict=True)}
        found |= {
            p.arg: d for p, d in zip(a.kwonlyargs, a.kw_defaults, strict=True) if d is not None
        }
        for names, words in LINE.findall(text):
            for name in names.split(", "):
                if name in found:
                    yield f"{node.name}({name})", words.strip(" ."), found[name]


@pytest.mark.parametrize("folder", ["chains", "learning", "hybrid", "ik", "calibration"])
def test_documented_defaults_are_those_of_the_code(folder):
    count = 0
    for path in sorted((ROOT / folder).glob("*.py")):
        for where, words, default in documented(path):
            try:
                expected, value = ast.literal_eval(words), ast.literal_eval(default)
            except (ValueError, SyntaxError):
                continue  # described in words
            count += 1
            assert value == expected, f"{where} of {path.name}: {words!r}, got {value!r}"
    assert count > 3
