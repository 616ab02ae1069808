"""The mutation library: from a good file to one that is damaged, hostile or odd; the same seed, the same mutant."""

from __future__ import annotations

import copy
import json
import random
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import yaml

HOSTILE_WORDS = (
    b"null", b"~", b"true", b"yes", b".nan", b".inf", b"-.inf", b"-1", b"0", b"0x_", b"0b_", b"0o8", b"1e400", b"1e300",
    b"9" * 20, b"9" * 5000, b"-" + b"9" * 4301, b"190:20:30", b"2024-13-45", b"2024-01-01", b"!!timestamp x",
    b"!!float x", b"!!python/object:os.system x", b"!!binary =", b"!!set {a, b}", b"!x y", b"&a [*a]", b"*a",
    b"<<: {a: 1}", b"? [a]",
    b"[" * 2000, b"{a: " * 500, b"- " * 900, b'"\\e[31m"', b'"\\0"', b'"a\\nb"', b"'" , b'"', b"%YAML 9.9\n---", b"---",
    b"...", b"|", b">", b"@", b"`", b"\t", b"\r", b"\x00", b"\x1b[2J", b"\xff\xfe", b"\xef\xbb\xbf", b"\xe2\x80\xae",
    b"\xed\xa0\x80", b"../../etc/passwd", b"/dev/zero", b"a:b:c", b":::", b"[/]", b"$HOME", b"{}", b"[]",
    b"[[]]", b"a" * 3000,
)  # fmt: skip
"""Pieces that readers stumble over, put in anywhere."""
HOSTILE_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2**31, 2**63, 10**18, 10**30, -(10**18), 0.5, 1e300, -1e300, 1e-320, float("inf"),
    float("nan"), "", "x", "x" * 5000, "1e400", "\x1b[31m", "a\nb", "é", "\u202e", [], [None], [[1]], {},
    {"a": {"b": {}}},
    list(range(600)), "os:system", ":::", "../x", "auto", "module:Name", "9" * 400, "1_000", "0x10", " 7 ",
)  # fmt: skip
"""Values that a key may be given."""


def mutant(good: bytes, seed: int) -> bytes:
    """A mutant of a good YAML file: one to three changes, of its bytes or of its content."""
    rng = random.Random(seed)
    content = good
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        content = rng.choice(_CHANGES)(content, rng)
    return content


def text_mutant(good: str, seed: int) -> str:
    """A mutant of a short text, such as a task id."""
    rng = random.Random(seed)
    letters = list(good)
    for _ in range(rng.choice((1, 1, 2, 3, 5))):
        place = rng.randrange(len(letters) + 1)
        change = rng.randrange(4)
        if change == 0:
            letters.insert(place, rng.choice(":::///...---__~ \t\n\0é\u202e\U0001f600%$*?\\\"',#+0v"))
        elif change == 1 and letters:
            del letters[place - 1]
        elif change == 2:
            letters[place:place] = letters[rng.randrange(len(letters) + 1) :] * rng.choice((1, 1, 30))
        elif letters:
            other = rng.randrange(len(letters))
            letters[place - 1], letters[other] = letters[other], letters[place - 1]
    return "".join(letters)


def json_mutant(good: bytes, seed: int) -> bytes:
    """A mutant of a good JSON file: of its content, or one time in four of its bytes."""
    rng = random.Random(seed)
    if rng.random() < 0.25:
        return rng.choice((_flip, _delete, _repeat, _truncate, _insert, _encode))(good, rng)
    data = json.loads(good)
    for _ in range(rng.choice((1, 1, 2))):
        _change_node(data, rng)
    return json.dumps(data).encode()


def binary_mutant(good: bytes, seed: int) -> bytes:
    """A mutant of a good binary file: one to three changes of its bytes."""
    rng = random.Random(seed)
    content = good
    for _ in range(rng.choice((1, 1, 2, 3))):
        content = rng.choice((_flip, _flip, _delete, _repeat, _truncate, _insert, _poke, _poke))(content, rng)
    return content


