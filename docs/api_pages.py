"""The API reference, ``docs/api/``: which public names there are, and a page for each group of modules.

The pages hold a heading and a mkdocstrings directive per name; ``make docs`` fills in the docstrings.
"""

import importlib
import inspect
import re
from typing import Any, NamedTuple

from docs.markdown import page, paragraph, table


class Group(NamedTuple):
    """One page: its title, and the modules whose public names it holds, in order."""

    title: str
    modules: tuple[str, ...]


# A name that several modules export is documented where it comes first.
GROUPS = {
    "flytrack_env": Group("The environment", ("flytrack_env",)),
    "wrappers": Group("Wrappers", ("flytrack_env.wrappers",)),
    "tracks": Group("Tracks", ("flytrack_env.tracks",)),
    "effects": Group("Effects", ("flytrack_env.effects",)),
    "dynamics": Group(
        "Physics and state", ("flytrack_env.dynamics", "flytrack_env.state", "flytrack_env.quaternion")
    ),
    "plants": Group(
        "Plants and black boxes", ("flytrack_env.plants", "flytrack_env.blackbox", "flytrack_env.apart")
    ),
    "parts": Group(
        "Parts of an episode",
        (
            "flytrack_env.episodes",
            "flytrack_env.resets",
            "flytrack_env.observations",
            "flytrack_env.rewards",
            "flytrack_env.terminations",
        ),
    ),
    "flights": Group(
        "Recorded flights", ("flytrack_env.rollout", "flytrack_env.flown_race", "flytrack_env.references")
    ),
    "viewing": Group(
        "Pictures and recordings",
        ("flytrack_env.pictures", "flytrack_env.viz_rerun", "flytrack_env.rendering"),
    ),
    "gymnasium": Group("Gymnasium", ("flytrack_env.gymnasium_adapter",)),
    "sysid": Group("Identification", ("flytrack_sysid", "flytrack_sysid.importing")),
    "diagnosis": Group(
        "Diagnosis",
        ("flytrack_sysid.diagnosis", "flytrack_sysid.diagnosis.plan", "flytrack_sysid.flight_recording"),
    ),
    "baseline": Group(
        "The PPO baseline",
        (
            "baselines.purejaxrl_ppo",
            "baselines.purejaxrl_ppo.evaluate",
            "baselines.purejaxrl_ppo.flights",
            "baselines.purejaxrl_ppo.training",
            "baselines.purejaxrl_ppo.flown_env",
        ),
    ),
    "loop": Group("The loop", ("flytrack_loop", "flytrack_loop.report")),
}
# Of modules without a list of their own (``__all__``), where not all that has no underscore is for users.
ONLY = {"flytrack_sysid.diagnosis.plan": ("advise",), "flytrack_env.apart": ("ResourceLimits",)}


def public_names(module_name: str) -> tuple[str, ...]:
    """Return a module's public names: its ``__all__``, else the functions and classes that it defines."""
    module = importlib.import_module(module_name)
    if module_name in ONLY:
        return ONLY[module_name]
    if hasattr(module, "__all__"):
        return tuple(module.__all__)
    return tuple(
        name
        for name, found in vars(module).items()
        if not name.startswith("_")
        and (inspect.isfunction(found) or inspect.isclass(found))
        and found.__module__ == module_name
    )


def documented_names() -> dict[str, str]:
    """Return the page of every public name, "module.name": that on which its docstring stands."""
    return {
        f"{module}.{name}": stem
        for stem, group in GROUPS.items()
        for module in group.modules
        for name in public_names(module)
    }


def summary(module_name: str) -> str:
    """Return the first paragraph of a module's docstring."""
    text = (importlib.import_module(module_name).__doc__ or "").split("\n\n")[0]
    return re.sub(r"\s+", " ", text).strip().replace("``", "`")


def identity(found: Any) -> int | None:
    """Return what tells objects apart that have a docstring of their own; None for plain values."""
    return id(found) if inspect.isfunction(found) or inspect.isclass(found) else None


def slug(heading: str) -> str:
    """Return the anchor of a heading, the same on the site and where Markdown is browsed."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def module_section(
    module_name: str, stem: str, seen: dict[int, tuple[str, str]], taken: set[str]
) -> list[str]:
    """Return the headings and directives of a module's names; what was seen before is only pointed at.

    seen: object -> its page and anchor. taken: headings of this page. Both are added to.
    """
    module = importlib.import_module(module_name)
    lines = [f"## {module_name}", "", *paragraph(summary(module_name)), *paragraph(f"`import {module_name}`")]
    repeated = []
    for name in public_names(module_name):
        key = identity(getattr(module, name))
        if key is not None and key in seen:
            there, anchor = seen[key]
            target = f"#{anchor}" if there == stem else f"{there}.md#{anchor}"
            repeated.append(f"[`{name}`]({target})")
            continue
        kind = "class" if inspect.isclass(getattr(module, name)) else "function"
        heading = f"{name} ({kind})" if name.lower() in taken else name
        taken.add(name.lower())
        if key is not None:
            seen[key] = (stem, slug(heading))
        lines += [f"### {heading}", "", f"::: {module_name}.{name}", ""]
    if repeated:
        lines += paragraph(f"Exported here, too: {', '.join(repeated)}.")
    return lines


def index_page() -> str:
    """Return the list of the reference's pages."""
    rows = [
        (f"[{group.title}]({stem}.md)", ", ".join(f"`{module}`" for module in group.modules))
        for stem, group in GROUPS.items()
    ]
    return page(
        "# API reference",
        "",
        *paragraph(
            "Every public name, from its docstring: shapes, units, frames, what is raised. What is not here",
            "may change without notice. The pages are filled in by `make docs`; read without it, they list",
            "the names, and the docstrings are in the modules.",
        ),
        *table(("page", "modules"), rows),
    )


def api_pages() -> dict[str, str]:
    """Return the pages of the reference by their file names."""
    seen: dict[int, tuple[str, str]] = {}
    written = {"index.md": index_page()}
    for stem, group in GROUPS.items():
        taken: set[str] = set()
        sections = [line for module in group.modules for line in module_section(module, stem, seen, taken)]
        written[f"{stem}.md"] = page(f"# {group.title}", "", *sections)
    return written
