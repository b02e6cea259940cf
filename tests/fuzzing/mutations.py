"""Spoiled files: by their bytes, their place, and the structure of their kind. Each function changes one file.

A mutation is a function (path, rng) that says in a few words what it did; ``REFUSED`` are those after which a file that
a command line names can no longer be used, whatever is in it.
"""

import json
import os
import sqlite3
import struct
import tomllib
import zlib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np

from tests.fuzzing import structures
from tests.fuzzing.structures import pick

Mutation = Callable[[Path, np.random.Generator], str]
HUGE_BYTES = 3 << 30
IMAGES = (".jpg", ".png")


def _bytes(said: str, change: Callable[[bytes, np.random.Generator], bytes]) -> Mutation:
    def spoil(path: Path, rng: np.random.Generator) -> str:
        path.write_bytes(change(path.read_bytes(), rng))
        return said

    return spoil


def _inserted(said: str, piece: Callable[[np.random.Generator], bytes]) -> Mutation:
    def change(data: bytes, rng: np.random.Generator) -> bytes:
        at = int(rng.integers(len(data) + 1))
        return data[:at] + piece(rng) + data[at:]

    return _bytes(said, change)


def _replaced(said: str, instead: Callable[[bytes], bytes]) -> Mutation:
    def change(data: bytes, rng: np.random.Generator) -> bytes:
        a, b = sorted(rng.integers(len(data) + 1, size=2).tolist())
        return data[:a] + instead(data[a:b]) + data[b:]

    return _bytes(said, change)


def _flipped(data: bytes, rng: np.random.Generator) -> bytes:
    found = bytearray(data)
    for at in rng.integers(len(found), size=int(rng.integers(1, 6))) if found else ():
        found[at] ^= 1 << int(rng.integers(8))
    return bytes(found)


LINE_ENDS = (b"\r\n", b"\r", b"\n\n", "\u2028".encode(), b"\x0c\n")
CONTROL = (b"\x1b[31;1m", b"\x00", b"\x07\x08", "\u202e\u200b".encode(), b"\x7f")
ENCODINGS = ("utf-16", "utf-16-be", "utf-32")
truncated = _bytes("truncated", lambda data, rng: data[: int(rng.integers(len(data) + 1))])
flipped = _bytes("flipped", _flipped)
emptied = _bytes("emptied", lambda *_: b"")
junk = _bytes("junk", lambda data, rng: rng.bytes(max(len(data), 64)))
utf_16 = _bytes("utf_16", lambda data, rng: data.decode("utf-8", "replace").encode(pick(rng, ENCODINGS)))


def _done(said: str, *steps: Callable[[Path], object]) -> Mutation:
    def spoil(path: Path, _) -> str:
        for step in steps:
            step(path)
        return said

    return spoil


a_folder = _done("a folder", Path.unlink, Path.mkdir)
missing = _done("missing", Path.unlink)
not_permitted = _done("not permitted", lambda path: path.chmod(0))
huge = _done(f"{HUGE_BYTES >> 30} GB", lambda path: os.truncate(path, HUGE_BYTES))
"""A hole without end, that takes no space."""


def a_broken_link(path: Path, rng: np.random.Generator) -> str:
    path.unlink()
    path.symlink_to(pick(rng, [path.name, "nowhere"]))
    return "a broken link"


def a_link(path: Path, _) -> str:
    """To the same file elsewhere."""
    path.rename(path.with_name(f"real {path.name}"))
    path.symlink_to(f"real {path.name}")
    return "a link"


BYTES = (
    truncated,
    flipped,
    _replaced("a piece twice", lambda piece: 2 * piece),
    _inserted("a piece of junk", lambda rng: rng.bytes(int(rng.integers(1, 200)))),
    _replaced("a piece of zeros", lambda piece: bytes(len(piece))),
)
TEXT = (
    _bytes("byte order mark", lambda data, _: b"\xef\xbb\xbf" + data),
    _bytes("other line ends", lambda data, rng: data.replace(b"\n", pick(rng, LINE_ENDS))),
    _inserted("control characters", lambda rng: pick(rng, CONTROL)),
    _inserted("a long line", lambda rng: pick(rng, [b"9", b"x", b"[", b'"', b" ", b","]) * 300_000),
    _inserted("latin 1", lambda _: b"\xb0 \xe9"),
)
MAY_BE_READ = (utf_16,)
"""Those of :data:`REFUSED` that some readers understand: UTF-16 and UTF-32 begin with a mark."""
REFUSED = (utf_16, emptied, junk, a_folder, missing, a_broken_link, not_permitted, huge)
PLACE = (a_link,)