def change_value(content: bytes, rng: random.Random) -> bytes:
    """Another value between two commas or colons of a line."""
    lines = content.split(b"\n")
    index = rng.randrange(len(lines))
    parts = re.split(rb"([,:])", lines[index])
    parts[rng.randrange((len(parts) + 1) // 2) * 2] = rng.choice((*HOSTILE_WORDS, b"-1", b"nan", b"inf", b"1e308", b""))
    lines[index] = b"".join(parts)
    return b"\n".join(lines)


def array_mutant(good: np.ndarray[Any, Any], rng: random.Random) -> np.ndarray[Any, Any] | None:
    """Another shape, type or value of an array; None leaves it out."""
    change = rng.randrange(7)
    if change == 0:
        return None
    if change == 1:
        return good.reshape(-1)
    if change == 2:
        return good[None]
    if change == 3:
        return np.repeat(np.atleast_1d(good), rng.choice((0, 2)), axis=0)
    if change == 4:
        with np.errstate(all="ignore"):
            return good.astype(rng.choice(("u1", "i1", "i8", "f2", "f4", "f8", "?", "S3", "U2")))
    changed = np.atleast_1d(good).copy()
    extreme = (-1, 0, 1, 2**31, -(2**62), 2**62) if good.dtype.kind in "iub" else (np.nan, np.inf, -1e38, 1e38, -0.5)
    with np.errstate(all="ignore"):
        value = np.asarray(rng.choice(extreme)).astype(good.dtype)
    changed.reshape(-1)[rng.randrange(max(changed.size, 1)) if change == 5 and changed.size else slice(None)] = value
    return changed.reshape(good.shape)


def _poke(content: bytes, rng: random.Random) -> bytes:
    """Write a number over the content: at its start, where sizes are, or at a place where a weight may be."""
    number = rng.choice(
        (
            struct.pack("<Q", rng.choice((0, 1, 2**31, 2**40, 2**63))),
            struct.pack("<f", rng.choice((float("nan"), float("inf")))),
        )
    )
    place = 0 if rng.random() < 0.3 else rng.randrange(len(content) + 1) // 4 * 4
    return content[:place] + number + content[place + len(number) :]


def _flip(content: bytes, rng: random.Random) -> bytes:
    if not content:
        return b"\x80"
    place = rng.randrange(len(content))
    return content[:place] + bytes([content[place] ^ 1 << rng.randrange(8)]) + content[place + 1 :]


def _delete(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(content) + 1)
    return content[:start] + content[start + rng.choice((1, 1, 5, 50)) :]


def _repeat(content: bytes, rng: random.Random) -> bytes:
    start, place = rng.randrange(len(content) + 1), rng.randrange(len(content) + 1)
    piece = content[start : start + rng.choice((1, 10, 100))] * rng.choice((1, 1, 2, 300))
    return content[:place] + piece + content[place:]


def _truncate(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def _insert(content: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(content) + 1)
    return content[:place] + rng.choice(HOSTILE_WORDS) + content[place:]


def _replace_value(content: bytes, rng: random.Random) -> bytes:
    """Replace the text after a colon of a line."""
    lines = content.split(b"\n")
    index = rng.randrange(len(lines))
    key, colon, _ = lines[index].partition(b":")
    lines[index] = key + colon + b" " + rng.choice(HOSTILE_WORDS)
    return b"\n".join(lines)


def _repeat_line(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    lines.insert(rng.randrange(len(lines) + 1), rng.choice(lines))
    return b"\n".join(lines)


def _encode(content: bytes, rng: random.Random) -> bytes:
    text = content.decode("utf-8", "replace")
    return text.encode(rng.choice(("utf-16", "utf-16-le", "utf-32", "latin-1", "utf-8-sig", "utf-7")), "replace")


def _change_content(content: bytes, rng: random.Random) -> bytes:
    """Give a key of the file another value, whatever is there."""
    try:
        data = yaml.safe_load(content)
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, KeyError, RecursionError):
        return _flip(content, rng)
    if not _change_node(data, rng):
        return _insert(content, rng)
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=rng.random() < 0.5).encode("utf-8", "replace")


def _change_node(data: Any, rng: random.Random) -> bool:
    """Change one value or one key somewhere in lists and mappings; False if there is none."""
    node, parents = data, []
    while isinstance(node, (dict, list)) and node and (not parents or rng.random() < 0.8):
        key = rng.choice(list(node)) if isinstance(node, dict) else rng.randrange(len(node))
        parents.append((node, key))
        node = node[key]
    if not parents:
        return False
    parent, key = parents[-1]
    if rng.random() < 0.15 and isinstance(parent, dict):
        parent[rng.choice(("unknown", 1, None, "\x1b[31m", "x" * 300, 1.5, True))] = parent.pop(key)
    else:
        parent[key] = copy.deepcopy(rng.choice(HOSTILE_VALUES))  # the next change must not change the table
    return True


_CHANGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flip, _delete, _repeat, _truncate, _insert, _replace_value, _replace_value, _repeat_line, _encode,
    _change_content, _change_content, _change_content, _change_content, _change_content,
)  # fmt: skip
TEXT_CHANGES = (_flip, _delete, _repeat, _truncate, _insert, _repeat_line, _encode)
"""Changes of any text."""
