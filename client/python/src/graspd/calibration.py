"""Finds the camera in a document of ROS, OpenCV, Open3D, librealsense, kalibr, BOP or another tool.

One walk collects the cameras, and one table names what may be said of them, in their object or in those around it. What
looks like a part of the calibration but cannot be understood is an error: with half of a calibration the grasps would be
wrong without a word. `grasp` reads files by the same rules.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from graspd.document import listed, number, numbers, plain, short

Read = TypeVar("Read")

NUMBER = r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w.])"

logger = logging.getLogger("graspd")

POLYNOMIAL = ("plumbbob", "rationalpolynomial", "thinprism", "radtan", "radialtangential", "brownconrady", "pinhole", "opencv")
"""Names of OpenCV's polynomial model, without separators."""
FISHEYE = ("equidistant", "fisheye", "kannalabrandt4", "opencvfisheye")
"""Names of OpenCV's fisheye."""
REALSENSE = ("none", "modified_brown_conrady", "inverse_brown_conrady", "ftheta", "brown_conrady", "kannala_brandt4")
"""Models of a lens by the number of librealsense's enum."""

INTRINSICS = ("fx", "fy", "cx", "cy")
EDGES = ("width", "height")
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
NAMES: dict[str, tuple[str, ...]] = {
    "matrix": ("k", "camk", "cameramatrix", "intrinsicmatrix", "intrinsics", "intrinsic", "mtx"),
    "projection": ("p", "projectionmatrix"),
    "fx": ("fx", "flx"),
    "fy": ("fy", "fly"),
    "cx": ("cx", "ppx", "xoffset"),
    "cy": ("cy", "ppy", "yoffset"),
    "width": (
        "width", "imagewidth", "imgwidth", "imwidth", "w", "widthpx", "framewidth", "sensorwidth", "cols", "columns", "ncols",
        "numcols", "imagecols", "resx", "xres", "resolutionx",
    ),
    "height": (
        "height", "imageheight", "imgheight", "imheight", "h", "heightpx", "frameheight", "sensorheight", "rows", "nrows",
        "numrows", "imagerows", "resy", "yres", "resolutiony",
    ),
    "size": (
        "imagesize", "imgsize", "imsize", "framesize", "size", "resolution", "imageresolution", "imgres", "res",
        "sensorresolution", "depthresolution",
    ),
    "shape": ("shape", "imageshape", "imgshape", "frameshape"),
    "distortion model": ("distortionmodel", "distortiontype", "distmodel", "disttype"),
    "distortion": ("d", "coeffs", "coefficients", "coeff", "coefs", "coef", "lensdistortion", "cameradistortion"),
    "radial": ("radialdistortion", "radial"),
    "tangential": ("tangentialdistortion", "tangential"),
    "camera model": ("model", "cameramodel", "lensmodel"),
    "fisheye": ("fisheye", "isfisheye"),
    "unit": ("scale",),
    **{name: (name,) for name in COEFFICIENTS},
}
"""Keys without case and separators, by what they say."""
ROLES = {name: role for role, names in NAMES.items() for name in names}


def role_of(key: Any) -> str | None:
    name = plain(key)
    if name in ROLES:
        return ROLES[name]
    if name.startswith("dist") and not name.startswith("distance") or name.startswith("kc"):
        return "distortion"
    if "dist" in name and "distance" not in name or "radial" in name or "tangential" in name:
        return "doubtful"
    if "depth" in name and "factor" in name or name == "pngdepthscale" or "unitspermet" in name:
        return "units per metre"
    if "depth" in name and ("scal" in name or "unit" in name):
        return "unit"
    return "unit-like" if is_unit_like(name) else None


def is_unit_like(name: str) -> bool:
    """Whether a key may be a unit of depths under a name that is not known."""
    of_depth = "depth" in name and (name.endswith(("tom", "tomm", "2m", "2mm")) or "step" in name or "lsb" in name)
    return of_depth or "perunit" in name or name in ("unit", "units", "zscale", "zunit", "zfactor", "scalefactor")


@dataclass(frozen=True)
class Found:
    """What a document says about a camera."""

    k: tuple[float, ...]
    """The intrinsic matrix, row by row."""
    size: tuple[int | None, int | None] | None
    distortion: tuple[float, ...]
    distortion_model: str
    depth_scale: float | None
    binning: tuple[int, int] = (1, 1)


