"""Tables of rates: measured in a process that is pinned to a core before JAX is read, and as Markdown."""

from typing import Any

from benchmarks.env_speed import cpu_name, pin_to_one_core


def measure_table(name: str) -> dict[str, Any]:
    """Return the rows of a table, and where they were measured."""
    where = pin_to_one_core()
    import jax
    from tqdm import tqdm

    from benchmarks.scaling.rates import TABLES

    title, rows = TABLES[name]
    device = cpu_name() if jax.default_backend() == "cpu" else jax.devices()[0].device_kind
    return {"title": title, "rows": list(tqdm(rows(), unit=name)), "device": f"{device}; {where}"}


def table(result: dict[str, Any]) -> str:
    """Return a table of rates."""
    lines = [f"| {result['title']} | million steps per second | start (s) |", "|---|---|---|"]
    lines += [f"| {_text(what)} | {rate:.3g} | {start:.1f} |" for what, rate, start in result["rows"]]
    return "\n".join(lines) + "\n"


def _text(what: Any) -> str:
    return f"{what:,}" if isinstance(what, int) else str(what)
