"""Hostile and damaged files: what accidents and malice make of a whole file of each format.

Each maker takes the bytes of a whole file and a random generator, and returns those of another.
"""

from __future__ import annotations

import copy
import io
import json
import pickle
import re
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from safetensors.numpy import load, save

from hybridkin.saving._file import _checksum

CANARY = "canary-of-executed-code"


class _Code:
    def __reduce__(self) -> tuple[Any, ...]:
        return open, (CANARY, "w")


PICKLED = pickle.dumps(_Code())
WHOLE_FILES = [  # of any name
    b"",
    b"\0" * 100,
    b"\xef\xbb\xbf",
    b"\xff\xfe" + "q1,q2\n1,2\n".encode("utf-16-le"),
    b"\xff" * 8 + b"{}",
    (2**62).to_bytes(8, "little") + b"{}",
    PICKLED,
    b"\x80\x02" + b"(" * 10_000,
    b"PK\x05\x06" + bytes(18),
    b"PAR1" + b"\xff" * 8 + b"PAR1",
    b"[" * 10_000,
    b"a=" * 10_000,
    b"<robot>" + b"<a>" * 10_000,
    b"a," * 10_000 + b"\n1",
    b"0" * 10_000_000,
    b"\n" * 1_000_000,
]
# As they stand in JSON; most are no value of the setting that they replace.
VALUES = ["null", "true", "-1", "0", "3", "1e999", "-1e999", "NaN", "1e-400", "1e300", '""', "[]"]
VALUES += [
    "{}",
    '"../../x"',
    '"\\ud800"',
    '"\\u0000"',
    "9" * 400,
    "9" * 5000,
    "[" * 500 + "]" * 500,
]
VALUES += ["[" * 10_000 + "]" * 10_000, '{"a":1,"a":2}', "[" + "0," * 99_999 + "0]", "1.5", "-0.0"]
VALUES += ['"' + "x" * 10_000_000 + '"', "[1e300]", "[-1]", "[[]]", '"elm"', "9007199254740993"]
NUMBERS = [b"1e999", b"nan", b"-inf", b"1e-400", b"1e300", b"", b"1_0", b"0x10", b"9" * 5000, b"-1"]
NUMBERS += ["\u0663".encode(), b"\0", b'"', b"1e18", b"--", b"1,5", b"\xed\xa0\x80", b"999999999"]


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Return data truncated, with bits flipped, or with bytes inserted, deleted or repeated."""
    at, n = int(rng.integers(len(data) + 1)), int(rng.integers(1, 40))
    ways = [
        lambda: data[:at],
        lambda: flipped(data, rng),
        lambda: data[:at] + rng.bytes(n) + data[at:],
        lambda: data[:at] + data[at + n :],
        lambda: data[:at] + data[at : at + n] * int(rng.integers(2, 50)) + data[at + n :],
        lambda: data[:at] + b"\xff" * n + data[at + n :],
        lambda: data[:at] + bytes(n) + data[at + n :],
        lambda: data[at:] + data[:at],
        lambda: data[:at] + bytes(rng.choice(list(b"\0\"'[]{}<>&,;\n=.eE-+9"), n)) + data[at:],
        lambda: WHOLE_FILES[int(rng.integers(len(WHOLE_FILES)))],
    ]
    return ways[int(rng.choice(len(ways), p=[0.15, 0.25] + 6 * [0.08] + [0.1, 0.02]))]()


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for place in rng.integers(len(data), size=rng.integers(1, 9)):
        changed[place] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def renumbered(data: bytes, rng: np.random.Generator) -> bytes:
    """Return text with some of its numbers replaced, or of its words exchanged."""
    parts = re.split(rb"([-+.\w]+)", data)
    for _ in range(rng.integers(1, 4)):
        k = 2 * int(rng.integers(len(parts) // 2)) + 1
        other = parts[2 * int(rng.integers(len(parts) // 2)) + 1]
        parts[k] = other if rng.random() < 0.3 else NUMBERS[int(rng.integers(len(NUMBERS)))]
    return b"".join(parts)


def _slots(entry: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every place of a JSON document, as its container and its key."""
    for key in entry if isinstance(entry, dict) else range(len(entry)):
        yield entry, key
        if isinstance(entry[key], (dict, list)):
            yield from _slots(entry[key])