@dataclass(frozen=True)
class Said:
    """Something that a document says."""

    role: str
    key: str
    value: Any
    distance: int
    """Steps to the object of the camera: even for it and those around it, odd for what else these contain."""


def find(document: Any, rectified: bool = False) -> Found:
    """The camera of a document, which may also be bare numbers. `rectified`: that of its rectified images, which have the
    projection matrix, if there is one, and no distortion."""
    found = list(walk(document, "", (), rectified))
    if any(camera != found[0][1] for _, camera in found):
        depths = [(path, camera) for path, camera in found if any(plain(key).startswith("depth") for key in path.split("."))]
        names = listed([path for path, _ in found])
        if len(depths) != 1:
            raise ValueError(f"several cameras in the file: {names}; give a file with the depth camera alone")
        logger.warning("the intrinsics are those of %s, one of %s", depths[0][0], names)
        return depths[0][1]
    if found:
        return found[0][1]
    # A .npz file with one array of any name.
    only = next(iter(document.values())) if isinstance(document, Mapping) and len(document) == 1 else document
    bare = numbers(only) or []
    if len(bare) < 4:
        keys = f"; keys in the file: {listed(list(document))}" if isinstance(document, Mapping) else ""
        keys = ": the file has no keys" if document == {} else keys
        raise ValueError(f"no intrinsics found{keys}")
    return camera_of(checked(matrix_of(bare)), (), rectified)


def walk(value: Any, path: str, around: tuple[Said, ...], rectified: bool) -> Iterable[tuple[str, Found]]:
    if isinstance(value, list):
        for index, inner in enumerate(value):
            if has_camera(inner):
                yield from walk(inner, f"{path}[{index}]", around, rectified)
    if not isinstance(value, Mapping):
        return
    said = (*collect(value, 0), *(replace(outer, distance=outer.distance + 2) for outer in around))
    projection = projection_of(value) if rectified else None
    k = intrinsics_of(value) if projection is None else checked(projection)
    if k is not None:
        yield path or "the file itself", windowed(camera_of(k, said, rectified), value)
    for key, inner in value.items():
        if has_camera(inner):
            yield from walk(inner, f"{path}.{key}" if path else str(key), said, rectified)


