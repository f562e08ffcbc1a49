"""Write files in the format of `torch.save` since torch 1.6, without torch.

The pickle is written byte by byte, since it names functions of torch that need not be there
(torch/serialization.py, `_save`; opcodes: the standard library's pickletools).
"""

from __future__ import annotations

import pickle
import struct
from pathlib import Path
from zipfile import ZipFile

import numpy as np

from casadi_ik.files.arrays import Array

Content = dict[str, "Content"] | list["Content"] | tuple["Content", ...] | str | int | Array
"""Content of a file; arrays become tensors of four-byte floats."""


class _Writer:
    """Bytes of a pickle and the values of its tensors."""

    def __init__(self) -> None:
        self.tensors: list[bytes] = []

    def of(self, content: Content) -> bytes:
        """Return the opcodes that push the content onto the stack of the reader."""
        if isinstance(content, dict):
            items = b"".join(self.of(key) + self.of(value) for key, value in content.items())
            return pickle.EMPTY_DICT + pickle.MARK + items + pickle.SETITEMS
        if isinstance(content, list):
            items = b"".join(map(self.of, content))
            return pickle.EMPTY_LIST + pickle.MARK + items + pickle.APPENDS
        if isinstance(content, tuple):
            return pickle.MARK + b"".join(map(self.of, content)) + pickle.TUPLE
        if isinstance(content, str):
            text = content.encode()
            return pickle.BINUNICODE + struct.pack("<I", len(text)) + text
        if isinstance(content, int):
            return pickle.BININT + struct.pack("<i", content)
        return self._tensor(content)

    def _tensor(self, values: Array) -> bytes:
        raw = np.ascontiguousarray(values, dtype="<f4")
        key, strides = str(len(self.tensors)), tuple(step // 4 for step in raw.strides)
        self.tensors.append(raw.tobytes())
        storages = pickle.MARK + self.of("storage") + pickle.GLOBAL + b"torch\nFloatStorage\n"
        storages += (
            self.of(key) + self.of("cpu") + self.of(raw.size) + pickle.TUPLE + pickle.BINPERSID
        )
        hooks = pickle.GLOBAL + b"collections\nOrderedDict\n" + pickle.EMPTY_TUPLE + pickle.REDUCE
        content = self.of(0) + self.of(raw.shape) + self.of(strides) + pickle.NEWFALSE + hooks
        build = pickle.GLOBAL + b"torch._utils\n_rebuild_tensor_v2\n"
        return build + pickle.MARK + storages + content + pickle.TUPLE + pickle.REDUCE


def write_torch(path: Path, content: Content) -> None:
    """Write a file.

    Args:
        path: The file; its stem names the folder within.
        content: Containers, texts, whole numbers and arrays.
    """
    writer = _Writer()
    pickle_bytes = pickle.PROTO + b"\x02" + writer.of(content) + pickle.STOP
    with ZipFile(path, "w") as archive:
        archive.writestr(f"{path.stem}/data.pkl", pickle_bytes)
        archive.writestr(f"{path.stem}/byteorder", "little")
        for key, raw in enumerate(writer.tensors):
            archive.writestr(f"{path.stem}/data/{key}", raw)
        archive.writestr(f"{path.stem}/version", "3\n")
