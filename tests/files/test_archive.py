"""Trees in files: what goes in comes out bit for bit, and damage or forgery is a clear error."""

import io
import json
import zipfile
from collections import OrderedDict, deque

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from safetensors.torch import load as load_safetensors
from saving import edit, same

from sb3_said.files import archive as tree_file
from sb3_said.files.archive import load_metadata, load_tree, save_tree


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
        hnp.unicode_string_dtypes(),
        hnp.datetime64_dtypes(),
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


@settings(max_examples=150, deadline=None)
@given(trees)
def test_a_tree_comes_back_bit_for_bit(tree):
    assert same(tree, round_trip(tree))


@pytest.mark.filterwarnings("ignore:ComplexHalf", "ignore:torch.quantize_per_tensor")
@pytest.mark.parametrize(
    "dtype", sorted({value for value in vars(th).values() if isinstance(value, th.dtype)}, key=str)
)
def test_every_dtype(dtype):
    tensor = th.arange(24, dtype=th.uint8).tile(16)[: 24 * dtype.itemsize].clone()
    tensor = (tensor % 2).bool() if dtype == th.bool else tensor.view(dtype)
    tree = {"vector": tensor, "scalar": tensor[0], "empty": tensor[:0].reshape(0, 3)}
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
    with pytest.raises(ValueError, match="metadata must be JSON"):
        save_tree(tmp_path / "tree", 1, {"array": np.zeros(1)})


def test_the_tensors_are_a_safetensors_file():
    file = io.BytesIO()
    tree = {"weight": th.randn(3, 4), "flags": th.tensor([True, False, True]), "half": th.randn(5).bfloat16()}
    save_tree(file, tree)
    with zipfile.ZipFile(file) as archive:
        loaded = load_safetensors(archive.read("tensors.safetensors"))
        assert {info.compress_type for info in archive.infolist()} == {zipfile.ZIP_STORED}
    assert same({f"tree[{name!r}]": tensor for name, tensor in sorted(tree.items())}, dict(sorted(loaded.items())))


def test_equal_trees_give_equal_bytes():
    first, second = io.BytesIO(), io.BytesIO()
    save_tree(first, {"a": th.ones(3)})
    save_tree(second, {"a": th.ones(3)})
    assert first.getvalue() == second.getvalue()


@pytest.mark.parametrize("optimizer_class", [th.optim.Adam, th.optim.AdamW, th.optim.SGD])
def test_an_optimizer_goes_on_as_if_never_saved(optimizer_class, tmp_path):
    def step(network, optimizer):
        optimizer.zero_grad()
        network(th.linspace(-1, 1, 12).reshape(4, 3)).square().sum().backward()
        optimizer.step()

    def build():
        network = th.nn.Linear(3, 2)
        return network, optimizer_class(network.parameters(), lr=0.01)

    network, optimizer = build()
    for _ in range(3):
        step(network, optimizer)
    save_tree(tmp_path / "checkpoint", {"network": network.state_dict(), "optimizer": optimizer.state_dict()})

    tree = load_tree(tmp_path / "checkpoint")
    resumed_network, resumed_optimizer = build()
    resumed_network.load_state_dict(tree["network"])
    resumed_optimizer.load_state_dict(tree["optimizer"])
    assert same(optimizer.state_dict(), resumed_optimizer.state_dict())
    for _ in range(3):
        step(network, optimizer)
        step(resumed_network, resumed_optimizer)
    assert same(dict(network.state_dict()), dict(resumed_network.state_dict()))
    assert same(optimizer.state_dict(), resumed_optimizer.state_dict())


# --- files that are not what they should be ---


def test_every_truncation_is_a_clear_error(tmp_path):
    path = tmp_path / "tree"
    save_tree(path, {"a": th.ones(30), "b": "text"})
    content = path.read_bytes()
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match="Cannot load"):
            load_tree(path)


@settings(max_examples=150, deadline=None)
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
        {"!tensor": ["tree", "save", [1]]},
        {"!tensor": ["nothing", "float32", [1]]},
        {"!tensor": ["tree", "float32", [3]]},
        {"!array": ["tree", "O", []]},
        {"!array": ["tree", "V8", [1]]},
        {"!class": "torch.nn.ReLU"},
        {"!object": ["gymnasium.Discrete", {"n": 2}]},
        {"!unheard": 1},
        {"!dict": [[[], 1]]},
    ],
)
def test_forged_entries_are_refused(tree, tmp_path):
    save_tree(tmp_path / "tree", th.zeros(1, dtype=th.float64))
    edit(tmp_path / "tree", lambda members: members | {"tree.json": json.dumps(tree)})
    with pytest.raises(ValueError, match="Cannot load"):
        load_tree(tmp_path / "tree")


def test_bools_are_zero_or_one_whatever_the_file_says(tmp_path):
    save_tree(tmp_path / "tree", [th.zeros(2, dtype=th.bool), np.zeros(2, bool)])
    edit(
        tmp_path / "tree",
        lambda members: members | {"tensors.safetensors": members["tensors.safetensors"][:-4] + b"\x07\x00\x07\x00"},
    )
    tensor, array = load_tree(tmp_path / "tree")
    assert tensor.view(th.uint8).tolist() == [1, 0] and array.view(np.uint8).tolist() == [1, 0]


@pytest.mark.parametrize(
    "entry",
    [[0, 10**15], [8, 16], [-8, 0], [0, 4], "x", None],
    ids=["huge", "gap", "negative", "short", "text", "none"],
)
def test_forged_offsets_are_refused(entry, tmp_path):
    def change(members):
        header = json.dumps({"tree": {"dtype": "F64", "shape": [1], "data_offsets": entry}}).encode()
        return members | {"tensors.safetensors": len(header).to_bytes(8, "little") + header + bytes(8)}

    save_tree(tmp_path / "tree", th.zeros(1, dtype=th.float64))
    with pytest.raises(ValueError, match="Cannot load"):
        load_tree(edit(tmp_path / "tree", change))


def test_zip_bombs_are_refused(tmp_path):
    save_tree(tmp_path / "tree", 1)
    with (
        zipfile.ZipFile(tmp_path / "tree") as old,
        zipfile.ZipFile(tmp_path / "bomb", "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for name in old.namelist():
            new.writestr(name, old.read(name))
    with pytest.raises(ValueError, match="compressed"):
        load_tree(tmp_path / "bomb")


def test_a_newer_format_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(tree_file, "FORMAT", 2)
    save_tree(tmp_path / "tree", 1)
    monkeypatch.setattr(tree_file, "FORMAT", 1)
    with pytest.raises(ValueError, match="format number is 2, this sb3_said reads up to 1: upgrade"):
        load_tree(tmp_path / "tree")
