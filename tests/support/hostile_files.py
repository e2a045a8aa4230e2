"""Hostile variants of saved files from a seeded generator: 2,000 in all, of which the suite draws a part.

Each is an agent, a policy, a replay or a checkpoint with one thing changed. A *sealed* one is sealed anew, as by a
forger who knows the format; nothing tells it from an honest file of another agent but what it holds. The others are
damaged or edited.
"""

import copy
import io
import json
import math
import zipfile

import numpy as np

from sb3_said.files.archive import seal

N_VARIANTS = 2000

NAMES = [
    "__class__",
    "log_ent_coef.__class__",
    "policy",
    "params",
    "../x",
    "/etc/passwd",
    "predict",
    "!tuple",
    "@",
    "",
    "0",
]
NUMBERS = [
    0,
    1,
    -1,
    3,
    625,
    10**6,
    10**9,
    2**31,
    2**63,
    10**30,
    0.5,
    -0.0,
    1e-300,
    1e30,
    1e308,
    math.nan,
    math.inf,
    -math.inf,
]
CLASSES = ["os.system", "builtins.eval", "torch.nn.ReLU", "torch.nn.Linear", "torch.nn.Softmax", "torch.optim.SGD",
           "torch.optim.LBFGS", "FlattenExtractor", "LinearSchedule", "ConstantSchedule", "FloatSchedule",
           "NormalActionNoise", "OrnsteinUhlenbeckActionNoise"]  # fmt: skip
# Settings that ask for memory or time, or that make a number that is not finite
CLAIMS = {
    "policy_kwargs": [
        {"n_critics": 10**9}, {"n_critics": 10**4}, {"net_arch": [10**5] * 4}, {"net_arch": [10**9]},
        {"net_arch": [8] * 10**5}, {"net_arch": {"pi": [8], "qf": [3000] * 100}}, {"net_arch": []},
        {"net_arch": [0, 0]}, {"net_arch": [-8]}, {"log_std_init": math.nan}, {"use_sde": True},
        {"activation_fn": {"@": ["torch.nn.GLU"]}}, {"optimizer_kwargs": {"lr": 1}},
        {"optimizer_kwargs": {"eps": math.nan}}, {"features_extractor_kwargs": {"a": 1}},
    ],
    "planner_kwargs": [
        {"depth": 10**9}, {"depth": 1000}, {"d_model": 2**30}, {"d_model": 16_384}, {"horizon": 10**9},
        {"horizon": 1000}, {"sampling_steps": 10**9}, {"sampling_steps": 100}, {"n_candidates": 10**9},
        {"n_candidates": 1000}, {"temperature": math.nan}, {"temperature": math.inf}, {"temperature": 1e38},
        {"choice_factor": math.inf}, {"betas": [math.nan, 1]}, {"mask": "fixed"}, {"precision": "float16"},
        {"weight_factor": "x"},
    ],
    "buffer_size": [10**9, 10**12, 0, -1, 1, 2.5], "n_envs": [10**6, 10**9, 0, -1, 10**12, True],
    "seed": [-1, 2**32, 2**64, "x"], "ent_coef": ["nan", "auto_nan", "inf", -1, "auto_-1", math.nan],
    "train_freq": [0, -1, [1, "x"], [1, "episode"], "step"], "gamma": [2, math.nan, "0.9", None],
    "target_entropy": ["nan", math.inf, [], "auto"], "stats_window_size": [10**12, 0, "x"],
    "learning_rate": [
        math.nan, -1, "x", {"@": ["LinearSchedule", 1, math.nan, 1]}, {"@": ["LinearSchedule", "1", 0, 1]},
        {"@": ["LinearSchedule", 1, 0, 0]}, {"@": ["FloatSchedule", {"@": ["torch.nn.ReLU"]}]},
        {"@": ["ConstantSchedule", []]},
    ],
    "action_noise": [
        {"@": ["NormalActionNoise", math.nan, 1, "<f4"]}, {"@": ["NormalActionNoise", 0.0, 1.0, "<U1000000000"]},
        {"@": ["NormalActionNoise", 0.0, -1.0, "<f4"]}, {"@": ["NormalActionNoise", [0.0] * 9, 1.0, "<f4"]},
    ],
}  # fmt: skip


