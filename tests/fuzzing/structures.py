"""Changes of what files hold once they are parsed: trees of JSON and TOML, rows of cells, numbers in text."""

import json
import re
from collections.abc import Callable

import numpy as np

NUMBERS = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-308, 0.0, -1.0, 1e9, 2**63, 10**30, 0.5, True)
WORDS = ("NaN", "1e999", "-1", "1e308", "null", "[]", '"x"', "9" * 5000, "[" * 100_000, "0x10", "1_000", "+1", "1,5")
LONG = "x" * 100_000
TEXTS = (
    *("", "text", "\x1b[31mred\x07", "a\nb", "\u202eabc", "é", LONG, "../../etc", "1,5", "nan", "٣"),
    *("\x00", "{{7*7}}"),
)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
KEYS = ("x", "", "a.b", "a b", "\x1b[1m", "é" * 300)
YAML = {
    "an alias bomb": "a: &a [x,x,x,x,x,x,x,x,x]\n"
    + "".join(f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True))
    + "distortion_model: *i\n",
    "deep": "a: " + "[" * 50_000,
    "deep maps": "{a: " * 5000,
    "a tag": "camera_matrix: !!python/object/apply:os.system ['true']\n",
    "two documents": "---\na: 1\n---\nb: 2\n",
    "a list": "- 1\n- 2\n",
    "a merge": "x: &x {a: 1}\ny: {<<: *x, <<: *x}\n",
    "itself": "camera_matrix: &a [*a]\n",
    "a long number": "image_width: " + "9" * 5000 + "\n",
    "a date": "image_width: 2020-01-01\n",
    "a list as key": "? [1, 2]\n: 3\n",
}
_ENTITIES = "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True))
XML = {
    "a bomb": f'<!DOCTYPE x [<!ENTITY a "x">{_ENTITIES}]><x>&i;</x>',
    "a file": '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><opencv_storage>&a;</opencv_storage>',
    "deep": "<a>" * 100_000,
    "empty": "<opencv_storage/>",
    "long": f"<opencv_storage><image_width>{'9' * 5000}</image_width></opencv_storage>",
    "other": "<svg xmlns='http://www.w3.org/2000/svg'/>",
}


def pick(rng: np.random.Generator, values):
    """One of them; not an array's copy of it."""
    return values[int(rng.integers(len(values)))]


class Raw(str):
    """Stands in the file as it is."""


def places(tree, above: tuple = ()) -> list[tuple]:
    """Paths of all values below the root, at most some thousand."""
    found = []
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        found.append((*above, key))
        if len(above) < 6:
            found += places(value, (*above, key))
    return found


def changed(tree, rng: np.random.Generator):
    """One change of a tree of dicts, lists and values; (tree, what was done)."""
    found = places(tree)
    if not found:
        return [], "a list"
    depth = int(rng.integers(1, 1 + max(len(p) for p in found)))  # values far down are many: each depth as often
    path = pick(rng, [p for p in found if len(p) == depth])
    holder = tree
    for key in path[:-1]:
        holder = holder[key]
    key, change = path[-1], pick(rng, CHANGES)
    said = change(holder, key, rng)
    return tree, f"{'.'.join(map(str, path))}: {said}"


def _put(values):
    def change(holder, key, rng) -> str:
        holder[key] = pick(rng, values)
        return repr(holder[key])[:40]

    return change


def _gone(holder, key, rng) -> str:
    del holder[key]
    return "gone"


def _kind(holder, key, rng) -> str:
    holder[key] = pick(rng, [None, [], {}, [[]], {"x": 1}, [None], [1, "a"], True, holder[key], [holder[key]]])
    return repr(holder[key])[:40]


def _sibling(holder, key, rng) -> str:
    other = pick(rng, list(holder) if isinstance(holder, dict) else range(len(holder)))
    holder[key], holder[other] = holder[other], holder[key]
    return f"exchanged with {other}"


def _more(holder, key, rng) -> str:
    if isinstance(holder, list):
        holder.insert(int(rng.integers(len(holder) + 1)), holder[key])
        return "twice"
    other = pick(rng, KEYS)
    holder[other] = holder.pop(key) if rng.random() < 0.5 else holder[key]
    return f"as {other[:10]!r}"


def _scaled(holder, key, rng) -> str:
    factor = pick(rng, [1e-3, 1e3, -1, 0, 1e300, 25.4])
    holder[key] = _times(holder[key], factor)
    return f"times {factor:g}"


