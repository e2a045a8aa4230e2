"""sb3-said tune, from a clone."""

from sb3_said.zoo.tune import main

if __name__ == "__main__":
    main()