def repaired(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a model file with another header or other arrays, and with the right checksum."""
    size = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(json.loads(data[8:size])["__metadata__"]["hybridkin"])
    arrays = {name: array.copy() for name, array in load(data).items()}
    value = ""
    if rng.random() < 0.5:
        places = [slot for slot in _slots(header) if slot[1] not in ("format", "version")]
        for _ in range(rng.integers(1, 3)):
            within, key = places[int(rng.integers(len(places)))]
            way = rng.integers(8)
            if way == 0 and isinstance(within, dict):
                within.pop(key, None)
            elif way == 1 and isinstance(within, dict):
                within[f"{key}x"] = within.pop(key, None)
            elif way == 2:
                other, of = places[int(rng.integers(len(places)))]
                got = other.get(of) if isinstance(other, dict) else (other or [0])[0]
                within[key] = copy.deepcopy(got)
            else:
                value = VALUES[int(rng.integers(len(VALUES)))]
                within[key] = "@"
    else:
        name = sorted(arrays)[int(rng.integers(len(arrays)))]
        changed = _other_array(arrays[name], [*arrays.values()], rng)
        if changed is None:
            del arrays[name]
        else:
            arrays[name] = changed
    text = json.dumps(header).replace('"@"', value)
    whole = {name: np.array(array, order="C") for name, array in arrays.items()}
    return save(whole, metadata={"hybridkin": text, "sha256": _checksum(text, whole)})


def _other_array(array: Any, others: list[Any], rng: np.random.Generator) -> Any:
    if array.dtype.kind not in "fi":
        return array[:-1]
    hostile = [np.nan, np.inf, -np.inf, 1e300, -1e300, 5e-324, 0.0, -1.0, 1e6, 1e-6, -0.0]
    single = hostile[int(rng.integers(len(hostile)))]
    one, all_of_it = array.copy(), np.full_like(array, 0)
    with np.errstate(all="ignore"):
        if array.dtype.kind == "f":
            one.ravel()[rng.integers(max(1, one.size)) :][:1] = single
            all_of_it[...] = single
    with np.errstate(all="ignore"):
        ways = [
            one, one, one, all_of_it, None, array[:0] if array.ndim else array[None],
            array[:-1] if array.ndim else array * 2, np.stack([array, array]), array.ravel(),
            array.T,
            array.astype(np.float16), array.astype(np.int64), array.astype(bool), -array,
            array * 1e3, rng.permutation(array.ravel()).reshape(array.shape),
            array.astype(np.float32), others[int(rng.integers(len(others)))],
            np.repeat(array, 3, axis=-1) if array.ndim else array, np.zeros((0, 7)),
        ]  # fmt: skip
    return ways[int(rng.integers(len(ways)))]


def _npy(array: Any, shape: str | None = None, descr: str | None = None) -> bytes:
    """Return an array as npy, with a header that says something else where asked."""
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asarray(array), allow_pickle=True)
    data = file.getvalue()
    size = 10 + int.from_bytes(data[8:10], "little")
    head = data[10:size].decode("latin1")
    if shape is not None:
        head = re.sub(r"\((?:\d+, ?)*\d*\)", lambda _: shape, head, count=1)
    if descr is not None:
        head = re.sub(r"'descr': '[^']*'", lambda _: f"'descr': {descr}", head)
    return data[:8] + len(head).to_bytes(2, "little") + head.encode("latin1") + data[size:]


SHAPES = ["(1000000000000000000,)", "(-1,)", "(0, 1000000000)", "(4294967296, 4294967296)", "()"]
SHAPES += [
    "(" + "1," * 70 + ")",
    "(" * 200 + ")" * 200,
    "(True,)",
    "(20.0,)",
    "'20'",
    "(2000000000,)",
]
SHAPES += ["(__import__('os'),)", f"(open({CANARY!r}, 'w'),)", "(0, 3000000)"]
DESCRS = ["'|O'", "'<U99999999'", "'<M8[s]'", "'<c16'", "'|V8'", "[('a', '<f8')]", "'<f2'", "'|S0'"]
DESCRS += [f"open({CANARY!r}, 'w')", "'<f8' * 99999", "'>i8'", "'?'", "[" * 100 + "]" * 100, "''"]


def zipped(data: bytes, rng: np.random.Generator) -> bytes:
    """Return an npz file with one member made by hand: code, false sizes, bombs, paths, doubles."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        members = [(name, file.read(name)) for name in file.namelist()]
        arrays = dict(np.load(io.BytesIO(data)))
    k = int(rng.integers(len(members)))
    name = members[k][0].removesuffix(".npy")
    array, (way, pick) = arrays[name], rng.integers(1000, size=2)
    objects = np.empty(20, dtype=object)
    objects[:] = _Code()
    ways = [
        lambda: _npy(objects),
        lambda: PICKLED,
        lambda: _npy(array, shape=SHAPES[pick % len(SHAPES)]),
        lambda: _npy(array, descr=DESCRS[pick % len(DESCRS)]),
        lambda: damaged(members[k][1], rng),
        lambda: renumbered(members[k][1][:128], rng) + members[k][1][128:],
        lambda: _npy(_other_array(array, [*arrays.values()], rng)),
        lambda: _npy(np.zeros((2, 100_000)) if pick % 10 else np.zeros(60_000_000)),
    ]
    content = ways[way % len(ways)]()
    content = members[k][1] if content is None else content
    names = [
        *4 * [members[k][0]],
        "../../" + CANARY + ".npy",
        "/" + CANARY,
        members[0][0],
        "\0.npy",
    ]
    members[k] = (names[way % len(names)] if way % 3 == 0 else members[k][0], content)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for member, body in members:
            file.writestr(zipfile.ZipInfo(member), body, zipfile.ZIP_DEFLATED)
    changed = out.getvalue()
    return damaged(changed, rng) if way % 5 == 0 else changed


def columnar(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a parquet file with columns of other kinds, or metadata that are damaged."""
    frame = pd.read_parquet(io.BytesIO(data))
    name, n = frame.columns[int(rng.integers(frame.shape[1]))], len(frame)
    kinds = [
        ["1.5"] * n, ["x" * 100_000] * n, [b"\0\xff"] * n, [[1.0, 2.0]] * n, [{"a": 1.0}] * n,
        [None] * n, [10**18] * n, pd.to_datetime(["2026-01-01"] * n), [True] * n, [np.nan] * n,
        pd.Categorical(["a"] * n), [np.inf] * n, pd.array([1, None] * (n // 2), dtype="Int64"),
        [float(v) for v in rng.choice([1e300, 5e-324, -0.0, np.nan], n)], [""] * n,
    ]  # fmt: skip
    if (way := rng.integers(4)) == 0:
        frame[name] = kinds[int(rng.integers(len(kinds)))]
    out = io.BytesIO()
    if way == 1:
        frame = frame.set_index(name)
    elif way == 2 and rng.random() < 0.05:  # a gigabyte of one value
        frame = pd.DataFrame(np.zeros((20_000_000, frame.shape[1])), columns=frame.columns)
    frame.to_parquet(out)
    changed = out.getvalue()
    foot = len(changed) - 8 - int.from_bytes(changed[-8:-4], "little")
    if way != 3:
        return changed
    return changed[:foot] + flipped(changed[foot:], rng)  # lengths and names of thrift


def described(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a document, TOML or XML, that costs more to read than its size says."""
    n = int(rng.integers(100, 20_000))
    if not data.lstrip().startswith(b"<"):
        ways = [b".".join([b"a"] * n) + b" = 1\n", b"[" + b".".join([b"b"] * n) + b"]\n"]
        ways += [b"c = " + b"[" * n, b"c = " + b"{a=" * n, b"c = [" + b"0," * n + b"]\n"]
        ways += [b"[[segment]]\n" * (n // 10), b"name = '" + b"x" * n + b"'\n", b"\xff\xfe"]
        ways += [b"name = 1\nname = 2\n", b"c = 0x" + b"f" * n + b"\n", b"repeat = 1" + b"0" * n]
        add = ways[int(rng.integers(len(ways)))]
        return add + data if rng.random() < 0.5 else data + b"\n" + add
    first, rest = data.split(b">", 1)
    bomb = b"".join(b'<!ENTITY a%d "%s">' % (k, b"&a%d;" % (k - 1) * 10) for k in range(1, 10))
    path = b"file:///etc/hostname"
    ways = [
        b'<!DOCTYPE r [<!ENTITY a0 "x">' + bomb + b"]>" + first + b">&a9;" + rest,
        b'<!DOCTYPE r [<!ENTITY x SYSTEM "' + path + b'">]>' + first + b">&x;" + rest,
        b'<!DOCTYPE r SYSTEM "' + path + b'">' + data,
        first + b">" + b"<a>" * n + b"</a>" * n + rest,
        first + b' a="' + b"x" * n * 100 + b'">' + rest,
        first + b">" + b"<link name='x'/>" * n + rest,
        first + b">" + b"".join(
            b"<link name='m%d'/><joint name='k%d' type='fixed'><parent link='m%d'/>"
            b"<child link='m%d'/></joint>" % (k, k, k - 1, k) for k in range(1, n)
        ) + b"<link name='m0'/>" + rest,
        first + b"><include file='/dev/zero'/>" + rest,
        first + b"><worldbody><replicate count='%d'><geom size='1'/>" % 10 ** (n % 12)
        + b"</replicate></worldbody>" + rest,
        first + b"><size nuser_body='%d'/>" % 10 ** (n % 12) + rest,
        first + b"><asset><texture name='t' builtin='flat' type='2d' width='%d'" % (n * n)
        + b" height='%d'/></asset>" % n + rest,
        first + b"><include filename='/etc/hostname'/>" + rest,
        first + b"><asset><hfield name='h' nrow='9' ncol='9' size='1 1 1 1' file='/dev/zero'/>"
        b"</asset>" + rest,
        data.decode().encode("utf-16"),
        b"\xef\xbb\xbf" + data,
        data.replace(b"joint", b"joint joint='a'", 1),
    ]  # fmt: skip
    return ways[int(rng.integers(len(ways)))]


def wide(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a table of text of an unlikely size: columns, cells, lines."""
    head, row, *_ = data.split(b"\n")
    n = int(rng.integers(100, 20_000))
    ways = [
        head + b"," + b",".join(b"c%d" % k for k in range(n)) + b"\n" + (row + b"\n") * n,
        data + b"\n" * n,
        head + b"\n" + row + b"x" * 100_000 + b"\n" + (row + b"\n") * n,
        head + b"\n" + row + b',"' + row * n,
        head.replace(b"q1", b'"' + b"q" * n + b'"') + b"\n" + row,
        head + b"\n" + b"," * n,
        data.decode().encode("utf-16"),
        b"\xef\xbb\xbf" + data.replace(b",", b";"),
        data.replace(b"\n", b"\r"),
        data.replace(b"\n", b"\n\n#\n"),
        head + b"\n" + b"0,0,0,0,0,0,0,0\n" * n,
    ]
    return ways[int(rng.integers(len(ways)))]
