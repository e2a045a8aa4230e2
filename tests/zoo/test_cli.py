"""The command sb3-said: it teaches, it names itself, it says what is missing; and what the wheel holds."""

from __future__ import annotations

import runpy
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path

import pytest

from sb3_said.zoo import cli

ROOT = Path(__file__).resolve().parents[2]


def call(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["/somewhere/bin/sb3-said", *words])
    cli.main()


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"]])
def test_help_names_every_command(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    call(monkeypatch, *words)
    shown = capsys.readouterr().out
    assert all(f"\n  {name} " in shown for name in cli.COMMANDS)


def test_an_unknown_command_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit, match="no command 'play', expected one of train, evaluate"):
        call(monkeypatch, "play")


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_a_command_teaches_by_its_own_name(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rl_zoo3")
    with pytest.raises(SystemExit) as stop:
        call(monkeypatch, name, "--help")
    shown = capsys.readouterr().out
    assert stop.value.code == 0 and f"usage: sb3-said {name} " in shown and f"\n  sb3-said {name} " in shown
    assert "scripts/" not in shown
    bad = {"train": ["--preset", "fast"], "tune": ["x", "--prune", "2"], "over-delays": ["--json", "x"]}
    with pytest.raises(SystemExit) as stop:
        call(monkeypatch, name, *bad.get(name, ["nowhere", "--record", "x.gif"][: 1 if name == "evaluate" else 3]))
    assert stop.value.code == 2 and f"sb3-said {name}: error: " in capsys.readouterr().err


@pytest.mark.parametrize(
    "start", ["import sb3_said.zoo.cli as cli; cli.main()", "import runpy; runpy.run_path({}, run_name='__main__')"]
)
def test_without_the_extra_it_says_what_to_install(start: str) -> None:
    code = "import sys; sys.modules['rl_zoo3'] = None; sys.argv = ['sb3-said', 'train']\n"
    code += start.format(repr(str(ROOT / "scripts" / "train.py")))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert done.returncode == 1 and done.stderr == (
        'rl_zoo3 is missing, which sb3-said train needs: pip install "sb3_said[zoo]"\n'
    )


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_a_clone_has_a_script_of_each_command(name: str) -> None:
    script = ROOT / "scripts" / f"{name.replace('-', '_')}.py"
    started: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "run", started.append)
        runpy.run_path(str(script), run_name="__main__")
    assert started == [name]


def test_ctrl_c_while_it_imports_is_no_traceback() -> None:
    code = "import importlib, signal, sys; sys.argv = ['sb3-said', 'evaluate']\n"
    code += "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "importlib.import_module = lambda name: signal.raise_signal(signal.SIGINT)\n"
    code += "from sb3_said.zoo.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert done.returncode == 130 and done.stderr == "\nInterrupted.\n"


def test_the_wheel_holds_every_package_and_the_presets() -> None:
    setup = ConfigParser()
    setup.read(ROOT / "setup.cfg")
    listed = setup["options"]["packages"].split()
    found = {str(path.parent.relative_to(ROOT)).replace("/", ".") for path in ROOT.glob("sb3_said/**/__init__.py")}
    assert {*listed} == found | {"sb3_said.zoo.configs"}, "setup.cfg lists other packages than there are"
    assert setup["options"]["package_dir"].split() == ["sb3_said.zoo.configs", "=", "zoo_configs"]
    assert setup["options.package_data"]["sb3_said.zoo.configs"].strip() == "*.yml"
