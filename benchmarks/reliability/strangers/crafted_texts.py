"""Text that is made to harm: TOML, JSON and CSV that take time or memory where nothing bounds it."""

import json
from typing import Any

from benchmarks.reliability.strangers.trees import RAW

LONG = 2**17  # characters, of what is long in one way
TINY = 1e-50  # above 0, and 0 as float32
JSON_PARTS = (
    *("[" * LONG, '{"a":' * LONG, "[" * 990 + "]" * 990, '{"a":' * 990 + "1" + "}" * 990),
    *("[" + "{}," * 2**18 + "{}]", "[" + '{"a":1},' * 2**17 + "1]", "[" + "[]," * 2**18 + "[]]"),
    *("{" + '"a":1,' * 2**17 + '"a":2}', "{" + ",".join(f'"{index:x}":0' for index in range(2**16)) + "}"),
    *("9" * 4301, "-" + "9" * LONG, "1e" + "9" * LONG, "0." + "1" * LONG, "NaN", "-Infinity", '"\\ud800"'),
    *('"' + "\\u0000" * LONG + '"', '"' + "x" * 2**20 + '"', '{"' + "\\n" * LONG + '": 1}', "1" + " " * LONG),
)
TOML_LINES = (
    "["
    + ".".join("b" * 1000)
    + "]\n"
    + "\n".join(f"a{n}." + ".".join("a" * 998) + " = 1" for n in range(120)),
    "\n".join(f"a{n}" + ".a" * 90 + " = 1" for n in range(1200)),
    "\n".join(f"[a{n}" + ".a" * 30 + "]" for n in range(3000)),
    "a = " + "[" * LONG,
    "a = " + "{a = " * 2**15,
    "a = [" + "[]," * 2**16 + "]",
    "a = {" + ", ".join(f"a{n} = {{}}" for n in range(15_000)) + "}",
    "[[gates]]\n" * 25_000,
    "[[a]]\n[a.b]\n[[a.b.c]]\n" * 8000,
    "\n".join(f"k{n} = 1" for n in range(20_000)),
    '"' + " " * LONG + '" = 1',
    "'" + "x" * LONG + "' = 1",
    'a = "' + "\\u0000" * 2**15 + '"',
    'a = """' + "\n" * LONG,
    "a = '''" + '"' * LONG,
    "a = 0x" + "f" * LONG,
    "a = 0b" + "1_" * 2**16 + "1",
    "a = " + "1" * LONG,
    "a = 1" + "_1" * 2**16,
    "a = 1." + "1" * LONG,
    "a = 1e" + "9" * LONG,
    "a = 1979-05-27T07:32:00." + "9" * LONG,
    "#" * LONG + "\x00",
    "\ufeffa = 1",
    " " * LONG + "= 1",
    "\t" * LONG,
)


def tomls(contents: list[bytes]) -> list[bytes]:
    """Return TOML that is long or deep in one way, at the end of a file that is well, and alone."""
    lines = [line.encode(errors="surrogatepass") for line in TOML_LINES]
    return [*(contents[0] + b"\n" + line for line in lines), *(line + b"\n" + contents[0] for line in lines)]


def jsons(tree: dict[str, Any], names: tuple[str, ...]) -> list[str]:
    """Return an object of which a value is hard to read; the names are those of the values."""
    parts = (*JSON_PARTS, *RAW.values())
    values = [
        json.dumps({**tree, name: "@here@"}).replace('"@here@"', part) for name in names for part in parts
    ]
    return [*parts, *values]


def models(contents: list[bytes]) -> list[bytes]:
    """Return model files of numbers that are 0 as float32, of what is hard to read, in other encodings."""
    tree = json.loads(contents[-1])
    parameters = tree["parameters"]
    changed = [{**parameters, name: TINY} for name in ("m", "g")]
    changed += [
        {**parameters, name: [TINY, 1.0, 1.0, 1.0][: len(parameters[name])]} for name in ("tau", "max_rate")
    ]
    changed += [{**parameters, "x" * LONG: 1.0}, {**parameters, "m": 10**400}]
    texts = [json.dumps({**tree, "parameters": one}) for one in changed]
    effects = [{"x" * LONG: {}}, {name: {"x" * LONG: 1.0} for name in tree["effects"]}]
    texts += [json.dumps({**tree, "effects": one}) for one in effects]
    texts += jsons(tree, ("version", "parameters", "effects", "provenance"))
    encodings = [contents[0].decode().encode(name) for name in ("utf-16", "utf-32", "utf-8-sig")]
    return [*(text.encode(errors="surrogatepass") for text in texts), *encodings]


def _rows(header: str, cells: dict[str, str], number: int = 3) -> str:
    """Return a CSV file of rows of zeros, but for some columns."""
    names = header.split(",")
    return (
        "\n".join([header, *(",".join(cells.get(name, "0") for name in names) for _ in range(number))]) + "\n"
    )


