"""sb3-said decide, from a clone."""

from sb3_said.zoo.decide import main

if __name__ == "__main__":
    main()
