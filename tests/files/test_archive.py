"""Trees in files: what goes in comes out bit for bit, and damage or forgery is a clear error."""

import io
import json
import os
import pickle
import signal
import tracemalloc
import zipfile
from collections import OrderedDict, deque

import numpy as np
import pytest
import torch as th
from forked import begin
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from saving import edit, same

from sb3_said.files import archive as tree_file
from sb3_said.files.archive import SavedFileError, load_metadata, load_tree, save_tree


def round_trip(tree):
    file = io.BytesIO()
    save_tree(file, tree)
    return load_tree(file)


# --- trees ---

arrays = hnp.arrays(
    st.one_of(
        hnp.boolean_dtypes(),
        hnp.integer_dtypes(endianness="?"),
        hnp.floating_dtypes(endianness="?"),
        hnp.complex_number_dtypes(),
    ),
    hnp.array_shapes(min_dims=0, min_side=0, max_dims=3, max_side=4),
)
tensors = arrays.filter(
    lambda array: array.dtype.isnative and array.dtype.kind in "biufc" and array.dtype.char not in "gG"
).map(th.from_numpy)
leaves = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(st.characters()), arrays, tensors,
    arrays.filter(lambda array: array.ndim == 0).map(lambda array: array[()]),
)  # fmt: skip
trees = st.recursive(
    leaves,
    lambda children: st.one_of(
        st.lists(children, max_size=4),
        st.lists(children, max_size=4).map(tuple),
        st.dictionaries(st.one_of(st.text(max_size=5), st.integers(), st.just("!tuple")), children, max_size=4),
    ),
    max_leaves=8,
)


@settings(max_examples=80, deadline=None)
@given(trees)
def test_a_tree_comes_back_bit_for_bit(tree):
    assert same(tree, round_trip(tree))


def test_layouts_in_memory():
    base = th.arange(12.0).reshape(3, 4)
    parameter = th.nn.Parameter(base.clone())
    tree = {
        "transposed": base.T,
        "strided": base[:, ::2],
        "shared": base,
        "shared again": base[1],
        "expanded": th.ones(1).expand(4),
        "conjugate": th.tensor([1 + 2j]).conj(),
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "reversed": np.arange(5)[::-1],
        "empty": np.zeros((0, 3)),
        "big endian": np.arange(3, dtype=">i4"),
    }
    assert same(tree, round_trip(tree))
    loaded = round_trip({"parameter": parameter})["parameter"]
    assert type(loaded) is th.Tensor and not loaded.requires_grad and loaded.equal(parameter)
    loaded += 1  # memory of its own, writable


def test_ordered_dicts_become_dicts_in_their_order():
    assert list(round_trip(OrderedDict(b=1, a=2)).items()) == [("b", 1), ("a", 2)]


@pytest.mark.parametrize(
    ("value", "place"),
    [
        (lambda: None, r"tree\['a'\]\[1\]"),
        ({1, 2}, r"tree\['a'\]\[1\]"),
        (np.array([None]), r"tree\['a'\]\[1\]"),
        ({(1, 2): 0}, r"tree\['a'\]\[1\].*keys"),
        (spaces.Discrete(2), r"tree\['a'\]\[1\]"),
        (th.zeros(3, device="meta"), r"tree\['a'\]\[1\]"),
        (th.eye(2).to_sparse(), r"tree\['a'\]\[1\]"),
        (deque([1]), r"tree\['a'\]\[1\]"),
        (np.zeros(2, [("x", "f4")]), r"tree\['a'\]\[1\]"),
        (np.array(["text"]), r"tree\['a'\]\[1\].*numbers or bools"),
        (th.zeros(2, dtype=th.bfloat16), r"tree\['a'\]\[1\].*BFloat16"),
    ],
)
def test_what_a_tree_cannot_hold_is_refused_with_its_place(value, place, tmp_path):
    with pytest.raises(ValueError, match=place):
        save_tree(tmp_path / "tree.zip", {"a": [0, value]})
    assert list(tmp_path.iterdir()) == []