def json_value(path: Path, rng: np.random.Generator) -> str:
    tree, said = structures.changed(json.loads(path.read_text()), rng)
    path.write_text(structures.text_of(tree))
    return said


def json_key_twice(path: Path, rng: np.random.Generator) -> str:
    text = path.read_text()
    at = text.index("{") + 1
    key = pick(rng, list(json.loads(text)) or ["x"])
    path.write_text(f"{text[:at]}{json.dumps(key)}: {pick(rng, structures.WORDS)}, {text[at:]}")
    return f"{key} twice"


def toml_value(path: Path, rng: np.random.Generator) -> str:
    tree, said = structures.changed(tomllib.loads(path.read_text()), rng)
    path.write_text(structures.toml_of(tree))
    return said


def csv_cells(path: Path, rng: np.random.Generator) -> str:
    rows = [line.split(",") for line in path.read_text().splitlines()]
    said = pick(rng, structures.TABLE)(rows, rng)
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")
    return said


def csv_form(path: Path, rng: np.random.Generator) -> str:
    text = path.read_text()
    forms = {
        "semicolons": text.replace(",", ";"),
        "decimal commas": text.replace(",", ";").replace(".", ","),
        "tabs": text.replace(",", "\t"),
        "quoted": "\n".join(",".join(f'"{c}"' for c in line.split(",")) for line in text.splitlines()),
        "an open quote": text.replace(",", ',"', 1 + int(rng.integers(9))),
        "header only": text.splitlines()[0],
        "no header": text.partition("\n")[2],
        "header twice": text.splitlines()[0] + "\n" + text,
    }
    name = pick(rng, list(forms))
    path.write_text(forms[name])
    return name


def text_number(path: Path, rng: np.random.Generator) -> str:
    """One number of a text file, be it YAML, XML or a table of COLMAP; or of what stands in a binary one's place."""
    text, said = structures.number_replaced(path.read_text(errors="surrogateescape"), rng)
    path.write_text(text, errors="surrogateescape")
    return said


def text_line(path: Path, rng: np.random.Generator) -> str:
    lines = path.read_text(errors="surrogateescape").splitlines() or [""]
    i, j = rng.integers(len(lines), size=2).tolist()
    said = pick(rng, ["gone", "twice", "exchanged", "commented"])
    if said == "gone":
        del lines[i]
    elif said == "twice":
        lines.insert(j, lines[i])
    elif said == "exchanged":
        lines[i], lines[j] = lines[j], lines[i]
    else:
        lines[i] = "#" + lines[i]
    path.write_text("\n".join(lines) + "\n", errors="surrogateescape")
    return f"line {i + 1} {said}"


def yaml_form(path: Path, rng: np.random.Generator) -> str:
    name = pick(rng, list(structures.YAML))
    path.write_text(path.read_text() + structures.YAML[name] if rng.random() < 0.5 else structures.YAML[name])
    return name


def xml_form(path: Path, rng: np.random.Generator) -> str:
    name = pick(rng, list(structures.XML))
    path.write_text(structures.XML[name])
    return name


def binary_number(path: Path, rng: np.random.Generator) -> str:
    """A number of eight bytes of a COLMAP model, its counts above all."""
    data = bytearray(path.read_bytes())
    at = 0 if rng.random() < 0.3 else int(rng.integers(max(len(data) - 8, 1)))
    value = pick(rng, structures.NUMBERS[:8])
    form, number = ("<d", value) if rng.random() < 0.5 else ("<Q", pick(rng, [0, 1, 2**31, 2**60, 2**64 - 1]))
    data[at : at + 8] = struct.pack(form, number)
    path.write_bytes(data)
    return f"{number} at {at}"


def database_row(path: Path, rng: np.random.Generator) -> str:
    """One change of a database that is still one."""
    with closing(sqlite3.connect(path, isolation_level=None)) as base:
        tables = [row[0] for row in base.execute("SELECT name FROM sqlite_master WHERE type='table' ORDER BY name")]
        table = pick(rng, [t for t in tables if not t.startswith("sqlite_")])
        columns = [row[1] for row in base.execute(f"PRAGMA table_info({table})")]
        column, kind = pick(rng, columns), pick(rng, ["drop", "rows gone", "blob", "value", "name", "row gone"])
        base.execute("PRAGMA foreign_keys=OFF")
        try:
            if kind == "drop":
                base.execute(f"DROP TABLE {table}")
            elif kind == "rows gone":
                base.execute(f"DELETE FROM {table}")
            elif kind == "row gone":
                base.execute(f"DELETE FROM {table} WHERE rowid = (SELECT min(rowid) FROM {table})")
            elif kind == "name":
                name = pick(rng, ["../../../x.jpg", "/etc/x.jpg", "", "a\x1b[31mb.jpg", "é" * 200 + ".jpg"])
                table, column = "images", "name"
                base.execute("UPDATE images SET name = ? WHERE image_id = 1", (name,))
            else:
                value = rng.bytes(int(rng.integers(40))) if kind == "blob" else pick(rng, structures.NUMBERS)
                base.execute(
                    f"UPDATE {table} SET {column} = ? WHERE rowid = (SELECT min(rowid) FROM {table})", (value,)
                )
        except (sqlite3.Error, OverflowError) as error:
            return f"{kind} of {table}.{column} not possible ({error})"
    return f"{kind} of {table}.{column}"


