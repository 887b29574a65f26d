"""Documents of numbers: JSON, YAML, YAML of OpenCV, the text of `numpy.savetxt`, and the arrays of .npy and .npz files."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SHOWN = 10
"""Names that are shown of a long list."""

MOST = 1 << 16
"""Values of an array; images are larger."""


def read(path: Path) -> Any:
    """A document as dictionaries, lists, numbers and texts. The arrays of a .npz file are a dictionary with their names."""
    content = path.read_bytes()
    try:
        if content.startswith(b"\x93NUMPY"):
            return array(path)
        if content.startswith(b"PK"):
            return arrays(path)
        return parse(content.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise ValueError(f"{path}: neither text (UTF-8) nor a .npy or .npz file") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def array(path: Path) -> Any:
    try:
        return np.load(path, allow_pickle=False).tolist()
    except ValueError as error:
        if "pickle" in str(error):
            raise ValueError('a pickled Python object, such as a dictionary; save the array alone: numpy.save(FILE, data["K"])') from None
        raise


def arrays(path: Path) -> dict[str, Any]:
    """The arrays of a .npz file. Images and pickled objects beside them are left out."""
    found: dict[str, Any] = {}
    with np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            try:
                array = archive[name]
            except ValueError:
                continue
            if array.size <= MOST:
                found[name] = array.tolist()
    return found


def parse(text: str) -> Any:
    """Of several YAML documents, as ``rostopic echo`` prints them, the first."""
    text = text.strip()
    if not text:
        raise ValueError("the file is empty")
    numbers = rows(text)
    if numbers is not None:
        return numbers
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        failure = error
    # OpenCV writes a directive without the space that YAML demands, and a tag that says nothing about the content.
    text = re.sub(r"\A%YAML:.*\n", "", text).replace("!!opencv-matrix", "")
    if text.startswith(("{", "[")) and '"' in text:
        raise ValueError(f"no valid JSON: {failure}")
    try:
        import yaml
    except ImportError as error:
        raise ImportError("reading YAML needs the package PyYAML") from error
    try:
        return next(yaml.safe_load_all(text))
    except yaml.YAMLError as error:
        raise ValueError(f"neither JSON nor YAML, nor rows of numbers: {error}") from None


def rows(text: str) -> list[list[float]] | None:
    """Rows of numbers, separated by spaces, commas or semicolons; lines with # are comments."""
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    # Without an empty cell the others would move.
    if any(re.search(r"^[,;]|[,;]\s*[,;]", line.rstrip(" ,;")) for line in lines):
        return None
    try:
        return [[float(word) for word in re.split(r"[ \t,;]+", line) if word] for line in lines if line]
    except ValueError:
        return None


def numbers(value: Any) -> list[float] | None:
    """All numbers of nested lists, in order. Texts of numbers are numbers, and OpenCV and ROS put matrices into `data`. None if
    anything else is among them."""
    if isinstance(value, (bool, bytes)) or value is None:
        return None
    if isinstance(value, Mapping):
        return numbers(value.get("data"))
    if isinstance(value, (str, int, float, np.number)):
        try:
            return [float(value)]
        except ValueError:
            return None
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, Sequence) and not hasattr(value, "__iter__"):
        return None
    parts = [numbers(inner) for inner in value]
    return None if any(part is None for part in parts) else [number for part in parts for number in part or []]


def number(value: Any) -> float | None:
    """A number, also as text or in lists of one."""
    found = numbers(value)
    return found[0] if found is not None and len(found) == 1 else None


def plain(key: Any) -> str:
    """A key as it is compared: its last part without case and separators, so that ``image_Width`` is ``imagewidth``."""
    return "".join(filter(str.isalnum, str(key).split(".")[-1])).lower()


def listed(names: Sequence[Any]) -> str:
    """The first names, and how many more there are."""
    more = f", … {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(map(str, names[:SHOWN])) + more


def short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:60] + "…"
