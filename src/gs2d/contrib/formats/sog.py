"""Read and write SOG, PlayCanvas's splats as lossless WebP images in a ZIP file, a folder, or a tree of folders.

Follows the format description (developer.playcanvas.com, version 2). Each pixel is a splat: log positions in 16 bits
over two images, scales and colours as indices into codebooks of 256, rotations as the three smallest components,
opacities in 8 bits, and higher harmonics as one of at most 65,536 rows of a palette. Coordinates are those of PLY. The
finest level of the streamed form (lod-meta.json) is read; sog_streamed.py writes it. Version 1, which is read only, has
ranges instead of codebooks, and opacity logits as the fourth colour channel.
"""

from __future__ import annotations

import io
import json
import math
import os
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gs2d.contrib.formats.quantised import logit_of_byte, morton_order, to_byte
from gs2d.contrib.formats.sog_palette import codebook, nearest_code, palette
from gs2d.core.atomic_files import atomic_write
from gs2d.core.growth import check_entries, check_growth
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import register_format, register_splat_reader
from gs2d.io.gaussians import Gaussians, Warn, drawn_bands, sigmoid, unit_quats

_ROW = 64  # palette rows per image row
_LONGEST = 16 << 20  # bytes of a JSON file
_MOST_CHUNKS = 10_000
Fetch = Callable[[str], bytes]


def write_sog(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write one .sog file (version 2), atomically and deterministically, in Morton order."""
    files = packed_sog(gaussians.rows(morton_order(gaussians.means)))
    with atomic_write(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data)  # the time stamp is 1980


def packed_sog(g: Gaussians) -> dict[str, bytes]:
    """Return the files of an SOG data set of disks by name, meta.json last; the order of the splats is kept."""
    shape = _image(len(g))
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "gs2d"}, "count": len(g), "model": "2dgs"}
    images: dict[str, np.ndarray] = {}

    logs = np.sign(g.means) * np.log1p(np.abs(g.means.astype(np.float64)))
    low, high = (f(logs, axis=0) if len(g) else np.zeros(3) for f in (np.min, np.max))
    span = np.where(high > low, high - low, 1.0)
    fixed = np.clip(np.rint((logs - low) / span * 65535.0), 0, 65535).astype(np.uint16)
    images |= {"means_l": (fixed & 255).astype(np.uint8), "means_u": (fixed >> 8).astype(np.uint8)}
    meta["means"] = {"mins": low.tolist(), "maxs": (low + span).tolist(), "files": ["means_l.webp", "means_u.webp"]}

    codes = codebook(g.log_scales)
    images["scales"] = nearest_code(g.log_scales, codes)
    meta["scales"] = {"codebook": codes.tolist(), "files": ["scales.webp"]}
    images["quats"] = _packed_quats(g.quats)
    meta["quats"] = {"files": ["quats.webp"]}
    codes = codebook(g.sh0)
    opacity = to_byte(255.0 * sigmoid(g.opacity_logits))[:, None]
    images["sh0"] = np.concatenate([nearest_code(g.sh0, codes), opacity], axis=1)
    meta["sh0"] = {"codebook": codes.tolist(), "files": ["sh0.webp"]}
    whole = {name: _laid_out(rows, shape) for name, rows in images.items()}
    if g.shN.shape[1] and len(g):
        meta["shN"], more = _packed_harmonics(g.shN, shape)
        whole |= more
    files = {f"{name}.webp": _webp(image) for name, image in whole.items()}
    return files | {"meta.json": json.dumps(meta, separators=(",", ":")).encode()}


def _image(count: int) -> tuple[int, int]:
    """Return (height, width) in px of images for ``count`` splats: multiples of 4, nearly square."""
    width = max(4, 4 * math.ceil(math.sqrt(count) / 4))
    return max(4, 4 * math.ceil(count / width / 4)), width


def _laid_out(rows: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    image = np.zeros((shape[0] * shape[1], rows.shape[1]), np.uint8)
    image[: len(rows)] = rows
    return image.reshape(*shape, rows.shape[1])


def _webp(image: np.ndarray) -> bytes:
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(image).save(data, "WEBP", lossless=True, exact=True, quality=100, method=4)
    return data.getvalue()


def _packed_quats(quats: np.ndarray) -> np.ndarray:
    """Return [N, 4] uint8: the three smallest of (w, x, y, z) in order, then 252 plus the index of the largest."""
    q = unit_quats(quats)
    rows, largest = np.arange(len(q)), np.abs(q).argmax(axis=1)
    q *= np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    smaller = q[np.arange(4) != largest[:, None]].reshape(-1, 3)
    packed = to_byte(255.0 * (smaller * math.sqrt(0.5) + 0.5))
    return np.concatenate([packed, (252 + largest[:, None]).astype(np.uint8)], axis=1)


def _packed_harmonics(shN: np.ndarray, shape: tuple[int, int]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the entry of meta.json for the higher harmonics, and their two images."""
    coefficients = shN.shape[1]
    centers, labels = palette(shN.reshape(len(shN), -1))
    codes = codebook(centers)
    colors = np.zeros((_ROW * math.ceil(len(centers) / _ROW), coefficients, 3), np.uint8)
    colors[: len(centers)] = nearest_code(centers, codes).reshape(-1, coefficients, 3)
    places = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1).astype(np.uint8)
    meta = {
        "count": len(centers),
        "bands": math.isqrt(coefficients),
        "codebook": codes.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
    images = {
        "shN_centroids": colors.reshape(-1, _ROW * coefficients, 3),
        "shN_labels": _laid_out(places, shape),
    }
    return meta, images


def read_sog(path: str | os.PathLike[str], warn: Warn = warnings.warn) -> tuple[Gaussians, str]:
    """Read a .sog file, the meta.json of a folder, or the finest level of a lod-meta.json.

    ``warn`` receives a message if SH bands above degree 3 are dropped. Raises DataError if the file is missing,
    damaged, or of another kind or version.
    """
    path = Path(path)
    try:
        if path.name.lower() == "lod-meta.json":
            return read_level(path, warn=warn), "streamed SOG, its finest level"
        if path.suffix.lower() == ".json":
            fetch, size = _in_folder(path.parent, path), path.stat().st_size
            return _SogReader(path, fetch, size, warn).read(path.name), "SOG, unpacked"
        with open(path, "rb") as file, zipfile.ZipFile(file) as archive:
            check_entries(path, archive.infolist())
            size = path.stat().st_size
            return _SogReader(path, lambda name: _of_archive(path, archive, name), size, warn).read(), "SOG"
    except OSError as error:
        raise DataError(f"cannot read {error.filename or path}: {error.strerror or error}") from error
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError) as error:
        raise DataError(f"{path}: expected SOG, but its ZIP file is broken ({error}); copy it again") from error


