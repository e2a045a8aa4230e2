"""What an import brings along, and which room may import which."""

import ast
import functools
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

import sb3_said

PACKAGE = Path(sb3_said.__file__).parent
#: The arrows of docs/design.md
MAY_IMPORT = {
    "delays": set(),
    "replay": {"delays"},
    "planner": {"replay"},
    "files": set(),
    "sac": {"delays", "replay", "files"},
    "said": {"delays", "replay", "planner", "files", "sac", "offline"},
    "offline": {"delays", "replay", "planner", "files", "sac"},
    "evaluation": set(),
    "realtime": {"delays"},
    "zoo": {"", "delays", "replay", "planner", "files", "sac", "said", "offline", "evaluation", "realtime"},
}


@functools.cache
def imports_of(file):
    """Return the modules of this package that a file imports, at any place, for type checking too."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.split(".")[0] == "sb3_said"}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "sb3_said":
            for alias in node.names:
                whole = PACKAGE.parent.joinpath(*node.module.split("."), f"{alias.name}.py")
                found.add(f"{node.module}.{alias.name}" if whole.exists() else node.module)
    return found


def test_rooms_import_as_the_design_says():
    rooms = {folder.name for folder in PACKAGE.iterdir() if (folder / "__init__.py").exists()}
    assert rooms == set(MAY_IMPORT)
    for room, allowed in MAY_IMPORT.items():
        found = {
            f"{name}.".split(".")[1]: file.name for file in (PACKAGE / room).glob("*.py") for name in imports_of(file)
        }
        assert set(found) - {room} <= allowed, (room, found)


def test_no_modules_import_each_other_in_a_circle():
    graph = {}
    for file in PACKAGE.glob("*/*.py"):
        name = ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
        graph[name] = imports_of(file) - {"sb3_said"}
    assert len(graph) > 30
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError


@pytest.mark.parametrize(
    ("statement", "without"),
    [
        ("from sb3_said import DelayedObservationWrapper", {"torch", "stable_baselines3"}),
        ("import sb3_said.planner", {"stable_baselines3", "gymnasium"}),
        ("import sb3_said; sb3_said.evaluation.rollout", {"torch", "stable_baselines3", "matplotlib"}),
        ("import sb3_said.realtime", {"torch", "stable_baselines3"}),
    ],
)
def test_a_room_does_without_what_it_does_not_need(statement, without):
    code = f"import sys\n{statement}\nprint(*{without!r} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == []


def test_public_names_are_those_of_their_folders():
    from sb3_said import delays, planner, sac, said

    homes = [delays, planner, sac, said]
    for name in sb3_said.__all__:
        assert [getattr(sb3_said, name)] == [getattr(home, name) for home in homes if hasattr(home, name)][:1]
        assert name in dir(sb3_said)
    with pytest.raises(AttributeError, match="module 'sb3_said' has no attribute 'SAIDD'"):
        sb3_said.SAIDD  # noqa: B018


def test_every_room_is_reachable_from_the_package():
    for room in MAY_IMPORT:
        assert getattr(sb3_said, room).__name__ == f"sb3_said.{room}"