def image_pixels(path: Path, rng: np.random.Generator) -> str:
    """Another photograph, readable, of the same name."""
    seen = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    kind = pick(rng, list(_PIXELS))
    cv2.imwrite(str(path), _PIXELS[kind](seen, rng))
    return kind


_PIXELS: dict[str, Callable] = {
    "one pixel": lambda seen, rng: seen[:1, :1],
    "one row": lambda seen, rng: seen[:1],
    "half": lambda seen, rng: seen[: len(seen) // 2],
    "turned": lambda seen, rng: np.rot90(seen).copy(),
    "mirrored": lambda seen, rng: seen[:, ::-1].copy(),
    "small": lambda seen, rng: seen[::7, ::7].copy(),
    "black": lambda seen, rng: np.zeros_like(seen),
    "white": lambda seen, rng: np.full_like(seen, 255),
    "noise": lambda seen, rng: rng.integers(0, 256, seen.shape).astype(np.uint8),
    "chequered": lambda seen, rng: (np.indices(seen.shape) // 6).sum(0).astype(np.uint8) % 2 * 255,
    "colour": lambda seen, rng: cv2.cvtColor(seen, cv2.COLOR_GRAY2BGR),
    "negative": lambda seen, rng: 255 - seen,
}  # fmt: skip


def image_form(path: Path, rng: np.random.Generator) -> str:
    """The same photograph in another encoding than its name says."""
    seen = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    deep = seen.astype(np.uint16) * 257
    forms = {
        "16 bit": (".png", deep),
        "16 bit, dark": (".png", deep // 4000),
        "float": (".tiff", seen.astype(np.float32)),
        "bitmap": (".bmp", seen),
        "transparent": (".png", cv2.merge([seen] * 4)),
    }
    kind = pick(rng, [*forms, "many pixels stated"])
    suffix, pixels = forms.get(kind, (".png", seen))
    data = bytearray(cv2.imencode(suffix, pixels)[1].tobytes())
    if kind == "many pixels stated":
        side = pick(rng, [30_000, 65_535, 2**31 - 1])
        data[16:24] = struct.pack(">II", side, side)
        data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    path.write_bytes(data)
    return kind


def image_name(path: Path, rng: np.random.Generator) -> str:
    name = pick(rng, ["x" * 240, "a\nb", "\x1b[31m", "<b>&", "a,b", "..x", "\udcff", "é ß", "%s", "'", ".hidden"])
    path.rename(path.with_name(name + path.suffix))
    return f"named {name[:20]!r}"


JSON = (json_value,) * 6 + (json_key_twice,)
TABLES = (csv_cells,) * 5 + (csv_form,)
TOML = (toml_value,) * 6
BY_SUFFIX: dict[str, tuple[Mutation, ...]] = {
    ".json": (*JSON, *TEXT),
    ".toml": (*TOML, text_number, text_line, *TEXT),
    ".csv": (*TABLES, text_line, *TEXT),
    ".txt": (text_number, text_number, text_number, text_line, *TEXT),
    ".yaml": (text_number, text_number, text_line, yaml_form, yaml_form, *TEXT),
    ".xml": (text_number, text_number, text_line, xml_form, *TEXT),
    ".bin": (binary_number,) * 4,
    ".mat": (binary_number,) * 4,
    ".cameramodel": (text_number, text_number, text_line, *TEXT),
    ".db": (database_row,) * 4,
    ".jpg": (image_pixels, image_form, image_name),
    ".png": (image_pixels, image_form, image_name),
}
"""Beside :data:`BYTES`, :data:`PLACE` and :data:`REFUSED`, which any file can suffer."""


def mutations_of(path: Path) -> tuple[Mutation, ...]:
    """What can be done to a file, as often as it is to be done."""
    return (*BY_SUFFIX.get(path.suffix, ()) * 2, *BYTES, *PLACE, *REFUSED)
