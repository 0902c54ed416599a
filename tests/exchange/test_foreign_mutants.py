"""Whatever stands in a file of another program: it is read, or refused in one short
sentence; and what is read can be calculated with."""

import struct

import numpy as np
import pytest
from mutants import mutants

from jaxro import exchange
from jaxro.exchange import files
from jaxro.tables.fields import TableError, tell

PIECES = (
    *("nan", "-1.#IND", "inf", "1e400", "1e308", "1e-320", "0", "-1", "1,5", "9" * 5000),
    *(" ", "\n", "\r", "\0", "\x1b[2J", "\u202e", "\u2028", "#", " # x", "", "é", "²", "3 "),
    *("1_0", "0x10", str(10**12), str(2**64 - 1), "[bold]", "a b", "\t", " 1 2 3 ", "SIMPLE_"),
)  # fmt: skip
BYTES = (
    *(b"\xff" * 8, b"\0" * 8, b"\xff" * 4, b"\0", b"", b"a", b"\x63\0\0\0", b"\x80"),
    *((10**12).to_bytes(8, "little"), (2**63).to_bytes(8, "little")),
    *(struct.pack("<d", x) for x in (np.nan, np.inf, 1e308, -1e-320, -5.0, 1e9)),
)
PLACES = np.random.default_rng(0).uniform(-300, 300, (3, 12, 2)).round(2)

BUNDLE = (
    "# Bundle file v0.3\n3 12\n" + "600 -0.1 0.01\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n" * 3
)
BUNDLE += "".join(
    f"1 2 {k}\n1 2 3\n3 "
    + " ".join(f"{c} {k} {PLACES[c, k, 0]} {PLACES[c, k, 1]}" for c in range(3))
    + "\n"
    for k in range(12)
)
MODEL = {
    "cameras": "1 OPENCV 640 480 600 600 320 240 -.1 .01 0 0\n2 FOV 640 480 600 600 320 240 .5\n",
    "images": "".join(
        f"{c + 1} 1 0 0 0 0 0 0 {1 + c // 2} photo {c}.jpg\n"
        + " ".join(f"{320 + x} {240 + y} {k}" for k, (x, y) in enumerate(PLACES[c]))
        + "\n"
        for c in range(3)
    ),
    "points3D": "".join(f"{k} 1 2 3 0 0 0 1 1 {k} 2 {k} 3 {k}\n" for k in range(12)),
}  # fmt: skip


def read_or_refused(path):
    try:
        found = files.read(path)
    except TableError as error:
        told = str(error)
        assert len(told) < 1000 and tell(told) == told
        return
    for name in ("x_left", "y_left", "x_right", "y_right", "sigma"):
        assert np.all(np.isfinite(getattr(found.pairs, name)))
    assert len(set(found.names)) == len(found.names)
    assert all(camera.focal > 0 for camera in found.cameras.photos.values())


def test_bundler(tmp_path, count=100):
    path = tmp_path / "mutant.out"
    path.write_text(BUNDLE)
    assert exchange.read_bundler(path).pairs.lengths.tolist() == [12] * 3
    for changed in mutants(BUNDLE, PIECES, count):
        path.write_bytes(changed.encode())
        read_or_refused(path)


def test_colmap(tmp_path, count=40):
    """Text and binary files, each of the three in its turn."""
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap has the camera models")
    folders = {"txt": tmp_path / "text", "bin": tmp_path / "binary"}
    for folder in folders.values():
        folder.mkdir()
    for name, text in MODEL.items():
        (folders["txt"] / f"{name}.txt").write_text(text)
    model = pycolmap.Reconstruction()
    model.read_text(str(folders["txt"]))
    model.write_binary(str(folders["bin"]))
    for ending, folder in folders.items():
        for name in MODEL:
            path = folder / f"{name}.{ending}"
            content, pieces = path.read_bytes(), BYTES
            if ending == "txt":
                pieces = [piece.encode() for piece in PIECES]
            for changed in mutants(content, pieces, count):
                path.write_bytes(changed)
                read_or_refused(folder)
            path.write_bytes(content)


def test_hdf5(tmp_path, count=4):
    h5py = pytest.importorskip("h5py", reason="HDF5 files need h5py")
    path = tmp_path / "mutant.h5"
    with h5py.File(path, "w") as file:
        for k in (1, 2):
            file[f"a/x{k}"] = PLACES[k]
            file[f"a/camera{k}/model"] = ["PINHOLE"]
            file[f"a/camera{k}/params"] = [600.0, 600, 0, 0]
    content = path.read_bytes()
    for changed in mutants(content, BYTES, count):
        path.write_bytes(changed)
        read_or_refused(path)
