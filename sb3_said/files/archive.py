"""Files of nested Python data and tensors: JSON for the structure, safetensors for the bytes, and no pickle.

Such a file is a zip archive of three members: ``metadata.json`` (format number, library versions), ``tree.json`` (the
nesting, with every number, string and flag) and ``tensors.safetensors`` (the arrays, named by their place in the tree).
Reading one builds only plain values, arrays and tensors, so a file from a stranger cannot run code.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import math
import os
import pathlib
import platform
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from typing import IO, Any, NamedTuple

import numpy as np
import torch as th

from sb3_said.files.atomic import PathOrFile, replacing

FORMAT = 1

_MEMBERS = {"metadata.json", "tree.json", "tensors.safetensors"}
_CHUNK = 1 << 24  # bytes read at a time: a large array never exists twice in memory
# Names the safetensors format has; any other dtype is stored as its bytes, and tree.json tells which it was.
_SAFETENSORS_NAMES = {
    "bool": "BOOL", "uint8": "U8", "int8": "I8", "uint16": "U16", "int16": "I16", "uint32": "U32", "int32": "I32",
    "uint64": "U64", "int64": "I64", "float16": "F16", "bfloat16": "BF16", "float32": "F32", "float64": "F64",
    "complex64": "C64", "float8_e4m3fn": "F8_E4M3", "float8_e5m2": "F8_E5M2",
}  # fmt: skip
# A table, not getattr: looking up an attribute of torch by a stranger's name can import modules.
_TORCH_DTYPES = {str(value).removeprefix("torch."): value for value in vars(th).values() if isinstance(value, th.dtype)}


class SavedFileError(ValueError):
    """A file cannot be read: damaged, of another kind or version, or it holds a pickle."""


class PickleRefusedError(SavedFileError):
    """A file holds a pickle, so that loading it could run code."""


def save_tree(path: PathOrFile, tree: Any, metadata: dict[str, Any] | None = None) -> None:
    """Write nested data to a file that :func:`load_tree` gives back unchanged.

    Arrays are written one after the other straight from where they lie. A path is replaced only once the new file is
    complete and on disk. Only one process at a time may write to it: what a killed one left half written is removed.

    :param path: where to write; missing folders are made. Or a binary file object, open for writing.
    :param tree: dicts (str or int keys), lists and tuples of None, bool, int, float, str, NumPy arrays and scalars, and
        tensors of any device, dtype and layout in memory. Tensors come back on the CPU, without ``requires_grad``.
    :param metadata: JSON data about the file, for :func:`load_metadata`
    :raises ValueError: for any other value, naming its place in the tree

    >>> import io
    >>> file = io.BytesIO()
    >>> save_tree(file, {"step": 3, "betas": (0.9, 0.999), "weight": th.zeros(2)})
    >>> load_tree(file)
    {'step': 3, 'betas': (0.9, 0.999), 'weight': tensor([0., 0.])}
    """
    encoder = Encoder()
    write_file(path, "tree", encoder.encode(tree, "tree"), encoder.blobs, metadata)


def load_tree(path: PathOrFile) -> Any:
    """Read what :func:`save_tree` wrote.

    :param path: the file's path, or a seekable binary file object
    :raises ValueError: if it is no such file, is damaged, or comes from a newer version of this package
    """
    saved = read_file(path, "tree")
    with readable(path):
        return Decoder(saved.blobs).decode(saved.root)


def load_metadata(path: PathOrFile) -> dict[str, Any]:
    """Read a file's description: ``format``, ``kind``, ``versions``, and under ``metadata`` what its writer added.

    :raises ValueError: as :func:`load_tree`
    """
    with readable(path), _open_archive(path) as archive:
        return _read_metadata(archive)


class Encoder:
    """Turns values into JSON nodes and puts their arrays aside, by name, in ``blobs``.

    A JSON object with one key that starts with ``!`` stands for what JSON lacks.
    """

    def __init__(self) -> None:
        self.blobs: dict[str, th.Tensor | np.ndarray] = {}

    def encode(self, value: Any, where: str) -> Any:
        """
        :param where: the value's place, as Python would write it, for error messages and array names
        :raises ValueError: if the value or a part of it cannot be written
        """
        # Exact types: a subclass would come back as its parent.
        if value is None or type(value) in (bool, int, str):
            return value
        if type(value) is float:
            return value if math.isfinite(value) else {"!float": repr(value)}
        if type(value) in (list, tuple):
            nodes = [self.encode(item, f"{where}[{index}]") for index, item in enumerate(value)]
            return nodes if type(value) is list else {"!tuple": nodes}
        if type(value) in (dict, OrderedDict):
            return self._encode_dict(value, where)
        if isinstance(value, th.Tensor):
            if value.layout != th.strided or value.is_quantized or value.device.type == "meta":
                raise ValueError(f"{where}: only dense tensors can be saved, not {value.layout} {value.dtype}.")
            self.blobs[where] = value.detach()
            return {"!tensor": [where, str(value.dtype).removeprefix("torch."), list(value.shape)]}
        if type(value) is np.ndarray or isinstance(value, np.generic):
            array = np.asarray(value)
            _check_dtype(array.dtype, where)
            self.blobs[where] = array
            tag = "!array" if type(value) is np.ndarray else "!scalar"
            return {tag: [where, array.dtype.str, list(array.shape)]}
        return self.encode_other(value, where)

    def encode_other(self, value: Any, where: str) -> Any:
        """Encode what a tree has no room for; a subclass that knows more overrides this."""
        raise ValueError(
            f"{where}: cannot save {value!r:.100} of type {type(value).__qualname__}. Expected dict, list, tuple, None,"
            " bool, int, float, str, a tensor, or a NumPy array or scalar: convert it first."
        )

    def _encode_dict(self, value: dict[Any, Any], where: str) -> Any:
        for key in value:
            if type(key) not in (str, int):
                raise ValueError(f"{where}: keys must be str or int, not {key!r} of type {type(key).__qualname__}.")
        items = [(key, self.encode(item, f"{where}[{key!r}]")) for key, item in value.items()]
        if all(type(key) is str and not key.startswith("!") for key in value):
            return dict(items)
        return {"!dict": items}


class Decoder:
    """The inverse of :class:`Encoder`.

    :param blobs: bytes of the arrays by name, each (n_bytes,) uint8; they become the arrays, without a copy
    :param device: where tensors go
    """

    def __init__(self, blobs: dict[str, np.ndarray], device: th.device | str = "cpu") -> None:
        self.blobs = blobs
        self.device = device

    def decode(self, node: Any) -> Any:
        """:raises ValueError: if the node is not one that :class:`Encoder` writes; damage may raise other errors"""
        if isinstance(node, list):
            return [self.decode(item) for item in node]
        if not isinstance(node, dict):
            return node
        tag = next(iter(node), "")
        if not tag.startswith("!"):
            return {key: self.decode(item) for key, item in node.items()}
        content = node[tag]
        if tag == "!float":
            return float(content)
        if tag == "!tuple":
            return tuple(self.decode(item) for item in content)
        if tag == "!dict":
            return {key: self.decode(item) for key, item in content}
        if tag == "!tensor":
            return self._tensor(*content).to(self.device)
        if tag == "!array":
            return self._array(*content)
        if tag == "!scalar":
            return self._array(*content)[()]
        return self.decode_other(tag, content)

    def decode_other(self, tag: str, content: Any) -> Any:
        """Decode what :meth:`Encoder.encode_other` of the matching subclass wrote."""
        raise SavedFileError(f"unknown entry {tag!r}")

    def _array(self, name: str, dtype: str, shape: list[int]) -> np.ndarray:
        # A stranger's bytes read as object pointers would be an attack: the check comes before the view.
        numpy_dtype = _check_dtype(np.dtype(dtype), name)
        return self._blob(name, numpy_dtype == np.bool_).view(numpy_dtype).reshape(shape)

    def _tensor(self, name: str, dtype: str, shape: list[int]) -> th.Tensor:
        if not self.blobs[name].size:  # torch cannot view nothing
            return th.empty(shape, dtype=torch_dtype(dtype))
        return th.from_numpy(self._blob(name, dtype == "bool")).view(torch_dtype(dtype)).reshape(shape)

    def _blob(self, name: str, is_bool: bool) -> np.ndarray:
        # NumPy and torch rely on bools being 0 or 1 in memory.
        return (self.blobs[name] != 0).view(np.uint8) if is_bool else self.blobs[name]


class SavedFile(NamedTuple):
    """The content of a file, before decoding."""

    root: Any  # the node of tree.json
    blobs: dict[str, np.ndarray]  # name -> (n_bytes,) uint8
    metadata: dict[str, Any]


def write_file(
    target: PathOrFile,
    kind: str,
    root: Any,
    blobs: dict[str, th.Tensor | np.ndarray],
    metadata: dict[str, Any] | None = None,
) -> None:
    """Write encoded data; everything that can be wrong with it is found before the target is touched.

    :param kind: what the file is, checked on reading
    :raises ValueError: if the metadata is not JSON, or the target is a folder
    """
    description = {"format": FORMAT, "kind": kind, "versions": _versions(), "metadata": metadata or {}}
    try:
        description_json = json.dumps(description, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"metadata must be JSON: dict, list, str, finite numbers, bool or None. {error}.") from error
    root_json = json.dumps(root, allow_nan=False)
    with replacing(target) as file, zipfile.ZipFile(file, "w") as archive:
        # ZipInfo without a date: equal content gives equal bytes.
        archive.writestr(zipfile.ZipInfo("metadata.json"), description_json)
        archive.writestr(zipfile.ZipInfo("tree.json"), root_json)
        with archive.open(zipfile.ZipInfo("tensors.safetensors"), "w", force_zip64=True) as member:
            _write_tensors(member, blobs)


def read_file(source: PathOrFile, kind: str) -> SavedFile:
    """
    :raises SavedFileError: if the source is damaged, foreign, of another kind, or newer than this package
    """
    with readable(source), _open_archive(source) as archive:
        metadata = _read_metadata(archive)
        if metadata["kind"] != kind:
            raise SavedFileError(f"it holds data of kind {metadata['kind']!r}, where {kind!r} was expected")
        root = json.loads(archive.read("tree.json"))
        n_bytes = archive.getinfo("tensors.safetensors").file_size
        with archive.open("tensors.safetensors") as member:
            return SavedFile(root, _read_tensors(member, n_bytes), metadata)


@contextlib.contextmanager
def readable(source: PathOrFile) -> Iterator[None]:
    """Turn whatever goes wrong while reading a damaged or forged file into one kind of error that names the file."""
    try:
        yield
    except MemoryError:
        raise
    except SavedFileError as error:
        raise type(error)(f"Cannot load {_name(source)}: {error}.") from error
    except Exception as error:
        if isinstance(error, OSError) and error.filename is not None:
            raise  # from opening the file, and says so: not there, no permission
        raise SavedFileError(
            f"Cannot load {_name(source)}: the file is damaged, incomplete, or was not written by sb3_said"
            f" ({type(error).__name__}: {error}). Get or save the file again."
        ) from error


@contextlib.contextmanager
def _open_archive(source: PathOrFile) -> Iterator[zipfile.ZipFile]:
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(open(source, "rb")) if isinstance(source, (str, os.PathLike)) else source
        try:
            archive = stack.enter_context(zipfile.ZipFile(file))
        except zipfile.BadZipFile:
            file.seek(0)
            if file.read(1) == b"\x80":  # the first byte of every pickle since protocol 2, torch's old format included
                raise PickleRefusedError("it is a pickle") from None
            raise
        names = archive.namelist()
        pickles = [name for name in names if pathlib.PurePath(name).suffix in (".pth", ".pt", ".pkl", ".pickle")]
        # Stable-Baselines3 puts pickles, as base64 text, into the JSON file "data".
        if "data" in names and b":serialized:" in archive.read("data"):
            pickles.append("data")
        if pickles:
            raise PickleRefusedError(f"its members {', '.join(sorted(pickles))} hold pickles")
        if set(names) != _MEMBERS or len(names) != len(_MEMBERS):
            raise SavedFileError(f"expected an archive of {sorted(_MEMBERS)}, got {sorted(names)[:10]}")
        if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
            raise SavedFileError("its members are compressed, which sb3_said never does and a zip bomb needs")
        yield archive


def _read_metadata(archive: zipfile.ZipFile) -> dict[str, Any]:
    metadata = json.loads(archive.read("metadata.json"))
    if metadata["format"] > FORMAT:
        raise SavedFileError(
            f"its format number is {metadata['format']}, this sb3_said reads up to {FORMAT}: upgrade sb3_said"
            f" (the file was written with {metadata.get('versions')})"
        )
    return metadata


def _write_tensors(file: IO[bytes], blobs: dict[str, th.Tensor | np.ndarray]) -> None:
    """The safetensors format: length of the header (8 bytes), header (JSON), then the arrays' bytes without gaps.

    Written by hand because the library needs all bytes at once, twice in memory, and refuses shared storage.
    """
    header: dict[str, Any] = {}
    offset = 0
    for name, blob in blobs.items():
        dtype = str(blob.dtype).removeprefix("torch.")
        n_bytes = blob.nbytes
        known = dtype in _SAFETENSORS_NAMES
        header[name] = {
            "dtype": _SAFETENSORS_NAMES[dtype] if known else "U8",
            "shape": list(blob.shape) if known else [n_bytes],
            "data_offsets": [offset, offset + n_bytes],
        }
        offset += n_bytes
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    file.write(len(text).to_bytes(8, "little") + text)
    for blob in blobs.values():
        file.write(_bytes_of(blob))


def _read_tensors(file: IO[bytes], n_bytes: int) -> dict[str, np.ndarray]:
    header_size = int.from_bytes(file.read(8), "little")
    header: dict[str, Any] = json.loads(file.read(header_size))
    available = n_bytes - 8 - header_size
    blobs = {}
    position = 0
    for name, entry in sorted(header.items(), key=lambda item: item[1]["data_offsets"]):
        begin, end = entry["data_offsets"]
        if not position == begin <= end <= available:
            raise SavedFileError(f"array {name!r} lies at bytes {begin} to {end} of {available}, expected {position}")
        blobs[name] = np.empty(end - begin, np.uint8)
        view = blobs[name].data
        for start in range(0, len(view), _CHUNK):
            chunk = view[start : start + _CHUNK]
            if file.readinto(chunk) != len(chunk):  # type: ignore[attr-defined]
                raise SavedFileError(f"array {name!r} is cut short")
        position = end
    if file.read(1):  # reading to the end also makes zipfile compare the checksum
        raise SavedFileError("there are bytes behind the last array")
    return blobs


def _bytes_of(blob: th.Tensor | np.ndarray) -> memoryview:
    """The bytes in C order; only a tensor on another device or an array with gaps is copied for it."""
    if isinstance(blob, th.Tensor):
        if not blob.numel():
            return memoryview(b"")
        blob = blob.cpu().resolve_conj().resolve_neg().contiguous().reshape(-1).view(th.uint8).numpy()
    return np.ascontiguousarray(blob).reshape(-1).view(np.uint8).data


def _check_dtype(dtype: np.dtype, where: str) -> np.dtype:
    if dtype.kind not in "biufcmMSU" or dtype.itemsize == 0:
        raise SavedFileError(
            f"{where}: NumPy dtype {dtype} cannot be saved, only numbers, bools, dates and non-empty strings"
        )
    return dtype


def torch_dtype(name: str) -> th.dtype:
    """
    :raises SavedFileError: if ``torch`` has no such dtype
    """
    if name not in _TORCH_DTYPES:
        raise SavedFileError(f"unknown dtype {name!r}")
    return _TORCH_DTYPES[name]


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for package in ("sb3_said", "stable_baselines3", "torch", "gymnasium", "numpy"):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "unknown"
    return versions


def _name(source: PathOrFile) -> str:
    return f"'{os.fspath(source)}'" if isinstance(source, (str, os.PathLike)) else "the file object"