def test_metadata(tmp_path):
    save_tree(tmp_path / "new" / "folder" / "tree", 1, {"step": 5})
    description = load_metadata(tmp_path / "new" / "folder" / "tree")
    assert description["metadata"] == {"step": 5}
    assert description["format"] == tree_file.FORMAT
    assert description["versions"]["torch"].split("+")[0] == th.__version__.split("+")[0]  # wheels may hide the build


def test_the_arrays_are_numpys_own_files():
    file = io.BytesIO()
    save_tree(file, {"weight": th.arange(12.0).reshape(3, 4), "flags": np.array([True, False])})
    file.seek(0)
    with np.load(file) as arrays:  # a zip of .npy files is NumPy's .npz
        assert same(arrays["0"], np.arange(12, dtype=np.float32).reshape(3, 4))
        assert same(arrays["1"], np.array([True, False]))
    with zipfile.ZipFile(file) as archive:
        assert {info.compress_type for info in archive.infolist()} == {zipfile.ZIP_STORED}


@pytest.mark.parametrize("make", [np.asfortranarray, lambda array: array[:, ::2], th.from_numpy])
def test_a_large_array_never_exists_twice(make, tmp_path):
    array = make(np.arange(20e6, dtype=np.float32).reshape(4, -1))
    tracemalloc.start()
    save_tree(tmp_path / "tree", {"array": array})
    assert tracemalloc.get_traced_memory()[1] < 40e6  # two pieces of 16 MiB, of 40 to 80 MB
    tracemalloc.reset_peak()
    loaded = load_tree(tmp_path / "tree")["array"]
    assert tracemalloc.get_traced_memory()[1] < loaded.nbytes + 5e6
    tracemalloc.stop()
    assert np.array_equal(loaded, array)


def test_equal_trees_give_equal_bytes():
    first, second = io.BytesIO(), io.BytesIO()
    save_tree(first, {"a": th.ones(3)})
    save_tree(second, {"a": th.ones(3)})
    assert first.getvalue() == second.getvalue()


def save_killed_amid_arrays(path):
    write, left = np.lib.format.write_array, [1, 2]

    def killed(*args, **kwargs):
        left.pop() if left else os.kill(os.getpid(), signal.SIGKILL)
        write(*args, **kwargs)

    np.lib.format.write_array = killed
    save_tree(path, [np.zeros(3_000_000)] * 4)


def test_a_kill_in_the_middle_of_a_write_leaves_the_old_file(tmp_path):
    save_tree(tmp_path / "tree", "old")
    killed = begin(tmp_path / "output.txt", save_killed_amid_arrays, tmp_path / "tree")
    killed.join()
    assert killed.exitcode == -signal.SIGKILL and load_tree(tmp_path / "tree") == "old"
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) > 2 * 24e6  # it was amid the new one


# --- files that are not what they should be ---


def test_every_truncation_is_a_clear_error(tmp_path):
    path = tmp_path / "tree"
    save_tree(path, {"a": th.ones(30), "b": "text"})
    content = path.read_bytes()
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match="Cannot load"):
            load_tree(path)


@settings(max_examples=80, deadline=None)
@given(st.data())
def test_a_flipped_byte_is_an_error_or_harmless(data):
    file = io.BytesIO()
    tree = {"a": th.ones(5), "b": [1, "text"], "c": np.zeros(3, bool)}
    save_tree(file, tree)
    content = bytearray(file.getvalue())
    content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        loaded = load_tree(io.BytesIO(content))
    except ValueError as error:
        assert "Cannot load" in str(error)
    else:
        assert same(tree, loaded)


