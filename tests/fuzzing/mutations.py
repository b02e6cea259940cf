"""Spoiled files: by their bytes, their place, and the structure of their kind.

Tables name what is done; functions of (what, rng) do it. Of :data:`PLACE` they change the file at a path, and may say
how; of :data:`DATA` and :data:`TEXT` they return other content. Of :data:`TREE` are functions that load and dump one.
"""

import contextlib
import csv
import json
import os
import re
import shutil
import sqlite3
import struct
import time
import tomllib
import zipfile
import zlib
from collections.abc import Callable
from contextlib import closing
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

Rng = np.random.Generator
PLACE, DATA, TEXT, TREE = "place", "data", "text", "tree"
Group = dict[str, tuple[str, Any]]
HUGE_BYTES = 3 << 30
DAYS_S = 86_400.0
NUMBERS = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-308, 0.0, -1.0, 1e9, 2**63, 10**30, 0.5, True)
WORDS = ("NaN", "1e999", "-1", "1e308", "null", "[]", '"x"', "9" * 5000, "[" * 100_000, "0x10", "1_000", "+1", "1,5")
TEXTS = (
    *("", "text", "\x1b[31mred\x07", "a\nb", "\u202eabc", "é", "x" * 100_000, "../../etc", "1,5", "nan", "٣"),
    *("\x00", "{{7*7}}"),
)
KINDS = (None, [], {}, [[]], {"x": 1}, [None], [1, "a"], True)
RAW = "as it is "
"""Marks the number of a word that stands in the file without quotes."""
KEYS = ("x", "", "a.b", "a b", "\x1b[1m", "é" * 300, "x_mm", "q1_rad")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
LINE_ENDS = (b"\r\n", b"\r", b"\n\n", "\u2028".encode(), b"\x0c\n")
CONTROL = (b"\x1b[31;1m", b"\x00", b"\x07\x08", "\u202e\u200b".encode(), b"\x7f", b"\xb0 \xe9")
NAMES = ("x" * 240, "a\nb", "\x1b[31m", "<b>&", "a,b", "..x", "\udcff", "é ß", "%s", "'", ".hidden")
LONG = [character * 300_000 for character in (b"9", b"x", b"[", b'"', b" ", b",")]
STEPS = list(zip("abcdefgh", "bcdefghi", strict=True))
YAML = (
    "a: &a [x,x,x,x,x,x,x,x,x]\n"
    + "".join(f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in STEPS)
    + "distortion_model: *i\n",
    "a: " + "[" * 50_000,
    "{a: " * 5000,
    "camera_matrix: !!python/object/apply:os.system ['true']\n",
    "---\na: 1\n---\nb: 2\n",
    "- 1\n- 2\n",
    "x: &x {a: 1}\ny: {<<: *x, <<: *x}\n",
    "camera_matrix: &a [*a]\n",
    "image_width: " + "9" * 5000 + "\n",
    "image_width: 2020-01-01\n",
    "? [1, 2]\n: 3\n",
)
_ENTITIES = "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in STEPS)
XML = (
    f'<!DOCTYPE x [<!ENTITY a "x">{_ENTITIES}]><x>&i;</x>',
    '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><opencv_storage>&a;</opencv_storage>',
    "<a>" * 100_000,
    "<opencv_storage/>",
    f"<opencv_storage><image_width>{'9' * 5000}</image_width></opencv_storage>",
    "<svg xmlns='http://www.w3.org/2000/svg'/>",
)


def pick(rng: Rng, values):
    """One of them; not an array's copy of it."""
    return values[int(rng.integers(len(values)))]


def _inserted(data: bytes, rng: Rng, piece: bytes) -> bytes:
    at = int(rng.integers(len(data) + 1))
    return data[:at] + piece + data[at:]


def _replaced(data: bytes, rng: Rng, instead: Callable[[bytes], bytes]) -> bytes:
    a, b = sorted(rng.integers(len(data) + 1, size=2).tolist())
    return data[:a] + instead(data[a:b]) + data[b:]


def _flipped(data: bytes, rng: Rng) -> bytes:
    found = bytearray(data)
    for at in rng.integers(len(found), size=int(rng.integers(1, 6))) if found else ():
        found[at] ^= 1 << int(rng.integers(8))
    return bytes(found)


