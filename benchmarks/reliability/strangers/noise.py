"""Damage that knows nothing of a file's format, and damage to text."""

import csv
import io
import re
from collections.abc import Callable, Sequence

import numpy as np

Rng = np.random.Generator

LARGEST_BYTES = 2**19  # twice that, of what becomes of a file: small ones are enough, and cheap
LONGEST_NOISE = 64
WORDS = [0, 1, 2**7, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1]
# What stands where text has a number, a string, or anything.
TOKENS = (
    *("nan", "inf", "-inf", "1e999", "-1e999", "1e-999", "0", "-0.0", "-1", "1e308", "3.4e38", "1e6", "1 2"),
    *("9007199254740993", "9223372036854775808", "1_000", "0x" + "f" * 5000, "1" * 5000, "0b2", "1e", "."),
    *("true", "null", "None", '""', "''", '"', "'''", '"\\ud800"', '"\\u0000"', "[]", "{}", "[[]]"),
    *("{a = 1}", "[" * 2000, "{" * 2000, '{"a":' * 2000, "a" + ".a" * 3000 + " = 1", "#", ",", "-", "1,5"),
    *('"../../../../etc/passwd"', '"/dev/zero"', '"' + "x" * 50_000 + '"', "\x1b[2J", "\x00", "\n", "\r"),
    *("__import__('os').system('true')", "=1+1", "%s%n", "1;5", "\u0661", "\u202e", "1979-05-27T07:32:00Z"),
)


def _place(rng: Rng, content: bytes | bytearray) -> int:
    return int(rng.integers(len(content) + 1))


def _span(rng: Rng, content: bytes) -> tuple[int, int]:
    """Return a stretch: mostly a short one."""
    start = _place(rng, content)
    longest = len(content) - start if rng.random() < 0.2 else min(len(content) - start, LONGEST_NOISE)
    return start, start + int(rng.integers(longest + 1))


def flip_bits(rng: Rng, content: bytes, others: Sequence[bytes]) -> bytes:
    """Flip one to eight bits."""
    found = bytearray(content)
    for _ in range(int(rng.integers(1, 9)) if found else 0):
        found[int(rng.integers(len(found)))] ^= 1 << int(rng.integers(8))
    return bytes(found)


def change_bytes(rng: Rng, content: bytes, others: Sequence[bytes]) -> bytes:
    """Overwrite a short stretch, by noise or by one byte."""
    start, end = _span(rng, content)
    size = min(end - start, LONGEST_NOISE)
    noise = rng.bytes(size) if rng.random() < 0.5 else bytes([int(rng.choice([0, 255, 127, 128, 10]))]) * size
    return content[:start] + noise + content[start + size :]


def write_word(rng: Rng, content: bytes, others: Sequence[bytes]) -> bytes:
    """Overwrite a few bytes by a number at the edge of what they can hold."""
    size, start = int(rng.choice([1, 2, 4, 8])), _place(rng, content)
    number = WORDS[int(rng.integers(len(WORDS)))] % 2 ** (8 * size)
    word = number.to_bytes(size, "little" if rng.random() < 0.5 else "big")
    return content[:start] + word + content[start + size :]


def cut_off(rng: Rng, content: bytes, others: Sequence[bytes]) -> bytes:
    """Leave out the end, or the beginning."""
    at = _place(rng, content)
    return content[:at] if rng.random() < 0.8 else content[at:]


def cut_out(rng: Rng, content: bytes, others: Sequence[bytes]) -> bytes:
    """Leave out a stretch."""
    start, end = _span(rng, content)
    return content[:start] + content[end:]