def tables(contents: list[bytes]) -> list[bytes]:
    """Return CSV files of endless lines and rows, of long cells, and of names without number."""
    text = contents[0].decode()
    header, first = text.split("\n")[:2]
    name, rest = header.split(",")[0], first.split(",", 1)[1]
    odd = (
        "1" * 60_000,
        "0." + "1" * 60_000,
        "1e" + "9" * 60_000,
        "0x10",
        "\u0661",
        "1_0",
        "1" + " " * 60_000,
    )
    found = [
        f"{text}{cell},{rest}\n" for cell in (*odd, "nan" * 20_000, "\x00" * 100, '"1\n"', "-0", "1e-400")
    ]
    found += [text + "," * 2**22, text + '"1\n",' * 2**18, text + "0," * 2**20, text + '"' + "\n" * 2**20]
    found += [",".join([name] * 30_000), header + "".join(f",x{number}" for number in range(9000)) + "\n"]
    found += [text + "\r" * 2**20, text.replace("\n", "\r"), text.replace("\n", "\x0b"), "\x00" * 2**20]
    found += [
        text + (f"{first}\n" * 4000),
        header + "\n" * 2**20,
        _rows(header, {}),
        _rows(header, {name: "9e307"}),
    ]
    encodings = [text.encode(one) for one in ("utf-16", "utf-8-sig")]
    return [*(one.encode() for one in found), *encodings, contents[0] + b"\xff" * 2**16]


def logs_csv(contents: list[bytes]) -> list[bytes]:
    """Return flight logs as ``tables`` does, and of a segment for every row."""
    names = "t,u_roll,u_pitch,u_yaw,u_thrust"
    segments = "".join(f"{number},0,0,0,0,{number}\n" for number in range(100_001))
    steps = "".join(f"{10**number},0,0,0,0\n" for number in range(300))
    return [*tables(contents), f"{names},segment\n{segments}".encode(), f"{names}\n{steps}".encode()]


def imported_csvs(contents: list[bytes]) -> list[bytes]:
    """Return logs of others as ``tables`` does, and of clocks over days and over the range of numbers."""
    lines = contents[0].decode().split("\n")
    rows = [line.split(",", 1)[1] for line in lines[1:-1]]
    found = tables(contents)
    for times in ([0, 10, 20], [0, 1e9, 2e9], [0, 1e300, 2e300], [-1e308, 0, 1e308], [0, 1e-300, 2e-300]):
        more = [times[-1] + 10.0 * (1 + index) for index in range(200)]
        later = (f"{time!r},{rows[index % len(rows)]}" for index, time in enumerate([*times, *more]))
        found.append("\n".join([lines[0], *later, ""]).encode())
    days = (f"{8.64e7 * index},{rows[index % len(rows)]}" for index in range(3000))
    return [*found, "\n".join([lines[0], *days, ""]).encode()]


MANIFESTS = ("../manifest.csv", "/etc/passwd", ".", "..", "file.csv", "\\\\", "a\\u0000b", "/dev/zero")
MAPPED = (
    *(f'[rows.manifest]\nfile = "{name}"\nkey = "file"\ncount = "rows"' for name in MANIFESTS),
    *(
        f"[rows]\n{text}"
        for text in ("first = 9007199254740991", "every = 9007199254740991", "from_s = -1e308")
    ),
    "[craft]\nmass_kg = 1e-50",
    "[craft]\nmax_rate_deg_s = [1e-50, 1e300, 5e-324]",
    "[craft]\nvoltage_v = [1e-50, 1e300]",
)


def mappings(contents: list[bytes]) -> list[bytes]:
    """Return mappings that lead elsewhere, and of numbers and delimiters that are hardly any."""
    short = contents[-1].decode().split("[rows.manifest]")[0]
    found = [f"{short}{part}\n" for part in MAPPED]
    delimiters = ("\\n", "\\r", '\\"', " ", "\\u0000", "\\U0010ffff", "0", ".")
    found += [f'delimiter = "{mark}"\n{short}' for mark in delimiters]
    found += [short.replace("0.01", step) for step in ("1e-320", "1e308", "5e-324", "1e-50")]
    scaled = contents[0].decode()
    found += [scaled.replace("scale = 0.001", f"scale = {scale}") for scale in ("1e-320", "1e308")]
    found += [
        scaled.replace("[1000, 2000, 2000, 1000]", f"[{low}, {low}, {low}, {low}]")
        for low in ("-1.7e308", "1e-320")
    ]
    found += [short.replace('"ail"', f'"{"x" * LONG}"'), short.replace('"ail"', '"\\u001b[31m"')]
    return [*(one.encode() for one in found), *tomls(contents)]


def settings(contents: list[bytes]) -> list[bytes]:
    """Return settings of numbers that are hardly any, and TOML that is hard to read."""
    odd = (
        "total_timesteps = 1e308",
        "learning_rate = 5e-324",
        f"hidden_sizes = [{'1,' * 50_000}]",
        "num_envs = 2e9",
    )
    return [*(one.encode() for one in odd), *tomls(contents)]


def endless(_: list[bytes]) -> list[bytes]:
    """Return texts that are long in one way each."""
    dots, quotes = b"a" + b".a" * 2**16 + b" = 1\n", b'"' + b"x" * 2**20
    return [dots, quotes, b"[" * 2**20, b"0," * 2**19, b"\n" * 2**22]
