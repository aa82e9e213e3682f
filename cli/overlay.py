"""Write into pictures: policy, place, command, measured speed, falls and time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from .play_session import Command, Readout

_DARK = (16, 20, 26)
_SHARE = 0.62
"""Opacity of the panel behind the text."""
_INK, _SOFT = (244, 246, 248), (176, 186, 196)


def table(readout: Readout) -> list[tuple[str, str, str, str]]:
    """Return command and measured speed as rows of a table, the head first."""
    return [
        ("", "forward m/s", "left m/s", "turn rad/s"),
        ("command", *_numbers(readout.command)),
        ("measured", *_numbers(readout.speed)),
    ]


def summary(readout: Readout) -> str:
    """Return friction, falls, arrivals and time in one line."""
    falls = "1 fall" if readout.falls == 1 else f"{readout.falls} falls"
    times = "once" if readout.arrivals == 1 else f"{readout.arrivals} times"
    arrivals = f"  ·  {times} at the target" if readout.arrivals else ""
    return f"friction {readout.friction:g}  ·  {falls}{arrivals}  ·  {readout.time:.1f} s"


def _numbers(command: Command) -> tuple[str, str, str]:
    forward, lateral, yaw = (f"{0.0 if abs(v) < 0.005 else v:+.2f}" for v in command)
    return forward, lateral, yaw


def annotate(picture: np.ndarray, readouts: Sequence[Readout]) -> np.ndarray:
    """Return a picture with a panel for each robot, the tiles side by side, (height, width, 3) uint8.

    Args:
        picture: (height, width, 3) uint8; is not changed.
    """
    image = Image.fromarray(picture)
    width = image.width // len(readouts)
    # Readable when a picture is small, and no larger than needed when it is big.
    points = max(11, round(min(image.height / 34, width / 30)))
    for at, readout in enumerate(readouts):
        _panel(image, at * width, width, points, readout)
    return np.asarray(image)


def _panel(image: Image.Image, left: int, width: int, points: int, readout: Readout) -> None:
    """Draw one robot's panel into the upper left corner of its tile."""
    font = ImageFont.load_default(size=points)
    line, pad, margin = round(1.35 * points), round(0.6 * points), round(0.5 * points)
    rows = table(readout)
    ends = [0.0]  # the first column begins at the left; numbers and their heads end where their column does
    for cells in zip(*rows, strict=True):
        ends.append(ends[-1] + max(font.getlength(cell) for cell in cells) + points)
    ends = [0.0, *(end - points for end in ends[2:])]
    title = _fitting(f"{readout.label}  ·  {readout.place}", font, width - 2 * (margin + pad))
    last = _fitting(summary(readout), font, width - 2 * (margin + pad))
    widest = max(ends[-1], font.getlength(title), font.getlength(last))
    box_width, box_height = round(widest) + 2 * pad, line * (len(rows) + 2) + 2 * pad
    x, y = left + margin, margin
    region = (x, y, x + box_width, y + box_height)
    behind = image.crop(region)
    image.paste(Image.blend(behind, Image.new("RGB", behind.size, _DARK), _SHARE), region)
    draw = ImageDraw.Draw(image)
    x, y = x + pad, y + pad
    draw.text((x, y), title, font=font, fill=_INK)
    for cells in rows:
        y += line
        for cell, end in zip(cells, ends, strict=True):
            soft = not cells[0] or not end
            draw.text((x + end, y), cell, font=font, fill=_SOFT if soft else _INK, anchor="ra" if end else "la")
    draw.text((x, y + line), last, font=font, fill=_SOFT)


def _fitting(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: float) -> str:
    """Return the part of a text that fits a width [pixels]."""
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "…") > width:
        text = text[:-1]
    return text + "…"