def _of_archive(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    try:
        entry = archive.getinfo(name)
    except KeyError:
        raise DataError(f"{path}: expected SOG, but {name[:80]!r} is missing; export it again") from None
    check_growth(path, path.stat().st_size, entry.file_size, f"an entry {name[:80]!r}")
    return archive.read(entry)


def _in_folder(home: Path, source: Path) -> Fetch:
    """Return a function that reads files in a folder by name; ``source`` is for errors."""

    def fetch(name: str) -> bytes:
        if not name or "\0" in name or not Path(os.path.realpath(home / name)).is_relative_to(os.path.realpath(home)):
            raise DataError(f"{source}: expected files in its own folder, got {name[:80]!r}")
        return (home / name).read_bytes()

    return fetch


class _SogReader:
    """Reads one SOG data set, with files fetched by name; ``size`` is the number of compressed bytes read so far."""

    def __init__(self, path: Path, fetch: Fetch, size: int, warn: Warn) -> None:
        self.path, self.fetch, self.size, self.warn = path, fetch, size, warn

    def read(self, name: str = "meta.json") -> Gaussians:
        """Return the splats."""
        meta = parsed(self.path, self.fetch(name))
        try:
            version = meta.get("version", 1 if "means" in meta else None)
            if version not in (1, 2):
                raise DataError(
                    f"{self.path}: expected SOG of version 1 or 2, got {str(version)[:20]}; convert it to PLY"
                )
            return self._gaussians(meta)
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
            words = " ".join(str(error).split())[:80]
            raise DataError(
                f"{self.path}: expected SOG, but its content is invalid "
                f"({type(error).__name__}: {words}); export the file again"
            ) from error

    def _gaussians(self, meta: dict[str, Any]) -> Gaussians:
        count = meta["count"] if "count" in meta else meta["means"]["shape"][0]
        if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count < 1 << 40:
            raise ValueError("expected a number of splats")
        low, high = (np.array(_floats(meta["means"][end], 3)) for end in ("mins", "maxs"))
        lower, upper = (self._rows(count, 3, name).astype(np.float64) for name in _names(meta["means"], 2))
        with np.errstate(over="ignore", invalid="ignore"):  # values are checked later
            logs = low + (high - low) * ((lower + 256.0 * upper) / 65535.0)
            means = (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)
        scales = _values(meta["scales"], self._rows(count, 3, *_names(meta["scales"], 1)))
        quats = _quats(self._rows(count, 4, *_names(meta["quats"], 1)))
        color = self._rows(count, 4, *_names(meta["sh0"], 1))
        shN = np.zeros((count, 0, 3), np.float32)
        if meta.get("shN") is not None:
            shN = self._harmonics(meta["shN"], count)
        if "codebook" in meta["sh0"]:
            return Gaussians(means, quats, scales, logit_of_byte(color[:, 3]), _values(meta["sh0"], color[:, :3]), shN)
        color = _values(meta["sh0"], color)  # version 1 includes opacity logits
        return Gaussians(means, quats, scales, color[:, 3], color[:, :3], shN)

    def _harmonics(self, entry: dict[str, Any], count: int) -> np.ndarray:
        centroids, labels = _names(entry, 2)
        image = self._pixels(centroids)[:, :, :3]
        bands = int(entry["bands"]) if "bands" in entry else math.isqrt(image.shape[1] // _ROW)  # version 1 has none
        if not 1 <= bands <= 8:
            raise ValueError("expected 1 to 3 bands of harmonics")
        coefficients = (bands + 1) ** 2 - 1
        if image.shape[1] != _ROW * coefficients:
            raise ValueError(f"expected {_ROW * coefficients} columns of centroids, got {image.shape[1]}")
        centers = image.reshape(-1, coefficients, 3)
        which = self._rows(count, 3, labels).astype(np.int64)
        which = which[:, 0] + 256 * which[:, 1]
        if len(which) and which.max() >= len(centers):
            raise ValueError(f"expected labels below {len(centers)}, got {which.max()}")
        packed = count * coefficients * 12
        check_growth(self.path, self.size, packed, f"a cloud of splats ({count:,} of them)")
        return _values(entry, drawn_bands(self.path, centers[which], self.warn))

    def _rows(self, count: int, width: int, name: str) -> np.ndarray:
        """Return the pixels of the splats [N, width] in an image."""
        image = self._pixels(name).reshape(-1, 4)
        if len(image) < count:
            raise ValueError(f"expected {count} pixels in {name[:40]}, got {len(image)}")
        return image[:count, :width]

    def _pixels(self, name: str) -> np.ndarray:
        """Read an image [H, W, 4] uint8; its size is checked before it is decoded."""
        data = self.fetch(name)
        self.size += len(data)
        try:
            with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as file:
                what = f"an image ({file.width}x{file.height})"
                check_growth(self.path, self.size, 4 * file.width * file.height, what)
                return np.asarray(file.convert("RGBA"))
        except DataError:
            raise
        except Exception as error:  # Pillow's parsers raise many kinds
            words = " ".join(str(error).split())[:80]
            raise DataError(f"{self.path}: cannot decode the image {name[:80]!r} ({words}); copy it again") from error


def parsed(path: Path, data: bytes) -> dict[str, Any]:
    """Parse a JSON object."""
    try:
        if len(data) > _LONGEST:
            raise ValueError(f"more than {_LONGEST} bytes")
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        words = " ".join(str(error).split())[:80]
        raise DataError(f"{path}: expected SOG, but its JSON is invalid ({words}); export it again") from error
    if not isinstance(document, dict):
        raise DataError(f"{path}: expected SOG, but its JSON is no object; export it again")
    return document


def _floats(values: Any, count: int) -> list[float]:
    numbers = [float(value) for value in values]
    if len(numbers) != count:
        raise ValueError(f"expected {count} numbers, got {len(numbers)}")
    return numbers


def _values(entry: dict[str, Any], packed: np.ndarray) -> np.ndarray:
    """Dequantize bytes [..., C] by a codebook, or by a range (version 1); float32."""
    with np.errstate(over="ignore", invalid="ignore"):  # values are checked later
        if "codebook" in entry:
            return np.array(_floats(entry["codebook"], 256)).astype(np.float32)[packed]
        low, high = (np.array(entry[end], np.float64) for end in ("mins", "maxs"))  # [C], or one number
        if low.shape != high.shape or low.shape not in ((), packed.shape[-1:]):
            raise ValueError(f"expected mins and maxs for {packed.shape[-1]} columns")
        return (low + (high - low) * (packed / 255.0)).astype(np.float32)


def _names(entry: dict[str, Any], count: int) -> list[str]:
    names = entry["files"]
    if not isinstance(names, list) or len(names) != count or not all(isinstance(name, str) for name in names):
        raise ValueError(f"expected {count} file names")
    return names


def _quats(packed: np.ndarray) -> np.ndarray:
    largest = packed[:, 3].astype(np.int64) - 252
    if len(largest) and largest.min() < 0:
        raise ValueError("expected rotations with a fourth byte of 252 or more")
    smaller = (packed[:, :3] / 255.0 - 0.5) * math.sqrt(2.0)
    q = np.zeros((len(packed), 4))
    q[np.arange(4) != largest[:, None]] = smaller.reshape(-1)
    q[np.arange(len(q)), largest] = np.sqrt(np.maximum(0.0, 1.0 - np.square(smaller).sum(axis=1)))
    return q.astype(np.float32)


def read_level(path: Path, level: int = 0, warn: Warn = warnings.warn) -> Gaussians:
    """Read one level of a lod-meta.json, with its environment; 0 is the finest.

    If a leaf does not have that level, its next coarser one is read, or else its coarsest.
    """
    index = parsed(path, path.read_bytes())
    fetch, parts = _in_folder(path.parent, path), []
    try:
        names, chunks = index["filenames"], _places(index["tree"], level)
        files: dict[int, Gaussians] = {}
        for file, offset, count in chunks:
            if file not in files:
                files[file] = _data_set(path, fetch, names[file], warn)
            if offset < 0 or count < 0 or offset + count > len(files[file]):
                raise ValueError(f"expected splats {offset} to {offset + count} in a chunk of {len(files[file])}")
            parts.append(files[file].rows(np.arange(offset, offset + count)))
        if index.get("environment") is not None:
            parts.append(_data_set(path, fetch, index["environment"], warn))
        if not parts:
            raise ValueError("no chunk of the finest level")
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        words = " ".join(str(error).split())[:80]
        raise DataError(
            f"{path}: expected streamed SOG, but its content is invalid ({type(error).__name__}: {words}); "
            "export it again"
        ) from error
    return Gaussians.joined(parts)


def _data_set(path: Path, fetch: Fetch, name: Any, warn: Warn) -> Gaussians:
    if not isinstance(name, str):
        raise TypeError("expected names of chunks")
    folder = name.rpartition("/")[0]
    reader = _SogReader(path, lambda inner: fetch(f"{folder}/{inner}" if folder else inner), 0, warn)
    return reader.read(name.rpartition("/")[2])


def _places(tree: Any, finest: int) -> list[tuple[int, int, int]]:
    """Return the distinct (file, offset, count) of one level of every leaf."""
    counts: dict[tuple[int, int], int] = {}
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        waiting += node.get("children") or []
        if "lods" in node:
            levels = {int(level): place for level, place in node["lods"].items()}
            place = levels[min((level for level in levels if level >= finest), default=max(levels))]
            file, offset, count = (int(place[key]) for key in ("file", "offset", "count"))
            if file < 0 or counts.setdefault((file, offset), count) != count:
                raise ValueError("expected each splat of a level once")
        if len(counts) > _MOST_CHUNKS or len(waiting) > _MOST_CHUNKS:
            raise ValueError(f"expected at most {_MOST_CHUNKS} chunks")
    return [(file, offset, count) for (file, offset), count in sorted(counts.items())]


register_format("sog", ending=".sog")(lambda path, splats: write_sog(path, Gaussians.of(splats)))


register_splat_reader("sog", endings=(".sog", "/meta.json", "/lod-meta.json"))(read_sog)