def variant(files, index):
    """Return one variant.

    :param files: the bytes of each saved file, by its name
    :param index: in 0..N_VARIANTS - 1; it alone decides the variant
    :return: the file's name, whether it is sealed anew, what was changed, and its bytes
    """
    rng = np.random.default_rng([7, index])
    name = list(files)[rng.integers(len(files))]
    if rng.random() < 0.15:
        what, content = damaged(rng, files[name], files)
        return name, False, what, content
    document, members = opened(files[name])
    change = STRUCTURAL[rng.choice(len(STRUCTURAL), p=WEIGHTS)]
    what = change(rng, document, members)
    if "tree.json" not in members:
        members = {"tree.json": json.dumps(document).encode(), **members}
    sealed = bool(rng.random() < 0.8)
    return (
        name,
        sealed,
        f"{change.__name__}: {what}"[:200],
        zipped(members, sealed, zipfile.ZipFile(io.BytesIO(files[name])).comment),
    )


def opened(content):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    return json.loads(members.pop("tree.json")), members


def zipped(members, sealed, comment, compression=zipfile.ZIP_STORED):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content, compression)
        archive.comment = seal(archive) if sealed else comment
    return file.getvalue()


# ---------------------------------------------------------------------------------------------------- the document


def places(rng, document):
    """Walk down to a random place, each level as likely as the others: (container, key, path)."""
    container, key, path = document, "tree", "tree"
    while isinstance(container[key], (dict, list)) and container[key] and rng.random() < 0.9:
        container = container[key]
        key = (
            list(container)[rng.integers(len(container))]
            if isinstance(container, dict)
            else int(rng.integers(len(container)))
        )
        path += f"/{key}"
    return container, key, path


def any_value(rng, old):
    number = NUMBERS[rng.integers(len(NUMBERS))]
    nested = 1.0
    for _ in range(int(10 ** rng.uniform(0, 2.9))):
        nested = [nested]
    choices = [
        None, True, False, number, number, number, NAMES[rng.integers(len(NAMES))], [], {}, nested, [old], {"a": old},
        {"!tuple": [old]}, {"!array": "tensor"}, {"!dict": [[1, old], [1, old]]}, {"!dict": [[[], old]]}, "x" * 10**5,
        {"@": [CLASSES[rng.integers(len(CLASSES))], *[number] * int(rng.integers(4))]}, [number] * 10**4, "nan",
        "1e999",
    ]  # fmt: skip
    if type(old) in (int, float):
        choices += [old * 1000, -old, old + 1, float(old), str(old), old * 10**9] * 2
    return choices[rng.integers(len(choices))]


def other_value(rng, document, members):
    container, key, path = places(rng, document)
    container[key] = any_value(rng, container[key])
    return f"{path} = {container[key]!r:.60}"


def other_key(rng, document, members):
    container, key, path = places(rng, document)
    if isinstance(container, list):
        container.insert(key, copy.deepcopy(container[rng.integers(len(container))]))
        return f"{path} doubled"
    value, how = container[key], rng.integers(3)
    if how < 2:
        del container[key]
    if how > 0:
        container[NAMES[rng.integers(len(NAMES))]] = value
    return f"{path} {('removed', 'renamed', 'doubled')[how]}"


def other_head(rng, document, members):
    key = ("format", "kind", "versions", "metadata")[rng.integers(4)]
    document[key] = any_value(rng, document[key])
    return f"{key} = {document[key]!r:.60}"


