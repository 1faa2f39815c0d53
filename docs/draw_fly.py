"""Draw what a pilot sees, docs/fly.png: ``python -m docs.draw_fly``; the champion is the pilot."""

import io
from pathlib import Path

from PIL import Image

from flytrack_env import load_track
from flytrack_env.files import write_atomically
from flytrack_env.rendering import make_renderer
from flytrack_fly.ghost import fly_champion, make_ghost
from flytrack_fly.session import Session

STEP = 640  # of the flight, on its second lap

if __name__ == "__main__":
    track = load_track("flytrack")
    _, commands, model = fly_champion(track, None)
    session = Session(track, model, make_ghost("reference", track, model)[0])
    for command in commands[:STEP]:
        session.fly(command)
    renderer, log = make_renderer(session.params.course, session.gate_ids), session.now.log
    picture = renderer.draw(log, session.ghost_state(), follows_nose=True, notes=session.notes())
    content = io.BytesIO()
    Image.fromarray(picture).save(content, "PNG", optimize=True)
    write_atomically(Path(__file__).with_name("fly.png"), content.getvalue())
