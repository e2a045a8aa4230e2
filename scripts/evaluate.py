"""sb3-said evaluate, from a clone."""

from sb3_said.zoo.evaluate import main

if __name__ == "__main__":
    main()
