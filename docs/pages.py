"""Write the documentation's pages that the code determines: ``python -m docs.pages``.

A page per environment id, effect and shipped track, the overview of effects, and the API reference's
lists of names. A test holds that the committed pages are what this writes.
"""

import argparse
from pathlib import Path

from docs.api_pages import api_pages
from docs.effect_pages import effect_page, effects_page
from docs.env_pages import env_page
from docs.track_pages import track_page
from flytrack_env.effects import EFFECTS
from flytrack_env.files import write_atomically
from flytrack_env.registration import ENVIRONMENTS
from flytrack_env.tracks import available_tracks

DOCS = Path(__file__).parent


def pages() -> dict[Path, str]:
    """Return every generated page by its path."""
    return {
        **{DOCS / "envs" / f"{env_id}.md": env_page(env_id) for env_id in ENVIRONMENTS},
        DOCS / "effects.md": effects_page(),
        **{DOCS / "effects" / f"{effect.name}.md": effect_page(effect) for effect in EFFECTS},
        **{DOCS / "tracks" / f"{name}.md": track_page(name) for name in available_tracks()},
        **{DOCS / "api" / name: text for name, text in api_pages().items()},
    }


def main() -> None:
    """Write the pages."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    for path, text in pages().items():
        path.parent.mkdir(exist_ok=True)
        write_atomically(path, text.encode())
        print(path)


if __name__ == "__main__":
    main()