def claim(rng, document, members):
    name = list(CLAIMS)[rng.integers(len(CLAIMS))]
    value = CLAIMS[name][rng.integers(len(CLAIMS[name]))]
    tree = document["tree"]
    if "arguments" not in tree:  # a replay or a checkpoint
        return other_numbers(rng, document, members)
    place = tree if name == "n_envs" else tree["arguments"]
    if name == "planner_kwargs" or (name == "policy_kwargs" and "state_dict" not in tree):
        place = place.setdefault(name, {})  # a policy has its own arguments beside the planner's
    if isinstance(value, dict) and "@" not in value:
        place.update(value)
    else:
        place[name] = value
    return f"{name} {value!r:.80}"


def other_class(rng, document, members):
    found = []

    def walk(node):
        for item in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
            if isinstance(item, dict) and "@" in item:
                found.append(item)
            walk(item)

    walk(document["tree"])
    if not found:
        return other_value(rng, document, members)
    node = found[rng.integers(len(found))]
    node["@"] = [CLASSES[rng.integers(len(CLASSES))], *node["@"][1:]]
    return f"class {node['@'][0]}"


def counters(rng, document, members):
    tree = document["tree"]
    part = tree.get("counters") or tree.get("evaluations", [{}])[0] or tree
    key = list(part)[rng.integers(len(part))]
    part[key] = [-1, 2**40, 2**63, 10**30, 1.5, "3", None, [10**9], [-1], [0.5], math.nan, True][rng.integers(12)]
    return f"{key} = {part[key]!r:.60}"


def random_position(rng, document, members):
    """Of a checkpoint's random states; of the others' any number."""
    state = document["tree"].get("random")
    if state is None:
        return other_value(rng, document, members)
    rows = [state["python"]["!tuple"], state["numpy"]]
    row = rows[rng.integers(2)]
    index = int(rng.integers(len(row)))
    if isinstance(row[index], dict) and "!tuple" in row[index]:
        row, index = row[index]["!tuple"], -1
    row[index] = NUMBERS[rng.integers(len(NUMBERS))]
    return f"random[{index}] = {row[index]!r:.40}"


# ---------------------------------------------------------------------------------------------------- the arrays


def header_of(content):
    length = 10 + int.from_bytes(content[8:10], "little")
    return content[:length], content[length:]


def npy(text, data):
    text = text if isinstance(text, bytes) else text.encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


def one_array(rng, members):
    names = [name for name in members if name.endswith(".npy")]
    return names[rng.integers(len(names))]


def other_numbers(rng, document, members):
    name = one_array(rng, members)
    array = np.load(io.BytesIO(members[name])).copy()
    how = ("nan", "inf", "1e38", "times 1000", "negative", "zeros", "bytes")[rng.integers(7)]
    flat, is_float = array.reshape(-1), array.dtype.kind == "f"
    with np.errstate(all="ignore"):
        if how == "bytes":
            flat[:] = np.frombuffer(rng.bytes(array.nbytes), array.dtype)
        elif how in ("nan", "inf", "1e38") and is_float and array.size:
            flat[rng.integers(array.size)] = float(how)
        else:
            factor = {"times 1000": 1000.0, "negative": -1.0}.get(how, 0.0)
            flat[:] = (flat * factor).astype(array.dtype)
    members[name] = saved_array(array)
    return f"{name} {how}"


def saved_array(array):
    file = io.BytesIO()
    np.lib.format.write_array(file, array, version=(1, 0), allow_pickle=False)
    return file.getvalue()


