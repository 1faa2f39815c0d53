"""Colours and sizes of a picture."""

from functools import cache, lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Colour = tuple[int, int, int]

FRAME_SIZE = (960, 540)  # pixels: width, height
TOP_VIEW_WIDTH = 400  # pixels; the chase view has the rest
# Everything but text is drawn this much larger and averaged down, because Pillow's lines are jagged.
SUPERSAMPLING = 2

BACKGROUND: Colour = (20, 24, 31)
GRID: Colour = (38, 45, 57)
BOUNDS: Colour = (66, 76, 92)
SKY_TOP: Colour = (44, 62, 92)
SKY_HORIZON: Colour = (112, 134, 160)
GROUND: Colour = (34, 40, 48)
GROUND_GRID: Colour = (58, 67, 80)
SHADOW: Colour = (14, 17, 22)
GATE: Colour = (150, 160, 175)
NEXT_GATE: Colour = (255, 150, 40)
GATE_AFTER: Colour = (250, 215, 140)
DRONE: Colour = (255, 255, 255)
FRONT_ROTOR: Colour = (255, 70, 70)
REAR_ROTOR: Colour = (225, 230, 238)
TEXT: Colour = (235, 239, 245)
FAINT_TEXT: Colour = (150, 160, 175)

FASTEST_M_S = 20.0  # the speed at which the trail's colour is at its end
# Blue, cyan, green, yellow, red: slow to fast.
SPEED_STOPS = np.array([(70, 110, 255), (60, 200, 240), (80, 220, 110), (250, 215, 60), (255, 70, 60)])
NUM_SPEED_COLOURS = 64


def _speed_table() -> list[Colour]:
    places = np.linspace(0.0, len(SPEED_STOPS) - 1.0, NUM_SPEED_COLOURS)
    stops = np.arange(len(SPEED_STOPS))
    channels = [np.interp(places, stops, SPEED_STOPS[:, channel]) for channel in range(3)]
    return [(int(r), int(g), int(b)) for r, g, b in zip(*channels, strict=True)]


SPEED_COLOURS = _speed_table()


def speed_colours(speeds_m_s: np.ndarray) -> list[Colour]:
    """Return the trail's colour at each speed (n,), m/s."""
    places = np.clip(speeds_m_s * (NUM_SPEED_COLOURS / FASTEST_M_S), 0, NUM_SPEED_COLOURS - 1)
    return [SPEED_COLOURS[place] for place in places.astype(int).tolist()]


def blend(colour: Colour, other: Colour, share: float) -> Colour:
    """Return a colour with that share, 0 to 1, of another one."""
    r, g, b = (round(a + (o - a) * share) for a, o in zip(colour, other, strict=True))
    return r, g, b


@cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's own font in a size, pixels."""
    return ImageFont.load_default(size)


@lru_cache(maxsize=1024)
def lettering(text: str, size: int) -> Image.Image:
    """Return one line of text as a mask; kept, because text costs more to set than gates to draw."""
    face = font(size)
    _, _, right, bottom = face.getbbox(text, anchor="la")
    mask = Image.new("L", (int(right) + 1, int(bottom) + 1))
    ImageDraw.Draw(mask).text((0, 0), text, 255, face, anchor="la")
    return mask