def _number_replaced(text: str, rng: Rng) -> str:
    """One number of a text, be it YAML, XML or a table of COLMAP, by another or by what is none."""
    place = pick(rng, list(NUMBER.finditer(text)) or list(re.finditer("$", text)))
    number = str(pick(rng, NUMBERS)) if rng.random() < 0.7 else pick(rng, [*WORDS, *TEXTS])
    return text[: place.start()] + number + text[place.end() :]


def _line_changed(text: str, rng: Rng) -> str:
    lines = text.splitlines() or [""]
    change = pick(rng, [_gone, _more, _exchanged, lambda lines, i, _: lines.insert(i, "#" + lines.pop(i))])
    change(lines, int(rng.integers(len(lines))), rng)
    return "\n".join(lines) + "\n"


def _binary_number(data: bytes, rng: Rng) -> bytes:
    """A number of eight bytes of a COLMAP model, its counts above all."""
    at = 0 if rng.random() < 0.3 else int(rng.integers(max(len(data) - 8, 1)))
    form, numbers = pick(rng, [("<d", NUMBERS[:8]), ("<Q", [0, 1, 2**31, 2**60, 2**64 - 1])])
    return data[:at] + struct.pack(form, pick(rng, numbers)) + data[at + 8 :]


# Trees of dicts, lists and values: JSON, TOML, YAML; rows or columns of a table. A change gets the holder of a value.


def _changed(tree, rng: Rng):
    """The tree after one change, at any depth."""
    if not tree:
        return []
    holder, key = {"": tree}, ""
    while isinstance(holder[key], dict | list) and holder[key] and (holder[key] is tree or rng.random() < 0.7):
        holder = holder[key]
        key = pick(rng, list(holder) if isinstance(holder, dict) else range(len(holder)))
    pick(rng, CHANGES)(holder, key, rng)
    return tree


def _gone(holder, key, _) -> None:
    holder.pop(key)


def _exchanged(holder, key, rng: Rng) -> None:
    other = pick(rng, list(holder) if isinstance(holder, dict) else range(len(holder)))
    holder[key], holder[other] = holder[other], holder[key]


def _more(holder, key, rng: Rng) -> None:
    if isinstance(holder, list):
        at = int(rng.integers(len(holder) + 1))
        holder[at:at] = [holder[key]] * pick(rng, [1, 1, 3, 200])
    else:
        holder[pick(rng, KEYS)] = holder.pop(key) if rng.random() < 0.5 else holder[key]


def _numbers(holder, key, rng: Rng) -> None:
    """All numbers below a place times a factor, or all the same."""
    factor, value = pick(rng, [1e-3, 1e3, -1, 0, 1e300, 25.4, None]), pick(rng, NUMBERS)

    def other(number: str) -> float:
        return value if factor is None else float(number) * factor

    holder[key] = json.loads(json.dumps(holder[key], default=str), parse_float=other, parse_int=other)


def _put(values) -> Callable:
    def change(holder, key, rng: Rng) -> None:
        holder[key] = pick(rng, values)

    return change


CHANGES = (
    *(_gone, _exchanged, _more, _numbers, _put(NUMBERS), _put(NUMBERS), _put(TEXTS)),
    *(_put(KINDS), _put([f"{RAW}{i}" for i in range(len(WORDS))])),
)


def _with_words(text: str) -> str:
    return re.sub(rf'"?{RAW}(\d+)"?', lambda found: WORDS[int(found[1])], text)


def _json(tree, between: str = ": ") -> str:
    """JSON with what JSON has not, as Python writes it; or inline TOML, " = " ``between`` a key and its value."""
    return _with_words(json.dumps(tree, ensure_ascii=False, default=str, separators=(", ", between)))


def _toml(tree) -> str:
    """Keys with inline values."""
    text = "".join(f"{json.dumps(key)} = {_json(value, ' = ')}\n" for key, value in (tree or {"x": []}).items())
    return text.replace("NaN", "nan").replace("Infinity", "inf")


def _table(text: str, rng: Rng) -> str:
    """A table changed as a list of rows, or of columns."""

    def turned(table) -> list[list]:
        lines = [line if isinstance(line, list) else [line] for line in table]
        return [list(line) for line in zip_longest(*lines, fillvalue="")] if by_column else lines

    by_column = rng.random() < 0.5
    rows = [[float(c) if NUMBER.fullmatch(c) else c for c in row] for row in csv.reader(text.splitlines())]
    return _with_words("".join(",".join(map(str, row)) + "\n" for row in turned(_changed(turned(rows), rng))))