@pytest.mark.parametrize(
    "tree",
    [
        {"!array": "object"},
        {"!array": ["tensor"]},
        {"!array": "tensor", "more": 1},
        [{"!array": "tensor"}, {"!array": "tensor"}],
        None,
        {"!class": "torch.nn.ReLU"},
        {"!object": ["gymnasium.Discrete", {"n": 2}]},
        {"!dict": [[[], {"!array": "tensor"}]]},
        {"!tuple": 3},
    ],
    ids=str,
)
def test_forged_entries_are_refused(tree, tmp_path):
    save_tree(tmp_path / "tree", th.zeros(1, dtype=th.float64))
    edit(tmp_path / "tree", lambda members: members | {"tree.json": with_tree(members, tree)})
    with pytest.raises(SavedFileError, match="Cannot load"):
        load_tree(tmp_path / "tree")


def with_tree(members, tree):
    return json.dumps(json.loads(members["tree.json"]) | {"tree": tree})


def test_deep_nesting_is_refused(tmp_path):
    save_tree(tmp_path / "tree", 1)
    edit(tmp_path / "tree", lambda members: {"tree.json": "[" * 200_000 + "]" * 200_000})
    with pytest.raises(SavedFileError, match="Cannot load"):
        load_tree(tmp_path / "tree")


def test_bools_are_zero_or_one_whatever_the_file_says(tmp_path):
    save_tree(tmp_path / "tree", [th.zeros(2, dtype=th.bool), np.zeros(2, bool), np.False_])
    edit(
        tmp_path / "tree",
        lambda members: {
            name: content if name == "tree.json" else content.replace(b"\n\0", b"\n\x07")
            for name, content in members.items()
        },
    )
    tensor, array, scalar = load_tree(tmp_path / "tree")
    assert tensor.view(th.uint8).tolist() == [1, 0] and array.view(np.uint8).tolist() == [1, 0]
    assert scalar.tobytes() == b"\1"


def header(text):
    text = text.encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(
    ("descr", "shape", "content"),
    [
        ("'<f8'", "(1000000000000000,)", bytes(8)),
        ("'<f8'", "(2,)", bytes(8)),
        ("'<f8'", "(1,)", bytes(16)),
        ("'<f8'", "(-1, -1)", bytes(8)),
        ("'<f8'", "(2**62, 4)", b""),
        ("'<f8'", "(0, 99999999999999999999999)", b""),
        ("'|O'", "(1,)", bytes(8)),
        ("'|O'", "(1,)", pickle.dumps([None])),
        ("[('x', '|O')]", "(1,)", bytes(8)),
        ("'|V8'", "(1,)", bytes(8)),
        ("'|V0'", "(99999999999999,)", b""),
        ("'<U2'", "(1,)", bytes(8)),
        ("-" * 40000 + "1", "()", b""),
        ("(" * 900, "()", b""),
        ("-" * 900 + "1", "()", b""),
    ],
    ids=lambda value: str(value)[:20],
)
def test_forged_headers_are_refused_before_memory_is_taken(descr, shape, content, tmp_path):
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}"
    save_tree(tmp_path / "tree", th.zeros(1, dtype=th.float64))
    edit(tmp_path / "tree", lambda members: members | {"0.npy": header(text) + content})
    tracemalloc.start()
    with pytest.raises(SavedFileError, match="Cannot load"):
        load_tree(tmp_path / "tree")
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


@pytest.mark.parametrize("names", [["extra.txt"], ["../0.npy"], ["1.npy", "3.npy"], ["1.npy"]], ids=str)
def test_members_that_do_not_belong_are_refused(names, tmp_path):
    save_tree(tmp_path / "tree", th.zeros(1))
    edit(tmp_path / "tree", lambda members: members | dict.fromkeys(names, members["0.npy"]))
    with pytest.raises(SavedFileError, match=r"expected an archive of|more arrays"):
        load_tree(tmp_path / "tree")


