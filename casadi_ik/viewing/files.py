"""Files that a page hands to the browser it is seen in."""

from __future__ import annotations

import io
import logging
import re
import struct
import zlib
from typing import Any

import numpy as np

from casadi_ik.grasps import Grasp
from casadi_ik.viewing.grasp_text import grasp_text

logger = logging.getLogger(__name__)

SIZE = (1600, 1000)
"""Of a picture [pixels]."""

PATIENCE = 20.0
"""How long a browser may draw [s]."""


def save_grasp(client: Any, grasp: Grasp, solved: bool) -> None:
    """Send a grasp file."""
    comment = "From a page on which contacts are dragged; " + ("solved." if solved else "unsolved.")
    name = re.sub(r"\W+", "_", grasp.name) or "grasp"
    text = grasp_text(grasp, comment).encode()
    client.send_file_download(f"{name}.yaml", text, save_immediately=True)


def save_picture(client: Any, name: str) -> None:
    """Send what a browser sees, drawn by it anew in print size, if it does draw."""
    try:
        image = client.get_render(SIZE[1], SIZE[0], transport_format="png", timeout=PATIENCE)
    except Exception as error:  # whatever it sends instead is read by imageio
        logger.debug("no picture: %s", error)
        return
    client.send_file_download(name, png(np.asarray(image)), save_immediately=True)


def picture_name(what: str) -> str:
    """A file name."""
    name = re.sub(r"\W+", "_", what) or "view"
    return f"{name}.png"


def png(image: np.ndarray) -> bytes:
    """An image (h, w, 3) or (h, w, 4) of bytes as a PNG file."""
    height, width, channels = image.shape
    rows = np.zeros((height, 1 + width * channels), dtype=np.uint8)
    rows[:, 1:] = image.reshape(height, -1)
    kind = {3: 2, 4: 6}[channels]
    out = io.BytesIO()
    out.write(b"\x89PNG\r\n\x1a\n")
    header = struct.pack(">2I5B", width, height, 8, kind, 0, 0, 0)
    for tag, data in (
        (b"IHDR", header),
        (b"IDAT", zlib.compress(rows.tobytes(), 6)),
        (b"IEND", b""),
    ):
        out.write(struct.pack(">I", len(data)) + tag + data)
        out.write(struct.pack(">I", zlib.crc32(tag + data)))
    return out.getvalue()