def _key_twice(text: str, rng: Rng) -> str:
    return text.replace("{", f"{{{json.dumps(pick(rng, list(json.loads(text)) or ['x']))}: {pick(rng, WORDS)}, ", 1)


def _instead(path: Path, _, make: Callable[[Path], object]) -> None:
    path.unlink()
    make(path)


def _a_link(path: Path, _) -> None:
    path.rename(path.with_name(f"real {path.name}"))
    path.symlink_to(f"real {path.name}")


def _aged(path: Path, rng: Rng) -> str:
    days = float(rng.uniform(-4000, 4000))
    os.utime(path, (time.time() - days * DAYS_S,) * 2)
    return f" by {days:.0f} days"


def _as_another(path: Path, rng: Rng, swap: bool) -> str:
    """What a file of its kind in its folder holds, such as detections of another image."""
    kind = path.name.partition("-")[0] if "-" in path.name else ""
    other = pick(rng, [each for each in path.parent.glob(f"{kind}*{path.suffix}") if each.is_file()])
    own = path.read_bytes()
    shutil.copyfile(other, path.with_name("copied"))
    if swap:
        other.write_bytes(own)
    path.with_name("copied").rename(path)
    return f" {other.name}"


def _edited(path: Path, rng: Rng) -> str:
    """A number, or the values of all arrays, changed by little, so that the file is still valid, where it is."""
    if path.suffix in (".json", ".toml"):
        text = path.read_text(errors="surrogateescape")
        if numbers := [found for found in NUMBER.finditer(text) if "." in found[0]]:
            number = pick(rng, numbers)
            edited = f"{text[: number.start()]}{1.001 * float(number[0])!r}{text[number.end() :]}"
            path.write_text(edited, errors="surrogateescape")
            return f" {number[0]}"
    with contextlib.suppress(OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error), np.load(path) as stored:
        floats = {name: values for name, values in stored.items() if values.dtype.kind == "f"}
        noisy = {name: values * (1 + 1e-3 * rng.standard_normal(values.shape)) for name, values in floats.items()}
        np.savez(path, **dict(stored) | noisy)
        return f" {', '.join(noisy)[:40]}"
    path.write_bytes(_flipped(path.read_bytes(), rng))
    return " in some bits"


def _named(path: Path, rng: Rng) -> str:
    name = pick(rng, NAMES)
    path.rename(path.with_name(name + path.suffix))
    return f" {name[:20]!r}"


def _row(path: Path, rng: Rng) -> str:
    """One change of a database that is still one."""
    with closing(sqlite3.connect(path, isolation_level=None)) as base:
        tables = [row[0] for row in base.execute("SELECT name FROM sqlite_master WHERE type='table' ORDER BY name")]
        table = pick(rng, [t for t in tables if not t.startswith("sqlite_")])
        column = pick(rng, [row[1] for row in base.execute(f"PRAGMA table_info({table})")])
        first = f"WHERE rowid = (SELECT min(rowid) FROM {table})"
        name = pick(rng, ["../../../x.jpg", "/etc/x.jpg", "", "a\x1b[31mb.jpg", "é" * 200 + ".jpg"])
        statement, *values = pick(
            rng,
            [
                (f"DROP TABLE {table}",),
                (f"DELETE FROM {table}",),
                (f"DELETE FROM {table} {first}",),
                (f"UPDATE {table} SET {column} = ? {first}", rng.bytes(int(rng.integers(40)))),
                (f"UPDATE {table} SET {column} = ? {first}", pick(rng, NUMBERS)),
                ("UPDATE images SET name = ? WHERE image_id = 1", name),
            ],
        )
        base.execute("PRAGMA foreign_keys=OFF")
        try:
            base.execute(statement, values)
        except (sqlite3.Error, OverflowError) as error:
            return f": {statement} not possible ({error})"
    return f": {statement}"


