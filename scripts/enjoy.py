"""sb3-said enjoy, from a clone."""

from sb3_said.zoo.cli import run

if __name__ == "__main__":
    run("enjoy")