def repeat(rng: Rng, content: bytes, others: Sequence[bytes]) -> bytes:
    """Repeat a stretch, once or many times."""
    start, end = _span(rng, content)
    times = int(rng.integers(1, 3)) if rng.random() < 0.7 else int(rng.integers(3, 3000))
    times = min(times, LARGEST_BYTES // max(end - start, 1))
    return content[:end] + content[start:end] * times + content[end:]


def insert_noise(rng: Rng, content: bytes, others: Sequence[bytes]) -> bytes:
    """Insert noise."""
    at = _place(rng, content)
    return content[:at] + rng.bytes(int(rng.integers(1, LONGEST_NOISE))) + content[at:]


def splice(rng: Rng, content: bytes, others: Sequence[bytes]) -> bytes:
    """Go on with another file of the kind."""
    other = others[int(rng.integers(len(others)))]
    return content[: _place(rng, content)] + other[_place(rng, other) :]


def replace_all(rng: Rng, content: bytes, others: Sequence[bytes]) -> bytes:
    """Return nothing, noise, or one byte many times."""
    size = int(rng.integers(0, 5000))
    return [b"", rng.bytes(size), bytes(size), b"[" * size, b"\xff" * size][int(rng.integers(5))]


Damage = Callable[[Rng, bytes, Sequence[bytes]], bytes]
DAMAGES: tuple[Damage, ...] = (
    *(flip_bits, change_bytes, write_word, cut_off, cut_out, repeat, insert_noise, splice),
    *(flip_bits, change_bytes, write_word),
)


def damage(rng: Rng, contents: Sequence[bytes]) -> bytes:
    """Return one of some files, damaged in one to four ways."""
    content = contents[int(rng.integers(len(contents)))]
    if rng.random() < 0.01:
        return replace_all(rng, content, contents)
    for _ in range(int(rng.integers(1, 5))):
        content = DAMAGES[int(rng.integers(len(DAMAGES)))](rng, content, contents)
    return content[: 2 * LARGEST_BYTES]


TEXT_PARTS = re.compile(rb'"[^"\n]*"|[-+]?[0-9][-+0-9.eE]*|[A-Za-z_]+|[\[\]{}(),:=]')


def damage_text(rng: Rng, contents: Sequence[bytes]) -> bytes:
    """Return one of some texts with some of its words, numbers, strings or lines replaced."""
    content = contents[int(rng.integers(len(contents)))]
    for _ in range(int(rng.integers(1, 4))):
        if rng.random() < 0.25:
            content = _move_lines(rng, content)
            continue
        parts = list(TEXT_PARTS.finditer(content))
        if parts:
            start, end = parts[int(rng.integers(len(parts)))].span()
            token = TOKENS[int(rng.integers(len(TOKENS)))].encode(errors="surrogatepass")
            content = content[:start] + token + content[end:]
    if rng.random() < 0.05:
        mark = [b"\xff", b"\xef\xbb\xbf", b"\x00", b"\xc3\x28", b"\xed\xa0\x80"][int(rng.integers(5))]
        at = _place(rng, content) if rng.random() < 0.5 else 0
        content = content[:at] + mark + content[at:]
    return content[: 2 * LARGEST_BYTES]


def _move_lines(rng: Rng, content: bytes) -> bytes:
    """Return lines of which one is left out, twice there, or elsewhere."""
    lines = content.split(b"\n")
    start, end = sorted(int(at) for at in rng.integers(len(lines), size=2))
    way = int(rng.integers(4))
    if way == 0:
        return b"\n".join(lines[:start] + lines[start + 1 :])
    if way == 1:
        return b"\n".join(lines[: start + 1] + lines[start:])
    if way == 2:
        lines[start], lines[end] = lines[end], lines[start]
        return b"\n".join(lines)
    block = lines[start : end + 1]
    size = sum(map(len, block)) + len(block)
    times = min(int(rng.integers(2, 200)), LARGEST_BYTES // size)
    return b"\n".join(lines[:start] + block * times + lines[end + 1 :])


def damage_cells(rng: Rng, contents: Sequence[bytes]) -> bytes:
    """Change whole cells and columns of a CSV file."""
    rows = list(csv.reader(io.StringIO(contents[int(rng.integers(len(contents)))].decode())))
    for _ in range(int(rng.integers(1, 4))):
        row = rows[int(rng.integers(len(rows)))]
        if not row:
            continue
        at, way = int(rng.integers(len(row))), rng.random()
        if way < 0.6:
            odd = (
                "nan",
                "inf",
                "",
                " ",
                "1e308",
                "-5",
                "x",
                "1e-400",
                "1" * 400,
                '"',
                "0x10",
                "1_0",
                "7" * 9,
            )
            row[at] = str(odd[int(rng.integers(len(odd)))])
        elif way < 0.7:
            del row[at]
        elif way < 0.8:
            row.insert(at, row[at])
        else:
            for other in rows:
                other[at:at] = other[at : at + 1]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()
