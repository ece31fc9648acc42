"""Mutants of the package: the operators of cosmic-ray, a seeded sample of places, a test of code.

Left out, because no test can or must see them: annotations, `if TYPE_CHECKING`, `@overload`,
`__all__`, lines with a pragma, and everything inside strings, which are docstrings and the texts
of messages and reprs (values inside an f-string included).
"""

from __future__ import annotations

import difflib
import inspect
import random
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import CodeType

from cosmic_ray.ast import get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).parents[2]
# Operators that need a name of a variable as argument are not used.
OPERATORS = {n: get_operator(n)() for n in operator_names() if not get_operator(n).arguments()}
BINARY = ("arith_expr", "term", "power", "shift_expr", "expr", "and_expr", "xor_expr")
STATEMENTS = {"simple_stmt", "if_stmt", "for_stmt", "while_stmt", "with_stmt", "try_stmt"}
HOLDERS = STATEMENTS | {"funcdef", "classdef", "file_input"}
NODES = {"operator", "keyword", "number", "comparison", "factor", "not_test", "test"}
NODES |= {"if_stmt", "for_stmt", "while_stmt", "except_clause", "decorator"}


@dataclass(frozen=True)
class Mutant:
    """One change of one file: the n-th place where an operator of cosmic-ray applies."""

    path: str
    operator: str
    occurrence: int
    lines: tuple[tuple[int, int], ...]  # of the node and of what holds it, the smallest first

    @property
    def family(self) -> str:
        return family(self.operator)

    @property
    def folder(self) -> str:
        return Path(self.path).parts[1]

    @property
    def key(self) -> tuple[str, str, int]:
        return self.path, self.operator, self.occurrence

    @cached_property
    def source(self) -> str:
        return (ROOT / self.path).read_text(encoding="utf-8")

    @cached_property
    def mutated(self) -> str:
        if not self.operator:  # the check of the runner: nothing is changed
            return self.source
        return mutate_code(self.source, OPERATORS[self.operator], self.occurrence)

    @property
    def diff(self) -> str:
        before, after = self.source.splitlines(), self.mutated.splitlines()
        lines = difflib.unified_diff(before, after, lineterm="", n=1)
        return "\n".join(line for line in lines if line[:3] not in ("---", "+++"))

    @property
    def code(self) -> CodeType | None:
        """The compiled module; None where the mutant is no Python."""
        return compiled(self.mutated, self.path)

    @cached_property
    def functions(self) -> list[tuple[CodeType, CodeType]] | None:
        """Functions before and after; None if more than bodies of functions differs."""
        return changed_functions(compiled(self.source, self.path), self.code)


def family(operator: str) -> str:
    return operator.split("/")[-1].split("_")[0]


def compiled(source: str, path: str) -> CodeType | None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return compile(source, str(ROOT / path), "exec", dont_inherit=True)
        except SyntaxError:
            return None


def changed_functions(before, after) -> list[tuple[CodeType, CodeType]] | None:
    is_function = before.co_flags & inspect.CO_OPTIMIZED
    if own(before) != own(after) and not is_function:
        return None
    pairs = [(before, after)] if is_function and before != after else []
    for inner in zip(nested(before), nested(after), strict=True):
        changed = changed_functions(*inner)
        if changed is None:
            return None
        pairs += changed
    return pairs


def nested(code: CodeType) -> list[CodeType]:
    return [c for c in code.co_consts if isinstance(c, CodeType)]


def own(code: CodeType) -> tuple:
    """What a code object holds beside the functions and classes inside it."""
    constants = [c.co_name if isinstance(c, CodeType) else c for c in code.co_consts]
    names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
    return code.co_code, names, repr(constants), code.co_exceptiontable


def left_out(node) -> bool:
    parent = node.parent
    kind = parent.type if parent else ""
    if node.type == "operator" and node.value in ("*", "**", "/"):
        return kind not in BINARY  # stars and slashes of signatures, calls and displays
    if node.type in ("fstring", "string"):
        return True
    if kind in ("tfpdef", "param"):
        return kind == "tfpdef" and node is parent.children[2]
    if kind == "annassign":
        return node is parent.children[1]
    if kind == "funcdef":
        return node is parent.annotation
    if node.type == "if_stmt":
        return node.children[1].get_code().strip() == "TYPE_CHECKING"
    if node.type == "decorated":
        return "overload" in node.children[0].get_code()
    return node.type == "expr_stmt" and node.children[0].get_code().strip() == "__all__"


def places(path: str) -> dict[tuple, list[Mutant]]:
    """Return the mutants of each place and family of operators."""
    source = (ROOT / path).read_text(encoding="utf-8")
    lines, found, count = source.splitlines(), defaultdict(list), Counter()
    for node, skip, extents in nodes(get_ast(source), False, ()):
        if node.type not in NODES:
            continue
        for name, operator in OPERATORS.items():
            for start, _ in operator.mutation_positions(node):
                if not skip and "pragma" not in lines[start[0] - 1]:
                    mutant = Mutant(path, name, count[name], extents)
                    found[mutant.family, path, start].append(mutant)
                count[name] += 1
    return found


def nodes(node, skip: bool, extents: tuple) -> Iterator[tuple]:
    """Walk in the order of cosmic-ray; with each node whether it is left out, and its lines."""
    skip = skip or left_out(node)
    extents = (node.start_pos[0], node.end_pos[0]), *extents
    yield node, skip, extents
    held = (
        extents if node.type in STATEMENTS | {"funcdef", "classdef", "file_input"} else extents[1:]
    )
    for child in getattr(node, "children", ()):
        yield from nodes(child, skip, held)


def sample(paths: list[str], n: int, seed: int) -> list[Mutant]:
    """Return n mutants in random order, each family of operators with its share of the places.

    First a place and a family are drawn, then one of the variants: cosmic-ray makes eleven of
    each binary operator, which would crowd out the rest. Those that do not compile are left out.
    """
    found = {key: ms for path in paths for key, ms in places(path).items()}
    generator, keys = random.Random(seed), sorted(found)
    generator.shuffle(keys)
    keys.sort(key=lambda key: key[0])
    step = len(keys) / n
    drawn = [generator.choice(found[keys[int((k + 0.5) * step)]]) for k in range(n)]
    generator.shuffle(drawn)
    return [mutant for mutant in drawn if mutant.code]