def _times(value, factor):
    if isinstance(value, dict):
        return {key: _times(each, factor) for key, each in value.items()}
    if isinstance(value, list):
        return [_times(each, factor) for each in value]
    return value * factor if isinstance(value, int | float) and not isinstance(value, bool) else value


_number = _put(NUMBERS)
CHANGES = (
    *(_gone, _number, _number, _put(TEXTS), _put([Raw(word) for word in WORDS])),
    *(_kind, _sibling, _more, _scaled),
)


def text_of(value, between: str = ": ") -> str:
    """JSON with what JSON has not, as Python writes it; or inline TOML, " = " ``between`` a key and its value."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)}{between}{text_of(v, between)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(text_of(each, between) for each in value) + "]"
    if between != ": " and isinstance(value, float | None):
        return '""' if value is None else repr(value)
    return str(value) if isinstance(value, Raw) else json.dumps(value, ensure_ascii=False)


def toml_of(tree) -> str:
    """Keys with inline values."""
    items = tree.items() if isinstance(tree, dict) else [("x", tree)]
    return "".join(f"{json.dumps(key)} = {text_of(value, ' = ')}\n" for key, value in items)


def number_replaced(text: str, rng: np.random.Generator) -> tuple[str, str]:
    """One number of a text by another, or by what is none."""
    found = list(NUMBER.finditer(text))
    if not found:
        return text + "1", "a number more"
    place = pick(rng, found)
    number = str(pick(rng, NUMBERS)) if rng.random() < 0.7 else pick(rng, [*WORDS, *TEXTS])
    return text[: place.start()] + number + text[place.end() :], f"{place[0]} → {number[:20]!r}"


Rows = list[list[str]]


def _cell(rows: Rows, rng) -> str:
    i = int(rng.integers(1, len(rows))) if len(rows) > 1 else 0
    j = int(rng.integers(len(rows[i])))
    cell = str(pick(rng, NUMBERS)) if rng.random() < 0.6 else pick(rng, [*WORDS, *TEXTS, '"', " "])
    rows[i][j] = cell
    return f"line {i + 1}, {rows[0][j] if j < len(rows[0]) else j}: {cell[:20]!r}"


def _column(rows: Rows, rng) -> str:
    j = int(rng.integers(len(rows[0])))
    name, value = rows[0][j], str(pick(rng, NUMBERS))
    for row in rows[1:]:
        row[j : j + 1] = [value]
    return f"all {name}: {value}"


def _column_gone(rows: Rows, rng) -> str:
    j = int(rng.integers(len(rows[0])))
    name = rows[0][j]
    for row in rows:
        del row[j : j + 1]
    return f"{name} gone"


def _columns_exchanged(rows: Rows, rng) -> str:
    i, j = rng.integers(len(rows[0]), size=2).tolist()
    rows[0][i], rows[0][j] = rows[0][j], rows[0][i]
    return f"{rows[0][j]} for {rows[0][i]}"


def _column_named(rows: Rows, rng) -> str:
    j, name = int(rng.integers(len(rows[0]))), pick(rng, [*KEYS, "x_mm", "q1_rad", *TEXTS])
    old, rows[0][j] = rows[0][j], name
    return f"{old} as {name[:20]!r}"


def _column_twice(rows: Rows, rng) -> str:
    j = int(rng.integers(len(rows[0])))
    for row in rows:
        row.insert(j, row[j] if j < len(row) else "")
    return f"{rows[0][j]} twice"


def _row_gone(rows: Rows, rng) -> str:
    count = int(rng.integers(1, len(rows))) if len(rows) > 1 else 0
    for _ in range(count):
        del rows[int(rng.integers(1, len(rows)))]
    return f"{count} rows gone"


def _row_twice(rows: Rows, rng) -> str:
    i = int(rng.integers(len(rows)))
    rows[i:i] = [list(rows[i])] * int(pick(rng, [1, 3, 200]))
    return f"line {i + 1} again"


def _cells_more(rows: Rows, rng) -> str:
    i = int(rng.integers(len(rows)))
    rows[i] = rows[i][:-1] if rng.random() < 0.5 else [*rows[i], "1"]
    return f"line {i + 1}: {len(rows[i])} cells"


TABLE: tuple[Callable[[Rows, np.random.Generator], str], ...] = (
    *(_cell, _cell, _cell, _column, _column_gone, _columns_exchanged, _column_named, _column_twice),
    *(_row_gone, _row_twice, _cells_more),
)
