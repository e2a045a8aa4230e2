"""Nested data and arrays in one file: a zip of a JSON document and NumPy's own ``.npy`` files, without pickle.

``tree.json`` holds the structure and all that JSON knows, ``0.npy``, ``1.npy``, ... hold the arrays. Reading builds
plain values, arrays and tensors and nothing else, so a file from a stranger runs no code.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import pathlib
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th

from sb3_said.files.atomic import PathOrFile, replacing

FORMAT = 3

_MAX_DOCUMENT = 2**24  # bytes of tree.json, whose objects take twenty times as much memory
_MAX_HEADER = 1024  # bytes that describe an array of numbers; a longer text could exhaust NumPy's parser


class SavedFileError(ValueError):
    """A file cannot be read: it is damaged, foreign, forged or newer, or it does not fit what it is read into."""


def save_tree(path: PathOrFile, tree: Any, metadata: dict[str, Any] | None = None, kind: str = "tree") -> None:
    """Write nested data that :func:`load_tree` gives back unchanged.

    Arrays are written piece by piece from where they lie. A path is written as
    :func:`~sb3_said.files.atomic.replacing` does it: whole or not at all, also by several processes at a time.

    :param path: where to write; missing folders are made. Or a binary file object, open for writing.
    :param tree: dicts (str or int keys), lists and tuples of None, bool, int, float, str, tensors, and NumPy arrays and
        scalars of numbers. Tensors come back on the CPU, without ``requires_grad``.
    :param metadata: JSON data about the file, for :func:`load_metadata`
    :param kind: what the file is; reading checks it
    :raises ValueError: for any other value, naming its place, before anything is written

    >>> import io
    >>> file = io.BytesIO()
    >>> save_tree(file, {"step": 3, "betas": (0.9, 0.999), "weight": th.zeros(2)})
    >>> load_tree(file)
    {'step': 3, 'betas': (0.9, 0.999), 'weight': tensor([0., 0.])}
    """
    arrays: list[np.ndarray] = []
    root = _encode(tree, "tree", arrays)
    libraries = ("sb3_said", "stable_baselines3", "torch", "gymnasium", "numpy")
    versions = {name: sys.modules[name].__version__ for name in libraries if name in sys.modules}
    document = {"format": FORMAT, "kind": kind, "versions": versions, "metadata": metadata or {}, "tree": root}
    text = json.dumps(document)
    if len(text) > _MAX_DOCUMENT:
        raise ValueError(f"The data is too large without its arrays, {len(text)} characters; put numbers into arrays.")
    with replacing(path) as file, zipfile.ZipFile(file, "w") as archive:
        archive.writestr(zipfile.ZipInfo("tree.json"), text)  # ZipInfo without a date: equal data, equal bytes
        for index, array in enumerate(arrays):
            with archive.open(zipfile.ZipInfo(f"{index}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, version=(1, 0), allow_pickle=False)
        archive.comment = seal(archive)


def seal(archive: zipfile.ZipFile) -> bytes:
    """Return the digest of an archive's names and checksums, which :func:`save_tree` leaves as its comment.

    It shows whether a file was changed after it was saved. It is no signature: whoever writes a file can seal it.
    """
    members = "".join(f"{info.filename} {info.CRC}\n" for info in archive.infolist())
    return hashlib.sha256(members.encode()).hexdigest().encode()


def load_tree(path: PathOrFile, kind: str | None = "tree") -> Any:
    """Read what :func:`save_tree` wrote, running no code from the file.

    :param path: of the file, or a seekable binary file object
    :param kind: as it was written; None takes any
    :raises SavedFileError: if it is no such file, is damaged, or comes from a newer version of this package
    """
    with readable(path), _opened(path) as (archive, document):
        if kind not in (None, document["kind"]):
            raise SavedFileError(f"it holds data of kind {document['kind']!r}, where {kind!r} was expected")
        arrays = (_read_array(archive, f"{index}.npy") for index in range(len(archive.namelist()) - 1))
        tree = _decode(document["tree"], arrays)
        if next(arrays, None) is not None:
            raise SavedFileError("it holds more arrays than its data names")
        return tree


def to_json(tree: Any) -> Any:
    """Return a tree without arrays as a JSON document that :func:`from_json` gives back unchanged.

    :raises ValueError: for an array, and for what :func:`save_tree` does not take
    """
    arrays: list[np.ndarray] = []
    node = _encode(tree, "tree", arrays)
    if arrays:
        raise ValueError(f"JSON holds no arrays, but there is one of the shape {arrays[0].shape}.")
    return node


def from_json(node: Any) -> Any:
    """Read what :func:`to_json` returned, running no code from it."""
    return _decode(node, iter(()))


def load_metadata(path: PathOrFile) -> dict[str, Any]:
    """Read a file's description: ``format``, ``kind``, ``versions``, and under ``metadata`` what its writer added.

    :raises SavedFileError: as :func:`load_tree`
    """
    with readable(path), _opened(path) as (_, document):
        return {name: value for name, value in document.items() if name != "tree"}


@contextlib.contextmanager
def readable(source: PathOrFile, explained: tuple[type[Exception], ...] = (SavedFileError,)) -> Iterator[None]:
    """Turn whatever goes wrong while reading a damaged or forged file into one error that names the file.

    :param explained: errors that already say what is wrong
    """
    name = f"'{os.fspath(source)}'" if isinstance(source, (str, os.PathLike)) else "the file object"
    try:
        yield
    except explained as error:
        raise SavedFileError(f"Cannot load {name}: {str(error).rstrip('.')}.") from error
    except Exception as error:
        is_others = isinstance(error, (Warning, th.OutOfMemoryError))  # no fault of the file
        if is_others or (isinstance(error, OSError) and error.filename is not None):
            raise  # an OSError with a name is from opening the file, and says so
        if isinstance(error, MemoryError):
            raise SavedFileError(
                f"Cannot load {name}: what it says it holds needs more memory than there is."
            ) from error
        raise SavedFileError(
            f"Cannot load {name}: the file is damaged, incomplete, or was not written by sb3_said"
            f" ({type(error).__name__}: {error}). Get or save the file again."
        ) from error


def _encode(value: Any, where: str, arrays: list[np.ndarray]) -> Any:
    """Return a JSON node and put arrays aside, in order. An object with a key ``!...`` stands for what JSON lacks."""
    if value is None or type(value) in (bool, int, float, str):  # exact types: a subclass would come back as its parent
        return value
    if type(value) in (list, tuple):
        nodes = [_encode(item, f"{where}[{index}]", arrays) for index, item in enumerate(value)]
        return nodes if type(value) is list else {"!tuple": nodes}
    if type(value) in (dict, OrderedDict):
        if odd := [key for key in value if type(key) not in (str, int)]:
            raise ValueError(f"{where}: cannot save the key {odd[0]!r}; keys must be str or int.")
        items = [[key, _encode(item, f"{where}[{key!r}]", arrays)] for key, item in value.items()]
        is_plain = all(type(key) is str and not key.startswith("!") for key in value)
        return dict(items) if is_plain else {"!dict": items}
    try:
        if isinstance(value, th.Tensor):
            kind, array = "tensor", value.numpy(force=True)
        elif isinstance(value, (np.ndarray, np.generic)):
            kind, array = "array" if isinstance(value, np.ndarray) else "scalar", np.asarray(value)
        else:
            raise TypeError("expected dict, list, tuple, None, bool, int, float, str, a tensor or an array")
        _check_dtype(array.dtype)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{where}: cannot save {value!r:.100} of type {type(value).__name__}: {error}.") from error
    arrays.append(array)
    return {"!array": kind}


def _decode(node: Any, arrays: Iterator[np.ndarray]) -> Any:
    if isinstance(node, list):
        return [_decode(item, arrays) for item in node]
    if not isinstance(node, dict):
        return node
    if not any(key.startswith("!") for key in node):
        return {key: _decode(item, arrays) for key, item in node.items()}
    ((tag, content),) = node.items()
    if tag == "!tuple":
        return tuple(_decode(item, arrays) for item in content)
    if tag == "!dict":
        pairs = [(key, _decode(item, arrays)) for key, item in content]
        if any(type(key) not in (str, int) for key, _ in pairs):
            raise SavedFileError("it has keys other than str and int")
        return dict(pairs)
    if tag != "!array" or content not in ("tensor", "array", "scalar"):
        raise SavedFileError(f"unknown entry {tag!r}")
    array = next(arrays)
    return th.from_numpy(array) if content == "tensor" else array if content == "array" else array[()]


@contextlib.contextmanager
def _opened(source: PathOrFile) -> Iterator[tuple[zipfile.ZipFile, dict[str, Any]]]:
    """Open an archive and read its document, once its members have the names and sizes of :func:`save_tree`."""
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(open(source, "rb")) if isinstance(source, (str, os.PathLike)) else source
        n_bytes = file.seek(0, os.SEEK_END)
        try:
            archive = stack.enter_context(zipfile.ZipFile(file))
        except zipfile.BadZipFile:
            file.seek(0)
            _refuse_pickle(file.read(1) == b"\x80")  # the first byte of every pickle since protocol 2
            raise
        names = archive.namelist()
        _refuse_pickle("data" in names or any(name.endswith((".pth", ".pkl")) for name in names))
        if set(names) != {"tree.json", *(f"{index}.npy" for index in range(len(names) - 1))}:
            raise SavedFileError(f"expected an archive of tree.json, 0.npy, 1.npy, ..., got {sorted(names)[:10]}")
        if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
            raise SavedFileError("its members are compressed, which sb3_said never does and a zip bomb needs")
        if sum(info.file_size for info in archive.infolist()) > n_bytes:
            raise SavedFileError("its members claim to be larger than the file")
        if archive.getinfo("tree.json").file_size > _MAX_DOCUMENT:
            raise SavedFileError(f"its tree.json is larger than {_MAX_DOCUMENT} bytes, which sb3_said never writes")
        document = json.loads(archive.read("tree.json"))
        if document["format"] > FORMAT:
            raise SavedFileError(
                f"its format number is {document['format']}, this sb3_said reads up to {FORMAT}: upgrade sb3_said"
                f" (the file was written with {document.get('versions')!s:.200})"
            )
        if archive.comment != seal(archive):
            raise SavedFileError("it was changed after sb3_said wrote it")
        yield archive, document


def _refuse_pickle(is_pickle: bool) -> None:
    if is_pickle:
        raise SavedFileError(
            "it holds a pickle, as Stable-Baselines3's own files do, and unpickling runs whatever code its author put"
            " there. If you trust the author, load it with Stable-Baselines3. Of an agent, such as SAC.load(path), hand"
            " over what it learned: set_parameters(loaded.get_parameters()). StableSAC and SAID have more than it, and"
            " learn in other units: make them with normalise_states=False, scale_rewards=False, and add"
            " exact_match=False. Of a replay buffer, SAID.learn_offline takes the loaded one"
        )


def _read_array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Read an array piece by piece, once its header is known to fit the member's size."""
    with archive.open(name) as member:
        if np.lib.format.read_magic(member) != (1, 0):
            raise SavedFileError(f"{name} is of another version of NumPy's format than 1.0")
        read_header: Any = np.lib.format.read_array_header_1_0  # Any: its type lacks max_header_size in NumPy 2.2
        shape, _, dtype = read_header(member, max_header_size=_MAX_HEADER)
        _check_dtype(dtype)  # a stranger's bytes as object pointers would be an attack
        n_bytes = member.tell() + math.prod(shape) * dtype.itemsize
        if min(shape, default=0) < 0 or n_bytes != archive.getinfo(name).file_size:
            raise SavedFileError(f"{name} does not have the size of {dtype} in the shape {shape}")
    with archive.open(name) as member:  # opened anew: seeking back would switch the checksum off
        array = np.lib.format.read_array(member, allow_pickle=False)
    # NumPy and torch rely on bools being 0 or 1 in memory.
    return np.asarray(array.view(np.uint8) != 0) if dtype == np.bool_ else array


def _check_dtype(dtype: np.dtype) -> None:
    if dtype.kind not in "biufc":
        raise SavedFileError(f"arrays must be of numbers or bools, not {dtype}")


def with_suffix(path: PathOrFile, suffix: str) -> PathOrFile:
    """Add a suffix to the path of a new file that has none, as SB3 does."""
    if isinstance(path, (str, os.PathLike)) and pathlib.Path(path).suffix == "":
        return f"{os.fspath(path)}{suffix}"
    return path


def existing(path: PathOrFile, suffix: str = ".zip") -> PathOrFile:
    """Add a suffix where the path alone is no file, as SB3 does.

    :raises FileNotFoundError: where neither is a file
    """
    if isinstance(path, (str, os.PathLike)) and not os.path.isfile(path):
        alone, path = os.fspath(path), f"{os.fspath(path)}{suffix}"
        if not os.path.isfile(path):
            raise FileNotFoundError(f"There is no file '{alone}' and no '{path}'.")
    return path