PIXELS: dict[str, tuple[str, Callable[[np.ndarray, Rng], np.ndarray]]] = {
    "one pixel": ("", lambda seen, _: seen[:1, :1]),
    "one row": ("", lambda seen, _: seen[:1]),
    "half": ("", lambda seen, _: seen[: len(seen) // 2]),
    "turned": ("", lambda seen, _: np.rot90(seen).copy()),
    "mirrored": ("", lambda seen, _: seen[:, ::-1].copy()),
    "small": ("", lambda seen, _: seen[::7, ::7].copy()),
    "black": ("", lambda seen, _: np.zeros_like(seen)),
    "white": ("", lambda seen, _: np.full_like(seen, 255)),
    "noise": ("", lambda seen, rng: rng.integers(0, 256, seen.shape).astype(np.uint8)),
    "chequered": ("", lambda seen, _: (np.indices(seen.shape) // 6).sum(0).astype(np.uint8) % 2 * 255),
    "colour": ("", lambda seen, _: cv2.cvtColor(seen, cv2.COLOR_GRAY2BGR)),
    "negative": ("", lambda seen, _: 255 - seen),
    "16 bit": (".png", lambda seen, _: seen.astype(np.uint16) * 257),
    "16 bit, dark": (".png", lambda seen, _: seen.astype(np.uint16) // 15),
    "float": (".tiff", lambda seen, _: seen.astype(np.float32)),
    "bitmap": (".bmp", lambda seen, _: seen),
    "transparent": (".png", lambda seen, _: cv2.merge([seen] * 4)),
}  # fmt: skip
"""Another photograph of the same name, and in another encoding than the name says."""


def _pixels(suffix: str, other: Callable[[np.ndarray, Rng], np.ndarray], data: bytes, rng: Rng) -> bytes:
    seen = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    own = ".png" if data.startswith(b"\x89PNG") else ".jpg"
    return cv2.imencode(suffix or own, other(seen, rng))[1].tobytes()


def _many_pixels(data: bytes, rng: Rng) -> bytes:
    """Stated in the head of a PNG."""
    png = bytearray(_pixels(".png", lambda seen, _: seen, data, rng))
    side = pick(rng, [30_000, 65_535, 2**31 - 1])
    png[16:24] = struct.pack(">II", side, side)
    png[29:33] = struct.pack(">I", zlib.crc32(bytes(png[12:29])))
    return bytes(png)


MARKED, NOT_PERMITTED = "in another encoding", "not permitted"
"""Some readers understand the first of these: UTF-16 and UTF-32 begin with a mark."""
REFUSED: Group = {
    "emptied": (DATA, lambda *_: b""),
    "junk": (DATA, lambda data, rng: rng.bytes(max(len(data), 64))),
    MARKED: (TEXT, lambda text, rng: text.encode(pick(rng, ["utf-16", "utf-16-be", "utf-32"]), "replace")),
    "missing": (PLACE, lambda path, _: path.unlink()),
    "a folder": (PLACE, partial(_instead, make=Path.mkdir)),
    "a link to nothing": (PLACE, partial(_instead, make=lambda path: path.symlink_to("nowhere"))),
    "a link to itself": (PLACE, partial(_instead, make=lambda path: path.symlink_to(path.name))),
    NOT_PERMITTED: (PLACE, lambda path, _: path.chmod(0)),
    "huge, a hole": (PLACE, lambda path, _: os.truncate(path, HUGE_BYTES)),
}
"""After these a file that a command line names can no longer be used, whatever is in it."""
BYTES: Group = {
    "truncated": (DATA, lambda data, rng: data[: int(rng.integers(len(data) + 1))]),
    "flipped": (DATA, _flipped),
    "a piece twice": (DATA, lambda data, rng: _replaced(data, rng, lambda piece: 2 * piece)),
    "a piece of zeros": (DATA, lambda data, rng: _replaced(data, rng, lambda piece: bytes(len(piece)))),
    "a piece of junk": (DATA, lambda data, rng: _inserted(data, rng, rng.bytes(int(rng.integers(1, 200))))),
    "a link": (PLACE, _a_link),
}
KEPT: Group = {
    "another's": (PLACE, partial(_as_another, swap=False)),
    "swapped with": (PLACE, partial(_as_another, swap=True)),
    "aged": (PLACE, _aged),
    "edited": (PLACE, _edited),
}
"""Of files that a run keeps."""
FORM: Group = {
    "byte order mark": (DATA, lambda data, _: b"\xef\xbb\xbf" + data),
    "other line ends": (DATA, lambda data, rng: data.replace(b"\n", pick(rng, LINE_ENDS))),
    "control characters": (DATA, lambda data, rng: _inserted(data, rng, pick(rng, CONTROL))),
    "a long line": (DATA, lambda data, rng: _inserted(data, rng, pick(rng, LONG))),
}
PARTS: Group = {"number": (TEXT, _number_replaced), "line": (TEXT, _line_changed)}
TABLE: Group = {
    "semicolons": (TEXT, lambda text, _: text.replace(",", ";")),
    "decimal commas": (TEXT, lambda text, _: text.replace(",", ";").replace(".", ",")),
    "tabs": (TEXT, lambda text, _: text.replace(",", "\t")),
    "quoted": (TEXT, lambda text, _: re.sub(r"[^,\n]+", r'"\g<0>"', text)),
    "an open quote": (TEXT, lambda text, rng: text.replace(",", ',"', 1 + int(rng.integers(9)))),
    "header only": (TEXT, lambda text, _: text.splitlines()[0]),
    "no header": (TEXT, lambda text, _: text.partition("\n")[2]),
    "header twice": (TEXT, lambda text, _: text.splitlines()[0] + "\n" + text),
}
CELLS: Group = {"table": (TEXT, _table)}
JSON_TREE: Group = {"tree": (TREE, (json.loads, _json))}
TOML_TREE: Group = {"tree": (TREE, (tomllib.loads, _toml))}
YAML_TREE: Group = {"tree": (TREE, (lambda text: None if "%YAML" in text else yaml.safe_load(text), _json))}
OTHER_YAML: Group = {"other YAML": (TEXT, lambda text, rng: pick(rng, ["", text]) + pick(rng, YAML))}
OTHER_XML: Group = {"other XML": (TEXT, lambda _, rng: pick(rng, XML))}
BINARY: Group = {"binary number": (DATA, _binary_number)}
IMAGE: Group = {name: (DATA, partial(_pixels, *form)) for name, form in PIXELS.items()}
BY_SUFFIX: dict[str, tuple[Group, ...]] = {
    ".json": (JSON_TREE, JSON_TREE, JSON_TREE, {"key twice": (TEXT, _key_twice)}, FORM),
    ".toml": (TOML_TREE, TOML_TREE, PARTS, FORM),
    ".csv": (CELLS, CELLS, CELLS, TABLE, PARTS, FORM),
    ".txt": (PARTS, PARTS, FORM),
    ".yaml": (YAML_TREE, OTHER_YAML, PARTS, FORM),
    ".xml": (OTHER_XML, PARTS, PARTS, FORM),
    ".cameramodel": (PARTS, PARTS, FORM),
    ".bin": (BINARY, BINARY),
    ".mat": (BINARY, BINARY),
    ".db": ({"row": (PLACE, _row)},) * 2,
    ".jpg": (IMAGE, IMAGE, {"many pixels": (DATA, _many_pixels), "named": (PLACE, _named)}),
}
BY_SUFFIX[".png"] = BY_SUFFIX[".jpg"]
"""Beside :data:`BYTES` and :data:`REFUSED`, which any file can suffer."""


def spoil(path: Path, rng: Rng, *groups: Group) -> tuple[str, str]:
    """Do one of the changes of these groups, or of those of its kind; its name, and what was done."""
    group = pick(rng, groups or (*BY_SUFFIX.get(path.suffix, ()), BYTES, REFUSED))
    name = pick(rng, list(group))
    kind, change = group[name]
    if kind == PLACE:
        return name, f"{name}{change(path, rng) or ''}"
    before = path.read_bytes()
    if kind == TREE:
        loads, dumps = change
        before, after = (
            dumps(tree).encode() for tree in (loads(before.decode()), _changed(loads(before.decode()), rng))
        )
    else:
        after = change(before if kind == DATA else before.decode(errors="surrogateescape"), rng)
        after = after if isinstance(after, bytes) else after.encode(errors="surrogateescape")
    path.write_bytes(after)
    at = next((i for i, (a, b) in enumerate(zip(before, after, strict=False)) if a != b), 0)
    return name, f"{name} at {at}: {before[at : at + 20]!r} → {after[at : at + 20]!r}"