def has_camera(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(names_camera(key, inner) or has_camera(inner) for key, inner in value.items())
    return isinstance(value, list) and any(isinstance(inner, (Mapping, list)) and has_camera(inner) for inner in value)


def names_camera(key: Any, value: Any) -> bool:
    role = role_of(key)
    if role in ("matrix", "projection"):
        return is_quoted(value) or len(numbers(value) or ()) >= 4
    return role == "fx" and number(value) is not None


def is_quoted(value: Any) -> bool:
    """Whether a text has the numbers of a matrix."""
    return isinstance(value, str) and re.match(r"\s*[-\[\d]", value) is not None and len(re.findall(NUMBER, value)) >= 4


def collect(value: Mapping[str, Any], distance: int) -> Iterable[Said]:
    """What an object says, and what the objects in it say that are no cameras themselves."""
    names = set(map(plain, value))
    for key, inner in value.items():
        role = role_of(key)
        if inner is None or role in ("matrix", "projection", *INTRINSICS) and not isinstance(inner, Mapping):
            continue
        # A quaternion has w alone, and a region of interest its own size.
        if role in EDGES and len(plain(key)) == 1 and not {"w", "h"} <= names:
            continue
        # Matrices and boards have rows and columns too.
        if role in EDGES and plain(key).endswith(("rows", "cols", "columns")) and ("data" in names or distance % 2 == 1):
            continue
        if isinstance(inner, Mapping):
            if key == "roi" or has_camera(inner) or role in ("matrix", "projection"):
                continue
            if role == "distortion" and numbers(inner) is None:
                yield from lens(key, inner, distance)
            elif role == "size":
                yield from collect(inner, distance)
            elif role is None:
                yield from collect(inner, distance | 1)
            else:
                yield Said(role, key, inner, distance)
        elif role in ("distortion", "doubtful") and isinstance(inner, str) and plain(inner) in POLYNOMIAL + FISHEYE:
            yield Said("distortion model", key, inner, distance)
        elif role is not None:
            yield Said(role, key, inner, distance)


def lens(key: str, value: Mapping[str, Any], distance: int) -> Iterable[Said]:
    """What the object of a distortion says: its coefficients by name or as a list, and its model."""
    own = {"type": "distortion model", "name": "distortion model"}
    own |= {"parameters": "distortion", "values": "distortion", "params": "distortion"}
    roles = [(own.get(plain(inner), role_of(inner)), inner) for inner in value]
    yield from (Said(role, inner, value[inner], distance) for role, inner in roles if role is not None)
    if not any(role in ("distortion", "radial", "tangential", *COEFFICIENTS) for role, _ in roles):
        yield Said("distortion", key, value, distance)


def nearest(said: Iterable[Said], role: str, read: Callable[[Said], Read | None]) -> Read | None:
    """The nearest value that `read` finds. Two at the same distance must agree."""
    found: tuple[Said, Read] | None = None
    for one in sorted((one for one in said if one.role == role), key=lambda one: one.distance):
        if found is not None and found[0].distance < one.distance:
            break
        value = read(one)
        if value is None:
            continue
        if found is not None and found[1] != value:
            raise ValueError(f"`{found[0].key}` is {short(found[0].value)}, but `{one.key}` is {short(one.value)}")
        found = found or (one, value)
    return None if found is None else found[1]


def camera_of(k: tuple[float, ...], said: Iterable[Said], rectified: bool) -> Found:
    said = tuple(said)
    edges = (nearest(said, "width", edge), nearest(said, "height", edge))
    size = nearest(said, "size", size_of) or nearest(said, "shape", size_of) or edges
    if any(one is not None and one != other for one, other in zip(edges, size)):
        raise ValueError(f"two sizes of the images: {edges} and {size}")
    coefficients, model = ((), "plumb_bob") if rectified else lens_of(said)
    scales = [nearest(said, role, unit) for role in ("unit", "units per metre")]
    scale = next((scale for scale in scales if scale is not None), None)
    if None not in scales and scales[0] != scales[1]:
        raise ValueError(f"two units of the depths: {scales[0]} m and {scales[1]} m")
    if scale is None:
        for one in filter(is_unused_unit, said):
            logger.warning(
                "`%s` is %s, which is not used; if it is the unit of the depths, give that in metres as depth_scale of the Camera",
                one.key,
                short(one.value),
            )
    return Found(k, None if size == (None, None) else size, coefficients, model, scale)


def is_unused_unit(said: Said) -> bool:
    is_pair = len(numbers(said.value) or ()) > 1
    is_unit = said.role == "unit-like" or plain(said.key) == "depthresolution"
    return is_unit and said.distance % 2 == 0 and not is_pair and number(said.value) not in (1.0, 1e-3)


def whole(value: float | None) -> int | None:
    return int(value) if value is not None and 1 <= value < 2**32 and value == int(value) else None


def edge(said: Said) -> int | None:
    pixels = whole(number(said.value))
    if plain(said.key).startswith("sensor") and (pixels is None or pixels < 100):
        # Millimetres of a chip.
        return None
    # ROS has 0 where the size is unknown.
    if pixels is None and said.distance % 2 == 0 and number(said.value) != 0:
        raise ValueError(f"`{said.key}` is {short(said.value)}, must be a number of pixels")
    return pixels


def size_of(said: Said) -> tuple[int | None, int | None] | None:
    value = said.value.lower().replace("×", "x").split("x") if isinstance(said.value, str) else said.value
    edges = [whole(edge) for edge in numbers(value) or ()]
    if said.role == "shape" and len(edges) in (2, 3) and None not in edges:
        return edges[1], edges[0]
    if said.role == "size" and len(edges) == 2 and None not in edges:
        return edges[0], edges[1]
    # The edge of a workspace, the shape of a thing, a unit, or what another object says of itself.
    if plain(said.key) in ("size", "shape", "res", "depthresolution") or said.distance % 2 == 1:
        return None
    raise ValueError(f"`{said.key}` is {short(said.value)}, must be the width and the height in pixels")


def lens_of(said: tuple[Said, ...]) -> tuple[tuple[float, ...], str]:
    """The coefficients and the model of a distortion."""

    def coefficients(said: Said) -> tuple[float, ...] | None:
        is_none = said.value is False or isinstance(said.value, str) and plain(said.value) in ("", "none")
        found = [] if is_none else numbers(said.value)
        if found is None:
            raise ValueError(
                f"`{said.key}` is {short(said.value)}, must be the numbers of the distortion; for rectified images give rectified=True"
            )
        return tuple(found)

    def coefficient(said: Said) -> float:
        found = number(said.value)
        if found is None:
            raise ValueError(f"`{said.key}` is {short(said.value)}, must be a number of the distortion")
        return found

    listed = nearest(said, "distortion", coefficients)
    named = {name: nearest(said, name, coefficient) for name in COEFFICIENTS}
    for role, names in [("radial", ("k1", "k2", "k3")), ("tangential", ("p1", "p2"))]:
        part = nearest(said, role, part_of)
        for name, value in zip(names, part or ()):
            if named[name] not in (None, value):
                raise ValueError("the distortion is in the file twice, with different numbers")
            named[name] = value
    for one in said:
        check_doubtful(one)
    models = (nearest(said, role, model_of) for role in ("distortion model", "fisheye", "camera model"))
    model = next((model for model in models if model is not None), None)
    if all(value is None for value in named.values()):
        return (listed or (), model or "plumb_bob")
    if model is None and named["p1"] is None and named["p2"] is None and named["k4"]:
        raise ValueError(
            "the distortion has k4 and no p1: name its `distortion_model`, equidistant (fisheye) or rational_polynomial"
        )
    names = ("k1", "k2", "k3", "k4") if plain(model or "") in FISHEYE else COEFFICIENTS
    of_names = tuple(named[name] or 0.0 for name in names)
    if listed is not None and (*listed, *[0.0] * (8 - len(listed)))[: len(of_names)] != of_names:
        raise ValueError("the distortion is in the file twice, with different numbers")
    return (listed or of_names, model or "plumb_bob")


def part_of(said: Said) -> tuple[float, ...] | None:
    """The radial or the tangential part of a distortion, as MATLAB has it."""
    found = numbers(said.value)
    most, parts = (3, "k1, k2 and k3") if said.role == "radial" else (2, "p1 and p2")
    if found is not None and 2 <= len(found) <= most:
        return tuple(found)
    if found is None or any(found):
        raise ValueError(f"`{said.key}` is {short(said.value)}, must be {parts} of the distortion")
    return None


def check_doubtful(said: Said) -> None:
    """Refuses what may be a distortion under another name."""
    found = all_numbers(said.value) if said.role == "doubtful" else []
    # A single number may be a distance.
    if any(found) and (len(found) > 1 or "distort" in plain(said.key)):
        raise ValueError(
            f"`{said.key}` is {short(said.value)}, which may be the distortion of the lens: name it `distortion_coefficients`, "
            "and its model `distortion_model`; for rectified images give rectified=True"
        )


def all_numbers(value: Any) -> list[float]:
    """The numbers in lists and objects of any depth."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list):
        return [number for inner in value for number in all_numbers(inner)]
    found = number(value)
    return [] if found is None else [found]


def model_of(said: Said) -> str | None:
    if said.role == "fisheye":
        is_set = said.value is True or number(said.value) == 1 or said.value == "true"
        return "equidistant" if is_set else None
    if isinstance(said.value, str):
        return said.value.split(".")[-1]
    index = whole((number(said.value) or 0) + 1)
    return REALSENSE[index - 1] if not isinstance(said.value, bool) and index is not None and index <= len(REALSENSE) else None


def unit(said: Said) -> float | None:
    """The unit of integer depths, metres."""
    value = number(said.value)
    if value is None:
        prefixes = {"": 1.0, "centi": 1e-2, "milli": 1e-3, "micro": 1e-6}
        texts = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
        texts |= {p + unit: scale for p, scale in prefixes.items() for unit in ("metre", "metres", "meter", "meters")}
        scale = texts.get(plain(said.value)) if isinstance(said.value, str) else None
    elif plain(said.key) == "scale" and 0.02 <= value < 50:
        # Scales an image or a scene.
        return None
    elif said.role == "units per metre" and value >= 1:
        scale = 1 / value
    else:
        # BOP gives it in millimetres, others in metres, or as units per metre.
        scale = 1 / value if value >= 50 else value * 1e-3 if value > 0.02 else value
    if scale is not None and 0 < scale < float("inf"):
        return scale
    if said.distance % 2 == 1:
        return None
    raise ValueError(
        f"`{said.key}` is {short(said.value)}, must be the unit of the depths: a number of metres above 0, or m, cm, mm or um"
    )


def intrinsics_of(value: Mapping[str, Any]) -> tuple[float, ...] | None:
    """The intrinsic matrix of an object."""
    found: list[tuple[str, tuple[float, ...]]] = []
    for key, inner in value.items():
        if role_of(key) != "matrix" or inner is None:
            continue
        of_key = numbers(inner)
        if of_key is not None and len(of_key) > 1:
            found.append((key, named_matrix(key, of_key)))
        elif of_key is None and isinstance(inner, list) and not any(isinstance(part, Mapping) for part in inner):
            raise ValueError(f"`{key}` is {short(inner)}, must be numbers")
        elif is_quoted(inner):
            raise ValueError(f"`{key}` is the text {short(inner)}, must be numbers without quotes")
    plains = {plain(key): key for key in reversed(list(value))}
    keys = [next((plains[name] for name in NAMES[role] if name in plains), None) for role in INTRINSICS]
    if None not in keys:
        parts = [number(value[key or ""]) for key in keys]
        for name, part in zip(keys, parts):
            if part is None:
                raise ValueError(f"`{name}` is {short(value[name or ''])}, must be a number")
        found.append((str(keys[0]), matrix_of([part or 0.0 for part in parts])))
    if not found:
        projection = projection_of(value)
        return None if projection is None else checked(projection)
    for key, other in found:
        if any(abs(one - two) > 1e-3 for one, two in zip(found[0][1], other)):
            raise ValueError(f"`{found[0][0]}` and `{key}` are different intrinsics")
    return checked(found[0][1])


def projection_of(value: Mapping[str, Any]) -> tuple[float, ...] | None:
    """The matrix of the projection matrix of an object."""
    for key, inner in value.items():
        found = numbers(inner) if role_of(key) == "projection" else None
        if found is not None and len(found) == 12:
            return named_matrix(key, found)
    return None


def named_matrix(key: str, found: list[float]) -> tuple[float, ...]:
    try:
        return matrix_of(found)
    except ValueError as error:
        raise ValueError(f"`{key}`: {error}") from None


def matrix_of(found: list[float]) -> tuple[float, ...]:
    """The matrix of nine numbers, of the twelve of a projection matrix without a translation, or of fx, fy, cx, cy."""
    if len(found) == 4:
        fx, fy, cx, cy = found
        return (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
    if len(found) == 12:
        last = found[3::4]
        if any(last):
            raise ValueError(f"the fourth column of the 3×4 matrix is {last}, must be 0")
        found = [value for row in (0, 4, 8) for value in found[row : row + 3]]
    if len(found) != 9:
        raise ValueError(f"{len(found)} numbers; an intrinsic matrix has nine, row by row")
    # Open3D has the columns one after the other.
    is_transposed = found[2] == 0 == found[5] and (found[6] or found[7])
    return tuple(found[i % 3 * 3 + i // 3] for i in range(9)) if is_transposed else tuple(found)


def checked(k: tuple[float, ...]) -> tuple[float, ...]:
    if not all(abs(value) < float("inf") for value in k):
        raise ValueError(f"the intrinsics are {k}, must be finite")
    if k[0] == 0 or k[4] == 0:
        raise ValueError("the intrinsics are 0: the camera is not calibrated")
    return k


def windowed(camera: Found, info: Mapping[str, Any]) -> Found:
    """The camera of the images that ROS sends if it crops them (`roi`) and then combines pixels (`binning`): CameraInfo has the
    intrinsics of the whole sensor."""
    roi = info.get("roi")
    roi = roi if isinstance(roi, Mapping) else {}
    offset = [number(roi.get(name)) or 0.0 for name in ("x_offset", "y_offset")]
    cropped = [int(number(roi.get(name)) or 0) for name in EDGES]
    binning = [max(int(number(info.get(name)) or 0), 1) for name in ("binning_x", "binning_y")]
    if offset == [0.0, 0.0] and cropped == [0, 0] and binning == [1, 1]:
        return camera
    fx, _, cx, _, fy, cy = camera.k[:6]
    # Pixel centres are at whole numbers.
    cx, cy = ((centre - first + 0.5) / bins - 0.5 for centre, first, bins in zip((cx, cy), offset, binning))
    k = (fx / binning[0], 0.0, cx, 0.0, fy / binning[1], cy, 0.0, 0.0, 1.0)
    sizes = [None if edge is None else (crop or edge) // bins for edge, crop, bins in zip(camera.size or (None, None), cropped, binning)]
    size = (sizes[0], sizes[1]) if any(sizes) else None
    return replace(camera, k=k, size=size, binning=(binning[0], binning[1]))