def scaled_bounds(rng, document, members):
    """Of a policy's or agent's spaces, which are named in the document; elsewhere any array."""
    spaces = document["tree"].get("spaces")
    if spaces is None:
        return other_numbers(rng, document, members)
    before = json.dumps(document["tree"]).split('"spaces"')[0].count('"!array"')
    n = json.dumps(spaces).count('"!array"')
    first = before + int(rng.integers(n // 2)) * 2
    for name in (f"{first}.npy", f"{first + 1}.npy"):
        array = np.load(io.BytesIO(members[name]))
        members[name] = saved_array((array * 1000).astype(array.dtype))
    return f"bounds {first} times 1000"


def other_header(rng, document, members):
    name = one_array(rng, members)
    _, data = header_of(members[name])
    array = np.load(io.BytesIO(members[name]))
    dtypes = ["<i4", "<f4", "<f8", "<f2", "<i8", "|b1", ">f4", "|O", "|V4", "<c8", "<U1", "|u1", "<M8[s]", "<u4"]
    shapes = [
        (0,),
        (10**9,),
        (10**9, 0),
        (0, 10**18),
        (-1,),
        (*array.shape, 1),
        array.shape[::-1],
        (array.size,),
        (1, 1, 1, 1),
        (2**40, 2**40),
        (),
    ]
    dtype, shape = array.dtype.str, array.shape
    if (how := rng.integers(4)) in (0, 2):
        dtype = dtypes[rng.integers(len(dtypes))]
    if how in (1, 2):
        shape = shapes[rng.integers(len(shapes))]
    if how < 3:
        text = f"{{'descr': {dtype!r}, 'fortran_order': {bool(rng.random() < 0.2)}, 'shape': {shape}, }}"
    else:
        text = [
            "",
            "{",
            "(" * 500,
            "{'descr': '<f4'}",
            "[]",
            "__import__('os').system('true')",
            "{'shape': " + "9" * 900 + "}",
        ][rng.integers(7)]
    members[name] = npy(text, data[: len(data) // 2] if rng.random() < 0.1 else b"" if rng.random() < 0.1 else data)
    return f"{name} {text}"


def other_members(rng, document, members):
    name, other = one_array(rng, members), one_array(rng, members)
    how = ("removed", "renamed", "exchanged", "added", "emptied", "repeated")[rng.integers(6)]
    if how == "removed":
        del members[name]
    elif how == "renamed":
        members[["../0.npy", "/tmp/x.npy", "data", "x.pkl", "00.npy", "0.npy/../1.npy"][rng.integers(6)]] = members.pop(
            name
        )
    elif how == "exchanged":
        members[name], members[other] = members[other], members[name]
    elif how == "added":
        members[f"{len(members)}.npy"] = members[name]
    elif how == "emptied":
        members[name] = b""
    else:
        members[name] *= 2
    return f"{name} {how}"


STRUCTURAL = [other_value, other_key, other_head, claim, other_class, counters, random_position, other_numbers,
              scaled_bounds, other_header, other_members]  # fmt: skip
WEIGHTS = np.array([6, 2, 0.5, 4, 1, 1.5, 1.5, 3, 1, 3, 1.5])
WEIGHTS = WEIGHTS / WEIGHTS.sum()


# ---------------------------------------------------------------------------------------------------- the bytes


def damaged(rng, content, files):
    how = ("flipped", "cut", "zeroed", "inserted", "joined", "compressed", "bomb", "moved", "noise")[rng.integers(9)]
    data, at = bytearray(content), int(rng.integers(len(content)))
    if how == "flipped":
        for place in rng.integers(len(data), size=int(rng.integers(1, 4))):
            data[place] ^= int(rng.integers(1, 256))
    elif how == "cut":
        del data[at:]
    elif how == "zeroed":
        data[at : at + 64] = bytes(len(data[at : at + 64]))
    elif how == "inserted":
        data[at:at] = rng.bytes(int(rng.integers(1, 40)))
    elif how == "joined":
        data += list(files.values())[rng.integers(len(files))]
    elif how == "moved":
        data[at:] = data[at:][::-1]
    elif how == "noise":
        data = bytearray(rng.bytes(len(content)))
    else:
        document, members = opened(content)
        comment = zipfile.ZipFile(io.BytesIO(content)).comment
        text = json.dumps(document)
        if how == "bomb":
            text += " " * 3 * 10**7
        data = zipped({"tree.json": text.encode(), **members}, True, comment, zipfile.ZIP_DEFLATED)
    return how, bytes(data)
