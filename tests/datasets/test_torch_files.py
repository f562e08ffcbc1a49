"""Files of torch, read without torch: their contents and their faults."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
from torch_zip import write_torch

import casadi_ik as ik
from casadi_ik.integrations.datasets.unpickling import read_torch


def test_torch_file_is_read() -> None:
    """A file of torch 2.13 has strides, several dtypes, empty and scalar tensors."""
    path = Path(__file__).parent / "written_by_torch.pt"
    content = read_torch(path)
    assert content["view"].array.tolist() == np.arange(12.0).reshape(3, 4).T[1:].tolist()
    assert [kind.array.tolist() for kind in content["kinds"]] == [[0, 1, 2]] * 7
    assert content["flag"].array.tolist() == [True, False]
    assert content["scalar"].array == 2.5
    assert content["empty"].array.shape == (0, 3)
    assert content["info"] == {"num": 3}
    robot = "panda+allegro_right"
    grasps = ik.load_candidates(path, robot, of="contactdb+apple")
    assert [grasp.palm is not None and len(grasp.posture) for grasp in grasps] == [16, 16]
    assert grasps[1].posture["allegro_thumb_3"] == pytest.approx(0.45)
    says = r"found grasps of 2 objects \(contactdb\+apple, ycb\+pear\), expected one"
    with pytest.raises(ik.errors.DescriptionError, match=says):
        ik.load_candidates(path, robot)
    with pytest.raises(ik.errors.DescriptionError, match=r"of:.*'cup'.*2"):
        ik.load_candidates(path, robot, of="cup")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"metadata": []}, "metadata: expected a list of at least one grasp"),
        ({"metadata": [(np.zeros(25),)]}, "metadata: row 0: expected q and the name"),
        ({"metadata": [(np.zeros(25), "a")]}, "row 0: rotation: holds NaN"),
        ({"metadata": [(np.zeros(9), "a")]}, r"row 0: q: found shape \(9,\), expected"),
        ({"metadata": [(np.ones(25), "a"), (np.ones(24), "a")]}, r"row 1: q: .* expected \(25,\)"),
        ({"grasps": 1}, "its layout is none of"),
    ],
)
def test_bad_torch_files(content: Any, says: str, tmp_path: Path) -> None:
    write_torch(tmp_path / "set.pt", content)
    with pytest.raises(ik.errors.DescriptionError, match=says) as caught:
        ik.load_candidates(tmp_path / "set.pt", "panda+allegro_right")
    assert "\n" not in str(caught.value)


def test_torch_files_of_other_kinds(tmp_path: Path) -> None:
    """The format before torch 1.6, other files, and tensors beyond their storage are refused."""
    path = tmp_path / "set.pt"
    path.write_bytes(pickle.dumps(0x1950A86A20F9469CFC6C, 2))
    with pytest.raises(ik.errors.DescriptionError, match=r"torch 1\.6"):
        read_torch(path)
    path.write_bytes(b"x,y,z")
    with pytest.raises(ik.errors.DescriptionError, match=r"set\.pt: file is not a zip file"):
        read_torch(path)
    write_torch(path, {"a": np.arange(4.0)})
    size, nine_tuple = (pickle.BININT + n.to_bytes(4, "little") + pickle.TUPLE for n in (4, 9))
    with ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    assert entries["set/data.pkl"].count(size) == 2  # of the raw file, then of the tensor
    head, shape = entries["set/data.pkl"].rsplit(size, 1)
    with ZipFile(path, "w") as archive:
        for name, data in (entries | {"set/data.pkl": head + nine_tuple + shape}).items():
            archive.writestr(name, data)
    with pytest.raises(
        ik.errors.DescriptionError, match="a tensor that is larger than its storage"
    ):
        read_torch(path)
