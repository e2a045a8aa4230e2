"""sb3-said card, from a clone."""

from sb3_said.zoo.cli import run

if __name__ == "__main__":
    run("card")
