"""The kernels of `src` as C text: decided, without what a model does not use."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from hybridkin.native.plan import Plan

_SOURCE = Path(__file__).parent / "src"
_SIZES = (("HK_MAX_N", "actuators"), ("HK_MAX_S", "segments"), ("HK_MAX_M", "outputs"))
_SIZES += (("HK_MAX_F", "features"), ("HK_MAX_P", "powers"))
# Instances for common sizes, by `switch` and by `if`: small code keeps the general one alone.
_SWITCH = re.compile(r"switch \(.*?\) \{.*\n(?: *case (\d+): \w+\(\1\b.*\n)+ *default: (.*)\n *\}")
_COMMON = re.compile(r"if \(HK_COMMON\(.*\)\)(?: \{\n(?:.*\n)*? *\}|\n[^;]*;)\s+else\s+")


def kernels_of(plan: Plan, place: int, steps: bool, single: bool) -> str:
    """Return the C text of the kernels that a plan needs, with its sizes.

    Parameters
    ----------
    plan : Plan
        The nodes.
    place : int
        That of the model among them.
    steps : bool
        Whether steps of inverse kinematics are computed, or the model alone.
    single : bool
        Whether numbers are float, not double.
    """
    headers, roots = ["plan.h", "model.h"], ["hk_model"]
    if steps:
        headers, roots = [*headers, "ik_step.h"], ["hk_model", "ik_tick", "ik_settings_of"]
    text = "\n".join(map(_included, headers))
    kinds = re.findall(r"\bHK_\w+", text[text.index("HK_ARCS") :].partition("}")[0])
    unused = {kind for number, kind in enumerate(kinds, 1) if number not in plan.kinds}
    text = re.sub(r"\bHK\((\w+)\)", r"hk_\1", _decided(text, single))
    text = _reachable(_COMMON.sub("", _SWITCH.sub(r"\2", _without_cases(text, unused))), roots)
    # The plan is a constant, so that the compiler knows all sizes.
    text = text.replace("} hk_plan;\n", "} hk_plan;\n\nstatic const hk_plan plan;\n")
    text = text.replace("hk_model(&ik->plan, ik->model", f"(void)ik;\n    hk_model(&plan, {place}")
    text = re.sub(r"__attribute__\(\((always_inline|noinline)\)\) ?", "", text)
    sizes = (f"#define {macro} {max(plan.largest.get(what, 0), 1)}" for macro, what in _SIZES)
    return "\n".join([*sizes, text])


def _included(name: str) -> str:
    """Return a header with those that it includes in place."""
    text = (_SOURCE / name).read_text()
    return re.sub('^#include "(.+)"$', lambda found: _included(found[1]), text, flags=re.MULTILINE)


def _decided(text: str, single: bool) -> str:
    """Return C text with the conditions decided that are known here; others stay."""
    known = {"if HK_LANES == 1": True, "ifdef HK_FLOAT": single, "ifndef HK_MAX_N": False}
    lines, stack = [], []
    for line in text.splitlines():
        words = line[1:].partition("/*")[0].strip() if line.startswith("#") else ""
        if words.startswith("if"):
            stack.append(True if words.endswith("_H") else known.get(words))
        decided = words.startswith(("if", "else", "endif")) and stack[-1] is not None
        if decided and words == "else":
            stack[-1] = not stack[-1]
        if not decided and False not in stack:
            lines.append(line)
        if words == "endif":
            stack.pop()
    return "\n".join(lines)


def _without_cases(text: str, unused: set[str]) -> str:
    """Return C text without the cases of kinds of nodes that are not used.

    A default that shares its statement with cases goes with the last of them.
    """
    lines, depth, block, bare = [""], None, False, False
    for line in text.splitlines():
        indent = len(line) - len(line.lstrip())
        label = re.match(r" *(?:case (HK_\w+)|default):(.*)", line)
        shared, bare = bare, bool(label and not label[2])  # its statement is that of the next label
        ends = block and indent == depth and line.strip() == "}"
        if depth is not None and not label and (not line or indent > depth or ends):
            continue
        kept = shared and re.match(r" *case \w+:$", lines[-1])
        goes = label is not None and (label[1] in unused or (shared and not kept and not label[1]))
        depth, block = indent if goes else None, line.endswith("{")
        if label and goes and kept:
            depth, line = None, label[2] and " " * (indent + 3) + label[2]
        if depth is None and (line or not goes):
            lines.append(line)
    # Of kinds that are all known the last one needs no label of its own.
    last = r"(?m)^( *)case HK_\w+: (\{\n(?:\1 .*\n)*\1\}|.*;)\n\1\}"
    return re.sub(last, r"\1default: \2\n\1}", "\n".join(lines))


def _items(text: str) -> Iterator[str]:
    """Yield the definitions and directives of C text, each with the comment right above it."""
    item, depth, comment = "", 0, False
    for line in text.splitlines():
        if not line and depth == 0 and not comment:
            item = ""
            continue
        item += line + "\n"
        if comment or line.startswith("/*"):
            comment = not line.endswith("*/")
            continue
        depth += line.count("{") - line.count("}")
        done = not line.endswith("\\") if line.startswith("#") else line.endswith((";", "}"))
        if done and depth == 0:
            yield item
            item = ""


def _names(item: str) -> list[str]:
    """Return what an item defines: nothing where it always counts."""
    item = re.sub(r"/\*.*?\*/|__attribute__\(\(.*?\)\)", "", item, flags=re.DOTALL).strip()
    if item.startswith("#"):
        return re.findall(r"^#define (\w+)", item)
    if item.startswith("enum"):
        return re.findall(r"\w+", item.partition("{")[2])
    if item.startswith("typedef"):
        return re.findall(r"(\w+);$", item)
    return re.findall(r"\w+(?=\(|\[)", item)[:1]


def _reachable(text: str, roots: list[str]) -> str:
    """Return the definitions of C text that the roots need."""
    items = [(item, {*_names(item)}) for item in _items(text) if not item.startswith("#undef")]
    needed, found = set(roots), {""}
    while found:
        found = {n for item, names in items if needed & names for n in re.findall(r"\w+", item)}
        found -= needed
        needed |= found
    kept = "\n".join(item for item, names in items if not names or needed & names)
    return re.sub(r"(?<=\n)(#.*\n)\n(?=#)", r"\1", kept)
