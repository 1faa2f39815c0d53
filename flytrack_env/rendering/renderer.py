"""One picture of a flight: the top view, the chase view and a line of text."""

import numpy as np
from PIL import Image, ImageDraw

from flytrack_env.rendering import palette
from flytrack_env.rendering.chase_view import ChaseView
from flytrack_env.rendering.geometry import gates_of
from flytrack_env.rendering.scene import GATE_INDEX, LAP_START, LAP_TIME, LAPS, FlightLog
from flytrack_env.rendering.top_view import TopView
from flytrack_env.state import BATTERY, VELOCITY
from flytrack_env.tracks import Course

TEXT_SIZE = 15  # pixels
TEXT_TOP = 12
BAR_HEIGHT = 34
# Left edge of each text of the line in the chase view.
COLUMNS = (14, 78, 182, 262, 340, 460)


class Renderer:
    """Draws pictures of any number of flights on one course, 960 x 540 pixels.

    A flight that was drawn before costs only what was flown since: its trail is kept as long as its log.
    """

    def __init__(self, course: Course):
        width, height = (palette.SUPERSAMPLING * size for size in palette.FRAME_SIZE)
        split = palette.SUPERSAMPLING * palette.TOP_VIEW_WIDTH
        gates = gates_of(course)
        self.top_view = TopView(course, gates, split, height)
        self.chase_view = ChaseView(course, gates, split, width - split, height)
        self.canvas = Image.new("RGB", (width, height))

    def draw(self, log: FlightLog) -> np.ndarray:
        """Return a picture of the log's last row and the way there, (540, 960, 3), uint8.

        Raises:
            ValueError: an empty log.
        """
        if len(log.rows) == 0:
            raise ValueError("log: found no rows, expected at least one")
        self.top_view.draw(self.canvas, log)
        self.chase_view.draw(self.canvas, log)
        picture = self.canvas.reduce(palette.SUPERSAMPLING)
        self._write(ImageDraw.Draw(picture), log)
        return np.array(picture)

    def _write(self, draw: ImageDraw.ImageDraw, log: FlightLog) -> None:
        """Write lap, gate, speed, battery and lap times above the chase view."""
        row = log.rows[-1].astype(float)
        last = f"last {row[LAP_TIME]:.2f} s" if row[LAP_TIME] > 0.0 else ""
        texts = (
            f"lap {row[LAPS] + 1:.0f}",
            f"next gate {row[GATE_INDEX]:.0f}",
            f"{np.linalg.norm(row[VELOCITY]):.1f} m/s",
            f"{row[BATTERY]:.2f} V",
            f"lap time {log.time_s - row[LAP_START]:.2f} s",
            last,
        )
        left = palette.TOP_VIEW_WIDTH
        draw.rectangle([left, 0, palette.FRAME_SIZE[0], BAR_HEIGHT], palette.BACKGROUND)
        for column, text in zip(COLUMNS, texts, strict=True):
            if text:
                draw.bitmap((left + column, TEXT_TOP), palette.lettering(text, TEXT_SIZE), palette.TEXT)