def test_names_are_looked_at_before_any_content(tmp_path, monkeypatch):
    save_tree(tmp_path / "tree", th.zeros(1))
    edit(tmp_path / "tree", lambda members: members | {"extra": b""})
    monkeypatch.setattr(zipfile.ZipFile, "open", None)
    with pytest.raises(SavedFileError, match="expected an archive of"):
        load_tree(tmp_path / "tree")


def test_a_member_that_claims_to_be_larger_than_the_file_is_refused(tmp_path, monkeypatch):
    save_tree(tmp_path / "tree", th.zeros(1))
    infolist = zipfile.ZipFile.infolist

    def lying(archive):
        infos = infolist(archive)
        infos[-1].file_size = 10**15
        return infos

    monkeypatch.setattr(zipfile.ZipFile, "infolist", lying)
    with pytest.raises(SavedFileError, match="larger than the file"):
        load_tree(tmp_path / "tree")


def test_zip_bombs_are_refused(tmp_path):
    save_tree(tmp_path / "tree", 1)
    with (
        zipfile.ZipFile(tmp_path / "tree") as old,
        zipfile.ZipFile(tmp_path / "bomb", "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for name in old.namelist():
            new.writestr(name, old.read(name))
    with pytest.raises(SavedFileError, match="compressed"):
        load_tree(tmp_path / "bomb")


def test_a_newer_format_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(tree_file, "FORMAT", 4)
    save_tree(tmp_path / "tree", 1)
    monkeypatch.undo()
    with pytest.raises(SavedFileError, match="format number is 4, this sb3_said reads up to 3: upgrade"):
        load_tree(tmp_path / "tree")
    with pytest.raises(FileNotFoundError):
        load_tree(tmp_path / "nowhere")


def test_a_file_that_was_changed_after_it_was_saved_is_refused(tmp_path):
    path = tmp_path / "tree"
    save_tree(path, {"weight": th.ones(3), "name": "a"})
    edit(path, lambda members: members)
    assert load_tree(path)["name"] == "a"
    for older in (b'"format": 3', b'"format": 2'):
        document = zipfile.ZipFile(path).read("tree.json").replace(b'"format": 3', older)
        edit(path, lambda members, document=document: members | {"tree.json": document}, sealed=False)
        with pytest.raises(SavedFileError, match="changed after sb3_said wrote it"):
            load_tree(path)
    for name, before, after in (("tree.json", b'"a"', b'"b"'), ("0.npy", th.ones(1), th.ones(1) + 1)):
        save_tree(path, {"weight": th.ones(3), "name": "a"})
        before, after = (x if isinstance(x, bytes) else x.numpy().tobytes() for x in (before, after))
        comment = zipfile.ZipFile(path).comment
        edit(path, lambda members: members | {name: members[name].replace(before, after)})  # noqa: B023
        assert zipfile.ZipFile(path).comment != comment
        with zipfile.ZipFile(path, "a") as archive:
            archive.comment = comment
        with pytest.raises(SavedFileError, match="changed after sb3_said wrote it"):
            load_tree(path)


def test_a_document_of_many_small_things_is_refused(tmp_path):
    with pytest.raises(ValueError, match="put numbers into arrays"):
        save_tree(tmp_path / "tree", [-1.2345678901234567e-100] * 700_000)
    save_tree(tmp_path / "tree", 1)
    edit(tmp_path / "tree", lambda members: {"tree.json": "[" + "[]," * 6_000_000 + "1]"})
    tracemalloc.start()
    with pytest.raises(SavedFileError, match=r"tree\.json is larger"):
        load_tree(tmp_path / "tree")
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


def test_too_little_memory_is_said(tmp_path, monkeypatch):
    save_tree(tmp_path / "tree", th.ones(3))

    def exhausted(*_, **__):
        raise MemoryError

    monkeypatch.setattr("numpy.lib.format.read_array", exhausted)
    with pytest.raises(SavedFileError, match="more memory than there is"):
        load_tree(tmp_path / "tree")
