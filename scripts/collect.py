"""sb3-said collect, from a clone."""

from sb3_said.zoo.cli import run

if __name__ == "__main__":
    run("collect")
