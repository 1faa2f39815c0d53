"""Damage to what JSON and TOML hold: values of other kinds and sizes, names missing, new or twice."""

import copy
import json
import math
from typing import Any

from benchmarks.reliability.strangers.noise import Rng

# Text that takes the place of a marked value: what no Python value can be written as.
RAW = {
    "@deep lists@": "[" * 100_000,
    "@closed lists@": "[" * 400 + "]" * 400,
    "@deeper lists@": "[" * 950 + "]" * 950,
    "@deep tables@": '{"a":' * 400 + "1" + "}" * 400,
    "@digits@": "7" * 4200,
    "@endless digits@": "7" * 50_000,
    "@beyond@": "1e999",
    "@lone half@": '"\\ud800"',
}
ODD: tuple[Any, ...] = (
    *(0, -1, 1, 2, 3, 1.5, -0.0, 1e-320, 1e-9, 0.999, 1e6, 1e9, 3.5e38, 1e308, -1e308, math.nan, math.inf),
    *(-math.inf, 2**31, 2**53, 2**63, 2**64, 10**30, -(10**400), 10**400, True, False, None, "", "0", "nan"),
    *("flytrack", "../../../../tmp/evil", "/etc/passwd", "a\x00b", "\x1b[2J", "\u202e", "x" * 300),
    *("x" * 100_000, [], {}, [[]], [0.0], [0.0] * 3, [1.0, 0.0, 0.0, 0.0], [math.nan] * 4, ["a"] * 4),
    *([0] * 20_000, {"a": 1}, {"": None}, {"x" * 2000: 1}, [None], [True] * 4, {"a": [{"b": []}]}, *RAW),
)


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Return every place in a tree: what holds it, and its name or number there."""
    found, open_parts = [], [tree]
    while open_parts:
        part = open_parts.pop()
        items = part.items() if isinstance(part, dict) else enumerate(part)
        for name, value in list(items):
            found.append((part, name))
            if isinstance(value, (dict, list)):
                open_parts.append(value)
    return found


def odd_value(rng: Rng, value: Any) -> Any:
    """Return something in place of a value: odd, or near to it."""
    if isinstance(value, float) and rng.random() < 0.4:
        factor = float(rng.choice([-1.0, 0.0, 0.5, 2.0, 1000.0, 1e30]))
        return value * factor if rng.random() < 0.7 else str(value)
    if type(value) is int and rng.random() < 0.4:
        return [value + 1, value - 1, -value, 2 * value, float(max(min(value, 10**6), -1)), 1000 * value][
            int(rng.integers(6))
        ]
    if isinstance(value, list) and rng.random() < 0.5:
        return [value[:-1], value + value, value[:1] * 3, [value], list(reversed(value))][
            int(rng.integers(5))
        ]
    if isinstance(value, str) and rng.random() < 0.3:
        return value[:-1] if rng.random() < 0.5 else value + "x"
    return _odd(rng)


def _odd(rng: Rng) -> Any:
    return copy.deepcopy(ODD[int(rng.integers(len(ODD)))])  # what is put into a tree may be damaged next


def damage_tree(rng: Rng, tree: Any) -> Any:
    """Return a copy of a tree of which one to three places are damaged."""
    tree = json.loads(json.dumps(tree))
    for _ in range(int(rng.integers(1, 4))):
        places = _places(tree)
        if not places:
            return _odd(rng)
        holder, name = places[int(rng.integers(len(places)))]
        way = rng.random()
        if way < 0.7:
            holder[name] = odd_value(rng, holder[name])
        elif way < 0.85:
            del holder[name]
        elif isinstance(holder, dict):
            key = ["x", "../x", "", name.upper(), "x" * 5000, "a\nb", "version"][int(rng.integers(7))]
            holder[key] = copy.deepcopy(holder[name]) if rng.random() < 0.5 else holder.pop(name)
        else:
            holder.insert(name, copy.deepcopy(holder[name]))
    if rng.random() < 0.02:
        return _odd(rng)
    return tree


def _with_raw(text: str) -> bytes:
    for mark, raw in RAW.items():
        text = text.replace(f'"{mark}"', raw)
    return text.encode(errors="surrogatepass")


def as_json(rng: Rng, tree: Any) -> bytes:
    """Return a tree as JSON, now and then with a name that is there twice."""
    text = json.dumps(tree, indent=1)
    if rng.random() < 0.05:
        lines = text.split("\n")
        at = int(rng.integers(len(lines)))
        text = "\n".join([*lines[: at + 1], *lines[at:]])
    return _with_raw(text)


def as_toml(tree: Any) -> bytes:
    """Return a tree as TOML: a line for every name at the top, whose value stands on that line."""
    if not isinstance(tree, dict):
        return _with_raw(_toml_value(tree))
    return _with_raw(
        "".join(f"{_toml_value(str(name))} = {_toml_value(one)}\n" for name, one in tree.items())
    )


def _toml_value(value: Any) -> str:
    if isinstance(value, dict):
        inner = ", ".join(f"{_toml_value(str(name))} = {_toml_value(one)}" for name, one in value.items())
        return f"{{{inner}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml_value, value))}]"
    if isinstance(value, float):
        return repr(value)
    if value is None:
        return "null"
    return json.dumps(value)
