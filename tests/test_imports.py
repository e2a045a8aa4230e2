"""What an import brings along."""

import subprocess
import sys

import pytest

import sb3_said


@pytest.mark.parametrize(
    "statement", ["import sb3_said.delays", "from sb3_said import DelayedObservationWrapper", "import sb3_said"]
)
def test_the_delayed_world_does_without_torch(statement):
    code = f"import sys\n{statement}\nassert not {{'torch', 'stable_baselines3'}} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_public_names_are_those_of_their_folders():
    from sb3_said import delays, planner, sac, said

    homes = [delays, planner, sac, said]
    for name in sb3_said.__all__:
        assert [getattr(sb3_said, name)] == [getattr(home, name) for home in homes if hasattr(home, name)][:1]
        assert name in dir(sb3_said)
    with pytest.raises(AttributeError, match="module 'sb3_said' has no attribute 'SAIDD'"):
        sb3_said.SAIDD  # noqa: B018
